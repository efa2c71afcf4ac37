"""The population of subhalos in a whole halo: its tree, which subhalos survive, and the structure of these."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np

from warmlens.cosmology import Cosmology
from warmlens.halos.concentration import ConcentrationRelation, FormationHistory, scatter_concentration
from warmlens.halos.dark_matter import ColdDarkMatter, DarkMatter
from warmlens.halos.merger_tree import MergerTree, branching_table, grow_tree
from warmlens.halos.model import HaloModel
from warmlens.halos.positions import draw_nfw_radii, draw_orbit_radii
from warmlens.halos.power_spectrum import SharpKVariance, cdm_power, filtered_variance
from warmlens.halos.profiles import infall_structure, nfw_norm, nfw_parameters, tidal_tracks, truncation
from warmlens.halos.stripping import TidalField, draw_circularity, friction_ln_a
from warmlens.types import BoolArray, FloatArray, IntArray

MASS_BINS: FloatArray = np.linspace(6.0, 14.0, 81)  # log10(m/Msun)
VMAX_BINS: FloatArray = np.geomspace(1.0, 1000.0, 61)  # v_max [km/s]
MASS_BINS.flags.writeable = False
VMAX_BINS.flags.writeable = False

_MODELS_CACHED = 8  # dark-matter models whose variance is kept


@dataclass(frozen=True)
class SubhaloStructure:
    """Masses and profiles of subhalos, one entry each in every array.

    Attributes
    ----------
    m_bound, m_acc
        Bound mass when observed and M200c at infall [Msun].
    z_acc
        Redshift of infall.
    concentration
        R200c/r_s at infall.
    r_max_kpc, v_max_kms
        Peak of the circular velocity when observed, after tidal stripping.
    r_s_kpc, rho_s, r_t_kpc
        Scale radius [kpc], scale density [Msun/kpc^3] and truncation radius [kpc] of the profile
        rho_s / [x (1+x)^2] tau^2 / (tau^2 + x^2), x = r/r_s, tau = r_t/r_s, whose mass is m_bound.
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


@dataclass(frozen=True)
class WholeHalo(SubhaloStructure):
    """One halo with all its surviving subhalos."""

    # M200c of the host [Msun] and the redshift at which it has that mass and subhalos are observed
    m_halo_msun: float
    z_root: float
    # Of each subhalo: that of its orbit at infall, and its distance from the centre of the host
    circularity: FloatArray
    radius_kpc: FloatArray
    n_accreted: int  # halos accreted above the resolution: lost to dynamical friction, stripped or surviving
    # Of these: lost to dynamical friction, and stripped below min_mass_msun
    n_friction: int
    n_stripped_below: int
    tree_steps: int  # steps of the merger tree
    z_half: float  # redshift at which the trunk had half its mass

    @property
    def n_surviving(self) -> int:
        """Number of subhalos left."""
        return self.m_bound.size

    @property
    def f_sub(self) -> float:
        """Mass of all survivors over the mass of the halo."""
        return float(self.m_bound.sum() / self.m_halo_msun)

    @property
    def cumulative_mass_function(self) -> IntArray:
        """Survivors with log10(m_bound) above each of `MASS_BINS`."""
        return _count_above(self.m_bound, 10.0**MASS_BINS)

    @property
    def cumulative_vmax_function(self) -> IntArray:
        """Survivors with v_max above each of `VMAX_BINS`."""
        return _count_above(self.v_max_kms, VMAX_BINS)


