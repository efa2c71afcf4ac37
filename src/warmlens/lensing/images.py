"""Images of a point source: the lens equation solved on a deflection that is given at the pixels."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import RectBivariateSpline

from warmlens.imaging.grid import PixelGrid
from warmlens.types import FloatArray

TOLERANCE_ARCSEC = 1e-9  # in the source plane
MAX_STEP_ARCSEC = 0.05  # of one iteration: Newton's step is too long near a critical curve
MAX_ITERATIONS = 100


class DeflectionField:
    """Deflection (x, y) [2, ny, nx] [arcsec] at the pixel centres, interpolated with a cubic spline."""

    def __init__(self, deflection: FloatArray, grid: PixelGrid) -> None:
        if deflection.shape != (2, *grid.shape):
            raise ValueError(f"the deflection must be [2, {grid.ny}, {grid.nx}], got {deflection.shape}")
        self.grid = grid
        self._splines = [
            RectBivariateSpline(np.arange(grid.ny), np.arange(grid.nx), plane) for plane in deflection
        ]

    def lens(self, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return source positions [n, 2] of sky positions [n, 2] [arcsec], and d source / d sky [n, 2, 2].

        Raises
        ------
        ValueError
            If a position lies off the image.
        """
        columns, rows = self.grid.to_pixel(positions[:, 0], positions[:, 1])
        inside = (columns >= 0) & (columns <= self.grid.nx - 1) & (rows >= 0) & (rows <= self.grid.ny - 1)
        if not inside.all():
            raise ValueError(f"a point-source image left the image, at {positions[~inside][0].tolist()} arcsec")
        alpha = np.stack([spline.ev(rows, columns) for spline in self._splines], axis=1)
        along = np.stack(  # d alpha_i / d (column, row)
            [
                np.stack([spline.ev(rows, columns, dy=1), spline.ev(rows, columns, dx=1)], axis=1)
                for spline in self._splines
            ],
            axis=1,
        )
        # the axes are orthonormal, so d (column, row) / d sky is their transpose over the pixel scale
        jacobian = np.eye(2) - along @ np.array(self.grid.axes).T / self.grid.pixel_scale
        return positions - alpha, jacobian


def solve_images(field: DeflectionField, source: FloatArray, start: FloatArray) -> FloatArray:
    """Find the images [n, 2] of a source position [2] by Newton's method from sky positions [n, 2] [arcsec].

    At an image, theta - alpha(theta) is the source position to `TOLERANCE_ARCSEC`.

    Raises
    ------
    ArithmeticError
        If an image does not converge, or its parity changed: then it is another image.
    ValueError
        If an image leaves the field.
    """
    images = np.array(start, dtype=np.float64)
    traced, jacobian = field.lens(images)
    parity = np.sign(np.linalg.det(jacobian))
    for _ in range(MAX_ITERATIONS):
        offset = source - traced
        if np.abs(offset).max() < TOLERANCE_ARCSEC:
            break
        step = np.linalg.solve(jacobian, offset[:, :, None])[:, :, 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        images += step * np.minimum(1.0, MAX_STEP_ARCSEC / np.maximum(length, np.finfo(np.float64).tiny))
        traced, jacobian = field.lens(images)
    else:
        worst = int(np.argmax(np.abs(offset).max(axis=1)))
        raise ArithmeticError(
            f"point-source image {worst} did not converge in {MAX_ITERATIONS} steps from "
            f"{start[worst].tolist()}: {np.abs(offset[worst]).max():.2e} arcsec are left in the source plane"
        )
    changed = np.sign(np.linalg.det(jacobian)) != parity
    if changed.any():
        first = int(np.argmax(changed))
        raise ArithmeticError(
            f"point-source image {first} crossed a critical curve from {start[first].tolist()} to "
            f"{images[first].tolist()}: it is another image"
        )
    return images


def moved_images(smooth: DeflectionField, perturbed: DeflectionField, observed: FloatArray) -> FloatArray:
    """Return the positions [n, 2] [arcsec] to which a perturbation of the lens moves observed images [n, 2].

    The source is the mean of the observed images traced through the smooth lens. Its images in the smooth lens
    differ from the observed ones, since that lens is imperfect. This difference is kept, so that without a
    perturbation the images are the observed ones.
    """
    source = smooth.lens(observed)[0].mean(axis=0)
    unperturbed = solve_images(smooth, source, observed)
    return observed + (solve_images(perturbed, source, unperturbed) - unperturbed)
