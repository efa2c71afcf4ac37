"""The scan at the paper's size: time, accuracy against a direct solve, memory and disk, in one run.

160 x 160 pixels, two bands, n_max 50 and 15 clumps of n_max 3, nested shapelets; 2,483 mocks at 6,400
positions are extrapolated from a sample. One thread:
OPENBLAS_NUM_THREADS=1 python benchmarks/scan.py [--quick] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path
from typing import NamedTuple

from warmlens import runtime

runtime.prepare()  # before numpy: one thread, and compiled kernels of this code

import numpy as np
from lenstronomy.LensModel.lens_model import LensModel
from scipy import linalg

from warmlens.fitting.linear import build_linear_model, physical_coefficients, solve
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.apply import delta_r, delta_r_and_response
from warmlens.scan.maps import residual_images, residual_maps
from warmlens.scan.nested import NestedShapelets
from warmlens.scan.operator import build_shard, project_band
from warmlens.scan.perturber import Perturber
from warmlens.scan.raster import Raster
from warmlens.scan.response import LinearResponse, expected_delta_r
from warmlens.scan.shard import OperatorShard, ScanBand
from warmlens.types import FloatArray

QUASARS = ((-2.037, -0.520), (-2.076, 0.662), (-1.460, -1.632), (1.074, 0.356))
SOURCE = (-0.503, -0.058)
PERTURBER = Perturber(0.01, 0.1)
ARRAYS = ("matrices", "sensitivity", "nested_inverse", "pixels", "responses", "response_noise")
NESTED = NestedShapelets(5, 1e-5, (0.02, 0.1))
BANDS = (814.0, 555.0)
MOCKS, CORES = 2483, 2


class Scene(NamedTuple):
    """Problem of one band, and its whitened mocks [npix, k]."""

    band: ScanBand
    data: FloatArray


class Measured(NamedTuple):
    """Seconds per unit, bytes per position, and the largest error of one band."""

    design: float
    build: float
    fit: float
    apply: float
    amplitude: float
    expected: float
    attenuation: float
    residuals: float
    direct: float
    n_bytes: float
    error: float


def smooth_rays(grid: PixelGrid, factor: int) -> SmoothRays:
    """Rays of the published smooth lens of RXJ1131-1231."""
    theta_x, theta_y = grid.subpixel_coordinates(factor)
    parameters = [
        {"theta_E": 1.634, "gamma": 1.957, "e1": 0.0831, "e2": 0.1065, "center_x": 0.0, "center_y": 0.0},
        {"gamma1": -0.0841, "gamma2": -0.0054},
        {"theta_E": 0.213, "center_x": -0.097, "center_y": 0.614},
    ]
    x, y = LensModel(["EPL", "SHEAR", "SIS"]).ray_shooting(theta_x.ravel(), theta_y.ravel(), parameters)
    return SmoothRays(theta_x, theta_y, x.reshape(theta_x.shape), y.reshape(theta_x.shape))


def make_scene(arguments: argparse.Namespace, wavelength: float) -> Scene:
    """Mocks of one band: a spiral's light that the basis cannot follow exactly, noise as in the paper's image."""
    rng = np.random.default_rng(int(wavelength))
    grid = PixelGrid.centred((arguments.pixels, arguments.pixels), 0.05)
    rays = smooth_rays(grid, arguments.factor)
    angle, distance = 2.4 * np.arange(15), 0.05 + 0.02 * np.arange(15)
    clumps = [
        ShapeletSet(3, 0.03, SOURCE[0] + float(r * np.cos(a)), SOURCE[1] + float(r * np.sin(a)))
        for a, r in zip(angle, distance, strict=True)
    ]
    sets = (ShapeletSet(arguments.n_max, 0.18, *SOURCE), *clumps)
    psf = hst_like_psf(wavelength, 0.05, arguments.psf)
    convolution = Convolution(psf, grid.shape)
    fixed = np.stack([*(point_source(psf, grid, *xy).ravel() for xy in QUASARS), np.ones(grid.ny * grid.nx)], 1)
    radius = np.hypot(rays.source_x - SOURCE[0], rays.source_y - SOURCE[1])
    light = (np.exp(-radius / 0.15) * (1.0 + 0.5 * np.cos(20.0 * radius))).mean(axis=1).reshape(grid.shape)
    image = convolution.forward(light)
    weights = 1.0 / np.sqrt(0.0082**2 + image / 1980.0)
    columns = pixel_basis(sets, rays.source_x, rays.source_y)
    model = build_linear_model(columns, fixed, convolution, weights, 1e-8)
    data = (weights * image).reshape(-1, 1) + rng.normal(size=(weights.size, arguments.mocks))
    return Scene(ScanBand(model, sets, rays, PERTURBER, convolution, weights), data)


def direct_minimum(scene: Scene, columns: FloatArray, nested: FloatArray, prior: float) -> float:
    """J of the first mock with this source basis: convolve, normal equations, Cholesky, residual."""
    band = scene.band
    images = np.ascontiguousarray(np.hstack([columns, nested]).T).reshape(-1, *band.convolution.shape)
    moved = (band.weights * band.convolution.forward(images)).reshape(-1, band.weights.size).T
    n_source, n_nested = band.model.n_source, nested.shape[1]
    norms = np.append(band.model.column_norms, np.ones(n_nested))
    design = np.hstack([moved[:, :n_source], band.model.design[:, n_source:], moved[:, n_source:]])
    design[:, :n_source] /= norms[:n_source]
    weight = np.append(band.model.prior, np.full(n_nested, prior))
    gram = design.T @ design
    gram[np.diag_indices_from(gram)] += weight
    data = scene.data[:, 0]
    x = linalg.cho_solve(linalg.cho_factor(gram, lower=True), design.T @ data)
    residual = data - design @ x
    return float(residual @ residual + weight @ x**2)


def direct_delta_r(scene: Scene, shard: OperatorShard, position: int) -> tuple[float, float]:
    """Delta R of the first mock by two direct solves, and the seconds of one of them."""
    x, y, beta = (float(value) for value in shard.points[position])
    nested = (ShapeletSet(NESTED.n_max, beta, x, y),)
    band = scene.band
    rays, place = band.rays, shard.positions[position]
    alpha = PERTURBER.deflection(rays.theta_x - place[0], rays.theta_y - place[1])
    minima: list[float] = []
    prior = 0.0
    for bend in ((0.0, 0.0), alpha):
        start = time.perf_counter()
        source = rays.source_x - bend[0], rays.source_y - bend[1]
        extra = pixel_basis(nested, *source)
        if not minima:
            seen = band.convolution.forward(np.ascontiguousarray(extra.T).reshape(-1, *band.weights.shape))
            prior = NESTED.ridge * float(np.sum((band.weights * seen) ** 2, axis=(1, 2)).max())
        minima.append(direct_minimum(scene, pixel_basis(band.sets, *source), extra, prior))
        seconds = time.perf_counter() - start
    return minima[1] - minima[0], seconds


def measure(arguments: argparse.Namespace, wavelength: float, positions: FloatArray) -> Measured:
    """Build and apply the operator of one band, and solve directly at some positions."""
    scene = make_scene(arguments, wavelength)
    band, data = scene
    model, convolution, weights = band.model, band.convolution, band.weights
    start = time.perf_counter()
    projection = project_band(band)
    design = time.perf_counter() - start

    def build(where: FloatArray) -> OperatorShard:
        return build_shard(band, projection, where, NESTED, response=True)

    build(positions[:1])  # compile
    start = time.perf_counter()
    shard = build(positions)
    build_seconds = (time.perf_counter() - start) / len(positions)
    start = time.perf_counter()
    fit = solve(model, data)
    back_projected = residual_images(fit, convolution, weights)
    fit_seconds = (time.perf_counter() - start) / arguments.mocks
    coefficients = physical_coefficients(model, fit.coefficients)[: model.n_source]
    delta_r(shard, band, coefficients[:, :1], back_projected[:, :1])  # compile
    start = time.perf_counter()
    maps = delta_r(shard, band, coefficients, back_projected)
    apply_seconds = (time.perf_counter() - start) / maps.size

    def respond(x: FloatArray, residuals: FloatArray) -> LinearResponse:
        return delta_r_and_response(shard, band, x, residuals)[1]

    respond(coefficients[:, :1], back_projected[:, :1])  # compile
    start = time.perf_counter()
    response = respond(coefficients, back_projected)
    amplitude_seconds = (time.perf_counter() - start) / maps.size - apply_seconds
    clean = solve(model, data.mean(axis=1, keepdims=True))  # nearly without noise
    source = physical_coefficients(model, clean.coefficients)[: model.n_source]
    quiet = respond(source, residual_images(clean, convolution, weights))
    seen = quiet.fisher[:, 0] > 1.0  # where eps of the perturber is known at all
    mean = response.fisher[seen].mean(axis=1)
    attenuation = float(np.median(quiet.fisher[seen, 0] / mean))
    predicted = np.median((mean - response.noise[seen, 0] * (1.0 - 1.0 / arguments.mocks)) / mean)
    print(f"Fisher information without over with noise: {attenuation:.3f}, predicted {predicted:.3f}")
    expected_delta_r(shard, band, [0.01], source[:, 0])  # compile
    start = time.perf_counter()
    expected_delta_r(shard, band, [0.01], source[:, 0])
    expected_seconds = (time.perf_counter() - start) / len(positions)
    alone = solve(model, data[:, :1])
    residual_maps(shard, band, alone)  # compile
    start = time.perf_counter()
    residual_maps(shard, band, alone)
    residual_seconds = (time.perf_counter() - start) / len(positions)
    errors, times = [], []
    for position in np.linspace(0, len(positions) - 1, arguments.direct).astype(int):
        expected, seconds = direct_delta_r(scene, shard, int(position))
        errors.append(abs(float(maps[position, 0]) - expected))
        times.append(seconds)
    n_bytes = sum(getattr(shard, name).nbytes for name in ARRAYS)
    print(
        f"{wavelength:.0f} nm: {model.design.shape[1]} columns, "
        f"{np.diff(shard.pixel_offsets).mean():.0f} pixels moved, "
        f"Delta R from {maps.min():.2f} to {maps.max():.2f}, direct {min(times):.2f} s"
    )
    return Measured(
        design, build_seconds, fit_seconds, apply_seconds, amplitude_seconds, expected_seconds, attenuation,
        residual_seconds, min(times), n_bytes / len(positions), max(errors),
    )  # fmt: skip


def main() -> None:
    """Measure both bands and extrapolate to the paper's campaign."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--n-max", type=int, default=50)
    parser.add_argument("--pixels", type=int, default=160)
    parser.add_argument("--psf", type=int, default=81, help="side of the PSF")
    parser.add_argument("--factor", type=int, default=1, help="sub-pixels along a side of a pixel")
    parser.add_argument("--mocks", type=int, default=250)
    parser.add_argument("--positions", type=int, default=640)
    parser.add_argument("--direct", type=int, default=6, help="positions solved directly")
    parser.add_argument("--quick", action="store_true", help="a sample of the sample, in two minutes")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.positions, arguments.direct = min(arguments.positions, 80), min(arguments.direct, 2)

    raster = Raster(4.0, 4.0, 0.05).coordinates()
    start = (len(raster) - arguments.positions) // 3  # through the arcs; a run of positions, as a shard is
    bands = [measure(arguments, wavelength, raster[start:][: arguments.positions]) for wavelength in BANDS]
    design, build, fit, apply, amplitude, expected, attenuation, residuals, direct, n_bytes, _ = np.mean(
        bands, axis=0
    )
    total = len(BANDS) * (design + len(raster) * build + MOCKS * fit + MOCKS * len(raster) * apply)
    result = {
        "us_per_mock_position_band": 1e6 * apply,
        "us_per_mock_position_band_amplitude": 1e6 * amplitude,
        "speedup_vs_direct": direct / apply,
        "max_abs_error": max(band.error for band in bands),
        "build_ms_per_position_band": 1e3 * build,
        "fit_ms_per_mock_band": 1e3 * fit,
        "residual_maps_ms_per_position_band": 1e3 * residuals,
        "expected_delta_r_ms_per_theta_e_position_band": 1e3 * expected,
        "median_fisher_without_over_with_noise": attenuation,
        "direct_seconds": direct,
        "campaign_minutes": total / CORES / 60.0,
        "campaign_minutes_without_building": len(BANDS) * MOCKS * (fit + len(raster) * apply) / CORES / 60.0,
        "peak_rss_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "operator_gb": len(BANDS) * len(raster) * n_bytes / 1e9,
        "mocks": arguments.mocks,
        "positions": arguments.positions,
    }
    for name, value in result.items():
        print(f"{name:36s} {value:12.6g}")
    if arguments.json:
        numbers = {name: float(value) for name, value in result.items()}
        arguments.json.write_text(json.dumps(numbers, indent=1) + "\n")


if __name__ == "__main__":
    main()
