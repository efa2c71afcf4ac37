from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from warmlens.inference.bound import weighted_quantile
from warmlens.inference.priors import HALO_MASS_PRIORS, MASS_PRIORS, reweightings
from warmlens.inference.table import Table


def table(n=20_000, halo=(13.0, 13.5), seed=1):
    rng = np.random.default_rng(seed)
    features = np.zeros((n, 2)), np.zeros((n, 1))
    return Table(
        np.arange(n),
        rng.uniform(1.0, 5.0, n),
        rng.uniform(*halo, n),
        (1.0, 5.0),
        halo,
        features,
        (np.zeros(2), np.zeros(1)),
    )


def test_the_prior_alone_has_the_quantiles_of_each_prior():
    samples, by_prior = table(), reweightings(table())
    p = 0.2
    exact = {
        "uniform_m": 1.0 + 4.0 * p,
        "uniform_log_m": 5.0**p,
        "uniform_inverse_m": 1.0 / (1.0 - p * 0.8),
        "uniform_log_half_mode_mass": 5.0**p,
    }
    assert set(exact) == set(MASS_PRIORS)
    for name, value in exact.items():
        assert weighted_quantile(samples.m_kev, by_prior[name].weights, p) == pytest.approx(value, abs=0.03)


def test_halo_mass_priors_say_what_the_box_cuts_off():
    by_prior = reweightings(table())
    assert by_prior["flat_13_13.5"].warnings == ()
    assert (by_prior["flat_13_13.5"].weights == 1.0).all()
    assert "16% of it lies outside" in by_prior["normal_13.36_0.14"].warnings[0]
    assert "91% of it lies outside" in by_prior["normal_13.9_0.3"].warnings[0]
    wide = reweightings(table(halo=(12.0, 15.0)))
    assert all(wide[name].warnings == () for name in HALO_MASS_PRIORS)
    mean = np.average(table(halo=(12.0, 15.0)).log10_mass, weights=wide["normal_13.36_0.14"].weights)
    assert mean == pytest.approx(13.36, abs=0.01)
    assert "50% of it" in reweightings(table(halo=(13.25, 14.0)))["flat_13_13.5"].warnings[0]


def test_tables_that_cannot_be_used_are_refused():
    good = table(50)
    with pytest.raises(ValueError, match=r"all 50 samples have m_kev = 3\.0"):
        dataclasses.replace(good, m_kev=np.full(50, 3.0))
    with pytest.raises(ValueError, match="leaves the prior"):
        dataclasses.replace(good, log10_mass=good.log10_mass + 1.0)
    with pytest.raises(ValueError, match="not finite"):
        dataclasses.replace(good, features=(np.full((50, 2), np.nan),))
    with pytest.raises(ValueError, match="ascending"):
        dataclasses.replace(good, sample_id=good.sample_id[::-1])
