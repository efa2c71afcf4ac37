"""What the stage `abc` writes of the null test."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from warmlens.artifacts.file import Dataset
from warmlens.inference.analysis import Analysis
from warmlens.inference.bound import HEADLINE
from warmlens.inference.checks import Predictive, Rank
from warmlens.inference.null import NullTest
from warmlens.inference.summary_sets import Summary
from warmlens.stages.abc.numbers import to_json_types
from warmlens.types import IntArray


def null_numbers(
    test: NullTest,
    kinds: tuple[str, ...],
    analysis: Analysis,
    ranks: Mapping[str, Rank],
    predictive: Mapping[str, Predictive],
    n_failed: int,
) -> dict[str, Any]:
    """Return the bounds of the mocks with those of prior and cold dark matter, and where the observation lies.

    Parameters
    ----------
    test, kinds
        The test, and the kinds of summaries that it cut on.
    analysis
        The inference on the observation.
    ranks
        Of the observation among the mocks.
    predictive
        The paper's summaries of the mocks against those of the observation.
    n_failed
        Mocks that failed.
    """
    low, median, high = test.quantiles_kev
    return to_json_types(
        {
            "n_mocks": len(test.bounds),
            "n_failed": n_failed,
            "bound_kev": {"low": low, "median": median, "high": high},
            "prior_only_kev": analysis.bounds[HEADLINE].prior_only_kev,
            "expected_limit_kev": None if analysis.expected is None else analysis.expected.quantiles_kev[2],
            "fraction_reaching_bound": test.fraction_reaching(analysis.bounds[HEADLINE].value_kev),
            "nearest_neighbour_percentile": {
                kind: {"median": np.median(values), "max": values.max()}
                for kind, values in zip(kinds, test.nearest_percentile, strict=True)
            },
            "observation_among_mocks": {name: dataclasses.asdict(rank) for name, rank in ranks.items()},
            "distance_p": {kind: value.p_value for kind, value in predictive.items()},
        }
    )


def null_datasets(
    mock_id: IntArray, test: NullTest, single: Mapping[str, Summary], predictive: Mapping[str, Predictive]
) -> dict[str, Dataset]:
    """Return all arrays of the null test."""
    mock = ("mock",)
    result = {
        "null/sample": Dataset(mock_id, "", mock, "number of the mock without substructure"),
        "null/bounds": Dataset(test.bounds, "keV", ("mock", "level"), "their bounds q05, q0455, q02275"),
        "null/nearest_percentile": Dataset(
            test.nearest_percentile, "", ("kind", "mock"), "how far they lie from the samples [% of samples]"
        ),
    }
    for name, values in single.items():
        result[f"null/{name}"] = Dataset(values.null, "", mock, f"{name} of the mock")
    for kind, check in predictive.items():
        quantiles = Dataset(check.quantiles, "", ("level", "point"), "2.5, 16, 50, 84, 97.5% of the mocks")
        result[f"null/{kind}/quantiles"] = quantiles
    return result
