"""The finished model of a band: amplitudes, image, chi2 with and without the quasars' cores, their variance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from warmlens.config.smooth_model import SmoothModelBlock
from warmlens.fitting.image_model import ImageModel, Solution
from warmlens.fitting.lens_fit import first_model, fit_lens, outside_cores
from warmlens.fitting.linear import build_linear_model, solve
from warmlens.fitting.smooth_model import band_fit
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.observation import Observation, checked_band
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.macro_model import deflection
from warmlens.types import BoolArray, FloatArray

GRID = PixelGrid.centred((40, 40), 0.05)
PSF = hst_like_psf(805.0, 0.05, 15)
NOISE = NoiseModel(0.01, 2000.0)
QUASARS = ((0.5, 0.3), (-0.4, -0.6))
FIXED = (300.0, 150.0, 0.004)
LENS = {"theta_E": 0.4, "center_x": 0.01, "center_y": 0.02}


def block(n_max: int = 4, **values: object) -> SmoothModelBlock:
    return SmoothModelBlock.model_validate(
        {
            "mode": "given",
            "lens": {"lens_model_list": ["SIS"], "kwargs_lens": [LENS]},
            "lens_light": {"lens_light_model_list": [], "kwargs_lens_light": []},
            "quasar_images": QUASARS,
            "noise_from": "data",
            "quasar_variance_fraction": 0.0,
            "quasar_core_arcsec": 0.2,
            "disc_arcsec": None,
            "lens_core_mask_arcsec": 0.0,
            "fit_background": True,
            "source": {"n_max": n_max, "beta_arcsec": 0.25, "center": [0.0, 0.0], "supersampling": 1},
            "ridge": 1e-8,
            "chi2_red_range": [0.9, 1.1],
            "allow_poor_fit": False,
            **values,
        }
    )


@pytest.fixture(scope="module")
def source() -> FloatArray:
    coefficients = np.random.default_rng(3).normal(size=15)
    coefficients[0] = 4.0
    return coefficients


@pytest.fixture(scope="module")
def observed(source: FloatArray) -> Observation:
    x, y = GRID.subpixel_coordinates(1)
    alpha = deflection(["SIS"], [LENS], x, y)
    basis = pixel_basis([ShapeletSet(4, 0.25, 0.0, 0.0)], x - alpha[0], y - alpha[1])
    clean = Convolution(PSF, GRID.shape).forward((basis @ source).reshape(GRID.shape)) + FIXED[2]
    clean += sum(flux * point_source(PSF, GRID, *at) for flux, at in zip(FIXED, QUASARS, strict=False))
    image = NOISE.draw(clean, clean, np.random.default_rng(4))
    mask = np.ones(GRID.shape, dtype=bool)
    mask[:3] = False
    band = checked_band("F814W", GRID, image, NOISE.sigma(np.maximum(clean, 0.0)), mask, PSF, NOISE)
    return Observation("simulated", GRID, (band,))


def solved(settings: SmoothModelBlock, observed: Observation) -> tuple[ImageModel, Solution, BoolArray]:
    model = first_model(settings, observed)
    solution = model.solve(model.space.start)
    return model, solution, outside_cores(settings, GRID, np.array(QUASARS))


def test_amplitudes_and_chi2(observed: Observation, source: FloatArray) -> None:
    model, solution, outside = solved(block(), observed)
    band = observed.bands[0]
    fit = band_fit(model, solution, 0, band.sigma, outside)
    assert fit.fixed_coefficients == pytest.approx(FIXED, rel=0.01, abs=0.002)
    np.testing.assert_allclose(fit.source_coefficients, source, atol=0.1)
    assert fit.n_pixels == 37 * 40
    assert fit.n_columns == 15 + 3
    freedom = fit.n_pixels - fit.n_columns
    assert fit.chi2_red == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / freedom))
    pull = band.weights * (band.image - fit.model)
    assert fit.chi2 == pytest.approx(np.sum(pull**2), rel=1e-9)
    assert fit.chi2_red == fit.chi2 / freedom
    counted = band.mask & outside
    assert fit.n_pixels_outside_cores == counted.sum() < fit.n_pixels - 50
    assert fit.chi2_outside_cores == pytest.approx(np.sum(pull[counted] ** 2), rel=1e-9)
    assert fit.chi2_noise_only == pytest.approx(fit.chi2_outside_cores, rel=1e-9)  # nothing was added to it
    np.testing.assert_array_equal(fit.sigma[~band.mask], np.inf)
    np.testing.assert_allclose(fit.sigma[band.mask], band.sigma[band.mask], rtol=1e-12)
    np.testing.assert_array_equal(fit.psf, band.psf)


def test_fixed_image_is_all_but_the_source(observed: Observation) -> None:
    model, solution, outside = solved(block(), observed)
    fit = band_fit(model, solution, 0, observed.bands[0].sigma, outside)
    expected = sum(
        f * point_source(PSF, GRID, *at) for f, at in zip(fit.fixed_coefficients, QUASARS, strict=False)
    )
    np.testing.assert_allclose(fit.fixed_image, expected + fit.fixed_coefficients[2], atol=1e-10)
    light = pixel_basis(solution.sets, solution.source_x, solution.source_y) @ fit.source_coefficients
    arcs = Convolution(PSF, GRID.shape).forward(light.reshape(GRID.shape))
    np.testing.assert_allclose(fit.model - fit.fixed_image, arcs, atol=1e-10)


def test_the_scan_s_linear_model_is_the_same_fit(observed: Observation) -> None:
    """What the scan rebuilds from the artifact gives the amplitudes and the chi2 of the fit."""
    model, solution, outside = solved(block(), observed)
    band = observed.bands[0]
    fit = band_fit(model, solution, 0, band.sigma, outside)
    source = pixel_basis(solution.sets, solution.source_x, solution.source_y)
    fixed = np.ascontiguousarray(solution.bands[0].fixed.reshape(3, -1).T)
    weights = np.where(np.isfinite(fit.sigma), 1.0 / fit.sigma, 0.0)
    rebuilt = build_linear_model(source, fixed, Convolution(fit.psf, GRID.shape), weights, 1e-8)
    again = solve(rebuilt, (weights * band.image).reshape(-1, 1))
    assert again.chi2[0] == pytest.approx(fit.chi2, rel=1e-9)


def test_variance_near_quasars(observed: Observation) -> None:
    settings = block(quasar_variance_fraction=0.2)
    model, solution, outside = solved(settings, observed)
    band = observed.bands[0]
    plain = band_fit(model, solution, 0, band.sigma, outside)
    noisy = fit_lens(settings, observed)
    fit = band_fit(noisy.model, noisy.solution, 0, band.sigma, outside)
    quasars = np.tensordot(plain.fixed_coefficients[:2], solution.bands[0].fixed[:2], axes=1)
    expected = np.sqrt(band.sigma**2 + (0.2 * quasars) ** 2)
    np.testing.assert_allclose(fit.sigma[band.mask], expected[band.mask], rtol=1e-9)
    assert (fit.sigma > 2.0 * band.sigma)[band.mask].any()
    assert fit.chi2 < plain.chi2
    assert fit.chi2_outside_cores < fit.chi2_noise_only  # that one knows the observation's noise alone
    counted = band.mask & outside
    pull = (band.image - fit.model) / band.sigma
    assert fit.chi2_noise_only == pytest.approx(np.sum(pull[counted] ** 2), rel=1e-9)


def test_more_amplitudes_than_pixels(observed: Observation) -> None:
    """Judged on the pixels outside of the cores."""
    settings = block(n_max=8, disc_arcsec=0.42)
    model, solution, outside = solved(settings, observed)
    n_used = solution.bands[0].pixels.size
    assert n_used > 48  # enough, were it not for the cores
    counted = np.flatnonzero(outside.ravel()[solution.bands[0].pixels])[:48]
    few = np.zeros(outside.size, dtype=bool)
    few[solution.bands[0].pixels[counted]] = True
    with pytest.raises(
        ValueError,
        match=r"band F814W: 48 amplitudes for 48 unmasked pixels outside the quasars' cores; "
        r"lower smooth_model\.source\.n_max or unmask more pixels",
    ):
        band_fit(model, solution, 0, observed.bands[0].sigma, few.reshape(GRID.shape))
    band_fit(model, solution, 0, observed.bands[0].sigma, outside)


def test_weights_of_a_pixel_scale_its_pull(observed: Observation) -> None:
    """Twice the noise, a quarter of chi2: chi2_red tells a wrong noise."""
    model, solution, outside = solved(block(), observed)
    halved = replace(model, bands=(replace(model.bands[0], weights=0.5 * model.bands[0].weights),))
    fit = band_fit(halved, halved.solve(solution.vector), 0, 2.0 * observed.bands[0].sigma, outside)
    assert fit.chi2_red == pytest.approx(0.25, rel=0.2)
    assert fit.chi2_red_noise_only == pytest.approx(fit.chi2_red_outside_cores, rel=1e-9)
