"""The fit of the smooth lens to two bands that lenstronomy made: truth within 3 sigma, chi2_red within 3% of 1.

100 x 100 pixels per band, so that chi2_red of pure noise scatters by 1.4%; lenstronomy blurs with its own
convolution and draws the quasars from a kernel of 5 times the resolution, here splines shift the pixels' kernel.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from lenstronomy.Data.imaging_data import ImageData
from lenstronomy.Data.psf import PSF
from lenstronomy.ImSim.image_model import ImageModel
from lenstronomy.LensModel.lens_model import LensModel
from lenstronomy.LightModel.light_model import LightModel
from lenstronomy.PointSource.point_source import PointSource

from warmlens.config.smooth_model import SmoothModelBlock
from warmlens.fitting.lens_fit import LensFit, fit_lens
from warmlens.fitting.variable_projection import covariance
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.observation import Band, Observation, checked_band

GRID = PixelGrid.centred((100, 100), 0.05)
FINE = 5
SIGMA = 0.03
N_MAX, BETA, SOURCE = 8, 0.15, (0.04, 0.03)
LENSES, LIGHTS = ["EPL", "SHEAR", "SIS"], ["SERSIC_ELLIPSE", "SERSIC"]
LENS: list[dict[str, float]] = [
    {"theta_E": 1.0, "gamma": 2.05, "e1": 0.12, "e2": 0.05, "center_x": 0.01, "center_y": -0.02},
    {"gamma1": 0.06, "gamma2": 0.02},
    {"theta_E": 0.1, "center_x": 0.3, "center_y": 0.7},
]
LIGHT: list[dict[str, float]] = [
    {"R_sersic": 0.4, "n_sersic": 1.5, "e1": 0.05, "e2": 0.08, "center_x": 0.013, "center_y": -0.017},
    {"R_sersic": 0.15, "n_sersic": 1.2, "center_x": 0.3, "center_y": 0.7},
]
QUASARS = np.array([[0.77163, -0.76047], [-0.754747, 0.735311], [-0.979596, -0.409596], [0.442664, 1.026176]])
FREE_LENS: list[dict[str, Any]] = [
    {"theta_E": [0.7, 1.3, None], "gamma": [1.5, 2.5, None], "e1": [-0.4, 0.4, None], "e2": [-0.4, 0.4, None]},
    {"gamma1": [-0.4, 0.4, None], "gamma2": [-0.4, 0.4, None]},
    {"theta_E": [0.0, 0.6, None], "center_x": [-0.3, 0.9, 0.05], "center_y": [0.1, 1.3, 0.05]},
]
FREE_LIGHT: list[dict[str, Any]] = [
    {"R_sersic": [0.05, 1.5, None], "n_sersic": [0.3, 6.0, None]},
    {"R_sersic": [0.01, 0.5, None]},
]


def lenstronomy_band(name: str, width: float, flux: float, rng: np.random.Generator) -> Band:
    """Image of the true lens: shapelet source, Sersic galaxies, quasars and sky, all by lenstronomy."""
    half = 8 * FINE + FINE // 2
    axis = np.arange(-half, half + 1) * GRID.pixel_scale / FINE
    fine = np.exp(-0.5 * (axis[:, None] ** 2 + axis**2) / width**2)
    psf = PSF("PIXEL", kernel_point_source=fine / fine.sum(), point_source_supersampling_factor=FINE)
    data = ImageData(
        np.zeros(GRID.shape),
        transform_pix2angle=np.eye(2) * GRID.pixel_scale,
        ra_at_xy_0=GRID.origin_x,
        dec_at_xy_0=GRID.origin_y,
    )
    model = ImageModel(
        data,
        psf,
        LensModel(LENSES),
        LightModel(["SHAPELETS"]),
        LightModel(LIGHTS),
        PointSource(["LENSED_POSITION"]),
        kwargs_numerics={"supersampling_factor": 1, "point_source_supersampling_factor": FINE},
    )
    amplitudes = 0.25 * rng.normal(size=(N_MAX + 1) * (N_MAX + 2) // 2)
    amplitudes[0] = 3.0
    source = {"amp": flux * amplitudes / GRID.pixel_scale**2, "n_max": N_MAX, "beta": BETA}
    source |= {"center_x": SOURCE[0], "center_y": SOURCE[1]}
    light = [{"amp": flux * amp, **kwargs} for amp, kwargs in zip((200.0, 150.0), LIGHT, strict=True)]
    points = {"ra_image": QUASARS[:, 0], "dec_image": QUASARS[:, 1]}
    points |= {"point_amp": flux * np.array([40.0, 30.0, 20.0, 30.0])}
    image = model.image(LENS, [source], light, [points]) + 0.02 + SIGMA * rng.normal(size=GRID.shape)
    return checked_band(
        name, GRID, image, np.full(GRID.shape, SIGMA), np.ones(GRID.shape, dtype=bool),
        psf.kernel_point_source, NoiseModel(SIGMA, 1e9),
    )  # fmt: skip


@pytest.fixture(scope="module")
def observed() -> Observation:
    rng = np.random.default_rng(31)
    bands = (lenstronomy_band("F814W", 0.055, 1.0, rng), lenstronomy_band("F555W", 0.045, 0.7, rng))
    return Observation("simulated", GRID, bands)


def block(**lens_free: Any) -> SmoothModelBlock:
    """Start 5 per cent off in everything that is free, up and down in turn; quasars measured to 2 mas."""
    lens, light, sign = copy.deepcopy(LENS), copy.deepcopy(LIGHT), 1.0
    for models, free in ((lens, FREE_LENS), (light, FREE_LIGHT)):
        for kwargs, keys in zip(models, free, strict=True):
            for key in keys:
                kwargs[key] *= 1.0 + 0.05 * sign
                sign = -sign
    quasars = QUASARS + 0.002 * np.random.default_rng(8).normal(size=QUASARS.shape)
    return SmoothModelBlock.model_validate(
        {
            "mode": "fit",
            "lens": {"lens_model_list": LENSES, "kwargs_lens": lens},
            "lens_light": {"lens_light_model_list": LIGHTS, "kwargs_lens_light": light},
            "quasar_images": quasars.tolist(),
            "noise_from": "data",
            "quasar_variance_fraction": 0.0,
            "quasar_core_arcsec": 0.15,
            "disc_arcsec": None,
            "lens_core_mask_arcsec": 0.0,
            "fit_background": True,
            "source": {"n_max": N_MAX, "beta_arcsec": 1.05 * BETA, "center": "quasars", "supersampling": 1},
            "ridge": 1e-8,
            "chi2_red_range": [0.9, 1.1],
            "allow_poor_fit": False,
            "fit": {
                "lens_free": lens_free.get("lens_free", FREE_LENS),
                "lens_light_free": FREE_LIGHT,
                "satellites": [[2, 1]],
                "potential_shapelets": {"number": 0, "beta_arcsec": 1.0, "sigma": 0.02},
                "quasar_sigma_arcsec": 0.002,
                "tie_arcsec": 0.001,
                "source_beta": [0.08, 0.3, None],
                "search": None,
                "levels": [4],
                "max_steps": 15,
                "tolerance": 1e-5,
                "psf": None,
                "seed": 3,
            },
        }
    )


@pytest.fixture(scope="module")
def fit(observed: Observation) -> LensFit:
    return fit_lens(block(), observed)


def true_values(names: tuple[str, ...]) -> np.ndarray:
    out = []
    for name in names:
        component, key = name.split(".")
        kind, number = component.split("_")
        if kind == "quasar":
            out.append(QUASARS[int(number), "xy".index(key)])
        elif kind == "source":
            out.append(BETA)
        else:
            out.append((LENS if kind == "lens" else LIGHT)[int(number)][key])
    return np.array(out)


def test_truth_is_recovered_within_three_sigma(fit: LensFit) -> None:
    assert fit.converged
    space = fit.model.space
    truth = true_values(space.names)
    error = np.sqrt(np.diag(covariance(fit.model, fit.solution)))
    pull = (fit.solution.vector - truth) / error
    assert np.abs(pull).max() < 3.0, dict(zip(space.names, np.round(pull, 2), strict=True))
    lens = np.array([name.startswith("lens") for name in space.names])
    assert np.abs((space.start - truth) / error)[lens].max() > 20.0  # the start was not within the errors
    assert np.sqrt(np.mean(pull**2)) < 1.5


def test_chi2_of_both_bands_is_that_of_noise(fit: LensFit) -> None:
    for band in fit.solution.bands:
        freedom = band.pixels.size - band.amplitudes.size
        assert freedom > 9900
        assert band.chi2 / freedom == pytest.approx(1.0, abs=0.03)


def test_source_and_quasars_come_together(fit: LensFit) -> None:
    apart = fit.solution.quasar_sources - fit.solution.quasar_sources.mean(axis=0)
    assert np.abs(apart).max() < 0.003
    np.testing.assert_allclose(fit.solution.center, SOURCE, atol=0.01)


def test_a_lens_with_the_wrong_slope_is_revealed_by_chi2(observed: Observation) -> None:
    """Wrong twin: gamma held 5 per cent off, everything else free."""
    free = copy.deepcopy(FREE_LENS)
    del free[0]["gamma"]
    wrong = fit_lens(block(lens_free=free), observed)
    assert wrong.converged
    assert max(band.chi2 / (band.pixels.size - band.amplitudes.size) for band in wrong.solution.bands) > 1.03
