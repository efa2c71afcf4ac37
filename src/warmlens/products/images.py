"""Reading one band of a user's FITS files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from warmlens.config.file import expand_path
from warmlens.config.observation import FITS_FILES, MAX_SIDE, FitsBandBlock, ObservationBlock
from warmlens.config.types import ConfigError
from warmlens.imaging.fits import read_image, sky_steps
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.noise_correlation import checked_correlation, sky_noise
from warmlens.imaging.observation import Band, Observation, checked_band
from warmlens.products.observation import read_observation
from warmlens.types import BoolArray, FloatArray

_UNITS = {"electron/s", "electrons/s", "e-/s", "electron s-1", "electrons s-1"}  # "/" may stand between spaces
_LARGEST = 1e30  # e-/s or s: its square is a number too
_SHAPE_TOLERANCE = 1e-3  # of pixels being square and axes orthogonal


def read_band(name: str, block: FitsBandBlock) -> tuple[PixelGrid, Band]:
    """Read and check image, PSF, mask and noise of one band.

    Raises
    ------
    ConfigError
        Naming the file or key, what was found, what was expected and what to do.
    """
    try:
        return _read_band(name, block)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError([str(error)]) from error


def _read_band(name: str, block: FitsBandBlock) -> tuple[PixelGrid, Band]:
    path = expand_path(block.science)
    image, header = read_image(path, block.extension, MAX_SIDE)
    _check_units(path, header, block.units)
    grid = _pixel_grid(path, header, image.shape, block)
    psf, _ = read_image(expand_path(block.psf), 0, MAX_SIDE)
    mask = np.ones(image.shape, dtype=bool)
    if block.mask is not None:
        values, _ = read_image(expand_path(block.mask), 0, MAX_SIDE)
        if not np.isfinite(values).all():
            raise ValueError(f"{block.mask}: the mask has pixels that are not finite, expected 0 and 1")
        mask = values > 0
    if block.sigma is not None:
        noise = NoiseModel(None, None)
        sigma, _ = read_image(expand_path(block.sigma), 0, MAX_SIDE)
    elif block.weight is not None:
        noise = NoiseModel(None, None)
        weight, _ = read_image(expand_path(block.weight), 0, MAX_SIDE)
        if weight.shape == mask.shape:
            mask = mask & (weight > 0)  # weight 0: no data in that pixel
        sigma = 1.0 / np.sqrt(np.where(weight > 0, weight, np.nan))
    else:
        noise = NoiseModel(
            background_rms=_header_number(path, header, block.background_rms, "BKGRMS", "background_rms"),
            exposure_s=_header_number(path, header, block.exposure_s, "EXPTIME", "exposure_s"),
        )
        sigma = noise.sigma(image)
    band = checked_band(name, grid, image, sigma, mask, psf, noise)
    return grid, replace(band, noise=replace(noise, correlation=_noise_correlation(grid, band, block)))


def _noise_correlation(grid: PixelGrid, band: Band, block: FitsBandBlock) -> FloatArray | None:
    """As the user's file has it, or as measured in blank sky; None: independent pixels."""
    if block.noise_correlation is not None:
        values, _ = read_image(expand_path(block.noise_correlation), 0, MAX_SIDE)
        where = f"{block.noise_correlation}"
    elif block.blank_sky_arcsec is not None:
        where = f"observation.fits.{band.name}.blank_sky_arcsec: {block.blank_sky_arcsec:g}"
    else:
        return None
    try:
        if block.blank_sky_arcsec is not None:
            values, _ = sky_noise(band.image, blank_sky(grid, band, block.blank_sky_arcsec))
        return checked_correlation(values)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def blank_sky(grid: PixelGrid, band: Band, radius_arcsec: float) -> BoolArray:
    """Unmasked pixels farther than a radius from the origin [ny, nx]."""
    return (np.hypot(*grid.coordinates()) > radius_arcsec) & band.mask


def input_files(block: FitsBandBlock) -> dict[str, Path]:
    """The files that a band is read from, by the name of their key."""
    return {key: expand_path(getattr(block, key)) for key in FITS_FILES if getattr(block, key) is not None}