class HaloPopulation:
    """Generator of whole halos at one redshift; its tables are computed once.

    Parameters
    ----------
    cosmology
        Background and cold power spectrum.
    z_root
        Redshift at which hosts have their mass and subhalos are observed; 0 <= z_root < model.z_max.
    model
        Subhalo physics.
    """

    def __init__(self, cosmology: Cosmology, z_root: float, model: HaloModel) -> None:
        if not 0.0 <= z_root < model.z_max:
            raise ValueError(f"z_root must be >= 0 and below z_max = {model.z_max!r}, got {z_root!r}")
        self.cosmology = cosmology
        self.z_root = z_root
        self.model = model
        self.cold_concentration = _cold_concentration(model, cosmology)
        self._spectrum = cdm_power(cosmology)
        self._variances = lru_cache(_MODELS_CACHED)(self._tabulate_variance)
        cold = self.variance(ColdDarkMatter())
        self._formation = FormationHistory.of_cold_halos(cold, model.formation_mass_cap_msun)

    def variance(self, dark_matter: DarkMatter) -> SharpKVariance:
        """Return the variance S(M) of the dark matter, cached for the models used last."""
        return self._variances(dark_matter)

    def resolution_msun(self, dark_matter: DarkMatter) -> float:
        """Return the smallest mass [Msun] that trees follow: that of the dark matter, or min_mass_msun."""
        resolution = dark_matter.resolution_msun
        if not 0.0 <= resolution < math.inf:
            raise ValueError(f"resolution_msun of {dark_matter.label} must be finite and >= 0, got {resolution!r}")
        return max(resolution, self.model.min_mass_msun)

    def lightest_host_msun(self, dark_matter: DarkMatter) -> float:
        """Return the mass [Msun] up to which a host has no two progenitors above the resolution."""
        return 2.0 * self.resolution_msun(dark_matter)

    def tree(self, dark_matter: DarkMatter, m_halo_msun: float, rng: np.random.Generator) -> MergerTree:
        """Draw the merger tree alone; parameters as in `draw`, for a host above `lightest_host_msun`."""
        resolution, lightest = self.resolution_msun(dark_matter), self.lightest_host_msun(dark_matter)
        if not lightest < m_halo_msun < math.inf:
            raise ValueError(
                f"m_halo_msun must be finite and exceed {lightest:.6g} Msun, twice the resolution "
                f"for {dark_matter.label}, got {m_halo_msun!r}"
            )
        model, clock = self.model, self.cosmology.collapse_clock
        table = branching_table(
            self.variance(dark_matter),
            m_halo_msun,
            resolution,
            model.branching,
            model.barrier_factor,
            dark_matter.barrier_ratio,
        )
        return grow_tree(table, float(clock(self.z_root)), float(clock(model.z_max)), rng)

    def draw(self, dark_matter: DarkMatter, m_halo_msun: float, rng: np.random.Generator) -> WholeHalo:
        """Draw one halo of mass M200c at z_root [Msun]; up to `lightest_host_msun` it has no subhalos."""
        if 0.0 < m_halo_msun <= self.lightest_host_msun(dark_matter):
            return _without_subhalos(m_halo_msun, self.z_root)
        model = self.model
        tree = self.tree(dark_matter, m_halo_msun, rng)
        ln_a = -np.log1p(self.cosmology.clock_to_redshift(tree.clock_acc))
        circularity = draw_circularity(tree.m_acc_msun.size, rng)
        m_bound, sunk = self._evolve(tree, ln_a, circularity)
        light = ~sunk & (m_bound < model.min_mass_msun)
        left = ~(sunk | light)

        m_acc, m_bound, circularity = tree.m_acc_msun[left], m_bound[left], circularity[left]
        z_acc = np.expm1(-ln_a[left])
        matched = self._formation.matching_mass(self.variance(dark_matter), m_acc)
        concentration = scatter_concentration(
            self.cold_concentration(matched, z_acc),
            model.concentration_scatter_dex,
            model.concentration_min,
            rng,
        )
        r_infall, v_infall = infall_structure(m_acc, z_acc, concentration, self.cosmology)
        r_ratio, v_ratio = tidal_tracks(m_bound / m_acc)
        r_max, v_max = r_infall * r_ratio, v_infall * v_ratio
        r_s, rho_s = nfw_parameters(r_max, v_max)
        return WholeHalo(
            m_halo_msun=m_halo_msun,
            z_root=self.z_root,
            m_bound=m_bound,
            m_acc=m_acc,
            z_acc=z_acc,
            circularity=circularity,
            concentration=concentration,
            r_max_kpc=r_max,
            v_max_kms=v_max,
            r_s_kpc=r_s,
            rho_s=rho_s,
            r_t_kpc=r_s * truncation(m_bound / nfw_norm(r_s, rho_s)),
            radius_kpc=self._draw_radii(tree, left, z_acc, circularity, rng),
            n_accreted=tree.m_acc_msun.size,
            n_friction=int(sunk.sum()),
            n_stripped_below=int(light.sum()),
            tree_steps=tree.steps,
            z_half=float(self.cosmology.clock_to_redshift(tree.half_mass_clock)),
        )

    def _evolve(
        self, tree: MergerTree, ln_a_acc: FloatArray, circularity: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Return bound masses at z_root [Msun], and which subhalos dynamical friction has removed."""
        model = self.model
        ln_a_sunk = friction_ln_a(
            ln_a_acc,
            tree.host_mass_msun / tree.m_acc_msun,
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

    def _draw_radii(
        self,
        tree: MergerTree,
        left: BoolArray,
        z_acc: FloatArray,
        circularity: FloatArray,
        rng: np.random.Generator,
    ) -> FloatArray:
        """Draw the distances [kpc] from the centre of the subhalos that are left."""
        if self.model.positions == "nfw_host":
            host_mass = np.full(z_acc.size, tree.trunk_mass_msun[0])
            host_z = np.full(z_acc.size, self.z_root)
        else:
            host_mass, host_z = tree.host_mass_msun[left], z_acc
        radius = self.cosmology.radius_200c(host_mass, host_z)
        concentration = self.cold_concentration(host_mass, host_z)
        if self.model.positions == "orbit_infall":
            return draw_orbit_radii(radius, concentration, circularity, rng)
        return draw_nfw_radii(radius, concentration, z_acc.size, rng)

    def _tabulate_variance(self, dark_matter: DarkMatter) -> SharpKVariance:
        return filtered_variance(dark_matter.transfer, self._spectrum, self.cosmology, self.model.sharp_k_a)


def _without_subhalos(m_halo_msun: float, z_root: float) -> WholeHalo:
    """Return the limit of `HaloPopulation.draw` at `lightest_host_msun`: a tree that ends at its root."""
    of_subhalos = (*(field.name for field in fields(SubhaloStructure)), "circularity", "radius_kpc")
    values: dict[str, Any] = {name: np.empty(0) for name in of_subhalos}
    values |= dict.fromkeys(("n_accreted", "n_friction", "n_stripped_below", "tree_steps"), 0)
    return WholeHalo(**values, m_halo_msun=m_halo_msun, z_root=z_root, z_half=z_root)


def _cold_concentration(model: HaloModel, cosmology: Cosmology) -> ConcentrationRelation:
    if model.concentration == "duffy08":
        return ConcentrationRelation.duffy08(cosmology.h, model.concentration_min)
    return ConcentrationRelation(
        model.concentration_amplitude,
        model.concentration_mass_slope,
        model.concentration_redshift_slope,
        model.concentration_pivot_msun,
        model.concentration_min,
    )


def _count_above(values: FloatArray, thresholds: FloatArray) -> IntArray:
    return values.size - np.searchsorted(np.sort(values), thresholds, side="right")
