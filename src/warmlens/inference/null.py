"""Null test: the bounds that the procedure draws from mocks without substructure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warmlens.inference.acceptance import accept
from warmlens.inference.bootstrap import quantiles_of_counts
from warmlens.inference.bound import HEADLINE_INDEX, LEVEL_VALUES
from warmlens.inference.checks import CloudCheck
from warmlens.inference.table import Table
from warmlens.types import BoolArray, FloatArray


@dataclass(frozen=True)
class NullTest:
    """Each mock without substructure as the observation.

    Attributes
    ----------
    accepted
        [n_mocks, n].
    bounds
        Quantiles of the accepted relic masses per level of `LEVELS` [n_mocks, n_levels] [keV]; NaN where the
        rule accepts nothing.
    nearest_percentile
        Percentage of samples that are closer to their nearest other one than the mock is to its nearest sample
        [n_kinds, n_mocks].
    """

    accepted: BoolArray
    bounds: FloatArray
    nearest_percentile: FloatArray

    @property
    def quantiles_kev(self) -> tuple[float, float, float]:
        """16, 50 and 84% of the headline bounds [keV]."""
        low, median, high = np.nanquantile(self.bounds[:, HEADLINE_INDEX], [0.16, 0.5, 0.84])
        return float(low), float(median), float(high)

    def fraction_reaching(self, bound_kev: float) -> float:
        """Fraction of the mocks whose headline bound is as high as `bound_kev` or higher."""
        return float(np.mean(self.bounds[:, HEADLINE_INDEX] >= bound_kev))


def null_test(
    table: Table,
    mocks: Sequence[FloatArray],
    cloud: CloudCheck,
    rule: str,
    fraction: float,
    rng: np.random.Generator,
) -> NullTest:
    """Apply the acceptance to mocks, points of each kind [n_mocks, n_features], in place of the observation."""
    distances = table.distances_from(mocks)
    n_mocks = distances.shape[1]
    accepted = np.array(
        [accept(distances[:, i], rule, fraction, table.sample_id, rng).accepted for i in range(n_mocks)]
    )
    some = accepted.any(axis=1)
    bounds = np.full((n_mocks, LEVEL_VALUES.size), np.nan)
    if some.any():
        bounds[some] = quantiles_of_counts(table.m_kev, accepted[some], LEVEL_VALUES)
    return NullTest(accepted, bounds, cloud.percentiles(distances.min(axis=2)))
