"""Write a simulated lens as FITS files, as an observer has them: image, PSF, noise map.

    python docs/examples/simulate_lens.py FOLDER

It stands for a lens of yours in docs/own_lens.md. lenstronomy traces and astropy's WCS says where each pixel lies;
nothing of warmlens is used. One band, 0.08" pixels, north 35 degrees off the image's columns, four quasar images.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units
from astropy.io import fits
from astropy.wcs import WCS
from lenstronomy.LensModel.lens_model import LensModel
from lenstronomy.LensModel.Solver.lens_equation_solver import LensEquationSolver
from lenstronomy.LightModel.light_model import LightModel
from scipy.signal import fftconvolve

SCALE, SIDE, ROLL_DEG = 0.08, 74, 35.0  # arcsec, pixels, position angle of the image's rows
RA_DEG, DEC_DEG = 211.6, -44.3  # of the lens
FWHM, PSF_SIDE = 0.20, 25  # arcsec, pixels
EXPOSURE_S, BACKGROUND_RMS, SKY = 2400.0, 0.01, 0.003  # s, e-/s, e-/s
OVERSAMPLING = 3

# Positions in arcsec, x to the West, y to the North, from the lens.
LENS_MODELS = ["EPL", "SHEAR"]
LENS: list[dict[str, float]] = [
    {"theta_E": 1.25, "gamma": 2.06, "e1": 0.08, "e2": -0.06, "center_x": 0.02, "center_y": -0.03},
    {"gamma1": -0.05, "gamma2": 0.03},
]
LIGHT = [
    {"amp": 14.0, "R_sersic": 0.7, "n_sersic": 1.5, "e1": 0.05, "e2": -0.04, "center_x": 0.02, "center_y": -0.03}
]
QUASAR = (0.09, -0.04)  # in the source plane
QUASAR_FLUX = 10.0  # e-/s, unlensed
SOURCE = [
    {"amp": 30.0, "sigma": 0.11, "center_x": 0.09, "center_y": -0.04},
    {"amp": 5.0, "sigma": 0.08, "center_x": 0.22, "center_y": -0.07},
    {"amp": 4.0, "sigma": 0.09, "center_x": -0.05, "center_y": 0.14},
]


def header(roll_deg: float = ROLL_DEG) -> fits.Header:
    """Header of an image whose rows point `roll_deg` East of North; the lens is off the middle."""
    cos, sin = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
    step = SCALE / 3600.0
    cards: dict[str, Any] = {
        "BUNIT": "electron/s", "EXPTIME": EXPOSURE_S,
        "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": RA_DEG, "CRVAL2": DEC_DEG,
        "CRPIX1": SIDE / 2 + 2.3, "CRPIX2": SIDE / 2 - 1.4,
        "CD1_1": -step * cos, "CD1_2": step * sin, "CD2_1": step * sin, "CD2_2": step * cos,
    }  # fmt: skip
    return fits.Header(cards)


def sky(wcs: WCS, columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offsets to the West and to the North [arcsec] of 0-based pixels, along great circles from the lens."""
    here = wcs.pixel_to_world(columns, rows)
    east, north = wcs.pixel_to_world(*(wcs.wcs.crpix - 1.0)).spherical_offsets_to(here)
    return -east.arcsec, north.arcsec


def quasar_images() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position (x, y) [arcsec] and flux [e-/s] of the quasar's images, the brightest first."""
    lens = LensModel(LENS_MODELS)
    x, y = LensEquationSolver(lens).image_position_from_source(
        *QUASAR, LENS, min_distance=0.02, search_window=5.0, precision_limit=1e-10
    )
    flux = QUASAR_FLUX * np.abs(lens.magnification(x, y, LENS))
    order = np.argsort(-flux)
    return x[order], y[order], flux[order]


def psf_kernel() -> np.ndarray:
    """A round Moffat profile at the pixels' centres, sum 1."""
    axis = np.arange(PSF_SIDE) - PSF_SIDE // 2
    return _moffat(np.hypot(axis[:, None], axis))


def _moffat(radius_pixels: np.ndarray) -> np.ndarray:
    beta = 4.0
    core = 0.5 * FWHM / SCALE / np.sqrt(2.0 ** (1.0 / beta) - 1.0)
    profile = (1.0 + (radius_pixels / core) ** 2) ** -beta
    return profile / profile.sum()


def noiseless(wcs: WCS) -> np.ndarray:
    """Lensed source, lens and quasars [y, x] [e-/s per pixel]."""
    middle = (np.arange(OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5
    fine = (np.arange(SIDE)[:, None] + middle).ravel()
    columns, rows = np.meshgrid(fine, fine)
    x, y = (c.ravel() for c in sky(wcs, columns, rows))
    source_x, source_y = LensModel(LENS_MODELS).ray_shooting(x, y, LENS)
    light = LightModel(["GAUSSIAN"] * len(SOURCE)).surface_brightness(source_x, source_y, SOURCE)
    light = light + LightModel(["SERSIC_ELLIPSE"]).surface_brightness(x, y, LIGHT)
    blocks = light.reshape(SIDE, OVERSAMPLING, SIDE, OVERSAMPLING) * SCALE**2
    image = fftconvolve(blocks.mean(axis=(1, 3)), psf_kernel(), mode="same")
    grid_rows, grid_columns = np.mgrid[:SIDE, :SIDE]
    for x_quasar, y_quasar, flux in zip(*quasar_images(), strict=True):
        column, row = pixel(wcs, x_quasar, y_quasar)
        image += flux * _moffat(np.hypot(grid_columns - column, grid_rows - row))
    return image


def pixel(wcs: WCS, x: float, y: float) -> tuple[float, float]:
    """0-based column and row of an offset to the West and to the North [arcsec]."""
    lens = wcs.pixel_to_world(*(wcs.wcs.crpix - 1.0))
    there = lens.spherical_offsets_by(-x * units.arcsec, y * units.arcsec)
    column, row = wcs.world_to_pixel(there)
    return float(column), float(row)


def write(folder: Path, seed: int = 7) -> None:
    """Write sci.fits, psf.fits and noise.fits."""
    head = header()
    rng = np.random.default_rng(seed)
    signal = noiseless(WCS(head))
    counts = rng.poisson((signal + SKY) * EXPOSURE_S) / EXPOSURE_S
    image = counts + BACKGROUND_RMS * rng.standard_normal(signal.shape)
    noise = np.sqrt(BACKGROUND_RMS**2 + (signal + SKY) / EXPOSURE_S)
    folder.mkdir(parents=True, exist_ok=True)
    for name, data, cards in (("sci", image, head), ("psf", psf_kernel(), None), ("noise", noise, head)):
        fits.PrimaryHDU(data.astype(np.float32), cards).writeto(folder / f"{name}.fits", overwrite=True)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
