"""Stage `observation`: read the user's FITS images, make the simulated observation, or take another campaign's."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from warmlens.artifacts.file import Dataset
from warmlens.config.observation import SimulatedBlock
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.mock import subpixel_field
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.observation import Band, Observation, checked_band
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source
from warmlens.imaging.source import SpiralSource
from warmlens.lensing.macro_model import deflection, light_images
from warmlens.lensing.substructure import filtered_deflection
from warmlens.physics import check_field, geometry, halo_generator, smooth_host
from warmlens.products.images import artifact_path, input_files, read_fits
from warmlens.products.observation import copy_bands, observation_datasets
from warmlens.sampling import stream
from warmlens.stage_table import ObservationSettings
from warmlens.stages.job import Job
from warmlens.types import FloatArray

log = logging.getLogger(__name__)


def run(job: Job[ObservationSettings]) -> None:
    """Write the observation."""
    block = job.settings.observation
    if block.kind == "fits":
        assert block.fits is not None  # config: kind fits comes with its block
        blocks = {name: block.fits[name] for name in block.bands}
        files = {f"{name}/{key}": path for name, b in blocks.items() for key, path in input_files(b).items()}
        job.write(*observation_datasets(read_fits(blocks)), sources=files)
    elif block.kind == "artifact":
        source = artifact_path(block)
        job.write(*copy_bands(source, block.bands), sources={"artifact": source})
    else:
        assert block.simulated is not None
        observation, truth = simulate(job.settings)
        datasets, metadata = observation_datasets(observation)
        job.write({**datasets, **truth}, {**metadata, "truth": block.simulated.truth.model_dump()})


def simulate(settings: ObservationSettings) -> tuple[Observation, dict[str, Dataset]]:
    """Make the simulated observation, and the datasets that hold its truth."""
    block, halos, filters = settings.observation.simulated, settings.halos, settings.deflections
    assert block is not None and halos is not None and filters is not None
    assert settings.cosmology is not None and settings.redshifts is not None
    grid = PixelGrid.centred(block.shape, block.pixel_scale_arcsec)
    check_field(halos.field_half_width_arcsec, grid, filters.filter_arcsec)
    truth = block.truth
    generator = halo_generator(settings.cosmology, settings.redshifts, halos)
    realization = generator.draw(
        truth.m_th_kev,
        10.0**truth.log10_m_halo_msun,
        halos.field_half_width_arcsec,
        stream(truth.seed, "halos", 0),
    )
    _, lens = geometry(settings.cosmology, settings.redshifts)
    host = smooth_host(generator, truth.log10_m_halo_msun, realization.f_sub) if filters.smooth_host else None
    delta = filtered_deflection(realization.subhalos, grid, lens, filters.filter_arcsec, filters.filter, host)
    bands = tuple(_simulated_band(name, block, grid, delta) for name in settings.observation.bands)
    log.info("simulated %d bands with %d subhalos", len(bands), len(realization.subhalos.m_bound))
    extra = {
        "truth/delta_alpha": Dataset(
            delta, "arcsec", ("component", "y", "x"), "substructure of the truth: filtered deflection (x, y)"
        )
    }
    return Observation("simulated", grid, bands), extra


def _simulated_band(name: str, block: SimulatedBlock, grid: PixelGrid, delta_alpha: FloatArray) -> Band:
    clean, psf = true_image(name, block, grid, delta_alpha)
    noise = NoiseModel(block.bands[name].background_rms, block.bands[name].exposure_s)
    image = noise.draw(clean, clean, stream(block.truth.seed, "observation", 0, name))
    mask = np.ones(grid.shape, dtype=bool)
    return checked_band(name, grid, image, noise.sigma(image), mask, psf, noise)


def true_image(
    name: str, block: SimulatedBlock, grid: PixelGrid, delta_alpha: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the image [ny, nx] [e-/s per pixel] of a band before noise, and its PSF.

    Parameters
    ----------
    name, block, grid
        Band, its simulation and the pixels.
    delta_alpha
        What the substructure adds to the deflection, [2, ny, nx] [arcsec].
    """
    band = block.bands[name]
    x, y = grid.subpixel_coordinates(block.supersampling)
    alpha = deflection(block.lens.lens_model_list, block.lens.kwargs_lens, x, y)
    rays = np.array([x, y]) - alpha - subpixel_field(delta_alpha, block.supersampling)
    psf = hst_like_psf(band.wavelength_nm, grid.pixel_scale, block.psf_pixels)
    rng = stream(block.source.seed, "source", 0)
    source = SpiralSource.draw(
        block.source.center,
        block.source.disc_scale_arcsec,
        block.source.n_clumps,
        block.source.clump_sigma_arcsec,
        rng,
    )
    pixel_area = grid.pixel_scale**2
    light = source.surface_brightness(rays[0], rays[1], band.source_flux, band.clump_flux_fraction)
    arcs = light.mean(axis=-1).reshape(grid.shape) * pixel_area
    lens_light = block.lens_light
    galaxy = light_images(
        lens_light.lens_light_model_list, lens_light.kwargs_lens_light, grid, block.supersampling
    )
    galaxy = np.tensordot(band.lens_light_amplitudes, galaxy, axes=1)
    quasars: Any = sum(
        flux * point_source(psf, grid, qx, qy)
        for flux, (qx, qy) in zip(band.quasar_fluxes, block.quasar_images, strict=True)
    )
    return Convolution(psf, grid.shape).forward(arcs + galaxy) + quasars + band.sky, psf
