"""Reading one band of a user's FITS files."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning
from astropy.wcs import WCS, FITSFixedWarning

from warmlens.config import FitsBandBlock
from warmlens.config_file import expand_path
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.observation import Band, checked_band
from warmlens.types import FloatArray

_UNITS = {"electron/s", "electrons/s", "e-/s", "electron s-1", "electrons s-1"}
_SHAPE_TOLERANCE = 1e-3  # of pixels being square and axes orthogonal


def read_band(name: str, block: FitsBandBlock) -> tuple[PixelGrid, Band]:
    """Read and check image, PSF, mask and noise of one band.

    Raises
    ------
    ValueError
        Naming the file or key, what was found, what was expected and what to do.
    """
    path = expand_path(block.science)
    image, header = _read_image(path, block.extension)
    _check_units(path, header, block.units)
    grid = _pixel_grid(path, header, image.shape, block)
    psf, _ = _read_image(expand_path(block.psf), 0)
    mask = np.ones(image.shape, dtype=bool)
    if block.mask is not None:
        mask = _read_image(expand_path(block.mask), 0)[0] > 0
    if block.sigma is not None:
        noise = NoiseModel(None, None)
        sigma, _ = _read_image(expand_path(block.sigma), 0)
    elif block.weight is not None:
        noise = NoiseModel(None, None)
        weight, _ = _read_image(expand_path(block.weight), 0)
        if weight.shape == mask.shape:
            mask = mask & (weight > 0)  # weight 0: no data in that pixel
        sigma = 1.0 / np.sqrt(np.where(weight > 0, weight, np.nan))
    else:
        noise = NoiseModel(
            background_rms=_header_number(path, header, block.background_rms, "BKGRMS", "background_rms"),
            exposure_s=_header_number(path, header, block.exposure_s, "EXPTIME", "exposure_s"),
        )
        sigma = noise.sigma(image)
    return grid, checked_band(name, grid, image, sigma, mask, psf, noise)


def input_files(block: FitsBandBlock) -> dict[str, Path]:
    """The files that a band is read from, by the name of their key."""
    keys = ("science", "psf", "mask", "sigma", "weight")
    return {key: expand_path(getattr(block, key)) for key in keys if getattr(block, key) is not None}


def _read_image(path: Path, extension: int) -> tuple[FloatArray, fits.Header]:
    if not path.is_file():
        raise ValueError(f"{path}: no such file; correct the path under observation.fits")
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message="File may have been truncated")
            with fits.open(path, memmap=False) as hdus:
                n_extensions = len(hdus)
                data = hdus[extension].data if extension < n_extensions else None
                header = hdus[extension].header if extension < n_extensions else fits.Header()
    except (OSError, TypeError, ValueError, AstropyUserWarning) as error:
        raise ValueError(f"{path}: not a readable FITS file, or truncated ({error})") from error
    if extension >= n_extensions:
        raise ValueError(
            f"{path}: has {n_extensions} extensions, extension {extension} was asked for; "
            "set observation.fits.BAND.extension"
        )
    if data is None or data.ndim != 2:
        found = "no data" if data is None else f"{data.ndim} dimensions"
        raise ValueError(f"{path}: extension {extension} holds {found}, expected an image [y, x]")
    return np.array(data, dtype=np.float64), header


def _check_units(path: Path, header: fits.Header, given: str | None) -> None:
    found = given or header.get("BUNIT")
    if found is None:
        raise ValueError(f"{path}: no BUNIT; say observation.fits.BAND.units: electron/s if that is the unit")
    if str(found).strip().lower() not in _UNITS:
        raise ValueError(f"{path}: BUNIT is {found!r}, expected electron/s; convert the image")


def _header_number(path: Path, header: fits.Header, given: float | None, keyword: str, key: str) -> float:
    value: Any = given if given is not None else header.get(keyword)
    if value is None:
        raise ValueError(f"{path}: no keyword {keyword}; set observation.fits.BAND.{key}, sigma or weight")
    if not (isinstance(value, int | float) and np.isfinite(value) and value > 0):
        raise ValueError(f"{path}: {keyword} is {value!r}, expected a positive number")
    return float(value)


def _pixel_grid(path: Path, header: fits.Header, shape: tuple[int, ...], block: FitsBandBlock) -> PixelGrid:
    if block.pixel_scale_arcsec is not None:
        step = block.pixel_scale_arcsec * np.eye(2)
        reference = block.center_pixel
    else:
        step, crpix = _wcs_steps(path, header)
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


def _wcs_steps(path: Path, header: fits.Header) -> tuple[FloatArray, tuple[float, float]]:
    """Sky step (x West, y North) [arcsec] of a column and of a row as a 2x2 matrix, and CRPIX from 0."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        wcs = WCS(header)
    if not wcs.has_celestial:
        raise ValueError(
            f"{path}: no celestial WCS; set observation.fits.BAND.pixel_scale_arcsec and center_pixel"
        )
    east_north = wcs.celestial.pixel_scale_matrix * 3600.0
    step = np.array([[-1.0], [1.0]]) * east_north
    column, row = wcs.celestial.wcs.crpix - 1.0
    return step, (float(column), float(row))
