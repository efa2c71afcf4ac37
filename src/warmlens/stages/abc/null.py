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
from warmlens.stages.abc.numbers import plain
from warmlens.types import IntArray

MAX_REACHING = 0.05  # fraction of mocks without substructure that may give a bound as high


def null_numbers(
    test: NullTest,
    kinds: tuple[str, ...],
    found: Analysis,
    ranks: Mapping[str, Rank],
    predictive: Mapping[str, Predictive],
    n_failed: int,
) -> dict[str, Any]:
    """Bounds of the mocks, beside those of the prior and of cold dark matter, and the observation among the mocks.

    Parameters
    ----------
    test, kinds
        The test, and the kinds of summaries that it cut on.
    found
        The inference on the observation.
    ranks
        Of the observation among the mocks.
    predictive
        The paper's summaries of the mocks against those of the observation.
    n_failed
        Mocks that failed.
    """
    low, median, high = test.quantiles_kev
    return plain(
        {
            "n_mocks": len(test.bounds),
            "n_failed": n_failed,
            "bound_kev": {"low": low, "median": median, "high": high},
            "prior_only_kev": found.bounds[HEADLINE].prior_only_kev,
            "expected_limit_kev": None if found.expected is None else found.expected.quantiles_kev[2],
            "fraction_reaching_bound": test.fraction_reaching(found.bounds[HEADLINE].value_kev),
            "nearest_neighbour_percentile": {
                kind: {"median": np.median(values), "max": values.max()}
                for kind, values in zip(kinds, test.nearest_percentile, strict=True)
            },
            "observation_among_mocks": {name: dataclasses.asdict(rank) for name, rank in ranks.items()},
            "distance_p": {kind: value.p_value for kind, value in predictive.items()},
        }
    )


def null_warnings(test: NullTest, found: Analysis, n_failed: int) -> list[str]:
    """What the null test says against the bound."""
    warnings = []
    reaching = test.fraction_reaching(found.bounds[HEADLINE].value_kev)
    if reaching > MAX_REACHING:
        warnings.append(
            f"null test: {reaching:.0%} of {len(test.bounds)} mocks without substructure give a bound as high"
        )
    if n_failed:
        warnings.append(f"null test: {n_failed} mocks without substructure failed and are left out")
    return warnings


def null_datasets(
    mock_id: IntArray, test: NullTest, single: Mapping[str, Summary], predictive: Mapping[str, Predictive]
) -> dict[str, Dataset]:
    """All arrays of the null test."""
    mock = ("mock",)
    result = {
        "null/sample": Dataset(mock_id, "", mock, "number of the mock without substructure"),
        "null/bounds": Dataset(test.bounds, "keV", ("mock", "level"), "their bounds q05, q0455, q02275"),
        "null/nearest_percentile": Dataset(
            test.nearest_percentile, "", ("kind", "mock"), "how far they lie from the samples [% of samples]"
        ),
    }
    for name, item in single.items():
        result[f"null/{name}"] = Dataset(item.null, "", mock, f"{name} of the mock")
    for kind, values in predictive.items():
        quantiles = Dataset(values.quantiles, "", ("level", "point"), "2.5, 16, 50, 84, 97.5% of the mocks")
        result[f"null/{kind}/quantiles"] = quantiles
    return result
