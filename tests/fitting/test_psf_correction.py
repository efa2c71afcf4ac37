"""The PSF on the quasar images: smoothed wings, the correction, and the error that is left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from warmlens.fitting.image_model import FitBand, ImageModel, Solution, SourceBasis
from warmlens.fitting.parameters import Macro, ParameterSpace
from warmlens.fitting.psf_correction import PsfError, corrected_psf, kernel_radius, psf_error, smooth_wings
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import hst_like_psf
from warmlens.imaging.shapelets import surface_brightness
from warmlens.types import FloatArray

GRID = PixelGrid.centred((64, 64), 0.055)
LENS = (
    {"theta_E": 1.0, "gamma": 2.05, "e1": 0.12, "e2": 0.05, "center_x": 0.01, "center_y": -0.02},
    {"gamma1": 0.06, "gamma2": 0.02},
    {"theta_E": 0.1, "center_x": 0.3, "center_y": 0.7},
)
QUASARS = np.array([[0.77163, -0.76047], [-0.754747, 0.735311], [-0.979596, -0.409596], [0.442664, 1.026176]])
FLUXES = np.array([300.0, 250.0, 200.0, 150.0])
SIGMA = 0.01
RIGHT = hst_like_psf(814.0, 0.055, 25, blur_arcsec=0.045)
WRONG = hst_like_psf(800.0, 0.055, 25, blur_arcsec=0.04)
CORE = kernel_radius(RIGHT, 0.055) <= 0.2


def blank(psf: FloatArray) -> ImageModel:
    band = FitBand("red", np.zeros(GRID.shape), np.full(GRID.shape, 1.0 / SIGMA), psf)
    return ImageModel(
        grid=GRID, bands=(band,), space=ParameterSpace(Macro(LENS, (), QUASARS, 0.12), ()),
        lens_models=("EPL", "SHEAR", "SIS"), light_models=(), basis=SourceBasis(6, None), supersampling=1,
        fit_background=True, ridge=1e-8, tie_arcsec=np.inf,
    )  # fmt: skip


def observed_image(seed: int, extra: FloatArray | float = 0.0) -> FloatArray:
    """Quasars and an arc of the host around them through the right PSF, `extra` light and noise."""
    model = blank(RIGHT)
    solution = model.solve(np.empty(0))
    coefficients = 0.1 * np.random.default_rng(3).normal(size=28)
    coefficients[0] = 2.0
    light = surface_brightness(solution.sets, coefficients, solution.source_x, solution.source_y).mean(axis=-1)
    image = model.convolutions[0].forward(light.reshape(GRID.shape))
    image += np.tensordot([*FLUXES, 0.01], solution.bands[0].fixed, axes=1) + extra
    return image + SIGMA * np.random.default_rng(seed).normal(size=GRID.shape)


def with_psf(psf: FloatArray, image: FloatArray) -> tuple[ImageModel, Solution]:
    model = blank(psf)
    model = replace(model, bands=(replace(model.bands[0], image=image),))
    return model, model.solve(np.empty(0))


def error_of(psf: FloatArray) -> float:
    return float(np.sqrt(np.mean((psf - RIGHT)[CORE] ** 2)))


@pytest.fixture(scope="module")
def image() -> FloatArray:
    return observed_image(1)


def corrected(
    psf: FloatArray, image: FloatArray, times: int, radius: float = 0.5, sigma: float = 0.2
) -> FloatArray:
    for _ in range(times):
        psf = corrected_psf(*with_psf(psf, image), 0, radius, sigma)
    return psf


def test_correction_moves_towards_the_truth(image: FloatArray) -> None:
    """The core's error falls to less than a third at once, and by ten in three rounds."""
    once, thrice = (corrected(WRONG, image, n) for n in (1, 3))
    assert error_of(once) < error_of(WRONG) / 3.0
    assert error_of(thrice) < error_of(WRONG) / 10.0
    assert thrice.sum() == pytest.approx(1.0, abs=1e-12)
    before, after = (with_psf(psf, image)[1] for psf in (WRONG, thrice))
    assert after.chi2 / after.n_pixels < 1.05
    assert before.chi2 / before.n_pixels > 2.0
    fluxes = (solution.bands[0].fixed_amplitudes[:4] for solution in (before, after))
    worst = [np.abs(fitted / FLUXES - 1.0).max() for fitted in fluxes]
    assert worst[1] < 0.5 * worst[0]


def test_correction_of_the_right_psf_is_noise(image: FloatArray) -> None:
    assert error_of(corrected(RIGHT, image, 1)) < 0.05 * error_of(WRONG)


def test_only_pixels_within_the_radius_change(image: FloatArray) -> None:
    radius = kernel_radius(WRONG, 0.055)
    kernel = corrected(WRONG, image, 1, radius=0.15)
    outside = radius > 0.15
    ratio = (kernel / WRONG)[outside]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-12)  # normalised again, no more
    assert np.ptp((kernel / WRONG)[~outside]) > 0.01


def test_prior_bounds_the_correction(image: FloatArray) -> None:
    """A prior of 1e-5 of each pixel holds the PSF against the evidence, but for the floor of faint pixels."""
    tight = corrected(WRONG, image, 1, sigma=1e-5)
    loose = corrected(WRONG, image, 1, sigma=0.2)
    assert error_of(loose) < 0.5 * error_of(tight)
    assert np.abs(tight - WRONG)[CORE].max() < 0.4 * np.abs(loose - WRONG)[CORE].max()


