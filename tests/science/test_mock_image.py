"""A mock of the default lens, pixel by pixel against lenstronomy's image of the same models."""

from __future__ import annotations

from typing import Any

import numpy as np
from lenstronomy.Data.imaging_data import ImageData
from lenstronomy.Data.psf import PSF
from lenstronomy.ImSim.image_model import ImageModel
from lenstronomy.LensModel.lens_model import LensModel
from lenstronomy.LightModel.light_model import LightModel

from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.mock import lensed_image
from warmlens.imaging.psf import Convolution, hst_like_psf
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.deflection import tnfw_deflection
from warmlens.lensing.macro_model import deflection

N_MAX, BETA, CENTER = 10, 0.18, (-0.503, -0.058)
TOLERANCE = 1e-5  # of the peak: the subhaloes' deflection is interpolated to 2e-5 of itself


def test_mock_image_with_subhaloes(paper_lens: tuple[list[str], list[dict[str, Any]]]) -> None:
    names, kwargs = paper_lens
    grid = PixelGrid.centred((80, 80), 0.06)
    psf = hst_like_psf(805.0, grid.pixel_scale, 21)
    shapelets = ShapeletSet(N_MAX, BETA, *CENTER)
    coefficients = np.random.default_rng(8).normal(size=shapelets.n_coefficients)
    center_x, center_y = np.array([-2.0, 0.6]), np.array([0.1, -1.1])
    r_s, r_t, scale = np.array([0.3, 0.15]), np.array([0.9, 0.8]), np.array([0.02, 0.04])
    x, y = grid.subpixel_coordinates(2)
    alpha = deflection(names, kwargs, x, y) + tnfw_deflection(x, y, center_x, center_y, r_s, r_t, scale)
    ours = lensed_image((shapelets,), coefficients, x - alpha[0], y - alpha[1], Convolution(psf, grid.shape))

    subhaloes = [
        {"Rs": r_s[i], "alpha_Rs": scale[i] * (1.0 - np.log(2.0)), "r_trunc": r_t[i],
         "center_x": center_x[i], "center_y": center_y[i]}
        for i in range(2)
    ]  # fmt: skip
    data = ImageData(
        np.zeros(grid.shape),
        transform_pix2angle=np.eye(2) * grid.pixel_scale,
        ra_at_xy_0=grid.origin_x,
        dec_at_xy_0=grid.origin_y,
    )
    model = ImageModel(
        data,
        PSF("PIXEL", kernel_point_source=psf),
        LensModel([*names, "TNFW", "TNFW"]),
        LightModel(["SHAPELETS"]),
        kwargs_numerics={"supersampling_factor": 2, "supersampling_convolution": False},
    )
    source = {"amp": coefficients, "n_max": N_MAX, "beta": BETA, "center_x": CENTER[0], "center_y": CENTER[1]}
    theirs = model.image([*kwargs, *subhaloes], [source], unconvolved=False)
    theirs = theirs / grid.pixel_scale**2  # per pixel -> surface brightness, the unit of our coefficients
    peak = np.abs(theirs).max()
    assert np.abs(ours - theirs).max() < TOLERANCE * peak
    without = deflection(names, kwargs, x, y)
    smooth = lensed_image((shapelets,), coefficients, x - without[0], y - without[1], Convolution(psf, grid.shape))
    assert np.abs(smooth - theirs).max() > 1e-2 * peak  # the subhaloes are seen
