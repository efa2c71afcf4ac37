"""The lens and its image at the paper's size: deflections against lenstronomy, mocks of two bands, the fit.

Ratios are taken within one run. One thread is the fair setting:
OPENBLAS_NUM_THREADS=1 python benchmarks/imaging.py --json FILE
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from lenstronomy.LensModel.lens_model import LensModel
from rich.console import Console
from rich.table import Table

from warmlens.config.file import load_config
from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.fitting.lens_fit import fit_lens
from warmlens.halos.lens_halo import Subhalos
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.mock import lensed_image, subpixel_field
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.psf import Convolution, hst_like_psf
from warmlens.imaging.shapelets import ShapeletSet, n_coefficients
from warmlens.lensing.deflection import TnfwHalos, tnfw_angular_scales, tnfw_deflection
from warmlens.lensing.high_pass import margin_pixels
from warmlens.lensing.substructure import filtered_deflection
from warmlens.products.observation import read_observation
from warmlens.stage_table import stage_settings
from warmlens.stages.job import make_job, run_job
from warmlens.types import FloatArray

ROOT = Path(__file__).parents[1]
PIXELS, PIXEL_SCALE, FILTER_ARCSEC = 160, 0.05, 0.4
SOURCE, BETA, N_MAX = (-0.503, -0.058), 0.18, 50
N_CLUMPS, CLUMP_N_MAX, CLUMP_BETA = 15, 3, 0.03
BANDS_NM = {"F814W": 805.0, "F555W": 536.0}
SMOOTH_LENS = (
    ["EPL", "SHEAR", "SIS"],
    [
        {"theta_E": 1.634, "gamma": 1.957, "e1": 0.0831, "e2": 0.1065, "center_x": 0.0, "center_y": 0.0},
        {"gamma1": -0.0841, "gamma2": -0.0054},
        {"theta_E": 0.213, "center_x": -0.097, "center_y": 0.614},
    ],
)


def field_of_subhalos(n: int, rng: np.random.Generator) -> Subhalos:
    """Subhalos of 10^7 to 10^10 Msun over the field, with the sizes that they have in the campaign."""
    half_width = 0.5 * PIXELS * PIXEL_SCALE + 4.0 * FILTER_ARCSEC
    mass = 1e7 * 10.0 ** rng.exponential(0.5, n).clip(max=3.0)
    r_s = 0.4 * (mass / 1e7) ** 0.4 * 10.0 ** (0.1 * rng.standard_normal(n))
    rho_s = mass / (4.0 * np.pi * r_s**3)
    x, y = rng.uniform(-half_width, half_width, (2, n))
    none = np.zeros(n)
    return Subhalos(
        m_bound=mass, m_acc=mass, z_acc=none, concentration=none, r_max_kpc=none, v_max_kms=none,
        r_s_kpc=r_s, rho_s=rho_s, r_t_kpc=2.5 * r_s, x_arcsec=x, y_arcsec=y,
    )  # fmt: skip


def deflections(n_subhalos: int, repeats: int) -> dict[str, float]:
    """Sum of the deflections on the image with its margin, ours and lenstronomy's in turn."""
    geometry = LensGeometry.from_redshifts(Cosmology(), 0.295, 0.658)
    grid = PixelGrid.centred((PIXELS, PIXELS), PIXEL_SCALE)
    subhalos = field_of_subhalos(n_subhalos, np.random.default_rng(1))
    r_s, r_t, scale = tnfw_angular_scales(
        subhalos.r_s_kpc,
        subhalos.r_t_kpc,
        subhalos.rho_s,
        geometry.kpc_per_arcsec,
        geometry.sigma_crit_msun_kpc2,
    )
    x, y = (axis.ravel() for axis in grid.padded(margin_pixels(FILTER_ARCSEC, PIXEL_SCALE)).coordinates())
    lens = LensModel(["TNFW"] * n_subhalos)
    kwargs = [
        {
            "Rs": r_s[k],
            "alpha_Rs": scale[k] * (1.0 - np.log(2.0)),  # of the profile without truncation
            "r_trunc": r_t[k],
            "center_x": subhalos.x_arcsec[k],
            "center_y": subhalos.y_arcsec[k],
        }
        for k in range(n_subhalos)
    ]

    def ours() -> FloatArray:
        return tnfw_deflection(x, y, TnfwHalos(subhalos.x_arcsec, subhalos.y_arcsec, r_s, r_t, scale))

    def theirs() -> FloatArray:
        return np.array(lens.alpha(x, y, kwargs))

    error = np.abs(ours() - theirs()).max() / np.abs(theirs()).max()
    ours_seconds, theirs_seconds = in_turn([ours, theirs], repeats)
    (map_seconds,) = in_turn([lambda: filtered_deflection(subhalos, grid, geometry, FILTER_ARCSEC)], repeats)
    return {
        "deflection_speedup": theirs_seconds / ours_seconds,
        "deflection_max_relative_error": float(error),
        "deflection_seconds": ours_seconds,
        "filtered_deflection_seconds": map_seconds,
        "n_subhalos": n_subhalos,
    }


