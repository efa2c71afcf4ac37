from __future__ import annotations

import numpy as np
import pytest

from warmlens.fitting.smooth_model import FixedColumns, fit_band
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.observation import Band, checked_band
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.rays import SmoothRays

GRID = PixelGrid.centred((40, 40), 0.05)
SETS = (ShapeletSet(4, 0.25, 0.0, 0.0),)
PSF = hst_like_psf(805.0, 0.05, 15)
NOISE = NoiseModel(0.01, 2000.0)


@pytest.fixture(scope="module")
def setup() -> tuple[Band, SmoothRays, FixedColumns, Convolution, np.ndarray]:
    rng = np.random.default_rng(3)
    x, y = GRID.subpixel_coordinates(1)
    rays = SmoothRays(x, y, 0.6 * x, 0.6 * y)
    convolution = Convolution(PSF, GRID.shape)
    quasars = [point_source(PSF, GRID, *position).ravel() for position in ((0.5, 0.3), (-0.4, -0.6))]
    fixed = FixedColumns(("quasar_0", "quasar_1", "background"), np.array([*quasars, np.ones(1600)]).T, 2)
    source = rng.normal(size=SETS[0].n_coefficients)
    source[0] = 4.0
    light = convolution.forward((pixel_basis(SETS, rays.source_x, rays.source_y) @ source).reshape(GRID.shape))
    clean = light + (fixed.images @ [300.0, 150.0, 0.004]).reshape(GRID.shape)
    image = NOISE.draw(clean, clean, rng)
    mask = np.ones(GRID.shape, dtype=bool)
    mask[:3] = False
    band = checked_band("F814W", GRID, image, NOISE.sigma(np.maximum(clean, 0.0)), mask, PSF, NOISE)
    return band, rays, fixed, convolution, source


def test_amplitudes_and_chi2(setup) -> None:
    band, rays, fixed, convolution, source = setup
    fit = fit_band(band, SETS, rays, fixed, convolution, 1e-8, 0.0)
    assert fit.fixed_coefficients == pytest.approx([300.0, 150.0, 0.004], rel=0.01, abs=0.002)
    np.testing.assert_allclose(fit.source_coefficients, source, atol=0.1)
    assert fit.n_pixels == 37 * 40
    assert fit.n_columns == 15 + 3
    sigma_chi2 = np.sqrt(2.0 / (fit.n_pixels - fit.n_columns))
    assert fit.chi2_red == pytest.approx(1.0, abs=4.0 * sigma_chi2)
    assert fit.chi2 == pytest.approx(np.sum((band.weights * (band.image - fit.model)) ** 2), rel=1e-6)


def test_variance_near_quasars(setup) -> None:
    band, rays, fixed, convolution, _ = setup
    fit = fit_band(band, SETS, rays, fixed, convolution, 1e-8, 0.2)
    quasars = (fixed.images[:, :2] @ fit.fixed_coefficients[:2]).reshape(GRID.shape)
    expected = np.sqrt(band.sigma**2 + (0.2 * quasars) ** 2)
    np.testing.assert_allclose(fit.sigma[band.mask], expected[band.mask], rtol=0.03)
    assert fit.chi2 < fit_band(band, SETS, rays, fixed, convolution, 1e-8, 0.0).chi2


def test_more_amplitudes_than_pixels(setup) -> None:
    band, rays, fixed, convolution, _ = setup
    many = (ShapeletSet(60, 0.25, 0.0, 0.0),)
    with pytest.raises(ValueError, match=r"1894 amplitudes for 1480 unmasked pixels; lower smooth_model\.source"):
        fit_band(band, many, rays, fixed, convolution, 1e-8, 0.0)
