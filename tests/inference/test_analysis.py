from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from warmlens.inference.analysis import Analysis, analyse
from warmlens.inference.bound import TooFewError
from warmlens.inference.calibration import MIN_ROWS
from warmlens.inference.table import Table
from warmlens.sampling import stream


def table(n=800, seed=1, sigma=0.5):
    rng = np.random.default_rng(seed)
    m, log10_mass = rng.uniform(1.0, 5.0, n), rng.uniform(13.0, 13.5, n)
    first = m[:, None] + sigma * rng.standard_normal((n, 1))
    second = log10_mass[:, None] + 0.1 * rng.standard_normal((n, 1))
    observed = np.array([3.5]), np.array([13.2])
    return Table(np.arange(n), m, log10_mass, (1.0, 5.0), (13.0, 13.5), (first, second), observed)


def run(samples, rule="max_rank", fraction=0.15, n_rows=400, seed=1) -> Analysis:
    return analyse(samples, rule, fraction, 100, n_rows, lambda name: stream(seed, name, 0))


def test_a_good_table_gives_everything_and_the_same_again():
    first, again = run(table(sigma=1.0)), run(table(sigma=1.0))
    assert first.bounds == again.bounds
    assert first.other_priors == again.other_priors
    np.testing.assert_array_equal(first.trials.pit, again.trials.pit)
    assert first.bounds["q0455"].value_kev > 1.5
    assert first.calibration.passed
    assert first.adjusted.valid
    assert first.n_rows == 400
    assert set(first.crossings) == {"1/10", "1/20"}
    sharp = run(table()).crossings
    assert 1.0 < sharp["1/20"].m_kev <= sharp["1/10"].m_kev < 3.5
    assert first.other_priors["uniform_m"].value_kev == first.bounds["q0455"].value_kev
    assert first.other_priors["uniform_inverse_m"].value_kev <= first.bounds["q0455"].value_kev
    assert run(table(sigma=1.0), seed=2).bounds["q0455"].mc_error_kev != first.bounds["q0455"].mc_error_kev


def test_an_adjustment_is_not_valid_on_too_few_rows():
    analysis = run(table(), n_rows=MIN_ROWS - 1)
    assert analysis.adjusted_calibration is not None
    assert not analysis.adjusted.valid
    assert analysis.calibration.passed is None


def test_a_miscalibrated_posterior_says_so():
    """Summaries that are sharp but for a fold: the tolerance smears them, the ranks are not flat."""
    samples = table(sigma=0.0)
    folded = dataclasses.replace(
        samples,
        features=(np.abs(samples.features[0] - 2.0), samples.features[1]),
        observed=(np.array([1.5]), samples.observed[1]),
    )
    analysis = run(folded, fraction=0.3)
    assert not analysis.calibration.exact
    assert analysis.calibration.passed, "a bound that is too weak is no false one"
    text = " ".join(analysis.warnings)
    assert "the truth lies above it too often" in text
    assert "ranks of m_th_kev are not uniform" in text


def test_a_constant_parameter_gives_a_warning():
    samples = table()
    constant = dataclasses.replace(samples, log10_mass=np.full(samples.n, 13.25))
    analysis = run(constant)
    assert "all samples have the halo mass 10^13.25 Msun: nothing is marginalised" in analysis.warnings
    assert isinstance(analysis.other_priors["flat_13_13.5"].value_kev, float)
    outside = dataclasses.replace(constant, log10_mass_range=(12.0, 13.5), log10_mass=np.full(samples.n, 12.5))
    refused = run(outside).other_priors["flat_13_13.5"]
    assert isinstance(refused, str)
    assert "prior flat_13_13.5" in refused or "weights" in refused


def test_a_refusal_carries_the_estimate():
    with pytest.raises(TooFewError, match="marginal_and leaves") as caught:
        run(table(), rule="marginal_and", fraction=0.05)
    assert 1.0 < caught.value.estimate < 5.0
