"""Stage `smooth_model` on a small observation: given and fitted lens, refusals and warnings, masks, clumps."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.config.file import parse_config
from warmlens.config.model import Config
from warmlens.fitting import judgement
from warmlens.fitting.judgement import ArcChi2, band_residuals, chi2_of_arcs, unresolved_pixels
from warmlens.fitting.lens_fit import first_model, fit_lens, outside_cores, usable_pixels
from warmlens.fitting.linear import solve
from warmlens.fitting.smooth_model import SmoothModel, band_fit
from warmlens.fitting.variable_projection import covariance, prior_axes
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.noise_correlation import correlate, neighbours
from warmlens.imaging.observation import Band, Observation, checked_band
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source
from warmlens.imaging.shapelets import ShapeletSet, surface_brightness
from warmlens.lensing.macro_model import deflection, light_images
from warmlens.products.observation import observation_datasets, read_observation
from warmlens.products.smooth_model import read_smooth_model
from warmlens.stage_table import stage_settings
from warmlens.stages.scan_operator import scan_linear_model
from warmlens.types import FloatArray

from ..shared import run_stage

ROOT = Path(__file__).parents[2]
GRID = PixelGrid.centred((60, 60), 0.06)
LENSES, LIGHTS = ["EPL", "SHEAR", "SIS"], ["SERSIC", "SERSIC"]
LENS: list[dict[str, float]] = [
    {"theta_E": 1.0, "gamma": 2.05, "e1": 0.12, "e2": 0.05, "center_x": 0.01, "center_y": -0.02},
    {"gamma1": 0.06, "gamma2": 0.02, "ra_0": 0.0, "dec_0": 0.0},
    {"theta_E": 0.1, "center_x": 0.3, "center_y": 0.7},
]
LIGHT: list[dict[str, float]] = [
    {"R_sersic": 0.3, "n_sersic": 1.5, "center_x": 0.013, "center_y": -0.017},
    {"R_sersic": 0.1, "n_sersic": 1.2, "center_x": 0.3, "center_y": 0.7},
]
QUASARS = [[0.77163, -0.76047], [-0.754747, 0.735311], [-0.979596, -0.409596], [0.442664, 1.026176]]
SOURCE = [0.04, 0.03]
SIGMA = 0.02


def smooth_block() -> dict[str, Any]:
    """Everything right, and a fit of a few parameters."""
    return {
        "mode": "fit",
        "lens": {"lens_model_list": LENSES, "kwargs_lens": copy.deepcopy(LENS)},
        "lens_light": {"lens_light_model_list": LIGHTS, "kwargs_lens_light": copy.deepcopy(LIGHT)},
        "quasar_images": copy.deepcopy(QUASARS),
        "noise_from": "data",
        "quasar_variance_fraction": 0.0,
        "quasar_core_arcsec": 0.15,
        "disc_arcsec": None,
        "lens_core_mask_arcsec": 0.0,
        "fit_background": True,
        "source": {"n_max": 6, "beta_arcsec": 0.15, "center": "quasars", "supersampling": 1, "clumps": None},
        "ridge": 1e-8,
        "chi2_red_range": [0.9, 1.1],
        "allow_poor_fit": False,
        "fit": {
            "lens_free": [
                {"theta_E": [0.7, 1.3, None], "e1": [-0.4, 0.4, None]},
                {"gamma1": [-0.4, 0.4, None]},
                {"theta_E": [0.0, 0.6, 0.05], "center_x": [-0.3, 0.9, 0.05]},
            ],
            "lens_light_free": [{"R_sersic": [0.05, 1.5, None]}, {}],
            "satellites": [[2, 1]],
            "potential_shapelets": {"number": 3, "beta_arcsec": 1.0, "sigma": 0.02},
            "quasar_sigma_arcsec": 0.005,
            "tie_arcsec": 0.003,
            "source_beta": [0.1, 0.3, 0.02],
            "search": None,
            "levels": [3],
            "max_steps": 8,
            "tolerance": 1e-4,
            "psf": None,
            "seed": 3,
        },
    }


def config(block: dict[str, Any]) -> Config:
    raw = json.loads(json.dumps(yaml.safe_load((ROOT / "config.yaml").read_text())))
    raw["smooth_model"] = block
    raw["scan"]["marginalise_lens"] = False
    return parse_config(raw)


def observe(clump: float, n_bands: int, correlation: FloatArray | None = None) -> Observation:
    """The truth of the block, and a compact feature of the source that the shapelets do not hold."""
    x, y = GRID.subpixel_coordinates(1)
    rays = np.array([x, y]) - deflection(LENSES, LENS, x, y)
    sets = [ShapeletSet(6, 0.15, *SOURCE), ShapeletSet(0, 0.025, SOURCE[0] + 0.25, SOURCE[1] - 0.1)]
    galaxies = light_images(LIGHTS, LIGHT, GRID, 1)
    bands: list[Band] = []
    for name, wavelength, flux in (("F814W", 814.0, 1.0), ("F555W", 600.0, 0.7))[:n_bands]:
        psf = hst_like_psf(wavelength, GRID.pixel_scale, 15)
        coefficients = 0.2 * np.random.default_rng(3).normal(size=29)
        coefficients[0], coefficients[-1] = 3.0, clump
        light = surface_brightness(sets, flux * coefficients, *rays).mean(axis=-1).reshape(GRID.shape)
        image = Convolution(psf, GRID.shape).forward(light + flux * np.tensordot((60.0, 20.0), galaxies, axes=1))
        image += flux * sum(
            f * point_source(psf, GRID, *q) for f, q in zip((40, 30, 20, 30), QUASARS, strict=True)
        )
        white = np.random.default_rng((1, len(bands))).normal(size=GRID.shape)
        image += 0.02 + SIGMA * (white if correlation is None else correlate(white, correlation))
        mask = np.ones(GRID.shape, dtype=bool)
        mask[:2] = False
        noise = NoiseModel(SIGMA, 1e9)
        bands.append(checked_band(name, GRID, image, np.full(GRID.shape, SIGMA), mask, psf, noise))
    return Observation("simulated", GRID, tuple(bands))


@pytest.fixture(scope="module")
def observed() -> Observation:
    return observe(0.0, 1)


@pytest.fixture(scope="module")
def clumpy() -> Observation:
    return observe(4.0, 2)


@pytest.fixture(scope="module")
def folder(observed: Observation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lens_fit")
    write_artifact(
        path / "observation.h5", Provenance("observation", {"test": 1}), *observation_datasets(observed)
    )
    return path


@pytest.mark.parametrize("known", [False, True], ids=["taken as independent", "known"])
def test_correlated_noise_of_the_image_is_warned_of(known: bool, tmp_path: Path) -> None:
    """Unless the mocks have the same."""
    correlation = np.array([[0.1, 0.3, 0.1], [0.2, 1.0, 0.2], [0.1, 0.3, 0.1]])
    observed = observe(0.0, 1, correlation)
    if known:
        (band,) = observed.bands
        observed = replace(observed, bands=(replace(band, noise=replace(band.noise, correlation=correlation)),))
    write_artifact(
        tmp_path / "observation.h5", Provenance("observation", {"test": 1}), *observation_datasets(observed)
    )
    with open_artifact(run({**smooth_block(), "mode": "given"}, tmp_path), "smooth_model") as artifact:
        row, column, across = neighbours(artifact.array("F814W/residual_correlation"))
        warnings = artifact.metadata["problems"] + artifact.metadata["notes"]
    assert (row, column, across) == pytest.approx((0.2, 0.3, 0.1), abs=0.06)  # the fit takes a little of it
    expected = (
        f"F814W: neighbouring pixels' residuals correlate by {row:.2f} along rows and {column:.2f} along columns"
    )
    assert [expected in warning for warning in warnings] == ([] if known else [True])


def off(block: dict[str, Any]) -> dict[str, Any]:
    """The start of what is free 5 per cent off."""
    for index, key in ((0, "theta_E"), (0, "e1"), (1, "gamma1"), (2, "theta_E")):
        block["lens"]["kwargs_lens"][index][key] *= 1.05
    block["lens_light"]["kwargs_lens_light"][0]["R_sersic"] *= 0.95
    return block


def run(block: dict[str, Any], folder: Path, name: str = "model.h5") -> Path:
    settings: Any = stage_settings(config(block), "smooth_model")
    run_stage("smooth_model", settings, folder / name, observation=folder / "observation.h5")
    return folder / name


@pytest.fixture(scope="module")
def fitted(folder: Path) -> Path:
    return run(off(smooth_block()), folder, "fitted.h5")


def test_fit_finds_the_lens(fitted: Path) -> None:
    with open_artifact(fitted, "smooth_model") as artifact:
        meta = artifact.metadata
        value, error = artifact.array("parameters/value"), artifact.array("parameters/error")
        matrix = artifact.array("parameters/covariance")
    names = [parameter["name"] for parameter in meta["parameters"]]
    truth = {"lens_0.theta_E": 1.0, "lens_0.e1": 0.12, "lens_1.gamma1": 0.06, "lens_2.theta_E": 0.1,
             "lens_2.center_x": 0.3, "lens_3.coeffs_1": 0.0, "light_0.R_sersic": 0.3, "quasar_3.y": 1.026176,
             "source_0.beta": 0.15}  # fmt: skip
    assert len(names) == 5 + 3 + 1 + 8 + 1
    for name, expected in truth.items():
        i = names.index(name)
        assert abs(value[i] - expected) < 4.0 * error[i], name
    assert abs(1.05 - value[0]) > 10.0 * error[0]
    np.testing.assert_allclose(np.sqrt(np.diag(matrix)), error)
    assert meta["converged"] and meta["problems"] == meta["notes"] == []
    assert [step["name"] for step in meta["history"]] == ["n_max 3", "n_max 6", "last fit"]
    assert meta["history"][0]["n_max"] == 3 and meta["history"][-1]["n_max"] == 6
    steps = meta["history"]
    assert steps[-1]["chi2_per_pixel"] <= steps[1]["chi2_per_pixel"] + 1e-6 < steps[0]["chi2_per_pixel"]
    assert meta["kwargs_lens"][0]["theta_E"] == value[0]
    assert meta["kwargs_lens"][3]["coeffs"] == pytest.approx(value[5:8].tolist())


def test_product_of_the_fit(fitted: Path, observed: Observation) -> None:
    """What the campaign reads: rays and deflections of the fitted lens, errors of the lens as image changes."""
    model = read_smooth_model(fitted)
    x, y = GRID.coordinates()
    alpha = deflection(list(model.lens_models), list(model.kwargs_lens), x, y)
    np.testing.assert_allclose(model.deflection, alpha, atol=1e-13)
    np.testing.assert_allclose(model.rays.source_x[:, 0], (x - alpha[0]).ravel(), atol=1e-12)
    assert model.lens_models == (*LENSES, "SHAPELETS_CART")
    assert model.names == ("quasar_0", "quasar_1", "quasar_2", "quasar_3", "light_0", "light_1", "background")
    assert model.fixed["F814W"].shape == (3600, 7)
    fit = model.fits["F814W"]
    assert 0.9 < fit.chi2_red < 1.1
    pull = (observed.bands[0].image - fit.model)[2:] / SIGMA
    assert fit.chi2 == pytest.approx(np.sum(pull**2), rel=1e-9)
    macro = model.macro["F814W"]
    assert macro.shape == (3600, 18)
    with open_artifact(fitted, "smooth_model") as artifact:
        variance = artifact.array("parameters/covariance")
        best = artifact.array("parameters/value")
    fit_again = fit_lens(config(off(smooth_block())).smooth_model, observed)
    images, _ = fit_again.model.derivatives(fit_again.model.solve(best))
    expected = images[0] @ variance @ images[0][::97].T
    np.testing.assert_allclose(macro @ macro.T[:, ::97], expected, atol=1e-6 * np.abs(macro).max() ** 2)


def test_same_input_same_result(folder: Path, fitted: Path) -> None:
    """Bit by bit, with the swarm, too."""
    block = off(smooth_block())
    block["fit"]["search"] = {"particles": 4, "iterations": 2, "n_max": 2}
    paths = [run(block, folder, f"swarm_{i}.h5") for i in range(2)] + [
        run(off(smooth_block()), folder, "again.h5")
    ]
    arrays = []
    for path in (*paths, fitted):
        with open_artifact(path, "smooth_model") as artifact:
            names = (
                "parameters/value",
                "parameters/error",
                "F814W/model",
                "F814W/source_coefficients",
                "deflection",
            )
            arrays.append({name: artifact.array(name) for name in names})
    for name in arrays[0]:
        np.testing.assert_array_equal(arrays[0][name], arrays[1][name])
        np.testing.assert_array_equal(arrays[2][name], arrays[3][name])


def test_given_lens_is_used_as_it_is(folder: Path) -> None:
    block = smooth_block() | {"mode": "given", "fit": None}
    path = run(block, folder, "given.h5")
    model = read_smooth_model(path)
    assert list(model.kwargs_lens) == LENS
    assert model.macro["F814W"].shape == (3600, 0)
    assert 0.9 < model.fits["F814W"].chi2_red < 1.1
    np.testing.assert_array_equal(model.quasars, QUASARS)
    with open_artifact(path, "smooth_model") as artifact:
        assert (
            artifact.metadata["history"] == []
            and artifact.metadata["problems"] == artifact.metadata["notes"] == []
        )
        assert "parameters" not in artifact.file
    wrong = off(smooth_block() | {"mode": "given", "fit": None})
    with pytest.raises(ValueError, match=r"F814W: chi2_red = .* lies above 1\.1"):
        run(wrong, folder, "wrong.h5")


def test_fit_that_does_not_converge_is_refused(folder: Path) -> None:
    block = off(smooth_block())
    block["fit"] |= {"max_steps": 1, "levels": []}
    with pytest.raises(ValueError, match=r"(?s)did not converge in 2 steps; raise smooth_model\.fit\.max_steps.*"
                       r"chi2_red = .* lies above 1\.1.*smooth_model\.allow_poor_fit: true"):  # fmt: skip
        run(block, folder, "poor.h5")
    assert not (folder / "poor.h5").exists()
    path = run(block | {"allow_poor_fit": True}, folder, "poor.h5")
    with open_artifact(path, "smooth_model") as artifact:
        warnings = artifact.metadata["problems"] + artifact.metadata["notes"]
        assert not artifact.metadata["converged"]
    assert len(warnings) == 2
    assert "did not converge" in warnings[0] and "lies above 1.1" in warnings[1]


def test_hit_limits_are_named(folder: Path) -> None:
    block = off(smooth_block())
    block["fit"]["lens_free"][0]["theta_E"] = [1.03, 1.3, None]
    with pytest.raises(
        ValueError, match=r"ran into the limits of .*lens_0\.theta_E.*; widen them in smooth_model\.fit"
    ):
        run(block, folder, "limit.h5")


def test_structure_that_rays_do_not_resolve(folder: Path, fitted: Path, observed: Observation) -> None:
    """A set of 1 mas beside the ray of one pixel, where it adds nothing: chi2 is as before, mocks are not."""
    model = read_smooth_model(fitted)
    assert unresolved_pixels(observed, model, "F814W").size == 0
    fit = model.fits["F814W"]
    ray = np.argmax(fit.model - fit.fixed_image)
    x, y = model.rays.source_x.ravel()[ray], model.rays.source_y.ravel()[ray]
    tiny = ShapeletSet(0, 0.001, float(x) + 0.004, float(y))
    amplitudes = np.append(fit.source_coefficients, 1e4 * fit.source_coefficients.max())
    finer = replace(model, sets=(*model.sets, tiny), fits={"F814W": replace(fit, source_coefficients=amplitudes)})
    assert unresolved_pixels(observed, finer, "F814W").max() > 30.0


def test_bright_arcs_that_are_fitted_worse_than_faint_ones_are_reported(
    folder: Path, observed: Observation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pixels wrong by 2% of the arcs' light: chi2 per pixel grows with the light."""
    given = smooth_block() | {"mode": "given", "fit": None}
    model = read_smooth_model(run(given, folder, "bright.h5"))
    outside = outside_cores(config(given).smooth_model, GRID, model.quasars)

    def chi2(band: Band) -> ArcChi2:
        arcs = chi2_of_arcs(model, "F814W", band_residuals(band, model, outside))
        assert arcs is not None
        return arcs

    band = observed.bands[0]
    before = chi2(band)
    assert before.bright == pytest.approx(before.faint, abs=4.0 * np.sqrt(2.0 / before.n_bright))
    fit = model.fits["F814W"]
    light = fit.model - fit.fixed_image
    wrong = 0.02 * light * np.random.default_rng(8).normal(size=light.shape)
    after = chi2(replace(band, image=band.image + wrong))
    bright = light > 10.0 * fit.sigma
    assert after.n_bright == before.n_bright > 100
    assert after.bright - before.bright == pytest.approx(np.mean((wrong / fit.sigma)[bright] ** 2), rel=0.3)
    monkeypatch.setattr(judgement, "chi2_of_arcs", lambda *_: after)
    with open_artifact(run(given, folder, "worse.h5"), "smooth_model") as artifact:
        (warning,) = artifact.metadata["problems"] + artifact.metadata["notes"]
    assert f"chi2 a pixel is {after.bright:.2f} where the arcs exceed 10 sigma" in warning
    few = after._replace(n_bright=10)  # their chi2 may scatter as much
    monkeypatch.setattr(judgement, "chi2_of_arcs", lambda *_: few)
    with open_artifact(run(given, folder, "few.h5"), "smooth_model") as artifact:
        assert artifact.metadata["problems"] == artifact.metadata["notes"] == []


