"""Clumps: where residual features come from in the source, how many, and how significant noise looks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from warmlens.config.smooth_model import ClumpsBlock
from warmlens.fitting.clumps import find_clumps, residual_significance
from warmlens.fitting.image_model import FitBand, ImageModel, SourceBasis
from warmlens.fitting.parameters import Macro, ParameterSpace
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import fwhm, hst_like_psf
from warmlens.imaging.shapelets import ShapeletSet, surface_brightness
from warmlens.lensing.macro_model import deflection

GRID = PixelGrid.centred((60, 60), 0.06)
LENS = ({"theta_E": 1.0, "e1": 0.12, "e2": 0.05, "center_x": 0.011, "center_y": -0.021},)
CENTER = (0.06, 0.03)
SIGMA = 0.02
CLUMP = (0.22, -0.1)  # relative to the centre
OTHER = (-0.3, 0.2)
BETA = 0.2
NOTHING = np.zeros(GRID.shape, dtype=bool)
SCALE = 0.5


def clumps(number: int, threshold: float) -> ClumpsBlock:
    return ClumpsBlock(number=number, n_max=2, threshold=threshold, scale_in_fwhm=SCALE)


def build(features: dict[tuple[float, float], float], n_bands: int = 1, noise: float = SIGMA) -> ImageModel:
    """Arcs of a global source (in the basis) and of compact Gaussians (not in it) of the given peaks."""
    bands = tuple(
        FitBand(str(i), np.zeros(GRID.shape), np.full(GRID.shape, 1.0 / SIGMA), hst_like_psf(wave, 0.06, 13))
        for i, wave in enumerate((814.0, 700.0)[:n_bands])
    )
    model = ImageModel(
        grid=GRID, bands=bands, space=ParameterSpace(Macro(LENS, (), np.empty((0, 2)), BETA), ()),
        lens_models=("SIE",), light_models=(), basis=SourceBasis(4, CENTER), supersampling=1, fit_background=True,
        ridge=1e-10, tie_arcsec=np.inf,
    )  # fmt: skip
    solution = model.solve(np.empty(0))
    sets = [*solution.sets, *(ShapeletSet(0, 0.03, CENTER[0] + x, CENTER[1] + y) for x, y in features)]
    coefficients = np.concatenate([[3.0, 0.2, -0.1], np.zeros(12), list(features.values())])
    light = surface_brightness(sets, coefficients, solution.source_x, solution.source_y).mean(axis=-1)
    rng = np.random.default_rng(2)
    filled = [
        replace(band, image=convolution.forward(light.reshape(GRID.shape)) + noise * rng.normal(size=GRID.shape))
        for band, convolution in zip(bands, model.convolutions, strict=True)
    ]
    return replace(model, bands=tuple(filled))


def found_in(model: ImageModel, number: int = 15, threshold: float = 6.0, excluded=NOTHING):  # type: ignore[no-untyped-def]
    """In arcsec, relative to the source's centre; the sets themselves are in units of its scale."""
    sets = find_clumps(model, model.solve(np.empty(0)), clumps(number, threshold), excluded)
    return tuple(ShapeletSet(c.n_max, BETA * c.beta, BETA * c.center_x, BETA * c.center_y) for c in sets)


def offset(clump: ShapeletSet, position: tuple[float, float]) -> float:
    return float(np.hypot(clump.center_x - position[0], clump.center_y - position[1]))


@pytest.fixture(scope="module")
def one() -> ImageModel:
    return build({CLUMP: 2.0})


def test_a_feature_is_found_where_it_is(one: ImageModel) -> None:
    """Within its scale; relative to the source's centre, which is not the origin."""
    first = found_in(one)[0]
    assert offset(first, CLUMP) < first.beta
    assert offset(first, (CLUMP[0] + CENTER[0], CLUMP[1] + CENTER[1])) > first.beta  # wrong twin: not relative
    assert first.n_max == 2
    resolution = SCALE * fwhm(one.bands[0].psf, GRID.pixel_scale)
    assert 0.4 * GRID.pixel_scale < first.beta < resolution  # magnified, but rays resolve it


def test_rays_resolve_clumps_on_a_critical_curve() -> None:
    """A feature behind the lens's centre makes a ring: magnified without limit along it, not at all across."""
    sets = found_in(build({(LENS[0]["center_x"] - CENTER[0], LENS[0]["center_y"] - CENTER[1]): 3.0}))
    assert sets
    for clump in sets:
        assert clump.beta > 0.5 * GRID.pixel_scale * 0.8  # across, an isothermal lens shrinks lengths by 1


