from __future__ import annotations

import numpy as np
import pytest

from warmlens.inference.summary_sets import (
    SETS,
    Summary,
    kinds_of,
    learned_points,
    points,
    side_by_side,
    summary_set,
)
from warmlens.inference.table import Table
from warmlens.sampling import stream

GRIDS = {"correlation": np.linspace(0.0, 2.5, 40), "cumulative": np.linspace(-40.0, -4.0, 20)}


def simulated(n: int = 1500, n_null: int = 3, seed: int = 1, response: bool = True, signal: float = 2.0):
    """Parameters [n, 2] and summaries of which one of the forty numbers of C(dr), and the response, tell of m."""
    rng = np.random.default_rng(seed)
    size = n + 1 + n_null
    theta = np.column_stack([rng.uniform(1.0, 5.0, size), rng.uniform(13.0, 13.5, size)])
    arrays = {
        "correlation": rng.standard_normal((size, 40)),
        "cumulative": rng.standard_normal((size, 20)),
        "counts": rng.standard_normal((size, 3)),
        "chi2": 1e4 + rng.standard_normal(size),
    }
    arrays["correlation"][:, 5] += signal * theta[:, 0]
    if response:
        arrays["mean_z2"] = 3.0 * signal * theta[:, 0] + rng.standard_normal(size)
        arrays["amplitude_correlation"] = rng.standard_normal((size, 4))
    summaries = {name: Summary(rows[:n], rows[n], rows[n + 1 :]) for name, rows in arrays.items()}
    return theta[:n], summaries


def table(theta: np.ndarray, known: dict[str, Summary], kinds: tuple[str, ...]) -> Table:
    chosen = [known[kind] for kind in kinds]
    return Table(
        np.arange(len(theta)),
        *theta.T,
        (1.0, 5.0),
        (13.0, 13.5),
        tuple(summary.samples for summary in chosen),
        tuple(summary.observed for summary in chosen),
        kinds,
    )


def worth(theta: np.ndarray, known: dict[str, Summary], name: str):
    kinds = kinds_of(name, known)
    return summary_set(table(theta, known, kinds), 0.05, 100, 200, lambda key: stream(1, key, 0))


def test_what_the_sets_are_worth_on_one_table() -> None:
    theta, summaries = simulated()
    more, learned = learned_points(theta, summaries, np.random.default_rng(0))
    known = points(summaries, GRIDS, "integral") | more
    worths = {name: worth(theta, known, name) for name in SETS}
    gain = {name: entry.gain.gain_nats for name, entry in worths.items()}
    assert gain["learned_m"] > gain["learned"] > gain["sharper"] > gain["paper"] > gain["cumulative"]
    assert abs(gain["cumulative"]) < 4 * worths["cumulative"].gain.gain_error_nats
    assert gain["learned_m"] > 0.8
    assert worths["sharper"].kinds == ("response", "counts")
    assert learned.r_squared[0] > 0.8


def test_without_the_linear_response_the_sharper_set_is_the_counts() -> None:
    theta, summaries = simulated(n=300, response=False)
    known = points(summaries, GRIDS, "integral")
    assert kinds_of("sharper", known) == ("counts",)
    assert kinds_of("learned", known) == ()
    assert worth(theta, known, "sharper").kinds == ("counts",)


@pytest.mark.parametrize("distance", ["integral", "whitened"])
def test_points_of_observation_and_null_test_are_those_of_samples(distance: str) -> None:
    """A sample as the observation or as a mock has the very point that it has as a sample."""
    _, summaries = simulated(n=200)
    same = {
        name: Summary(summary.samples, summary.samples[4], summary.samples[[9, 4]])
        for name, summary in summaries.items()
    }
    for kind, summary in points(same, GRIDS, distance).items():
        np.testing.assert_allclose(summary.observed, summary.samples[4], rtol=1e-10, atol=1e-10, err_msg=kind)
        np.testing.assert_allclose(summary.null, summary.samples[[9, 4]], rtol=1e-10, atol=1e-10, err_msg=kind)


def test_the_null_test_has_no_say_in_the_points_of_the_observation() -> None:
    _, summaries = simulated(n=200)
    summaries["counts"].samples[:, 0] = summaries["counts"].observed[0] = 0.0
    summaries["counts"].null[:, 0] = 50.0
    without = {
        name: Summary(summary.samples, summary.observed, np.empty((0, *summary.observed.shape)))
        for name, summary in summaries.items()
    }
    for distance in ("integral", "whitened"):
        first, second = points(summaries, GRIDS, distance), points(without, GRIDS, distance)
        for kind in first:
            np.testing.assert_array_equal(first[kind].samples, second[kind].samples)
            np.testing.assert_array_equal(first[kind].observed, second[kind].observed)
            assert second[kind].null.shape == (0, *first[kind].observed.shape)


def test_learned_points_of_a_sample_are_not_of_a_model_that_saw_it() -> None:
    """Without any signal and with many summaries: in-sample predictions would tell the parameters."""
    theta, summaries = simulated(n=150, signal=0.0)
    points_of, learned = learned_points(theta, summaries, np.random.default_rng(0))
    everything = side_by_side(summaries, tuple(summaries)).samples
    design = np.column_stack([np.ones(150), everything])
    in_sample = design @ np.linalg.lstsq(design, theta[:, 0], rcond=None)[0]
    assert np.corrcoef(in_sample, theta[:, 0])[0, 1] > 0.5
    assert np.corrcoef(points_of["learned_m"].samples[:, 0], theta[:, 0])[0, 1] < 0.25
    assert (learned.r_squared < 0.1).all()
    assert points_of["learned_m"].null.shape == (3, 1)
    with pytest.raises(ValueError, match="learned summaries need 50 samples"):
        learned_points(*simulated(n=40), np.random.default_rng(0))