def test_a_source_that_rays_do_not_resolve_is_reported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A little of it is a warning, much is refused."""
    block = smooth_block() | {"mode": "given", "fit": None}
    monkeypatch.setattr(judgement, "unresolved_pixels", lambda *_: np.array([4.0, 8.0]))
    with open_artifact(run(block, folder, "unresolved.h5"), "smooth_model") as artifact:
        (warning,) = artifact.metadata["problems"] + artifact.metadata["notes"]
    assert "1 mas changes 2 pixels by more than their arc's light, by up to 8 sigma" in warning
    monkeypatch.setattr(judgement, "unresolved_pixels", lambda *_: np.array([4.0, 80.0]))
    with pytest.raises(ValueError, match=r"up to 80 sigma.*smooth_model\.source\.clumps"):
        run(block, folder, "refused.h5")


def test_chi2_below_the_range_is_a_warning(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    block = smooth_block() | {"mode": "given", "chi2_red_range": [1.5, 2.0]}
    with open_artifact(run(block, folder, "low.h5"), "smooth_model") as artifact:
        (warning,) = artifact.metadata["problems"] + artifact.metadata["notes"]
    assert "F814W: chi2_red =" in warning and "lies below 1.5" in warning
    assert warning in caplog.text


@pytest.mark.parametrize(("factor", "refused"), [(1.1, False), (1.5, True), (30.0, True)])
def test_chi2_far_below_the_range_is_refused(
    factor: float, refused: bool, observed: Observation, tmp_path: Path
) -> None:
    """With a noise map that is too large; how far below is refused goes with the range."""
    (band,) = observed.bands
    noise = NoiseModel(None, None)
    larger = replace(observed, bands=(replace(band, sigma=factor * band.sigma, noise=noise),))
    provenance = Provenance("observation", {"test": 1})
    write_artifact(tmp_path / "observation.h5", provenance, *observation_datasets(larger))
    block = smooth_block() | {"mode": "given"}
    if refused:
        with pytest.raises(ValueError, match=r"lies far below 0\.9.*scatter of the sky \(warmlens validate\)"):
            run(block, tmp_path)
        block |= {"chi2_red_range": [0.6, 1.1]} if factor < 2.0 else {"allow_poor_fit": True}
    with open_artifact(run(block, tmp_path), "smooth_model") as artifact:
        (warning,) = artifact.metadata["problems"] + artifact.metadata["notes"]
    assert "below 0." in warning


@pytest.mark.parametrize("mode", ["given", "fit"])
def test_clumps(mode: str, clumpy: Observation) -> None:
    """None and 0 are the same; 15 allowed find the feature, and chi2 falls to the noise."""
    block = smooth_block() | {"mode": mode}
    block["fit"] |= {"levels": [], "max_steps": 3}
    results = []
    for number in (None, 0, 15):
        block["source"]["clumps"] = number if number is None else {
            "number": number, "n_max": 1, "threshold": 6.0, "scale_in_fwhm": 0.5}  # fmt: skip
        results.append(fit_lens(config(block).smooth_model, clumpy))
    none, zero, some = results
    assert none.model.basis.clumps == zero.model.basis.clumps == ()
    assert zero.solution.chi2 == pytest.approx(none.solution.chi2, rel=1e-3)
    beta = some.solution.macro.beta
    distance = [
        np.hypot(beta * c.center_x - 0.25, beta * c.center_y + 0.1) / (beta * c.beta)
        for c in some.model.basis.clumps
    ]
    assert 1 <= len(distance) <= 15 and min(distance) < 1.5
    assert some.solution.chi2 / some.solution.n_pixels < 1.1 < none.solution.chi2 / none.solution.n_pixels
    if mode == "fit":
        assert [step.n_clumps for step in some.history] == [0, len(distance), len(distance)]


def test_disc_and_core_masks(observed: Observation) -> None:
    block = smooth_block() | {"mode": "given", "disc_arcsec": 1.5, "lens_core_mask_arcsec": 0.2}
    settings = config(block).smooth_model
    x, y = GRID.coordinates()
    distance = np.hypot(x - 0.01, y + 0.02)  # of the first lens' centre
    usable = usable_pixels(settings, GRID)
    np.testing.assert_array_equal(usable, (distance <= 1.5) & (distance >= 0.2))
    fit = fit_lens(settings, observed)
    expected = usable & observed.bands[0].mask
    np.testing.assert_array_equal(fit.model.bands[0].weights > 0.0, expected)
    assert 0 < fit.solution.n_pixels == expected.sum() < 0.7 * observed.bands[0].mask.sum()


def test_masks_stay_through_the_noise_of_the_quasars(observed: Observation) -> None:
    block = smooth_block() | {"mode": "given", "disc_arcsec": 1.5, "quasar_variance_fraction": 0.05}
    fit = fit_lens(config(block).smooth_model, observed)
    usable = usable_pixels(config(block).smooth_model, GRID) & observed.bands[0].mask
    weights = fit.model.bands[0].weights
    np.testing.assert_array_equal(weights > 0.0, usable)
    assert weights[usable].min() < 0.5 / SIGMA and weights[usable].max() == pytest.approx(1.0 / SIGMA, rel=1e-3)


def test_cores_of_the_quasars(observed: Observation) -> None:
    settings = config(smooth_block()).smooth_model
    outside = outside_cores(settings, GRID, np.array(QUASARS))
    x, y = GRID.coordinates()
    nearest = np.min([np.hypot(x - qx, y - qy) for qx, qy in QUASARS], axis=0)
    np.testing.assert_array_equal(outside, nearest >= 0.15)
    assert outside_cores(settings, GRID, np.empty((0, 2))).all()


def test_psf_is_improved_in_the_fit(observed: Observation) -> None:
    """The stage's whole sequence, from a PSF that is too sharp: the core ends nearer to the truth."""
    block = smooth_block()
    block["fit"] |= {"levels": [], "max_steps": 3, "psf": {
        "iterations": 1, "radius_arcsec": 0.4, "relative_sigma": 0.2, "wing_radii_arcsec": [0.3, 0.4],
        "unknown_fraction": 0.05}}  # fmt: skip
    right = observed.bands[0]
    wrong = hst_like_psf(800.0, GRID.pixel_scale, 15, blur_arcsec=0.03)
    band = checked_band(right.name, GRID, right.image, right.sigma, right.mask, wrong, right.noise)
    fit = fit_lens(config(block).smooth_model, Observation("simulated", GRID, (band,)))
    improved = fit.model.bands[0].psf
    core = np.s_[4:11, 4:11]
    before, after = (np.abs(psf - right.psf)[core].max() for psf in (wrong, improved))
    assert after < 0.5 * before
    assert fit.psf_errors is not None and len(fit.psf_errors) == 1
    assert fit.psf_errors[0].radius[-1] == pytest.approx(0.4, abs=0.03)
    assert [step.name for step in fit.history] == ["n_max 6", "PSF 1 of 1", "last fit"]
    given = fit_lens(
        config(smooth_block() | {"mode": "given"}).smooth_model, Observation("simulated", GRID, (band,))
    )
    assert fit.solution.chi2 < given.solution.chi2