def mocks(repeats: int) -> dict[str, float]:
    """Noisy mock of two bands: perturbed rays, global shapelets and clumps, PSF, noise."""
    rng = np.random.default_rng(2)
    grid = PixelGrid.centred((PIXELS, PIXELS), PIXEL_SCALE)
    theta_x, theta_y = grid.subpixel_coordinates(1)
    names, kwargs = SMOOTH_LENS
    x, y = LensModel(names).ray_shooting(theta_x.ravel(), theta_y.ravel(), kwargs)
    rays_x, rays_y = x.reshape(theta_x.shape), y.reshape(theta_x.shape)
    sets = [ShapeletSet(N_MAX, BETA, *SOURCE)]
    sets += [ShapeletSet(CLUMP_N_MAX, CLUMP_BETA, *rng.normal(SOURCE, 0.25)) for _ in range(N_CLUMPS)]
    coefficients = rng.normal(size=(len(BANDS_NM), n_coefficients(sets)))
    convolutions = [
        Convolution(hst_like_psf(wavelength, PIXEL_SCALE, 81), grid.shape) for wavelength in BANDS_NM.values()
    ]
    delta_alpha = 1e-3 * rng.normal(size=(2, *grid.shape))
    rest = np.full(grid.shape, 10.0)  # quasars, lens light and background: images of the smooth model
    noise, sigma = NoiseModel(background_rms=0.0082, exposure_s=1980.0), np.ones(grid.shape)

    def mock() -> None:
        delta = subpixel_field(delta_alpha, 1)
        for amplitudes, convolution in zip(coefficients, convolutions, strict=True):
            image = lensed_image(sets, amplitudes, rays_x - delta[0], rays_y - delta[1], convolution)
            noise.draw(image + rest, sigma, rng)

    (seconds,) = in_turn([mock], repeats)
    return {"mock_seconds_two_bands": seconds}


def fit_minutes() -> dict[str, float]:
    """Minutes of the whole fit of the smooth model to the paper's simulated observation of two bands."""
    config = load_config([ROOT / "config.yaml"])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "observation.h5"
        run_job(make_job("observation", stage_settings(config, "observation"), path))
        observed = read_observation(path)
    start = time.perf_counter()
    fitted = fit_lens(config.smooth_model, observed)
    minutes = (time.perf_counter() - start) / 60.0
    return {"fit_minutes": minutes, "fit_chi2_per_pixel": fitted.solution.chi2 / fitted.solution.n_pixels}


def in_turn(works: list[Callable[[], object]], repeats: int) -> list[float]:
    """Median time [s] of each work; every round does all of them, so that all see the same load."""
    for work in works:
        work()  # compiles
    seconds: list[list[float]] = [[] for _ in works]
    for _ in range(repeats):
        for times, work in zip(seconds, works, strict=True):
            start = time.perf_counter()
            work()
            times.append(time.perf_counter() - start)
    return [statistics.median(times) for times in seconds]


def main() -> None:
    """Run all, print a table, write the numbers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path, help="file to write")
    parser.add_argument("--repeats", type=int, default=11, help="calls of which the median is taken")
    parser.add_argument("--quick", action="store_true", help="fewer subhalos and calls, and no fit")
    arguments = parser.parse_args()
    repeats = 3 if arguments.quick else arguments.repeats

    report = {**deflections(50 if arguments.quick else 500, repeats), **mocks(repeats)}
    if not arguments.quick:
        report |= fit_minutes()
    table = Table("number", "value", title=f"median of {repeats}")
    for name, value in report.items():
        table.add_row(name, f"{value:.4g}")
    Console().print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
