"""The halo of a lens: a whole halo with its subhalos, projected on the sky."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.halos.dark_matter import DarkMatter, dark_matter
from warmlens.halos.model import HaloModel
from warmlens.halos.population import MASS_BINS, VMAX_BINS, HaloPopulation, SubhaloStructure
from warmlens.halos.positions import project_isotropically
from warmlens.types import FloatArray, IntArray

__all__ = ["MASS_BINS", "VMAX_BINS", "HaloGenerator", "HaloModel", "HaloRealization", "Subhalos"]


@dataclass(frozen=True)
class Subhalos(SubhaloStructure):
    """Subhalos on the sky: structure, and position relative to the centre of the host [arcsec]."""

    x_arcsec: FloatArray
    y_arcsec: FloatArray


@dataclass(frozen=True)
class HaloRealization:
    """One drawn halo."""

    subhalos: Subhalos  # subhalos inside the field |x|, |y| <= half_width_arcsec
    n_accreted: int  # halos accreted above the resolution; the sum of the next three
    # Of these: lost to dynamical friction, stripped below min_mass_msun, and left (in the whole halo)
    n_friction: int
    n_stripped_below: int
    n_surviving: int
    f_sub: float  # mass of all survivors over the mass of the halo
    cumulative_mass_function: IntArray  # survivors with log10(m_bound) above each of `MASS_BINS`
    cumulative_vmax_function: IntArray  # survivors with v_max above each of `VMAX_BINS`
    tree_steps: int  # steps of the merger tree
    z_half: float  # redshift at which the trunk had half its mass


class HaloGenerator:
    """Generator of the halos of a lens, whose trees are rooted at its redshift.

    Attributes
    ----------
    population
        Whole halos at the redshift of the lens, without projection.
    """

    def __init__(self, cosmology: Cosmology, geometry: LensGeometry, model: HaloModel) -> None:
        self.cosmology = cosmology
        self.geometry = geometry
        self.model = model
        self.population = HaloPopulation(cosmology, geometry.z_lens, model)

    def dark_matter(self, m_th_kev: float) -> DarkMatter:
        """Return the thermal relic of the given mass [keV] with the model's transfer function; inf is cold."""
        return dark_matter(m_th_kev, self.cosmology, self.model.transfer_function)

    def draw(
        self, m_th_kev: float, m_halo_msun: float, half_width_arcsec: float, rng: np.random.Generator
    ) -> HaloRealization:
        """Draw one halo of a thermal relic.

        Parameters
        ----------
        m_th_kev
            Mass of the thermal relic [keV], > 0; inf for cold dark matter.
        m_halo_msun
            M200c of the host at the redshift of the lens [Msun]; up to twice the resolution it has no subhalos.
        half_width_arcsec
            Half the side of the square field whose subhalos are kept [arcsec].
        """
        return self.draw_model(self.dark_matter(m_th_kev), m_halo_msun, half_width_arcsec, rng)

    def draw_model(
        self, dark_matter: DarkMatter, m_halo_msun: float, half_width_arcsec: float, rng: np.random.Generator
    ) -> HaloRealization:
        """Draw one halo of any dark matter; the other parameters are those of `draw`."""
        if not half_width_arcsec > 0.0:
            raise ValueError(f"half_width_arcsec must be > 0, got {half_width_arcsec!r}")
        halo = self.population.draw(dark_matter, m_halo_msun, rng)
        x, y = project_isotropically(halo.radius_kpc / self.geometry.kpc_per_arcsec, rng)
        inside = np.maximum(np.abs(x), np.abs(y)) <= half_width_arcsec
        structure = {field.name: getattr(halo, field.name)[inside] for field in fields(SubhaloStructure)}
        return HaloRealization(
            subhalos=Subhalos(**structure, x_arcsec=x[inside], y_arcsec=y[inside]),
            n_accreted=halo.n_accreted,
            n_friction=halo.n_friction,
            n_stripped_below=halo.n_stripped_below,
            n_surviving=halo.n_surviving,
            f_sub=halo.f_sub,
            cumulative_mass_function=halo.cumulative_mass_function,
            cumulative_vmax_function=halo.cumulative_vmax_function,
            tree_steps=halo.tree_steps,
            z_half=halo.z_half,
        )
