from __future__ import annotations

import numpy as np
import pytest
from lenstronomy.LensModel.lens_model import LensModel
from lenstronomy.LensModel.lens_model_extensions import LensModelExtensions
from scipy.spatial import cKDTree

from warmlens.lensing.critical_curves import critical_curves, inverse_magnification
from warmlens.lensing.macro_model import deflection
from warmlens.types import FloatArray

WINDOW = (-2.5, 2.5, -2.5, 2.5)
SIS = (["SIS"], [{"theta_E": 1.1, "center_x": 0.203, "center_y": -0.107}])
EPL = (
    ["EPL", "SHEAR"],
    [
        {"theta_E": 1.4, "gamma": 1.9, "e1": 0.12, "e2": -0.07, "center_x": 0.03, "center_y": 0.05},
        {"gamma1": -0.06, "gamma2": 0.04},
    ],
)


def test_isothermal_sphere_has_its_einstein_ring_and_a_point() -> None:
    (curve,) = critical_curves(*SIS, WINDOW)
    center = np.array([0.203, -0.107])
    np.testing.assert_allclose(np.hypot(*(curve.sky - center).T), 1.1, atol=1e-4)
    np.testing.assert_allclose(curve.source, np.broadcast_to(center, curve.source.shape), atol=2e-4)
    np.testing.assert_array_equal(curve.sky[0], curve.sky[-1])


def test_elliptical_power_law_with_shear_equals_lenstronomy() -> None:
    curves = critical_curves(*EPL, WINDOW)
    model = LensModelExtensions(LensModel(EPL[0]))
    x, y, source_x, source_y = model.critical_curve_caustics(EPL[1], compute_window=5, grid_scale=0.01)
    assert len(curves) == len(x) == 2  # tangential, and radial since the slope is below isothermal
    expected = sorted(
        (np.column_stack(columns) for columns in zip(x, y, source_x, source_y, strict=True)),
        key=len,
        reverse=True,
    )
    for curve, theirs in zip(curves, expected, strict=True):
        for mine, other in ((curve.sky, theirs[:, :2]), (curve.source, theirs[:, 2:])):
            assert cKDTree(_dense(other)).query(mine)[0].max() < 1e-2
            assert cKDTree(_dense(mine)).query(other)[0].max() < 1e-2


def _dense(line: FloatArray) -> FloatArray:
    """Twenty points on every segment of a curve."""
    place = np.linspace(0, len(line) - 1, 20 * (len(line) - 1) + 1)
    return np.column_stack([np.interp(place, np.arange(len(line)), column) for column in line.T])


def test_determinant_is_that_of_finite_differences() -> None:
    x, y = np.array([1.0, -0.6, 0.2]), np.array([0.3, 0.8, -1.7])
    h = 1e-5
    along_x = (deflection(*EPL, x + h, y) - deflection(*EPL, x - h, y)) / (2 * h)
    along_y = (deflection(*EPL, x, y + h) - deflection(*EPL, x, y - h)) / (2 * h)
    expected = (1 - along_x[0]) * (1 - along_y[1]) - along_x[1] * along_y[0]
    np.testing.assert_allclose(inverse_magnification(*EPL, x, y), expected, atol=1e-6)


@pytest.mark.parametrize("step", [0.02, 0.01, 0.013])
@pytest.mark.parametrize("center", [(0.5, 0.5), (0.503, 0.496)])
def test_curves_end_at_the_singular_centre_of_a_satellite(step: float, center: tuple[float, float]) -> None:
    """Its two lobes meet there; a line from one to the other would be no caustic."""
    satellite = {"theta_E": 0.2, "center_x": center[0], "center_y": center[1]}
    lens = ([*EPL[0], "SIS"], [*EPL[1], satellite])
    curves = critical_curves(*lens, WINDOW, step)
    assert len(curves) == 4  # tangential, radial, two lobes
    for curve in curves:
        if np.hypot(*(curve.sky - center).T).min() < 5 * step:
            assert not np.array_equal(curve.sky[0], curve.sky[-1])
            angles = np.unwrap(np.arctan2(*(curve.sky - center).T))
            assert np.ptp(angles) < np.pi  # on one side of the satellite


def test_centre_on_a_point_of_the_grid() -> None:
    curves = critical_curves(["EPL"], [{**EPL[1][0], "center_x": 0.0, "center_y": 0.0, "gamma": 2.1}], WINDOW)
    assert len(curves) == 1


def test_lens_without_critical_curves() -> None:
    assert critical_curves(["SHEAR"], [{"gamma1": 0.1, "gamma2": 0.0}], WINDOW) == []


@pytest.mark.parametrize(("window", "step"), [((1.0, -1.0, -1.0, 1.0), 0.02), (WINDOW, 0.0)])
def test_empty_window_is_refused(window: tuple[float, float, float, float], step: float) -> None:
    with pytest.raises(ValueError, match="window"):
        critical_curves(*SIS, window, step)
