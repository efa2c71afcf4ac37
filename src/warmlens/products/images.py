"""Reading the bands of an observation from a user's FITS files."""

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
        paths = input_files(block)
        science = paths.pop("science")
        image, header = read_image(science, block.extension, MAX_SIDE)
        maps = {key: read_image(path, 0, MAX_SIDE)[0] for key, path in paths.items()}
        _check_units(science, header, block.units)
        grid = _pixel_grid(science, header, image.shape, block)
        if "sigma" in maps or "weight" in maps:
            noise, sigma = NoiseModel(None, None), _sigma_map(maps)
        else:
            noise = NoiseModel(
                background_rms=_header_number(science, header, block.background_rms, "BKGRMS", "background_rms"),
                exposure_s=_header_number(science, header, block.exposure_s, "EXPTIME", "exposure_s"),
            )
            sigma = noise.sigma(image)
        band = checked_band(name, grid, image, sigma, _mask(image, maps, block), maps["psf"], noise)
        correlation = _noise_correlation(grid, band, maps, block)
        return grid, replace(band, noise=replace(noise, correlation=correlation))
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError([str(error)]) from error


def input_files(block: FitsBandBlock) -> dict[str, Path]:
    """Return the paths of the files that a band is read from, by the name of their key."""
    return {key: expand_path(getattr(block, key)) for key in FITS_FILES if getattr(block, key) is not None}


def _mask(image: FloatArray, maps: dict[str, FloatArray], block: FitsBandBlock) -> BoolArray:
    """Return the pixels that are used: 1 in the mask, and of positive weight."""
    mask = np.ones(image.shape, dtype=bool)
    if "mask" in maps:
        if not np.isfinite(maps["mask"]).all():
            raise ValueError(f"{block.mask}: the mask has pixels that are not finite, expected 0 and 1")
        mask = maps["mask"] > 0
    if "weight" in maps and maps["weight"].shape == mask.shape:  # of another shape: `checked_band` refuses it
        mask = mask & (maps["weight"] > 0)
    return mask


def _sigma_map(maps: dict[str, FloatArray]) -> FloatArray:
    """Return the noise per pixel from a map of it or of the inverse variance, NaN where there is no weight."""
    if "sigma" in maps:
        return maps["sigma"]
    return 1.0 / np.sqrt(np.where(maps["weight"] > 0, maps["weight"], np.nan))


def _noise_correlation(
    grid: PixelGrid, band: Band, maps: dict[str, FloatArray], block: FitsBandBlock
) -> FloatArray | None:
    """Return the correlation of the noise from the user's file or from blank sky; None: independent pixels."""
    radius, where = block.blank_sky_arcsec, block.noise_correlation
    if radius is not None:
        where = f"observation.fits.{band.name}.blank_sky_arcsec: {radius:g}"
    if where is None:
        return None
    try:
        if radius is None:
            return checked_correlation(maps["noise_correlation"])
        return checked_correlation(sky_noise(band.image, blank_sky(grid, band, radius))[0])
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def blank_sky(grid: PixelGrid, band: Band, radius_arcsec: float) -> BoolArray:
    """Return the unmasked pixels farther than a radius from the origin [ny, nx]."""
    return (np.hypot(*grid.coordinates()) > radius_arcsec) & band.mask


def _check_units(path: Path, header: fits.Header, given: str | None) -> None:
    unit = given or header.get("BUNIT")
    if unit is None:
        raise ValueError(f"{path}: no BUNIT; set observation.fits.BAND.units: electron/s if that is the unit")
    if str(unit).strip().lower().replace(" / ", "/") not in _UNITS:
        raise ValueError(
            f"{path}: BUNIT is {unit!r}, expected electron/s; convert the image, or set "
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
    pairs: list[tuple[PixelGrid, Band]] = []
    for name, block in blocks.items():
        pairs.append(read_band(name, block))
        (first_grid, first), (grid, _) = pairs[0], pairs[-1]
        if grid != first_grid:
            problem = f"band {name} lies on other pixels than band {first.name}: {grid} against {first_grid}"
            raise ConfigError([f"{problem}; align the images (same shape, pixel scale, orientation and centre)"])
    return Observation("fits", pairs[0][0], tuple(band for _, band in pairs))


def artifact_path(block: ObservationBlock) -> Path:
    """Return the path of the observation that `kind: artifact` takes its bands from; it must exist."""
    assert block.artifact is not None  # config: kind artifact comes with its path
    path = expand_path(block.artifact)
    if not path.is_file():
        raise ConfigError([f"observation.artifact: {path}: no such file; run the campaign that makes it first"])
    return path


def planned_mask(block: ObservationBlock) -> tuple[PixelGrid, BoolArray]:
    """Return the pixel grid and the pixels that some band uses [ny, nx], before the stage has run."""
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
