"""Scan of one position: the low-rank operator against a direct solve, in one run, at the paper's size.

Prints both times, their ratio and the difference in Delta R. One thread is the fair setting:
OPENBLAS_NUM_THREADS=1 python benchmarks/scan.py
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from lenstronomy.LensModel.lens_model import LensModel
from scipy import linalg

from warmlens.fitting.linear import LinearModel, build_linear_model, physical_coefficients, solve
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.maps import delta_r, residual_images
from warmlens.scan.operator import build_shard, project_band
from warmlens.scan.perturber import Perturber
from warmlens.types import FloatArray

QUASARS = ((-2.037, -0.520), (-2.076, 0.662), (-1.460, -1.632), (1.074, 0.356))
SOURCE = (-0.503, -0.058)


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


def direct_minimum(
    columns: FloatArray, convolution: Convolution, weights: FloatArray, model: LinearModel, data: FloatArray
) -> float:
    """J of one image with another source basis: convolve, normal equations, Cholesky, residual."""
    images = np.ascontiguousarray(columns.T).reshape(-1, *convolution.shape)
    design = model.design.copy()
    design[:, : model.n_source] = (weights * convolution.forward(images)).reshape(-1, weights.size).T
    design[:, : model.n_source] /= model.column_norms[: model.n_source]
    gram = design.T @ design
    gram[np.diag_indices_from(gram)] += model.ridge
    x = linalg.cho_solve(linalg.cho_factor(gram, lower=True), design.T @ data)
    residual = data - design @ x
    return float(residual @ residual + model.ridge * x @ x)


def main() -> None:
    """Time a direct solve and the operator at the same position."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--n-max", type=int, default=50)
    parser.add_argument("--pixels", type=int, default=160)
    parser.add_argument("--factor", type=int, default=2, help="sub-pixels along a side of a pixel")
    parser.add_argument("--mocks", type=int, default=250)
    parser.add_argument("--positions", type=int, default=100)
    arguments = parser.parse_args()

    rng = np.random.default_rng(0)
    grid = PixelGrid.centred((arguments.pixels, arguments.pixels), 0.05)
    rays = smooth_rays(grid, arguments.factor)
    sets = (ShapeletSet(arguments.n_max, 0.18, *SOURCE),)
    psf = hst_like_psf(814.0, 0.05, 161)
    convolution = Convolution(psf, grid.shape)
    fixed = np.stack([*(point_source(psf, grid, *xy).ravel() for xy in QUASARS), np.ones(grid.ny * grid.nx)], 1)
    radius = np.hypot(rays.source_x - SOURCE[0], rays.source_y - SOURCE[1])
    light = (np.exp(-radius / 0.15) * (1.0 + 0.5 * np.cos(20.0 * radius))).mean(axis=1).reshape(grid.shape)
    image = convolution.forward(light)
    weights = 1.0 / np.sqrt(0.0082**2 + image / 1980.0)
    columns = pixel_basis(sets, rays.source_x, rays.source_y)
    model = build_linear_model(columns, fixed, convolution, weights, 1e-8)
    perturber = Perturber(0.01, 0.1)
    projection = project_band(model, convolution, weights, rays, perturber)
    angle = np.linspace(0.0, 2.0 * np.pi, arguments.positions, endpoint=False)
    positions = 1.8 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    data = (weights * image).reshape(-1, 1) + rng.normal(size=(weights.size, arguments.mocks))

    build_shard(model, projection, weights, sets, rays, perturber, positions[:1])  # compile
    start = time.perf_counter()
    shard = build_shard(model, projection, weights, sets, rays, perturber, positions)
    build_seconds = (time.perf_counter() - start) / arguments.positions
    start = time.perf_counter()
    fit = solve(model, data)
    tau = residual_images(fit, convolution, weights)
    fit_seconds = (time.perf_counter() - start) / arguments.mocks
    coefficients = physical_coefficients(model, fit.coefficients)[: model.n_source]
    delta_r(shard, sets, rays, perturber, coefficients[:, :1], tau[:, :1])  # compile
    start = time.perf_counter()
    maps = delta_r(shard, sets, rays, perturber, coefficients, tau)
    apply_seconds = (time.perf_counter() - start) / maps.size

    alpha = perturber.deflection(rays.theta_x - positions[0, 0], rays.theta_y - positions[0, 1])
    start = time.perf_counter()
    moved = pixel_basis(sets, rays.source_x - alpha[0], rays.source_y - alpha[1])
    perturbed = direct_minimum(moved, convolution, weights, model, data[:, 0])
    direct_seconds = time.perf_counter() - start
    smooth = direct_minimum(columns, convolution, weights, model, data[:, 0])

    print(f"{model.design.shape[1]} columns, {weights.size} pixels, {arguments.mocks} mocks")
    print(f"operator           {1e3 * build_seconds:8.2f} ms per position")
    print(f"smooth fit         {1e3 * fit_seconds:8.2f} ms per mock")
    print(f"scan               {1e6 * apply_seconds:8.2f} us per mock and position")
    print(f"direct solve       {direct_seconds:8.2f} s  per mock and position")
    print(f"ratio              {direct_seconds / apply_seconds:8.0f}")
    print(f"Delta R            {maps[0, 0]:.6f}, direct {perturbed - smooth:.6f}")


if __name__ == "__main__":
    main()