def test_artifact_reads_the_observation_back(folder: Path, observed: Observation) -> None:
    """The observation that the stage reads is the one that was written: the tests above judge the same data."""
    again = read_observation(folder / "observation.h5")
    np.testing.assert_array_equal(again.bands[0].image, observed.bands[0].image)
    np.testing.assert_array_equal(again.bands[0].mask, observed.bands[0].mask)


def test_noise_is_the_model_s_or_the_data_s(observed: Observation) -> None:
    """Poisson noise of the fitted image, unless the data's is asked for or a noise map is all there is."""
    band = observed.bands[0]
    poisson = NoiseModel(SIGMA, 500.0)
    band = checked_band(band.name, GRID, band.image, poisson.sigma(band.image), band.mask, band.psf, poisson)
    counted = Observation("simulated", GRID, (band,))
    mapped = Observation("fits", GRID, (replace(band, noise=NoiseModel(None, None)),))
    blocks = {name: smooth_block() | {"mode": "given", "noise_from": name} for name in ("model", "data")}
    settings = {name: config(block).smooth_model for name, block in blocks.items()}
    for name, data in (("data", counted), ("data", mapped), ("model", mapped)):
        fit = fit_lens(settings[name], data)
        np.testing.assert_allclose(fit.model.bands[0].weights[2:], 1.0 / band.sigma[2:], rtol=1e-12)
    fit = fit_lens(settings["model"], counted)
    first = first_model(settings["model"], counted)
    before = band_fit(first, first.solve(np.empty(0)), 0, band.sigma, np.ones(GRID.shape, dtype=bool))
    np.testing.assert_allclose(fit.model.bands[0].weights[2:], 1.0 / poisson.sigma(before.model)[2:], rtol=1e-9)
    assert np.abs(fit.model.bands[0].weights[2:] * band.sigma[2:] - 1.0).max() > 0.05