def test_pixels_without_weight_make_no_clumps(one: ImageModel) -> None:
    """Though residuals next to them look like peaks there."""
    band = one.bands[0]
    left = GRID.coordinates()[0] < 0.4
    half = replace(one, bands=(replace(band, weights=np.where(left, band.weights, 0.0)),))
    solution = half.solve(np.empty(0))
    rays = np.array([solution.source_x, solution.source_y]).reshape(2, -1)[:, left.ravel()]
    sets = find_clumps(half, solution, clumps(15, 3.0), NOTHING)
    assert sets
    for clump in sets:
        center = solution.center + BETA * np.array([clump.center_x, clump.center_y])
        assert np.hypot(*(rays - center[:, None])).min() < 1e-9


def test_counter_images_are_one_clump(one: ImageModel) -> None:
    """The feature has several images, each a peak of the residuals; they meet in the source."""
    solution = one.solve(np.empty(0))
    significance = residual_significance(one, solution)
    x, y = GRID.coordinates()
    alpha = deflection(("SIE",), LENS, x, y)
    near = np.hypot(x - alpha[0] - CENTER[0] - CLUMP[0], y - alpha[1] - CENTER[1] - CLUMP[1]) < 0.08
    sides = [near & (significance > 6.0) & side for side in (x + y > 0.0, x + y <= 0.0)]
    assert all(side.any() for side in sides)  # images on both sides of the lens
    sets = found_in(one)
    assert sum(offset(clump, CLUMP) < 1.5 * clump.beta for clump in sets) == 1
    for i, clump in enumerate(sets):
        for other in sets[:i]:
            apart = offset(clump, (other.center_x, other.center_y))
            assert apart > 1.5 * max(clump.beta, other.beta)


def test_a_clump_takes_the_residual_away(one: ImageModel) -> None:
    before = one.solve(np.empty(0))
    sets = find_clumps(one, before, clumps(15, 6.0), NOTHING)
    with_clumps = replace(one, basis=replace(one.basis, clumps=sets))
    after = with_clumps.solve(np.empty(0))
    assert residual_significance(with_clumps, after).max() < 0.3 * residual_significance(one, before).max()
    assert after.chi2 / after.n_pixels < 1.1 < before.chi2 / before.n_pixels


def test_number_threshold_and_order() -> None:
    """Most significant first, so that a smaller number is the beginning of a larger."""
    model = build({CLUMP: 1.0, OTHER: 3.0})
    both = found_in(model)
    assert offset(both[0], OTHER) < both[0].beta
    assert any(offset(clump, CLUMP) < clump.beta for clump in both[1:])
    assert found_in(model, number=1) == both[:1]
    few = found_in(model, threshold=20.0)
    assert 1 <= len(few) <= len(both) and few == both[: len(few)]
    assert found_in(model, threshold=1e4) == ()


def test_noise_has_no_clumps() -> None:
    assert found_in(build({}), threshold=5.0) == ()
    assert len(found_in(build({}), threshold=1.0)) == 15


def test_excluded_pixels_make_no_clumps(one: ImageModel) -> None:
    assert found_in(one, excluded=~NOTHING) == ()
    x, y = GRID.coordinates()
    alpha = deflection(("SIE",), LENS, x, y)
    images = np.hypot(x - alpha[0] - CENTER[0] - CLUMP[0], y - alpha[1] - CENTER[1] - CLUMP[1]) < 0.15
    sets = found_in(one, excluded=images)
    assert all(offset(clump, CLUMP) > clump.beta for clump in sets)


@pytest.mark.parametrize("n_bands", [1, 2])
def test_significance_of_noise(n_bands: int) -> None:
    """rms 1 per band, in quadrature; the weights' size and a mask do not matter."""
    model = build({}, n_bands)
    significance = residual_significance(model, model.solve(np.empty(0)))
    rms = np.sqrt(np.mean(significance**2))
    # 16 of 3600 pixels' freedom are fitted; PSF-sized patches leave about 500 independent values
    assert rms == pytest.approx(np.sqrt(n_bands), rel=0.05)


def test_significance_of_a_point_is_its_signal_to_noise() -> None:
    """A point source of flux F on uneven noise has F sqrt(sum (P / sigma)^2); masked pixels count for nothing."""
    model = build({}, noise=0.0)
    band = model.bands[0]
    weights = np.random.default_rng(8).uniform(20.0, 80.0, GRID.shape)
    weights[20:30, 14:16] = 0.0
    solution = model.solve(np.empty(0))
    point = np.zeros(GRID.shape)
    point[25, 12] = 1.0
    blurred = model.convolutions[0].forward(point)
    residual = (weights * 7.0 * blurred).ravel()[np.flatnonzero(weights)]
    solved = replace(solution.bands[0], pixels=np.flatnonzero(weights), residual=residual)
    uneven = replace(model, bands=(replace(band, weights=weights),))
    significance = residual_significance(uneven, replace(solution, bands=(solved,)))
    expected = 7.0 * np.sqrt(np.sum((weights * blurred) ** 2))
    assert significance[25, 12] == pytest.approx(expected, rel=1e-6)
    assert significance.max() == pytest.approx(expected, rel=0.02)
