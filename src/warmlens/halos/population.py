"""One halo with its subhaloes: tree, stripping, structure and positions put together."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.halos.barrier import jeans_mass
from warmlens.halos.concentration import ConcentrationRelation, FormationHistory
from warmlens.halos.merger_tree import MergerTree, branching_table, grow_tree
from warmlens.halos.positions import draw_nfw_radii, project_isotropically
from warmlens.halos.power_spectrum import SharpKVariance, cdm_power, sharp_k_variance
from warmlens.halos.profiles import (
    infall_structure,
    nfw_norm,
    nfw_parameters,
    tidal_tracks,
    truncation,
)
from warmlens.halos.stripping import TidalField, draw_circularity, friction_ln_a
from warmlens.types import BoolArray, FloatArray, IntArray

MASS_BINS: FloatArray = np.linspace(6.0, 14.0, 81)  # log10(m/Msun)
VMAX_BINS: FloatArray = np.geomspace(1.0, 1000.0, 61)  # v_max [km/s]
MASS_BINS.flags.writeable = False
VMAX_BINS.flags.writeable = False


@dataclass(frozen=True)
class HaloModel:
    """Choices and coefficients of the subhalo physics; the defaults are those of Birrer et al. 2017.

    Attributes
    ----------
    tau_dyn
        Dynamical time of tidal stripping, see `warmlens.halos.stripping.loss_per_efold`.
    positions
        "nfw_host": subhaloes follow the NFW profile of the host at the lens. "nfw_infall": that of the
        host when each was accreted.
    branching
        (G0, gamma1, gamma2) of Parkinson, Cole & Helly 2008.
    barrier_factor, sharp_k_a
        Factor of the collapse threshold and k_s R of the sharp-k filter (Benson et al. 2013).
    stripping_amplitude, stripping_slope
        A_ts and zeta of tidal stripping.
    min_mass_msun
        Floor of the tree's resolution, and smallest bound mass of a subhalo [Msun].
    friction_amplitude, friction_mass_slope, friction_circularity_slope
        A_df, b_df and c_df of dynamical friction.
    concentration_amplitude, concentration_mass_slope, concentration_redshift_slope
        A_c, B_c and C_c of the concentration of cold haloes.
    concentration_pivot_msun, concentration_min
        Pivot mass [Msun] of that relation and smallest concentration.
    formation_mass_cap_msun
        Heaviest cold halo [Msun] to which a warm halo is mapped for its concentration.
    z_max
        Redshift at which the tree ends.
    """

    tau_dyn: Literal["paper", "jvdb16"] = "paper"
    positions: Literal["nfw_host", "nfw_infall"] = "nfw_host"
    branching: tuple[float, float, float] = (0.57, 0.38, -0.01)
    barrier_factor: float = 1.197
    sharp_k_a: float = 2.5
    stripping_amplitude: float = 1.54
    stripping_slope: float = 0.07
    min_mass_msun: float = 1.0e7
    friction_amplitude: float = 0.216
    friction_mass_slope: float = 1.3
    friction_circularity_slope: float = 1.9
    concentration_amplitude: float = 5.22
    concentration_mass_slope: float = -0.072
    concentration_redshift_slope: float = -0.42
    concentration_pivot_msun: float = 2.0e12
    concentration_min: float = 1.5
    formation_mass_cap_msun: float = 1.0e16
    z_max: float = 20.0

    def __post_init__(self) -> None:
        if self.tau_dyn not in ("paper", "jvdb16"):
            raise ValueError(f'tau_dyn must be "paper" or "jvdb16", got {self.tau_dyn!r}')
        if self.positions not in ("nfw_host", "nfw_infall"):
            raise ValueError(f'positions must be "nfw_host" or "nfw_infall", got {self.positions!r}')
        for name in (
            "barrier_factor",
            "sharp_k_a",
            "stripping_slope",
            "min_mass_msun",
            "concentration_amplitude",
            "concentration_pivot_msun",
            "concentration_min",
            "formation_mass_cap_msun",
            "z_max",
        ):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be finite and > 0, got {value!r}")
        for name in ("stripping_amplitude", "friction_amplitude"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and >= 0, got {value!r}")


@dataclass(frozen=True)
class Subhalos:
    """Subhaloes, one entry each in every array.

    Attributes
    ----------
    m_bound, m_acc
        Bound mass at the lens and M200c at infall [Msun].
    z_acc
        Redshift of infall.
    concentration
        R200c/r_s at infall.
    r_max_kpc, v_max_kms
        Peak of the circular velocity at the lens, after tidal stripping.
    r_s_kpc, rho_s, r_t_kpc
        Scale radius [kpc], scale density [Msun/kpc^3] and truncation radius [kpc] of the profile
        rho_s / [x (1+x)^2] tau^2 / (tau^2 + x^2), x = r/r_s, tau = r_t/r_s, whose mass is m_bound.
    x_arcsec, y_arcsec
        Position on the sky relative to the centre of the host.
    """

    m_bound: FloatArray
    m_acc: FloatArray
    z_acc: FloatArray
    concentration: FloatArray
    r_max_kpc: FloatArray
    v_max_kms: FloatArray
    r_s_kpc: FloatArray
    rho_s: FloatArray
    r_t_kpc: FloatArray
    x_arcsec: FloatArray
    y_arcsec: FloatArray


@dataclass(frozen=True)
class HaloRealization:
    """One drawn halo.

    Attributes
    ----------
    subhalos
        Subhaloes inside the field |x|, |y| <= half_width_arcsec.
    n_accreted
        Haloes accreted above the resolution; the sum of the next three.
    n_friction, n_stripped_below, n_surviving
        Of these: lost to dynamical friction, stripped below min_mass_msun, and left (in the whole halo).
    f_sub
        Mass of all survivors over the mass of the halo.
    cumulative_mass_function
        Survivors with log10(m_bound) above each of `MASS_BINS`.
    cumulative_vmax_function
        Survivors with v_max above each of `VMAX_BINS`.
    tree_steps
        Steps of the merger tree.
    z_half
        Redshift at which the trunk had half its mass.
    """

    subhalos: Subhalos
    n_accreted: int
    n_friction: int
    n_stripped_below: int
    n_surviving: int
    f_sub: float
    cumulative_mass_function: IntArray
    cumulative_vmax_function: IntArray
    tree_steps: int
    z_half: float


class HaloGenerator:
    """Draws haloes with subhaloes; holds the tables that are the same for every sample.

    Parameters
    ----------
    cosmology
        Background and cold power spectrum.
    geometry
        Redshifts and distances of the lens; the tree is rooted at the lens.
    model
        Subhalo physics.
    """

    def __init__(self, cosmology: Cosmology, geometry: LensGeometry, model: HaloModel) -> None:
        if not model.z_max > geometry.z_lens:
            raise ValueError(f"z_max must exceed z_lens = {geometry.z_lens!r}, got {model.z_max!r}")
        self.cosmology = cosmology
        self.geometry = geometry
        self.model = model
        self._cold_concentration = ConcentrationRelation(
            model.concentration_amplitude,
            model.concentration_mass_slope,
            model.concentration_redshift_slope,
            model.concentration_pivot_msun,
            model.concentration_min,
        )
        self._spectrum = cdm_power(cosmology)
        self._formation = FormationHistory.of_cold_haloes(self.variance(math.inf), model.formation_mass_cap_msun)

    def variance(self, m_th_kev: float) -> SharpKVariance:
        """Variance S(M) of a thermal relic of the given mass [keV]; inf for cold dark matter."""
        return sharp_k_variance(m_th_kev, self._spectrum, self.cosmology, self.model.sharp_k_a)

    def resolution(self, m_th_kev: float) -> float:
        """Smallest mass [Msun] that trees of the given relic [keV] follow."""
        return max(jeans_mass(m_th_kev, self.cosmology), self.model.min_mass_msun)

    def draw(
        self, m_th_kev: float, m_halo_msun: float, half_width_arcsec: float, rng: np.random.Generator
    ) -> HaloRealization:
        """Draw one halo.

        Parameters
        ----------
        m_th_kev
            Mass of the thermal relic [keV], > 0; inf for cold dark matter.
        m_halo_msun
            M200c of the host at the redshift of the lens [Msun]; more than twice the resolution.
        half_width_arcsec
            Half the side of the square field whose subhaloes are kept [arcsec].
        rng
            Source of every random number.
        """
        if not half_width_arcsec > 0.0:
            raise ValueError(f"half_width_arcsec must be > 0, got {half_width_arcsec!r}")
        variance, tree = self._grow(m_th_kev, m_halo_msun, rng)
        ln_a = -np.log1p(self.cosmology.clock_to_redshift(tree.clock_acc))
        m_bound, sunk = self._evolve(tree, ln_a, rng)
        light = ~sunk & (m_bound < self.model.min_mass_msun)
        left = ~(sunk | light)
        survivors = self._describe(variance, tree, ln_a, m_bound, left, rng)
        inside = np.maximum(np.abs(survivors.x_arcsec), np.abs(survivors.y_arcsec)) <= half_width_arcsec
        return HaloRealization(
            subhalos=_select(survivors, inside),
            n_accreted=tree.m_acc_msun.size,
            n_friction=int(sunk.sum()),
            n_stripped_below=int(light.sum()),
            n_surviving=int(left.sum()),
            f_sub=float(survivors.m_bound.sum() / m_halo_msun),
            cumulative_mass_function=_count_above(survivors.m_bound, 10.0**MASS_BINS),
            cumulative_vmax_function=_count_above(survivors.v_max_kms, VMAX_BINS),
            tree_steps=tree.steps,
            z_half=float(self.cosmology.clock_to_redshift(tree.half_mass_clock)),
        )

    def tree(self, m_th_kev: float, m_halo_msun: float, rng: np.random.Generator) -> MergerTree:
        """Draw the merger tree alone; parameters as in `draw`."""
        return self._grow(m_th_kev, m_halo_msun, rng)[1]

    def _grow(
        self, m_th_kev: float, m_halo_msun: float, rng: np.random.Generator
    ) -> tuple[SharpKVariance, MergerTree]:
        if not m_th_kev > 0.0:
            raise ValueError(f"m_th_kev must be > 0 (inf for cold dark matter), got {m_th_kev!r}")
        resolution = self.resolution(m_th_kev)
        if not 2.0 * resolution < m_halo_msun < math.inf:
            raise ValueError(
                f"m_halo_msun must be finite and exceed {2.0 * resolution:.6g} Msun, twice the resolution "
                f"at m_th_kev = {m_th_kev!r}, got {m_halo_msun!r}"
            )
        model, clock = self.model, self.cosmology.collapse_clock
        variance = self.variance(m_th_kev)
        table = branching_table(
            variance,
            m_halo_msun,
            resolution,
            model.branching,
            model.barrier_factor,
            jeans_mass(m_th_kev, self.cosmology),
        )
        return variance, grow_tree(table, float(clock(self.geometry.z_lens)), float(clock(model.z_max)), rng)

    def _evolve(
        self, tree: MergerTree, ln_a_acc: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, BoolArray]:
        """Bound masses at the lens [Msun], and which subhaloes dynamical friction has removed."""
        model = self.model
        circularity = draw_circularity(tree.m_acc_msun.size, rng)
        mass_ratio = tree.host_mass_msun / tree.m_acc_msun
        ln_a_sunk = friction_ln_a(
            ln_a_acc,
            mass_ratio,
            circularity,
            model.friction_amplitude,
            model.friction_mass_slope,
            model.friction_circularity_slope,
        )
        ln_a_trunk = -np.log1p(self.cosmology.clock_to_redshift(tree.trunk_clock))
        field = TidalField.of_host(
            ln_a_trunk[::-1],
            np.log(tree.trunk_mass_msun[::-1]),
            model.stripping_amplitude,
            model.stripping_slope,
            model.tau_dyn,
            self.cosmology,
        )
        return field.bound_mass(tree.m_acc_msun, ln_a_acc), ln_a_sunk < ln_a_trunk[0]

    def _describe(
        self,
        variance: SharpKVariance,
        tree: MergerTree,
        ln_a_acc: FloatArray,
        m_bound: FloatArray,
        left: BoolArray,
        rng: np.random.Generator,
    ) -> Subhalos:
        """Structure and positions of the subhaloes that are left."""
        m_acc, m_bound = tree.m_acc_msun[left], m_bound[left]
        z_acc = np.expm1(-ln_a_acc[left])
        concentration = self._cold_concentration(self._formation.matching_mass(variance, m_acc), z_acc)
        r_infall, v_infall = infall_structure(m_acc, z_acc, concentration, self.cosmology)
        r_ratio, v_ratio = tidal_tracks(m_bound / m_acc)
        r_max, v_max = r_infall * r_ratio, v_infall * v_ratio
        r_s, rho_s = nfw_parameters(r_max, v_max)
        r_t = r_s * truncation(m_bound / nfw_norm(r_s, rho_s))

        if self.model.positions == "nfw_host":
            host_mass = np.full(m_acc.size, tree.trunk_mass_msun[0])
            host_z = np.full(m_acc.size, self.geometry.z_lens)
        else:
            host_mass, host_z = tree.host_mass_msun[left], z_acc
        radii = draw_nfw_radii(
            self.cosmology.radius_200c(host_mass, host_z),
            self._cold_concentration(host_mass, host_z),
            m_acc.size,
            rng,
        )
        x, y = project_isotropically(radii / self.geometry.kpc_per_arcsec, rng)
        return Subhalos(m_bound, m_acc, z_acc, concentration, r_max, v_max, r_s, rho_s, r_t, x, y)


def _select(subhalos: Subhalos, inside: BoolArray) -> Subhalos:
    return Subhalos(**{name: values[inside] for name, values in vars(subhalos).items()})


def _count_above(values: FloatArray, thresholds: FloatArray) -> IntArray:
    return values.size - np.searchsorted(np.sort(values), thresholds, side="right")