def test_axes_of_the_errors_and_their_priors(folder: Path, observed: Observation) -> None:
    """Along the axes errors are one and priors independent, none narrower than the error that it is part of."""
    fit = fit_lens(config(off(smooth_block())).smooth_model, observed)
    axes, sigma = prior_axes(fit.model, fit.solution)
    curvature = np.linalg.inv(covariance(fit.model, fit.solution))
    np.testing.assert_allclose(axes.T @ curvature @ axes, np.eye(18), atol=1e-6)
    _, traced = fit.model.derivatives(fit.solution)
    spread = (traced - traced.mean(axis=0)) / 0.003
    prior = np.einsum("qci,qcj->ij", spread, spread) + np.diag(fit.model.space.prior_sigma**-2.0)
    np.testing.assert_allclose(axes.T @ prior @ axes, np.diag(sigma**-2.0), atol=1e-6)
    assert (sigma >= 1.0).all() and sigma.min() < 3.0 and np.sum(sigma > 10.0) >= 5


def test_linear_refit_is_the_fit(fitted: Path, folder: Path, observed: Observation) -> None:
    """A lens that is 4 sigma away: the scan's linear fit with the lens free reaches the chi2 of a whole fit.

    With its lens fixed, or held by the errors of the fit instead of its priors, it does not.
    """
    model = read_smooth_model(fitted)
    band = observed.bands[0]
    step = 4.0 * np.random.default_rng(8).choice([-1.0, 1.0], model.macro_sigma.size) / np.sqrt(18)
    step *= model.macro_sigma > 3.0  # along a prior the image is not moved
    image = band.image + (model.macro["F814W"] @ step).reshape(GRID.shape)
    moved = Observation("simulated", GRID, (replace(band, image=image),))
    again = fit_lens(config(smooth_block()).smooth_model, moved)
    assert again.converged

    def chi2(model: SmoothModel, marginalise: bool) -> float:
        raw = config(smooth_block()).model_dump()
        raw["scan"] |= {"marginalise_lens": marginalise, "nested": None}
        linear = scan_linear_model(parse_config(raw).scan, observed, model, "F814W")
        return solve(linear, (image * band.weights).reshape(-1, 1)).chi2[0]

    whole = again.solution.chi2
    assert chi2(model, True) == pytest.approx(whole, abs=0.3)
    assert chi2(model, False) > whole + 8.0
    assert chi2(replace(model, macro_sigma=np.ones(18)), True) > whole + 2.0


