"""Physics objects of a configuration."""

from __future__ import annotations

from warmlens.config.model import CosmologyBlock, HalosBlock, RedshiftBlock
from warmlens.config.scan import ScanBlock
from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.halos.lens_halo import HaloGenerator, HaloModel
from warmlens.halos.merger_tree import BRANCHING
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.substructure import SmoothHost, required_half_width
from warmlens.scan.nested import NestedShapelets
from warmlens.scan.perturber import Perturber
from warmlens.scan.raster import Raster

_PRESETS = {"paper": ("paper", "nfw_host"), "calibrated": ("jvdb16", "nfw_infall")}


def geometry(cosmology: CosmologyBlock, redshifts: RedshiftBlock) -> tuple[Cosmology, LensGeometry]:
    """Return cosmology and lens geometry of the configuration."""
    background = Cosmology(**cosmology.model_dump())
    return background, LensGeometry.from_redshifts(background, redshifts.lens, redshifts.source)


def halo_generator(cosmology: CosmologyBlock, redshifts: RedshiftBlock, halos: HalosBlock) -> HaloGenerator:
    """Return the generator of halo realizations with the physics of the configuration."""
    return HaloGenerator(*geometry(cosmology, redshifts), halo_model(halos))


def halo_model(halos: HalosBlock) -> HaloModel:
    """Return the halo physics of the configuration, its preset resolved."""
    tau_dyn, positions = _PRESETS.get(halos.preset, (halos.tau_dyn, halos.positions))
    physics = halos.model_dump(exclude={"preset", "field_half_width_arcsec", "tau_dyn", "positions", "branching"})
    branching = BRANCHING[halos.branching] if isinstance(halos.branching, str) else halos.branching
    return HaloModel(tau_dyn=tau_dyn, positions=positions, branching=branching, **physics)  # type: ignore[arg-type]


def smooth_host(generator: HaloGenerator, log10_m_halo_msun: float, f_sub: float) -> SmoothHost:
    """Return what a halo of M200c holds besides its subhalos; its concentration is that of their positions."""
    m_halo, z_lens = 10.0**log10_m_halo_msun, generator.geometry.z_lens
    concentration = float(generator.population.cold_concentration(m_halo, z_lens))
    return SmoothHost.of_halo(m_halo, concentration, f_sub, generator.cosmology, z_lens)


def check_field(half_width_arcsec: float, grid: PixelGrid, filter_arcsec: float) -> None:
    """Refuse a field of subhalos that does not reach three filter widths beyond the image."""
    needed = required_half_width(grid, filter_arcsec)
    if half_width_arcsec < needed:
        raise ValueError(
            f"halos.field_half_width_arcsec = {half_width_arcsec:g} is too small: the image and three widths of "
            f"the filter (deflections.filter_arcsec = {filter_arcsec:g}) reach {needed:.2f}; "
            "raise it to at least that"
        )


def scan_perturber(block: ScanBlock) -> Perturber:
    """Return the perturber of the configuration."""
    return Perturber(block.perturber.theta_e_arcsec, block.perturber.r_trunc_arcsec)


def scan_nested(block: ScanBlock) -> NestedShapelets | None:
    """Return the nested shapelets of the configuration, if it has any."""
    nested = block.nested
    return None if nested is None else NestedShapelets(nested.n_max, nested.ridge, nested.beta_range_arcsec)


def scan_raster(block: ScanBlock) -> Raster:
    """Return the raster of the configuration, whose window `resolve_window` has set."""
    if block.window_arcsec is None:
        raise ValueError("scan.window_arcsec is null: resolve_window() sets it from the masks of the images")
    return Raster(*block.window_arcsec, block.step_arcsec, block.center)
