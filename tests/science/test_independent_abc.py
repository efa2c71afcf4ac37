"""Rejection on one table by pyABC (Schälte et al. 2022, JOSS 7, 4304): the same rows must be accepted.

pyABC plays the table row by row: it calibrates its threshold on all rows, then runs one generation over them.
It is given parameters and summaries alone; distance, threshold, acceptance and weights are its own. The regression
adjustment, which pyABC lacks, is repeated with scikit-learn, which comes with it.
`pip install 'warmlens[independent]'` installs both; these tests are skipped without.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
import pytest

from warmlens.inference.acceptance import accept
from warmlens.inference.adjustment import RIDGE, SAMPLES_PER_COMPONENT, adjust
from warmlens.inference.bound import LEVELS, lower_bounds
from warmlens.inference.distance import integral_features
from warmlens.inference.table import Table

pyabc = pytest.importorskip("pyabc", reason="pyABC is not installed: pip install 'warmlens[independent]'")

N, FRACTION = 1200, 0.1
PRIOR, HALO = (1.0, 5.0), (13.0, 13.5)
GRIDS = {"correlation": np.linspace(0.0, 2.5, 51), "cumulative": np.linspace(-40.0, -4.0, 73)}


@dataclass(frozen=True)
class Simulations:
    """Parameters [N], and the two curves of every row [N, n_grid] and of the observation [n_grid]."""

    m_kev: np.ndarray
    log10_mass: np.ndarray
    curves: dict[str, np.ndarray]
    observed: dict[str, np.ndarray]

    def table(self) -> Table:
        def features(curves: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
            return tuple(integral_features(GRIDS[kind], curves[kind]) for kind in GRIDS)

        of_rows, of_observation = features(self.curves), features(self.observed)
        return Table(np.arange(N), self.m_kev, self.log10_mass, PRIOR, HALO, of_rows, of_observation)


@pytest.fixture(scope="module")
def simulations() -> Simulations:
    """Curves that fall with the separation and rise with the two masses, and scatter; the last is observed."""
    rng = np.random.default_rng(11)
    m, log10_mass = rng.uniform(*PRIOR, N + 1), rng.uniform(*HALO, N + 1)
    m[-1], log10_mass[-1] = 3.6, 13.2
    level = 10.0 ** (log10_mass - 13.0) * (1.0 - 1.0 / m) * rng.lognormal(0.0, 0.2, N + 1)
    dr, threshold = GRIDS.values()
    shapes = {"correlation": 30.0 * np.exp(-dr / 0.3), "cumulative": 0.1 * np.exp((threshold + 4.0) / 8.0)}
    scatter = {"correlation": 2.0, "cumulative": 0.01}
    curves = {
        kind: level[:, None] * shape + scatter[kind] * rng.standard_normal((N + 1, shape.size))
        for kind, shape in shapes.items()
    }
    rows = {kind: values[:-1] for kind, values in curves.items()}
    return Simulations(m[:-1], log10_mass[:-1], rows, {kind: values[-1] for kind, values in curves.items()})


def trapezoid_sum(kind: str) -> Callable[[dict[str, np.ndarray], dict[str, np.ndarray]], float]:
    """Integral of the squared difference as the sum over the intervals of the grid, by hand."""
    step = np.diff(GRIDS[kind])

    def distance(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> float:
        squared = (np.asarray(first[kind]) - np.asarray(second[kind])) ** 2
        return float(np.sum(0.5 * step * (squared[1:] + squared[:-1])))

    return distance


def by_pyabc(simulations: Simulations, distance: Any) -> Any:
    """Accepted particles of pyABC, a data frame of row, m_kev and w."""
    order: Iterator[int] = cycle(range(N))

    class Replay(pyabc.random_variables.DistributionBase):
        """A prior that gives each row of the table in turn."""

        def copy(self) -> Replay:
            return self

        def rvs(self, *args: Any, **kwargs: Any) -> Any:
            row = next(order)
            return pyabc.Parameter(row=float(row), m_kev=simulations.m_kev[row])

        def pdf(self, x: Any) -> float:
            return 1.0

        def get_parameter_names(self) -> list[str]:
            return ["m_kev", "row"]

    def replay(parameter: Any) -> dict[str, np.ndarray]:
        return {kind: values[int(parameter["row"])] for kind, values in simulations.curves.items()}

    run = pyabc.ABCSMC(
        replay,
        Replay(),
        distance,
        pyabc.ConstantPopulationSize(round(FRACTION * N), nr_calibration_particles=N),
        eps=pyabc.QuantileEpsilon(alpha=FRACTION),
        sampler=pyabc.SingleCoreSampler(),
    )
    run.new("sqlite://", simulations.observed)
    history = run.run(max_nr_populations=1)
    frame, weights = history.get_distribution(t=0)
    return frame.assign(w=weights)


def ours(simulations: Simulations, rule: str) -> np.ndarray:
    """Rows that warmlens accepts, ascending."""
    table = simulations.table()
    found = accept(table.distances(), rule, FRACTION, table.sample_id, np.random.default_rng(0))
    return np.flatnonzero(found.accepted)


def rows(particles: Any) -> np.ndarray:
    return np.sort(particles["row"].to_numpy().astype(int))


def both_over_their_deviation() -> Any:
    """Sum of the two distances over their median absolute deviations, all of them pyABC's."""
    return pyabc.AdaptiveAggregatedDistance(
        [trapezoid_sum(kind) for kind in GRIDS],
        adaptive=False,
        scale_function=pyabc.distance.median_absolute_deviation,
    )


