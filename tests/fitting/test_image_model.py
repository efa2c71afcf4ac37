"""The smooth model as a function of its parameters: amplitudes, residuals, and the gradient of chi2."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from warmlens.fitting.image_model import FitBand, ImageModel, SourceBasis
from warmlens.fitting.linear import build_linear_model, physical_coefficients, solve
from warmlens.fitting.parameters import (
    Macro,
    ParameterSpace,
    beta_parameter,
    free_parameters,
    quasar_parameters,
    shapelet_parameters,
)
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.macro_model import deflection, light_images
from warmlens.types import FloatArray

GRID = PixelGrid.centred((48, 52), 0.07)
LENSES = ("EPL", "SHEAR", "SIS", "SHAPELETS_CART")
LIGHTS = ("SERSIC_ELLIPSE", "SERSIC")
KWARGS_LENS = (
    {"theta_E": 1.0, "gamma": 2.05, "e1": 0.12, "e2": 0.05, "center_x": 0.01, "center_y": -0.02},
    {"gamma1": 0.06, "gamma2": 0.02},
    {"theta_E": 0.1, "center_x": 0.313, "center_y": 0.689},
    {"beta": 1.0, "center_x": 0.0, "center_y": 0.0, "coeffs": [0.0, 0.01, -0.01, 0.005, 0.01, -0.005]},
)
KWARGS_LIGHT = (
    {"R_sersic": 0.3, "n_sersic": 1.5, "e1": 0.05, "e2": 0.02, "center_x": 0.013, "center_y": -0.017},
    {"R_sersic": 0.15, "n_sersic": 1.2, "center_x": 0.0, "center_y": 0.0},
)
QUASARS = np.array([[0.776, -0.771], [-0.761, 0.731], [-0.971, -0.412], [0.449, 1.021]])
FLUXES = (120.0, 80.0, 60.0, 90.0)
CLUMPS = (ShapeletSet(1, 0.3, 0.6, -0.4),)  # in units of the global scale
BETA = 0.2
FREE_LENS: list[dict[str, tuple[float, float, float | None]]] = [
    {
        "theta_E": (0.5, 1.5, None),
        "gamma": (1.5, 2.5, 0.1),
        "e1": (-0.4, 0.4, None),
        "center_y": (-0.3, 0.3, None),
    },
    {"gamma1": (-0.4, 0.4, None)},
    {"theta_E": (0.0, 0.6, 0.05), "center_x": (-0.6, 0.6, 0.05), "center_y": (0.1, 1.1, 0.05)},
    {},
]
FREE_LIGHT: list[dict[str, tuple[float, float, float | None]]] = [
    {"R_sersic": (0.05, 1.5, None), "n_sersic": (0.3, 6.0, 0.5), "e2": (-0.4, 0.4, None),
     "center_x": (-0.3, 0.3, None)},
    {"R_sersic": (0.005, 0.5, 0.03)},
]  # fmt: skip


def build(center: tuple[float, float] | None = None, supersampling: int = 1) -> ImageModel:
    """A quad with arcs, light of two galaxies and noise in two bands, the second with a mask."""
    parameters = [
        *free_parameters("lens", KWARGS_LENS, FREE_LENS),
        *shapelet_parameters(3, KWARGS_LENS[3]["coeffs"], 0.05),  # type: ignore[arg-type]
        *free_parameters("light", KWARGS_LIGHT, FREE_LIGHT),
        *quasar_parameters(QUASARS, 0.005),
        beta_parameter(BETA, (0.1, 0.4, 0.05)),
    ]
    space = ParameterSpace(Macro(KWARGS_LENS, KWARGS_LIGHT, QUASARS, BETA), tuple(parameters), ((2, 1),))
    rng = np.random.default_rng(7)
    bands = []
    for name, wavelength, flux in (("red", 814.0, 1.0), ("blue", 600.0, 0.6)):
        weights = rng.uniform(20.0, 50.0, GRID.shape)
        if name == "blue":
            weights[20:26, 22:30] = 0.0
        psf = hst_like_psf(wavelength, GRID.pixel_scale, 15)
        image = flux * smooth_image(psf, rng) + rng.normal(size=GRID.shape) / np.maximum(weights, 20.0)
        bands.append(FitBand(name, image, weights, psf))
    return ImageModel(
        grid=GRID, bands=tuple(bands), space=space, lens_models=LENSES, light_models=LIGHTS,
        basis=SourceBasis(5, center, CLUMPS), supersampling=supersampling, fit_background=True,
        ridge=1e-10, tie_arcsec=0.003,
    )  # fmt: skip


def smooth_image(psf: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Noise-free image whose source is richer than the model's, so that the residuals hold structure."""
    x, y = GRID.subpixel_coordinates(1)
    alpha = deflection(LENSES, KWARGS_LENS, x, y)
    shapelets = ShapeletSet(7, 0.2, 0.05, 0.02)
    coefficients = rng.normal(size=shapelets.n_coefficients) * 0.2
    coefficients[0] = 4.0
    light = (pixel_basis([shapelets], x - alpha[0], y - alpha[1]) @ coefficients).reshape(GRID.shape)
    galaxies = np.tensordot((60.0, 20.0), light_images(LIGHTS, KWARGS_LIGHT, GRID, 1), axes=1)
    quasars = sum(f * point_source(psf, GRID, *q) for f, q in zip(FLUXES, QUASARS, strict=True))
    return Convolution(psf, GRID.shape).forward(light + galaxies) + quasars + 0.02


