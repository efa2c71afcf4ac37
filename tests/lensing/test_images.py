"""Images of a point source against lenstronomy's lens equation solver and by construction."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from lenstronomy.LensModel.lens_model import LensModel
from lenstronomy.LensModel.Solver.lens_equation_solver import LensEquationSolver

from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.deflection import TnfwHalos, tnfw_deflection
from warmlens.lensing.images import DeflectionField, moved_images, solve_images
from warmlens.lensing.macro_model import deflection

C, S = np.cos(0.3), np.sin(0.3)
GRID = PixelGrid(130, 130, 0.05, -2.2, -4.0, ((C, -S), (S, C)))
QUASARS = np.array([[-2.037, -0.520], [-2.076, 0.662], [-1.460, -1.632], [1.074, 0.356]])
SUBHALO = TnfwHalos([-1.9], [-0.3], [0.15], [0.6], [0.02])


@pytest.fixture(scope="module")
def smooth(paper_lens: tuple[list[str], list[dict[str, Any]]]) -> np.ndarray:
    return deflection(*paper_lens, *GRID.coordinates())


def test_the_grid_covers_the_images() -> None:
    columns, rows = GRID.to_pixel(*QUASARS.T)
    assert min(columns.min(), rows.min()) > 5 and max(columns.max(), rows.max()) < 124


def test_images_are_those_of_lenstronomy(
    smooth: np.ndarray, paper_lens: tuple[list[str], list[dict[str, Any]]]
) -> None:
    names, kwargs = paper_lens
    perturbed = smooth + tnfw_deflection(*GRID.coordinates(), SUBHALO)
    source = np.array([-0.503, -0.058])
    images = solve_images(DeflectionField(perturbed, GRID), source, QUASARS)
    tnfw = {"Rs": 0.15, "alpha_Rs": 0.02 * (1 - np.log(2)), "r_trunc": 0.6, "center_x": -1.9, "center_y": -0.3}
    solver = LensEquationSolver(LensModel([*names, "TNFW"]))
    x, y = solver.image_position_from_source(
        *source, [*kwargs, tnfw], min_distance=0.05, search_window=6.0, precision_limit=1e-12
    )
    distance = np.hypot(images[:, 0, None] - x, images[:, 1, None] - y)
    assert distance.min(axis=1).max() < 1e-5  # the spline's error times the magnification
    assert len(set(distance.argmin(axis=1))) == 4
    unperturbed = solve_images(DeflectionField(smooth, GRID), source, QUASARS)
    assert np.hypot(*(unperturbed - images).T).max() > 1e-3


def test_without_a_perturbation_nothing_moves(smooth: np.ndarray) -> None:
    field = DeflectionField(smooth, GRID)
    np.testing.assert_allclose(moved_images(field, field, QUASARS), QUASARS, rtol=0, atol=1e-12)


def test_a_small_perturbation_moves_by_the_magnification(smooth: np.ndarray) -> None:
    """A constant deflection d moves an image by the inverse Jacobian times d."""
    field = DeflectionField(smooth, GRID)
    shift = np.array([3e-6, -2e-6])
    moved = moved_images(field, DeflectionField(smooth + shift[:, None, None], GRID), QUASARS)
    source = field.lens(QUASARS)[0].mean(axis=0)
    jacobian = field.lens(solve_images(field, source, QUASARS))[1]
    expected = np.linalg.solve(jacobian, np.broadcast_to(shift[:, None], (4, 2, 1)))[..., 0]
    np.testing.assert_allclose(moved - QUASARS, expected, rtol=2e-3, atol=1e-9)
    assert np.abs(expected).max() > 2 * np.abs(shift).max()


def test_jacobian_is_the_derivative(smooth: np.ndarray) -> None:
    field = DeflectionField(smooth, GRID)
    _, jacobian = field.lens(QUASARS)
    step = 1e-5
    for axis in range(2):
        offset = step * np.eye(2)[axis]
        numeric = (field.lens(QUASARS + offset)[0] - field.lens(QUASARS - offset)[0]) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, axis], numeric, atol=1e-6)


def test_failures_are_errors(smooth: np.ndarray) -> None:
    field = DeflectionField(smooth, GRID)
    with pytest.raises((ArithmeticError, ValueError), match="point-source image"):
        solve_images(field, np.array([0.9, 0.9]), QUASARS)  # a source with fewer images
    with pytest.raises(ValueError, match="left the image"):
        field.lens(np.array([[40.0, 0.0]]))
    with pytest.raises(ValueError, match="deflection must be"):
        DeflectionField(smooth[:, :-1], GRID)


def test_an_image_that_crosses_a_critical_curve_is_another() -> None:
    """alpha_x = x - (x^2 / 2 - c): a fold at x = 0; the images at -a and a change places."""
    grid = PixelGrid.centred((41, 41), 0.05)
    x, y = grid.coordinates()
    fold = DeflectionField(np.stack([x - 0.5 * x**2, 0.0 * y]), grid)
    assert solve_images(fold, np.array([0.08, 0.0]), np.array([[0.3, 0.0]]))[0, 0] == pytest.approx(0.4)
    with pytest.raises(ArithmeticError, match=r"did not converge|critical curve"):
        solve_images(fold, np.array([-0.02, 0.0]), np.array([[0.3, 0.0]]))  # both images are gone
    fine = PixelGrid.centred((101, 101), 0.004)
    x, y = fine.coordinates()
    waves = DeflectionField(np.stack([x - 0.1 * np.sin(80.0 * x), 0.0 * y]), fine)  # an image every 0.039 arcsec
    assert solve_images(waves, np.zeros(2), np.array([[0.005, 0.0]]))[0, 0] == pytest.approx(0.0, abs=1e-8)
    with pytest.raises(ArithmeticError, match="crossed a critical curve"):
        solve_images(waves, np.zeros(2), np.array([[1.5 / 80.0, 0.0]]))