def _check_units(path: Path, header: fits.Header, given: str | None) -> None:
    found = given or header.get("BUNIT")
    if found is None:
        raise ValueError(f"{path}: no BUNIT; say observation.fits.BAND.units: electron/s if that is the unit")
    if str(found).strip().lower().replace(" / ", "/") not in _UNITS:
        raise ValueError(
            f"{path}: BUNIT is {found!r}, expected electron/s; convert the image, or say "
            "observation.fits.BAND.units: electron/s if that is its unit all the same"
        )


def _header_number(path: Path, header: fits.Header, given: float | None, keyword: str, key: str) -> float:
    value: Any = given if given is not None else header.get(keyword)
    if value is None:
        raise ValueError(f"{path}: no keyword {keyword}; set observation.fits.BAND.{key}, sigma or weight")
    if not (isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < _LARGEST):
        raise ValueError(f"{path}: {keyword} is {value!r}, expected a positive number below {_LARGEST:g}")
    return float(value)


def _pixel_grid(path: Path, header: fits.Header, shape: tuple[int, ...], block: FitsBandBlock) -> PixelGrid:
    if block.pixel_scale_arcsec is not None:
        step = block.pixel_scale_arcsec * np.eye(2)
        reference = block.center_pixel
    else:
        step, crpix = sky_steps(path, header)
        reference = block.center_pixel or crpix
    scale = float(np.hypot(*step[:, 0]))
    axes = step / scale
    if not np.allclose(axes.T @ axes, np.eye(2), atol=_SHAPE_TOLERANCE):
        sides = np.hypot(*step)
        raise ValueError(
            f"{path}: pixels are not square ({sides[0]:.5f} x {sides[1]:.5f} arcsec, axes' scalar product "
            f"{axes[:, 0] @ axes[:, 1]:.4f}); resample the image to square pixels"
        )
    assert reference is not None  # config: a pixel scale comes with a centre
    ny, nx = shape
    if not (0 <= reference[0] < nx and 0 <= reference[1] < ny):
        raise ValueError(
            f"{path}: the frame's origin is pixel [x, y] = [{reference[0]:.1f}, {reference[1]:.1f}], outside the "
            f"{nx} x {ny} image; set observation.fits.BAND.center_pixel to the pixel of the lens centre"
        )
    origin = -step @ np.array(reference)
    rows = ((float(axes[0, 0]), float(axes[0, 1])), (float(axes[1, 0]), float(axes[1, 1])))
    return PixelGrid(ny, nx, scale, float(origin[0]), float(origin[1]), rows)


def read_fits(blocks: dict[str, FitsBandBlock]) -> Observation:
    """Read all bands; they must share one pixel grid."""
    grids: list[PixelGrid] = []
    bands: list[Band] = []
    for name, block in blocks.items():
        grid, band = read_band(name, block)
        grids.append(grid)
        bands.append(band)
        if grid != grids[0]:
            raise ValueError(
                f"band {name} lies on other pixels than band {bands[0].name}: {grid} against {grids[0]}; "
                "align the images (same shape, pixel scale, orientation and centre)"
            )
    return Observation("fits", grids[0], tuple(bands))


def artifact_path(block: ObservationBlock) -> Path:
    """The observation of another campaign that `kind: artifact` takes its bands from; it must be there."""
    assert block.artifact is not None  # config: kind artifact comes with its path
    path = expand_path(block.artifact)
    if not path.is_file():
        raise ConfigError([f"observation.artifact: {path}: no such file; run the campaign that makes it first"])
    return path


def planned_mask(block: ObservationBlock) -> tuple[PixelGrid, BoolArray]:
    """Pixel grid and the pixels that some band uses [ny, nx], before the stage has run."""
    if block.kind == "simulated":
        assert block.simulated is not None  # config: kind simulated comes with its block
        grid = PixelGrid.centred(block.simulated.shape, block.simulated.pixel_scale_arcsec)
        return grid, np.ones(grid.shape, dtype=bool)
    if block.kind == "artifact":
        observed = read_observation(artifact_path(block))
    else:
        assert block.fits is not None
        observed = read_fits({name: block.fits[name] for name in block.bands})
    masks = [band.mask for band in observed.bands if band.name in block.bands]
    return observed.grid, np.logical_or.reduce(masks)