@pytest.mark.parametrize("flip", [False, True])
def test_correction_has_the_right_orientation(flip: bool) -> None:
    """A ghost on one side of every quasar appears on that side of the kernel, not mirrored or transposed."""
    rows, columns = (2, -3) if not flip else (-3, 1)
    ghost = np.zeros_like(RIGHT)
    ghost[12 + rows, 12 + columns] = 0.02
    skewed = RIGHT + ghost
    skewed /= skewed.sum()
    model = blank(skewed)
    image = observed_image(1)
    fixed = model.solve(np.empty(0)).bands[0].fixed[:4] - blank(RIGHT).solve(np.empty(0)).bands[0].fixed[:4]
    kernel = corrected_psf(*with_psf(RIGHT, image + np.tensordot(FLUXES, fixed, axes=1)), 0, 0.5, 20.0)
    change = kernel - RIGHT
    assert np.unravel_index(np.argmax(change), change.shape) == (12 + rows, 12 + columns)
    assert change.max() == pytest.approx(0.02, rel=0.15)


def measured(image: FloatArray, radius: float = 0.4) -> PsfError:
    return psf_error(*with_psf(RIGHT, image), 0, np.full(GRID.shape, SIGMA), radius)


def test_error_of_the_right_psf_is_below_the_noise(image: FloatArray) -> None:
    """What is left in a ring is the scatter of the noise's own variance, for the mean flux of an image."""
    error = measured(image)
    np.testing.assert_allclose(error.radius, 0.055 * np.arange(1, 8))
    assert error.sigma.shape == (7,)
    assert np.all(error.sigma < SIGMA / FLUXES.min())
    assert np.all(error.sigma[2:] < SIGMA / FLUXES.mean())


def test_known_error_is_measured() -> None:
    """Each image has its own error of 1e-3 of the flux in every pixel within 0.33: n/(n - 1) of that variance."""
    x, y = GRID.coordinates()
    extra = np.zeros(GRID.shape)
    rng = np.random.default_rng(12)
    for (qx, qy), flux in zip(QUASARS, FLUXES, strict=True):
        near = np.hypot(x - qx, y - qy) < 0.33
        extra += np.where(near, 1e-3 * flux * rng.normal(size=GRID.shape), 0.0)
    error = measured(observed_image(1, extra), 0.66)
    inner = slice(1, 6)  # 0.055 to 0.33; four pixels in the ring within
    assert np.sqrt(np.mean(error.sigma[inner] ** 2)) == pytest.approx(1e-3 * np.sqrt(4.0 / 3.0), rel=0.15)
    assert np.all(error.sigma[7:] < 0.4e-3)


def test_error_of_the_wrong_psf_is_seen(image: FloatArray) -> None:
    wrong = psf_error(*with_psf(WRONG, image), 0, np.full(GRID.shape, SIGMA), 0.4)
    assert wrong.sigma.max() > 10.0 * measured(image).sigma.max()


def test_variance_about_the_images() -> None:
    error = PsfError(np.array([0.1, 0.2]), np.array([3e-3, 1e-3]))
    quasars, fluxes = QUASARS[:2], np.array([100.0, 50.0])
    variance = error.variance(GRID, quasars, fluxes)
    x, y = GRID.coordinates()
    expected = np.zeros(GRID.shape)
    for row in range(GRID.ny):
        for column in range(GRID.nx):
            for (qx, qy), flux in zip(quasars, fluxes, strict=True):
                distance = np.hypot(x[row, column] - qx, y[row, column] - qy)
                relative = 3e-3 if distance < 0.1 else 1e-3 if distance < 0.2 else 0.0
                expected[row, column] += (relative * flux) ** 2
    np.testing.assert_allclose(variance, expected, rtol=1e-12)
    assert len(np.unique(variance)) == 5
    np.testing.assert_array_equal(error.variance(GRID, np.empty((0, 2)), np.empty(0)), np.zeros(GRID.shape))


def test_smooth_wings() -> None:
    """Noise in the wings falls by three, the core is what it was, and a wing that is not round stays so."""
    clean = hst_like_psf(814.0, 0.05, 61)
    rows, columns = np.mgrid[-30:31, -30:31] * 0.05
    clean = clean + 2e-3 * np.exp(-0.5 * ((rows / 0.4) ** 2 + (columns / 0.8) ** 2)) / 60.0
    clean /= clean.sum()
    radius = kernel_radius(clean, 0.05)
    noisy = clean + 1e-5 * np.random.default_rng(4).normal(size=clean.shape)
    smoothed = smooth_wings(noisy, 0.05, 0.4, 0.6)
    assert smoothed.sum() == pytest.approx(1.0, abs=1e-12)
    ratio = (smoothed / noisy)[radius < 0.39]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-12)
    assert abs(ratio[0] - 1.0) < 1e-2
    wings = (radius > 0.6) & (radius < 1.3)
    before, after = (np.std((psf - clean)[wings]) for psf in (noisy, smoothed))
    assert after < before / 3.0
    along, across = wings & (np.abs(rows) < 0.2), wings & (np.abs(columns) < 0.2)
    contrast = [float(psf[along].mean() - psf[across].mean()) for psf in (clean, smoothed)]
    assert contrast[0] > 5e-6
    assert contrast[1] == pytest.approx(contrast[0], rel=0.2)


def test_kernel_radius() -> None:
    radius = kernel_radius(np.zeros((5, 5)), 0.1)
    assert radius[2, 2] == 0.0
    assert radius[2, 4] == pytest.approx(0.2) and radius[0, 2] == pytest.approx(0.2)
    assert radius[4, 4] == pytest.approx(0.2 * np.sqrt(2.0))
