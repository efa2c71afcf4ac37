"""Critical curves and caustics of a lens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from contourpy import contour_generator

from warmlens.lensing.macro_model import deflection
from warmlens.types import BoolArray, FloatArray

_SMALLEST_STEPS = 3.0
_CUT_STEPS = 1.5
_CENTRE = {"center_x", "center_y"}
_SINGULAR = 100.0  # determinant a thousandth of a step from the centre


@dataclass(frozen=True)
class CriticalCurve:
    """One connected critical curve and the caustic that it maps to, points (x, y) [n, 2] [arcsec]."""

    sky: FloatArray  # the last point is the first if the curve is closed
    source: FloatArray  # the same points in the source plane


def inverse_magnification(
    lens_model_list: Sequence[str], kwargs_lens: Sequence[Mapping[str, Any]], x: FloatArray, y: FloatArray
) -> FloatArray:
    """Return det(d beta / d theta) at positions [arcsec] of any shape; NaN where singular."""
    from lenstronomy.LensModel.lens_model import LensModel  # slow to import

    model = LensModel(list(lens_model_list))
    with np.errstate(divide="ignore", invalid="ignore"):  # at the very centre of a singular profile
        f_xx, f_xy, f_yx, f_yy = model.hessian(np.ravel(x), np.ravel(y), [dict(kwargs) for kwargs in kwargs_lens])
    return ((1.0 - f_xx) * (1.0 - f_yy) - f_xy * f_yx).reshape(np.shape(x))


def critical_curves(
    lens_model_list: Sequence[str],
    kwargs_lens: Sequence[Mapping[str, Any]],
    window: tuple[float, float, float, float],
    step_arcsec: float = 0.02,
) -> list[CriticalCurve]:
    """Find where the determinant of the Jacobian changes its sign, and the caustics, the longest curve first.

    Parameters
    ----------
    lens_model_list, kwargs_lens
        The lens in lenstronomy's names.
    window
        Smallest x, largest x, smallest y, largest y on the sky [arcsec]; curves end at its edge.
    step_arcsec
        Step of the grid on which the determinant is evaluated. The curves are interpolated linearly between its
        points, which leaves an error of about step^2 / (4 theta_E).

    Notes
    -----
    At the centre of a singular profile the determinant changes its sign through infinity, which on a grid looks
    like a critical curve. Curves are therefore cut there, and those smaller than three steps are left out.
    """
    x0, x1, y0, y1 = window
    if not (x0 < x1 and y0 < y1 and step_arcsec > 0.0):
        raise ValueError(f"window {window} and step {step_arcsec} of the critical curves must be positive")
    x = np.linspace(x0, x1, int(np.ceil((x1 - x0) / step_arcsec)) + 1)
    y = np.linspace(y0, y1, int(np.ceil((y1 - y0) / step_arcsec)) + 1)
    determinant = inverse_magnification(lens_model_list, kwargs_lens, *np.meshgrid(x, y))
    generator = contour_generator(x, y, np.ma.masked_invalid(determinant), line_type="Separate")
    singular = _singular_centres(lens_model_list, kwargs_lens, step_arcsec)
    pieces: list[FloatArray] = []
    for line in cast("list[FloatArray]", generator.lines(0.0)):
        distance = np.hypot(*(line[:, None] - singular).T).min(axis=0, initial=np.inf)
        pieces += _runs(line, distance > _CUT_STEPS * step_arcsec)
    pieces = [piece for piece in pieces if np.ptp(piece, axis=0).max() >= _SMALLEST_STEPS * step_arcsec]
    curves = []
    for piece in sorted(pieces, key=_length, reverse=True):
        alpha = deflection(lens_model_list, kwargs_lens, piece[:, 0], piece[:, 1])
        curves.append(CriticalCurve(piece, piece - alpha.T))
    return curves


def _singular_centres(
    lens_model_list: Sequence[str], kwargs_lens: Sequence[Mapping[str, Any]], step_arcsec: float
) -> FloatArray:
    """Return the centres of the profiles about which the determinant has no bound [n, 2] [arcsec]."""
    positions = [(kwargs["center_x"], kwargs["center_y"]) for kwargs in kwargs_lens if kwargs.keys() >= _CENTRE]
    centres = np.array(positions).reshape(-1, 2)
    around = 1e-3 * step_arcsec * np.array([[1.0, 0.2], [-0.2, 1.0], [-1.0, -0.2], [0.2, -1.0]])
    points = centres[:, None] + around
    determinant = inverse_magnification(lens_model_list, kwargs_lens, points[..., 0], points[..., 1])
    return centres[np.abs(determinant).max(axis=1) > _SINGULAR]


def _runs(line: FloatArray, good: BoolArray) -> list[FloatArray]:
    """Split a curve [n, 2] at the points that are not good."""
    if good.all():
        return [line]
    if np.array_equal(line[0], line[-1]):  # closed: begin at a bad point, so that no part is cut in two
        first = int(np.flatnonzero(~good)[0])
        line, good = np.roll(line[:-1], -first, axis=0), np.roll(good[:-1], -first)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int64)))
    return [line[start:stop] for start, stop in edges.reshape(-1, 2)]


def _length(line: FloatArray) -> float:
    return float(np.hypot(*np.diff(line, axis=0).T).sum())