def test_macro_columns_are_what_moving_the_lens_does(folder: Path, fitted: Path) -> None:
    """One sigma along an axis of the fit's errors changes the image by that column, and the scan takes them."""
    model = read_smooth_model(fitted)
    with open_artifact(fitted, "smooth_model") as artifact:
        names = [parameter["name"] for parameter in artifact.metadata["parameters"]]
    refitted = fit_lens(config(off(smooth_block())).smooth_model, read_observation(folder / "observation.h5"))
    axes, _ = prior_axes(refitted.model, refitted.solution)
    derivatives = np.linalg.solve(axes.T, model.macro["F814W"].T).T  # per unit of each parameter
    theta_e = names.index("lens_0.theta_E")
    shifted = copy.deepcopy(list(model.kwargs_lens))
    shifted[0]["theta_E"] += 1e-4
    x, y = GRID.subpixel_coordinates(1)
    change = deflection(model.lens_models, shifted, x, y) - deflection(model.lens_models, model.kwargs_lens, x, y)
    at_quasars = deflection(model.lens_models, shifted, *model.quasars.T) - deflection(
        model.lens_models, model.kwargs_lens, *model.quasars.T
    )
    moved = np.array([model.rays.source_x, model.rays.source_y]) - change + at_quasars.mean(axis=1)[:, None, None]
    source = model.fits["F814W"].source_coefficients
    images = [
        surface_brightness(model.sets, source, *rays).mean(axis=-1).reshape(GRID.shape)
        for rays in (moved, (model.rays.source_x, model.rays.source_y))
    ]
    expected = Convolution(model.fits["F814W"].psf, GRID.shape).forward((images[0] - images[1]) / 1e-4)
    column = derivatives[:, theta_e].reshape(GRID.shape)
    np.testing.assert_allclose(column, expected, atol=2e-3 * np.abs(expected).max())

    raw = config(smooth_block()).model_dump()
    raw["scan"] |= {"marginalise_lens": True, "nested": None}
    settings = stage_settings(parse_config(raw), "scan_design")
    inputs = {"observation": folder / "observation.h5", "smooth_model": fitted}
    run_stage("scan_design", settings, folder / "design.h5", **inputs)
    with open_artifact(folder / "design.h5", "scan_design") as artifact:
        prior, norms = artifact.array("F814W/prior"), artifact.array("F814W/column_norms")
    n_free = model.fits["F814W"].n_columns
    assert prior.size == n_free + len(names)
    np.testing.assert_allclose(prior[n_free:], 1e-8 + (model.macro_sigma * norms[n_free:]) ** -2.0)