@pytest.fixture(scope="module")
def model() -> ImageModel:
    return build()


def shifted(model: ImageModel) -> FloatArray:
    """A vector away from every first value, so that priors and tie pull, too."""
    lower, upper = model.space.limits
    rng = np.random.default_rng(11)
    scale = np.minimum(0.05 * (upper - lower), 0.3 * model.space.prior_sigma)
    return model.space.start + scale * rng.uniform(-0.3, 0.3, lower.size)


def differences(model: ImageModel, vector: FloatArray) -> FloatArray:
    """Derivative of |residuals|^2 / 2 along every parameter: fourth-order central differences."""

    def cost(values: FloatArray) -> float:
        residuals = model.residuals(model.solve(values))
        return 0.5 * float(residuals @ residuals)

    out = []
    for j in range(vector.size):
        step = np.zeros(vector.size)
        step[j] = 2e-4
        near = cost(vector + step) - cost(vector - step)
        far = cost(vector + 2 * step) - cost(vector - 2 * step)
        out.append((8.0 * near - far) / (12.0 * step[j]))
    return np.array(out)


@pytest.mark.parametrize(
    ("center", "supersampling", "temperature"), [(None, 1, 1.0), ((0.04, 0.03), 2, 3.0)], ids=["quasars", "fixed"]
)
def test_gradient(center: tuple[float, float] | None, supersampling: int, temperature: float) -> None:
    """J^T r against differences of the cost, for every kind of parameter, in units of its own curvature."""
    model = replace(build(center, supersampling), temperature=temperature)
    vector = shifted(model)
    solution = model.solve(vector)
    jacobian, residuals = model.jacobian(solution), model.residuals(solution)
    gradient, expected = jacobian.T @ residuals, differences(model, vector)
    scale = np.linalg.norm(jacobian, axis=0)  # the gradient of a step of one sigma that moves chi2 by order 1
    assert np.all(np.abs(gradient - expected) < 1e-3 * np.maximum(np.abs(expected), scale)), dict(
        zip(model.space.names, zip(gradient, expected, scale, strict=True), strict=True)
    )
    large = np.abs(expected) > scale
    kinds = {name.split(".")[0] + name.split(".")[1][:6] for name, is_large in
             zip(model.space.names, large, strict=True) if is_large}  # fmt: skip
    assert len(kinds) > 10  # the test holds most gradients to 1e-3 of themselves


def test_gradient_needs_the_moving_source_centre() -> None:
    """Wrong twin: the derivative of a source that stays where it is misses the motion of the basis."""
    model = build()
    vector = shifted(model)
    solution = model.solve(vector)
    still = replace(
        model, basis=replace(model.basis, center=(float(solution.center[0]), float(solution.center[1])))
    )
    np.testing.assert_allclose(still.solve(vector).chi2, solution.chi2, rtol=1e-12)
    images, _ = model.derivatives(solution)
    others, _ = still.derivatives(solution)
    j = model.space.names.index("lens_1.gamma1")
    assert np.abs(images[0][:, j] - others[0][:, j]).max() > 0.1 * np.abs(images[0][:, j]).max()
    light = model.space.names.index("light_0.R_sersic")
    np.testing.assert_array_equal(images[0][:, light], others[0][:, light])


def test_jacobian_of_tie_and_priors(model: ImageModel) -> None:
    """Rows below the pixels: the quasars' scatter over the tie, then the pulls; exact to differences."""
    vector = shifted(model)
    solution = model.solve(vector)
    n = solution.n_pixels
    rows = model.jacobian(solution)[n:]
    below = model.residuals(solution)[n:]
    n_parameters, step = vector.size, 1e-4
    assert rows.shape == (8 + n_parameters, n_parameters)
    tie = (solution.quasar_sources - solution.quasar_sources.mean(axis=0)) / 0.003
    np.testing.assert_allclose(below[:8], tie.ravel(), rtol=1e-12)
    np.testing.assert_allclose(below[8:], (vector - model.space.start) / model.space.prior_sigma, rtol=1e-12)
    for j in range(n_parameters):
        move = np.zeros(n_parameters)
        move[j] = step
        up, down = (model.residuals(model.solve(vector + sign * move))[n:] for sign in (1.0, -1.0))
        np.testing.assert_allclose(rows[:, j], (up - down) / (2 * step), rtol=0, atol=1e-4 * np.abs(rows).max())


