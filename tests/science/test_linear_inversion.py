"""One source inversion against lenstronomy's ImageLinearFit: chi2 and model image."""

import numpy as np
import pytest
from lenstronomy.Data.imaging_data import ImageData
from lenstronomy.Data.psf import PSF
from lenstronomy.ImSim.image_linear_solve import ImageLinearFit
from lenstronomy.LensModel.lens_model import LensModel
from lenstronomy.LightModel.light_model import LightModel

from warmlens.fitting.linear import build_linear_model, physical_coefficients, solve
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import Convolution, hst_like_psf
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis

LENS = (
    ["EPL", "SHEAR"],
    [
        {"theta_E": 0.8, "gamma": 1.95, "e1": 0.08, "e2": 0.05, "center_x": 0.0, "center_y": 0.0},
        {"gamma1": -0.05, "gamma2": 0.02, "ra_0": 0.0, "dec_0": 0.0},
    ],
)
N_MAX, BETA, CENTER = 10, 0.09, (0.05, -0.03)
LENS_LIGHT = {"amp": 1.0, "R_sersic": 0.3, "n_sersic": 1.5, "center_x": 0.0, "center_y": 0.0}


@pytest.mark.parametrize("factor", [1, 2])
def test_chi2_and_model_of_a_source_inversion(factor):
    """chi2 to 1e-6 relative, the model image to 1e-4 sigma: ridge 1e-10 here, none there."""
    grid = PixelGrid.centred((50, 50), 0.05)
    theta_x, theta_y = grid.subpixel_coordinates(factor)
    model = LensModel(LENS[0])
    source_x, source_y = model.ray_shooting(theta_x.ravel(), theta_y.ravel(), LENS[1])
    psf = hst_like_psf(814.0, 0.05, 41)
    rng = np.random.default_rng(8)
    sigma = rng.uniform(0.01, 0.02, grid.shape)
    mask = np.hypot(*grid.coordinates()) < 1.15
    y = np.hypot(source_x - 0.07, source_y + 0.02).reshape(theta_x.shape)
    light = (np.exp(-y / 0.08) + 0.4 * np.exp(-0.5 * (np.abs(y - 0.15) / 0.02) ** 2)).mean(axis=1)
    convolution = Convolution(psf, grid.shape)
    image = convolution.forward(light.reshape(grid.shape)) + sigma * rng.normal(size=grid.shape)

    data = ImageData(
        image,
        noise_map=sigma,
        ra_at_xy_0=grid.origin_x,
        dec_at_xy_0=grid.origin_y,
        transform_pix2angle=0.05 * np.eye(2),
    )
    theirs = ImageLinearFit(
        data,
        PSF(psf_type="PIXEL", kernel_point_source=psf, kernel_point_source_normalisation=False),
        model,
        LightModel(["SHAPELETS"]),
        LightModel(["SERSIC"]),
        kwargs_numerics={"supersampling_factor": factor, "supersampling_convolution": False},
        likelihood_mask=mask,
    )
    source = [{"n_max": N_MAX, "beta": BETA, "center_x": CENTER[0], "center_y": CENTER[1]}]
    their_model, _, _, their_amplitudes = theirs.image_linear_solve(LENS[1], source, [dict(LENS_LIGHT)])
    their_chi2 = theirs.reduced_chi2(their_model) * theirs.num_data_evaluate

    weights = mask / sigma
    sersic = LightModel(["SERSIC"]).surface_brightness(theta_x.ravel(), theta_y.ravel(), [LENS_LIGHT])
    fixed = convolution.forward(sersic.reshape(theta_x.shape).mean(axis=1).reshape(grid.shape)).reshape(-1, 1)
    columns = pixel_basis(
        [ShapeletSet(N_MAX, BETA, *CENTER)], source_x.reshape(theta_x.shape), source_y.reshape(theta_x.shape)
    )
    linear = build_linear_model(columns, fixed, convolution, weights, 1e-10)
    fit = solve(linear, (image * weights).reshape(-1, 1))
    coefficients = physical_coefficients(linear, fit.coefficients)[:, 0]
    source_image = convolution.forward((columns @ coefficients[:-1]).reshape(grid.shape))
    our_model = source_image + (fixed[:, 0] * coefficients[-1]).reshape(grid.shape)

    assert fit.chi2[0] == pytest.approx(their_chi2, rel=1e-6)
    assert np.abs((our_model - their_model) / sigma)[mask].max() < 1e-4
    # Amplitudes are per pixel here, per arcsec^2 there; source first, lens light last, in both.
    largest = np.abs(coefficients).max()
    np.testing.assert_allclose(coefficients, 0.05**2 * their_amplitudes, rtol=0, atol=1e-4 * largest)
    assert fit.chi2[0] > 0.8 * mask.sum()