RULES: dict[str, Callable[[], Any]] = {
    "correlation": lambda: trapezoid_sum("correlation"),
    "cumulative": lambda: trapezoid_sum("cumulative"),
    "scaled_sum": both_over_their_deviation,
}


@pytest.mark.parametrize("rule", RULES)
def test_the_same_rows_are_accepted(simulations: Simulations, rule: str) -> None:
    expected = ours(simulations, rule)
    np.testing.assert_array_equal(rows(by_pyabc(simulations, RULES[rule]())), expected)
    for other in RULES:  # wrong twins: another distance
        assert other == rule or not np.array_equal(ours(simulations, other), expected)


def test_one_swapped_row_is_seen(simulations: Simulations) -> None:
    particles = rows(by_pyabc(simulations, trapezoid_sum("correlation")))
    swapped = {kind: values.copy() for kind, values in simulations.curves.items()}
    near, far = particles[0], np.setdiff1d(np.arange(N), particles)[0]
    swapped["correlation"][[near, far]] = swapped["correlation"][[far, near]]
    twin = dataclasses.replace(simulations, curves=swapped)
    assert np.setxor1d(ours(twin, "correlation"), particles).tolist() == sorted([near, far])


def test_the_posterior_is_the_same(simulations: Simulations) -> None:
    particles = by_pyabc(simulations, trapezoid_sum("correlation"))
    masses, weights = particles["m_kev"].to_numpy(), particles["w"].to_numpy()
    table = simulations.table()
    distances = table.distances()
    found = accept(distances, "correlation", FRACTION, table.sample_id, np.random.default_rng(0))
    bounds = lower_bounds(table, found, distances, np.random.default_rng(1))
    for name, level in LEVELS.items():
        value = np.quantile(masses, level, method="inverted_cdf", weights=weights)
        assert bounds[name].value_kev == pytest.approx(value, rel=1e-12)
        # pyABC interpolates between the two neighbours, so that it is off by less than one step
        steps = np.searchsorted(np.sort(masses), [bounds[name].value_kev, pyabc_quantile(masses, weights, level)])
        assert abs(steps[0] - steps[1]) <= 1
    assert table.m_kev[found.accepted].mean() == pytest.approx(
        pyabc.weighted_statistics.weighted_mean(masses, weights), rel=1e-12
    )
    # a wrong twin: another distance
    twin = np.quantile(
        table.m_kev[ours(simulations, "cumulative")], 0.5, method="inverted_cdf"
    )  # another distance
    assert abs(np.quantile(masses, 0.5, method="inverted_cdf") - twin) > 1e-3


def pyabc_quantile(values: np.ndarray, weights: np.ndarray, level: float) -> float:
    return float(pyabc.weighted_statistics.weighted_quantile(values, weights, alpha=level))


def test_the_regression_adjustment_is_that_of_scikit_learn(simulations: Simulations) -> None:
    decomposition = pytest.importorskip("sklearn.decomposition")
    linear_model = pytest.importorskip("sklearn.linear_model")
    table = simulations.table()
    distances = table.distances()
    accepted = accept(distances, "correlation", FRACTION, table.sample_id, np.random.default_rng(0)).accepted
    found = adjust(
        table.parameters, table.ranges, table.stacked(), np.concatenate(table.observed), distances[:1], accepted
    )

    near, observed = table.stacked()[accepted], np.concatenate(table.observed)
    scale = 1.4826 * np.median(np.abs(near - np.median(near, axis=0)), axis=0)
    axes = decomposition.PCA(len(near) // SAMPLES_PER_COMPONENT, whiten=True).fit(near / scale)
    x, x_observed = axes.transform(near / scale), axes.transform((observed / scale)[None])
    distance = trapezoid_sum("correlation")
    near_curves = simulations.curves["correlation"][accepted]
    from_observed = np.array([distance({"correlation": curve}, simulations.observed) for curve in near_curves])
    weights = 1.0 - from_observed / from_observed.max()
    low, high = np.array(table.ranges).T
    unit = (table.parameters[accepted] - low) / (high - low)
    y = np.log(unit / (1.0 - unit))
    line = linear_model.Ridge(alpha=RIDGE * weights.sum()).fit(x, y, sample_weight=weights)
    ess = weights.sum() ** 2 / np.sum(weights**2)
    moved = line.predict(x_observed) + np.sqrt(ess / (ess - x.shape[1] - 1.0)) * (y - line.predict(x))
    np.testing.assert_allclose(found.weights, weights, atol=1e-12)
    np.testing.assert_allclose(found.values, low + (high - low) / (1.0 + np.exp(-moved)), rtol=1e-3)
    unmoved = np.abs(found.values[:, 0] - table.m_kev[accepted])  # a wrong twin: no adjustment
    assert np.median(unmoved) > 0.1
