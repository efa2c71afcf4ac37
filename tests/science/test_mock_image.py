"""A mock of the default lens, pixel by pixel against lenstronomy's image of the same models."""

from __future__ import annotations

from typing import Any

import numpy as np
from lenstronomy.Data.imaging_data import ImageData
from lenstronomy.Data.psf import PSF
from lenstronomy.ImSim.image_model import ImageModel
from lenstronomy.LensModel.lens_model import LensModel
from lenstronomy.LightModel.light_model import LightModel
from lenstronomy.PointSource.point_source import PointSource

from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.mock import lensed_image
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.deflection import TnfwHalos, tnfw_deflection
from warmlens.lensing.macro_model import deflection, lens_light

N_MAX, BETA, CENTER = 10, 0.18, (-0.503, -0.058)
TOLERANCE = 1e-6  # of the peak


def test_mock_image_with_subhalos(paper_lens: tuple[list[str], list[dict[str, Any]]]) -> None:
    names, kwargs = paper_lens
    grid = PixelGrid.centred((80, 80), 0.06)
    psf = hst_like_psf(805.0, grid.pixel_scale, 21)
    shapelets = ShapeletSet(N_MAX, BETA, *CENTER)
    coefficients = np.random.default_rng(8).normal(size=shapelets.n_coefficients)
    center_x, center_y = np.array([-2.0, 0.6]), np.array([0.1, -1.1])
    r_s, r_t, scale = np.array([0.3, 0.15]), np.array([0.9, 0.8]), np.array([0.02, 0.04])
    halos = TnfwHalos(center_x, center_y, r_s, r_t, scale)
    x, y = grid.subpixel_coordinates(2)
    alpha = deflection(names, kwargs, x, y) + tnfw_deflection(x, y, halos)
    ours = lensed_image((shapelets,), coefficients, x - alpha[0], y - alpha[1], Convolution(psf, grid.shape))

    subhalos = [
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
    theirs = model.image([*kwargs, *subhalos], [source], unconvolved=False)
    theirs = theirs / grid.pixel_scale**2  # per pixel -> surface brightness, the unit of our coefficients
    peak = np.abs(theirs).max()
    assert np.abs(ours - theirs).max() < TOLERANCE * peak
    without = deflection(names, kwargs, x, y)
    smooth = lensed_image((shapelets,), coefficients, x - without[0], y - without[1], Convolution(psf, grid.shape))
    assert np.abs(smooth - theirs).max() > 1e-2 * peak  # the subhalos are seen


def test_whole_mock_with_clumps_light_and_quasars(paper_lens: tuple[list[str], list[dict[str, Any]]]) -> None:
    """Source of several sets, Sersic light of the lens, and quasars: everything a mock holds but its noise.

    lenstronomy places point sources by interpolating the PSF linearly; on pixel centres both agree.
    """
    names, kwargs = paper_lens
    grid = PixelGrid.centred((80, 80), 0.0625)  # 1/16: pixel centres are exact numbers, no shift is left over
    psf = hst_like_psf(805.0, grid.pixel_scale, 21)
    convolution = Convolution(psf, grid.shape)
    rng = np.random.default_rng(9)
    sets = (ShapeletSet(N_MAX, BETA, *CENTER), *(ShapeletSet(3, 0.04, *rng.normal(CENTER, 0.2)) for _ in range(3)))
    coefficients = rng.normal(size=sum(shapelets.n_coefficients for shapelets in sets))
    x, y = grid.subpixel_coordinates(1)
    alpha = deflection(names, kwargs, x, y)
    sersic = {"R_sersic": 0.3, "n_sersic": 1.6, "center_x": -0.009, "center_y": 0.079}
    light = lens_light(["SERSIC"], [sersic], x, y)[0].reshape(grid.shape)
    quasars = [(12, 30, 40.0), (50, 66, 90.0)]  # row, column, flux
    positions = [grid.to_sky(np.array(float(column)), np.array(float(row))) for row, column, _ in quasars]
    ours = lensed_image(sets, coefficients, x - alpha[0], y - alpha[1], convolution) + convolution.forward(light)
    for (_, _, flux), (qx, qy) in zip(quasars, positions, strict=True):
        ours += flux * point_source(psf, grid, float(qx), float(qy))

    data = ImageData(
        np.zeros(grid.shape),
        transform_pix2angle=np.eye(2) * grid.pixel_scale,
        ra_at_xy_0=grid.origin_x,
        dec_at_xy_0=grid.origin_y,
    )
    model = ImageModel(
        data,
        PSF("PIXEL", kernel_point_source=psf),
        LensModel(names),
        LightModel(["SHAPELETS"] * len(sets)),
        LightModel(["SERSIC"]),
        PointSource(["LENSED_POSITION"]),
        kwargs_numerics={"supersampling_factor": 1},
    )
    split = np.split(coefficients, np.cumsum([shapelets.n_coefficients for shapelets in sets])[:-1])
    area = grid.pixel_scale**2
    source = [
        {"amp": amp / area, "n_max": shapelets.n_max, "beta": shapelets.beta, "center_x": shapelets.center_x,
         "center_y": shapelets.center_y}
        for shapelets, amp in zip(sets, split, strict=True)
    ]  # fmt: skip
    points = {
        "ra_image": np.array([float(qx) for qx, _ in positions]),
        "dec_image": np.array([float(qy) for _, qy in positions]),
        "point_amp": np.array([flux for *_, flux in quasars]),
    }
    theirs = model.image(kwargs, source, [{"amp": 1.0 / area, **sersic}], [points])
    peak = np.abs(theirs).max()
    assert np.abs(ours - theirs).max() < TOLERANCE * peak
    one_clump_less = lensed_image(sets[:-1], coefficients[:-10], x - alpha[0], y - alpha[1], convolution)
    all_clumps = lensed_image(sets, coefficients, x - alpha[0], y - alpha[1], convolution)
    assert np.abs(one_clump_less - all_clumps).max() > 1e3 * TOLERANCE * peak
