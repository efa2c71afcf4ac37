"""Stage `smooth_model`: amplitudes of source, light and quasars on the smooth lens of the configuration."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from warmlens.artifacts import Provenance, write_artifact
from warmlens.config import LensLightBlock, SmoothModelBlock
from warmlens.fitting.smooth_model import FixedColumns, fit_band
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.observation import Band
from warmlens.imaging.psf import Convolution, point_source
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.macro_model import deflection, lens_light
from warmlens.lensing.rays import SmoothRays
from warmlens.stages.products import SmoothModel, read_observation, smooth_model_datasets
from warmlens.stages.settings import SmoothModelSettings
from warmlens.types import FloatArray

log = logging.getLogger(__name__)


def run(settings: SmoothModelSettings, observation: Path, output: Path) -> None:
    """Fit every band and write the smooth model; say loudly where chi2 is not near 1."""
    provenance = Provenance("smooth_model", settings.as_dict(), {"observation": observation})
    block = settings.smooth_model
    observed = read_observation(observation)
    grid = observed.grid
    rays = trace_rays(block, grid)
    source = block.source
    sets = (ShapeletSet(source.n_max, source.beta_arcsec, *source.center),)
    fixed, fits = {}, {}
    for band in observed.bands:
        convolution = Convolution(band.psf, grid.shape)
        columns = fixed_columns(block, grid, band, convolution)
        fixed[band.name] = columns.images
        fits[band.name] = fit_band(
            band, sets, rays, columns, convolution, block.ridge, block.quasar_variance_fraction
        )
        log.info("%s: chi2_red = %.3f", band.name, fits[band.name].chi2_red)
    low, high = block.chi2_red_range
    warnings = [
        f"{name}: chi2_red = {fit.chi2_red:.2f} of the smooth model lies outside [{low:g}, {high:g}]: misfit and "
        "substructure look alike, do not trust a bound from this campaign"
        for name, fit in fits.items()
        if not low <= fit.chi2_red <= high
    ]
    for warning in warnings:
        log.warning(warning)
    lens = block.lens
    model = SmoothModel(
        deflection=deflection(lens.lens_model_list, lens.kwargs_lens, *grid.coordinates()),
        rays=rays,
        sets=sets,
        supersampling=source.supersampling,
        ridge=block.ridge,
        names=columns.names,
        fixed=fixed,
        n_quasars=columns.n_quasars,
        fits=fits,
    )
    datasets, metadata = smooth_model_datasets(model)
    write_artifact(output, provenance, datasets, {**metadata, "warnings": warnings})


def trace_rays(block: SmoothModelBlock, grid: PixelGrid) -> SmoothRays:
    """Trace the centres of all sub-pixels through the smooth lens."""
    x, y = grid.subpixel_coordinates(block.source.supersampling)
    alpha = deflection(block.lens.lens_model_list, block.lens.kwargs_lens, x, y)
    return SmoothRays(x, y, x - alpha[0], y - alpha[1])


def fixed_columns(block: SmoothModelBlock, grid: PixelGrid, band: Band, convolution: Convolution) -> FixedColumns:
    """Quasar images, light of the lens and background of one band, for amplitude 1."""
    quasars = [point_source(band.psf, grid, x, y) for x, y in block.quasar_images]
    light = convolution.forward(lens_light_images(block.lens_light, grid, block.source.supersampling))
    background = [np.ones(grid.shape)] if block.fit_background else []
    names = [f"quasar_{i}" for i in range(len(quasars))]
    names += [f"light_{i}" for i in range(len(light))] + ["background"] * len(background)
    images = np.array([*quasars, *light, *background]).reshape(len(names), grid.ny * grid.nx).T
    return FixedColumns(tuple(names), np.ascontiguousarray(images), len(quasars))


def lens_light_images(block: LensLightBlock, grid: PixelGrid, supersampling: int) -> FloatArray:
    """Light per pixel of each component for amplitude 1, before the PSF [component, ny, nx]."""
    x, y = grid.subpixel_coordinates(supersampling)
    light = lens_light(block.lens_light_model_list, block.kwargs_lens_light, x, y)
    return light.mean(axis=-1).reshape(len(light), *grid.shape) * grid.pixel_scale**2