def test_amplitudes_are_those_of_the_linear_model(model: ImageModel) -> None:
    """`fitting.linear` on columns made here, one by one."""
    vector = shifted(model)
    solution = model.solve(vector)
    macro = model.space.macro(vector)
    x, y = GRID.subpixel_coordinates(1)
    alpha = deflection(LENSES, macro.kwargs_lens, x, y)
    traced = macro.quasars - deflection(LENSES, macro.kwargs_lens, *macro.quasars.T).T
    center = traced.mean(axis=0)
    np.testing.assert_allclose(solution.center, center, atol=1e-14)
    np.testing.assert_allclose(solution.quasar_sources, traced, atol=1e-14)
    beta = vector[-1]  # clumps grow and move with the global set
    assert beta != BETA
    sets = (
        ShapeletSet(5, beta, *center),
        ShapeletSet(1, 0.3 * beta, center[0] + 0.6 * beta, center[1] - 0.4 * beta),
    )
    source = pixel_basis(sets, x - alpha[0], y - alpha[1])
    assert macro.kwargs_light[1]["center_x"] == macro.kwargs_lens[2]["center_x"] != KWARGS_LIGHT[1]["center_x"]
    light = light_images(LIGHTS, macro.kwargs_light, GRID, 1)
    for band, solved in zip(model.bands, solution.bands, strict=True):
        convolution = Convolution(band.psf, GRID.shape)
        images = [point_source(band.psf, GRID, *quasar) for quasar in macro.quasars]
        images += [*convolution.forward(light), np.ones(GRID.shape)]
        fixed = np.array(images).reshape(7, -1).T
        linear = build_linear_model(source, fixed, convolution, band.weights, model.ridge)
        fit = solve(linear, (band.weights * band.image).reshape(-1, 1))
        expected = physical_coefficients(linear, fit.coefficients)[:, 0]
        np.testing.assert_allclose(solved.amplitudes, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())
        assert solved.chi2 == pytest.approx(fit.chi2[0], rel=1e-9)
        assert solved.n_source == 21 + 3
        np.testing.assert_allclose(solved.fixed_amplitudes, expected[-7:], rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(solved.pixels, np.flatnonzero(band.weights))
        whole = np.zeros(GRID.ny * GRID.nx)
        whole[solved.pixels] = solved.residual
        np.testing.assert_allclose(whole, fit.residual[:, 0], atol=1e-7)
    assert solution.chi2 == sum(band.chi2 for band in solution.bands)
    assert solution.n_pixels == 2 * 48 * 52 - 6 * 8


def test_masked_pixels_do_not_matter(model: ImageModel) -> None:
    blue = model.bands[1]
    bright = replace(blue, image=np.where(blue.weights > 0.0, blue.image, 1e6))
    changed = replace(model, bands=(model.bands[0], bright))
    assert changed.solve(model.space.start).chi2 == model.solve(model.space.start).chi2


def test_what_amplitudes_follow_is_projected_out(model: ImageModel) -> None:
    solved = model.solve(model.space.start).bands[0]
    followed = solved.design @ np.random.default_rng(1).normal(size=(solved.design.shape[1], 3))
    assert np.abs(solved.project_out(followed)).max() < 1e-6 * np.abs(followed).max()
    free = np.random.default_rng(2).normal(size=(solved.pixels.size, 3))
    left = solved.project_out(free)
    np.testing.assert_allclose(solved.project_out(left), left, atol=1e-8)
    np.testing.assert_allclose(solved.design.T @ left, 0.0, atol=1e-6)
    assert np.abs(left).max() > 1.0


def test_temperature_scales_the_image_alone(model: ImageModel) -> None:
    solution = model.solve(shifted(model))
    hot = replace(model, temperature=2.5)
    n = solution.n_pixels
    for cold, warm in ((model.residuals(solution), hot.residuals(solution)),
                       (model.jacobian(solution), hot.jacobian(solution))):  # fmt: skip
        np.testing.assert_allclose(warm[:n], cold[:n] / 2.5, rtol=1e-13)
        np.testing.assert_array_equal(warm[n:], cold[n:])


def test_neither_quasars_nor_light_nor_background() -> None:
    """A bare arc about a fixed centre is a model, too."""
    model = build()
    lens = ParameterSpace(
        Macro(KWARGS_LENS, (), np.empty((0, 2)), BETA), tuple(free_parameters("lens", KWARGS_LENS, FREE_LENS))
    )
    bare = replace(model, space=lens, light_models=(), basis=SourceBasis(5, (0.05, 0.02)), fit_background=False)
    solution = bare.solve(lens.start)
    assert solution.bands[0].fixed.shape == (0, *GRID.shape)
    assert bare.jacobian(solution).shape == (bare.residuals(solution).size, len(lens.names))
    assert np.isfinite(bare.residuals(solution)).all()


def test_degenerate_columns_are_refused_by_name(model: ImageModel) -> None:
    twice = replace(model, basis=replace(model.basis, clumps=CLUMPS + CLUMPS), ridge=1e-18)
    with pytest.raises(ValueError, match=r"degenerate to rounding with smooth_model\.ridge = 1e-18"):
        twice.solve(twice.space.start)
