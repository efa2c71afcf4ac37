"""Free parameters: from vector to model, names, limits, priors and refusals."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest

from warmlens.fitting.parameters import (
    Macro,
    Parameter,
    ParameterSpace,
    beta_parameter,
    free_parameters,
    quasar_parameters,
    shapelet_parameters,
)

LENS = (
    {"theta_E": 1.0, "gamma": 2.0, "center_x": 0.0},
    {"theta_E": 0.1, "center_x": 0.3, "center_y": 0.7},
    {"beta": 1.0, "coeffs": [0.0, 0.01, 0.02]},
)
LIGHT = ({"R_sersic": 0.4, "center_x": 0.0}, {"R_sersic": 0.1, "center_x": 9.0, "center_y": 9.0})
QUASARS = np.array([[1.0, 0.5], [-0.8, 0.2]])


@pytest.fixture
def space() -> ParameterSpace:
    parameters = [
        *free_parameters("lens", LENS, [{"theta_E": (0.5, 1.5, 0.1)}, {"center_x": (-1.0, 1.0, None)}, {}]),
        *shapelet_parameters(2, LENS[2]["coeffs"], 0.05),  # type: ignore[arg-type]
        *free_parameters("light", LIGHT, [{"R_sersic": (0.1, 2.0, None)}, {}]),
        *quasar_parameters(QUASARS, 0.005),
        beta_parameter(0.2, (0.1, 0.4, None)),
    ]
    return ParameterSpace(Macro(LENS, LIGHT, QUASARS.copy(), 0.2), tuple(parameters), ((1, 1),))


NAMES = (
    "lens_0.theta_E", "lens_1.center_x", "lens_2.coeffs_0", "lens_2.coeffs_1", "lens_2.coeffs_2",
    "light_0.R_sersic", "quasar_0.x", "quasar_0.y", "quasar_1.x", "quasar_1.y",
    "source_0.beta",
)  # fmt: skip


def test_names_and_start(space: ParameterSpace) -> None:
    assert space.names == NAMES
    np.testing.assert_array_equal(space.start, [1.0, 0.3, 0.0, 0.01, 0.02, 0.4, 1.0, 0.5, -0.8, 0.2, 0.2])
    assert [space.names.index(name) for name in NAMES] == list(range(11))


def test_every_value_reaches_its_place_and_no_other(space: ParameterSpace) -> None:
    vector = np.arange(1.0, 12.0)
    macro = space.macro(vector)
    assert macro.kwargs_lens[0] == {"theta_E": 1.0, "gamma": 2.0, "center_x": 0.0}
    assert macro.kwargs_lens[1] == {"theta_E": 0.1, "center_x": 2.0, "center_y": 0.7}
    assert macro.kwargs_lens[2] == {"beta": 1.0, "coeffs": [3.0, 4.0, 5.0]}
    assert macro.kwargs_light[0] == {"R_sersic": 6.0, "center_x": 0.0}
    np.testing.assert_array_equal(macro.quasars, [[7.0, 8.0], [9.0, 10.0]])
    assert macro.beta == 11.0


def test_satellite_s_light_follows_its_lens(space: ParameterSpace) -> None:
    """The free centre and the one that is not free; without the pair the light stays where it was."""
    vector = space.start
    vector[space.names.index("lens_1.center_x")] = -0.25
    assert space.macro(vector).kwargs_light[1] == {"R_sersic": 0.1, "center_x": -0.25, "center_y": 0.7}
    alone = ParameterSpace(space.base, space.parameters)
    assert alone.macro(vector).kwargs_light[1] == LIGHT[1]


def test_base_is_not_changed(space: ParameterSpace) -> None:
    before = copy.deepcopy((space.base.kwargs_lens, space.base.kwargs_light)), space.base.quasars.copy()
    macro = space.macro(space.start + 0.1)
    macro.kwargs_lens[2]["coeffs"][0] = 99.0
    assert (space.base.kwargs_lens, space.base.kwargs_light) == before[0]
    np.testing.assert_array_equal(space.base.quasars, before[1])
    assert space.base.beta == 0.2


def test_vector_of_the_wrong_length(space: ParameterSpace) -> None:
    with pytest.raises(ValueError, match="zip"):
        space.macro(space.start[:-1])


def test_limits_and_priors(space: ParameterSpace) -> None:
    lower, upper = space.limits
    np.testing.assert_allclose(lower, [0.5, -1.0, -1.0, -0.99, -0.98, 0.1, 0.95, 0.45, -0.85, 0.15, 0.1])
    np.testing.assert_allclose(upper, [1.5, 1.0, 1.0, 1.01, 1.02, 2.0, 1.05, 0.55, -0.75, 0.25, 0.4])
    inf = math.inf
    np.testing.assert_allclose(space.prior_sigma, [0.1, inf, 0.05, 0.05, 0.05, inf, *[0.005] * 4, inf])


def test_at_limit(space: ParameterSpace) -> None:
    """Within 1e-3 of the range: 0.001 of theta_E's [0.5, 1.5], 0.002 of the centre's [-1, 1]."""
    vector = space.start
    assert not space.at_limit(vector).any()
    vector[0] = 1.5 - 0.0009
    vector[1] = -1.0 + 0.0019
    assert [name for name, hit in zip(space.names, space.at_limit(vector), strict=True) if hit] == [*NAMES[:2]]
    vector[0] = 1.5 - 0.0011
    vector[1] = -1.0 + 0.0021
    assert not space.at_limit(vector).any()


def test_step_of_the_differences() -> None:
    assert Parameter("lens", 0, "theta_E", None, 0.01, 0.0, 1.0, 1.0).step == 1e-4
    assert Parameter("lens", 0, "gamma", None, 2.0, 1.0, 3.0, 1.0).step == 2e-4


@pytest.mark.parametrize("start", [0.5, 1.5, 2.0, math.nan])
def test_start_outside_the_limits(start: float) -> None:
    with pytest.raises(ValueError, match=r"lens_0\.theta_E starts at .* inside its limits \(0\.5, 1\.5\)"):
        free_parameters("lens", [{"theta_E": start}], [{"theta_E": (0.5, 1.5, None)}])


@pytest.mark.parametrize("sigma", [0.0, -0.1, math.nan])
def test_impossible_prior(sigma: float) -> None:
    with pytest.raises(ValueError, match=r"prior of light_0\.R_sersic must be wider than 0"):
        Parameter("light", 0, "R_sersic", None, 0.4, 0.1, 2.0, sigma)


@pytest.mark.parametrize(
    ("kind", "models", "free", "message"),
    [
        (
            "lens",
            LENS,
            [{"theta": (0.5, 1.5, None)}, {}, {}],
            r"lens model 0 has no number 'theta'.*theta_E, gamma",
        ),
        ("lens", LENS, [{}, {}, {"coeffs": (-1.0, 1.0, None)}], r"lens model 2 has no number 'coeffs'"),
        ("light", LIGHT, [{}, {"n_sersic": (0.5, 6.0, 0.1)}], r"light model 1 has no number 'n_sersic'"),
    ],
)
def test_unknown_key(kind, models, free, message) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        free_parameters(kind, models, free)
