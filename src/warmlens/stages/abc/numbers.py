"""What the stage `abc` writes: every number of the inference for `abc.json`, and its arrays for the artifact."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from warmlens.artifacts.file import Dataset
from warmlens.inference.acceptance import KINDS
from warmlens.inference.analysis import Adjusted, Analysis, Calibration
from warmlens.inference.bound import HEADLINE, Bound
from warmlens.inference.calibration import CDM_LIKE_KEV, MASS_BINS_KEV, MIN_ROWS, Coverage
from warmlens.inference.checks import Predictive
from warmlens.inference.combine import Forecast
from warmlens.inference.likelihood import BoundaryKernels
from warmlens.inference.summary_sets import Summary
from warmlens.inference.table import Table
from warmlens.inference.verdict import Judgement
from warmlens.types import BoolArray, FloatArray

_COLUMNS = {
    "sample_id": ("", "number of the sample"),
    "m_th_kev": ("keV", "thermal relic mass"),
    "log10_m_halo_msun": ("dex(Msun)", "log10 of M200c of the host halo"),
    "status": ("", "0 done, otherwise failed"),
    "message": ("", "why the sample failed"),
    "distance_correlation": ("arcsec", "integral of the squared difference of C(dr)"),
    "distance_cumulative": ("", "integral of the squared difference of the cumulative distributions"),
    "max_rank": ("", "larger rank of the distances that the rule cut on"),
    "accepted": ("", "1 for accepted samples"),
    "weight": ("", "posterior weight"),
    "adjusted_m_th_kev": ("keV", "relic mass after the regression adjustment"),
    "adjusted_log10_m_halo_msun": ("dex(Msun)", "halo mass after the regression adjustment"),
    "adjusted_weight": ("", "posterior weight of the adjusted sample"),
}


def add_columns(
    table: pd.DataFrame,
    good: BoolArray,
    paper: FloatArray,
    single: Mapping[str, Summary],
    kinds: tuple[str, ...],
    analysis: Analysis,
) -> pd.DataFrame:
    """Return the table of all samples with summaries, distances, acceptance, weights and adjusted parameters.

    Parameters
    ----------
    table, good
        One row per sample, and those that have summaries [n].
    paper
        The paper's distances of these [2, n_good].
    single
        Summaries that are single numbers.
    kinds, analysis
        Kinds of summaries that the acceptance cut on, and the analysis of these.
    """
    table = table.copy()
    for name, values in single.items():
        table.loc[good, name] = values.samples
    for kind, values in zip(KINDS, paper, strict=True):
        table.loc[good, f"distance_{kind}"] = values
    for kind, values in zip(kinds, analysis.distances, strict=True):
        table.loc[good, f"cut_{kind}"] = values
    table.loc[good, "max_rank"] = analysis.acceptance.max_rank
    table["accepted"] = False
    table.loc[good, "accepted"] = analysis.acceptance.accepted
    table["weight"] = table["accepted"].astype(float)
    for name in ("adjusted_m_th_kev", "adjusted_log10_m_halo_msun", "adjusted_weight"):
        table[name] = np.nan
    if analysis.adjusted is not None:
        accepted = table["accepted"].to_numpy()
        table.loc[accepted, "adjusted_m_th_kev"] = analysis.adjusted.values[:, 0]
        table.loc[accepted, "adjusted_log10_m_halo_msun"] = analysis.adjusted.values[:, 1]
        table.loc[accepted, "adjusted_weight"] = analysis.adjusted.weights
    return table


def answer_datasets(
    table: pd.DataFrame,
    single: Sequence[str],
    samples: Table,
    analysis: Analysis,
    predictive: Mapping[str, Predictive],
) -> dict[str, Dataset]:
    """Return all arrays of the artifact; `single` are the columns of the summaries that are single numbers."""
    result = {}
    columns = dict(_COLUMNS)
    columns |= {f"cut_{kind}": ("", f"distance in {kind} that the acceptance used") for kind in samples.kinds}
    columns |= {name: ("", f"{name} of the sample") for name in single}
    for name, (unit, description) in columns.items():
        column = table[name]
        data: Any = column.tolist() if name == "message" else column.to_numpy()
        result[f"table/{name}"] = Dataset(data, unit, ("sample",), description)
    ratio = analysis.likelihood
    result |= {
        "likelihood/m_kev": Dataset(ratio.m_kev, "keV", ("mass",), "grid of the likelihood ratio"),
        "likelihood/ratio": Dataset(ratio.ratio, "", ("mass",), "B(m), 1 at the upper end of the prior"),
        "likelihood/replicates": Dataset(
            ratio.replicates, "", ("replicate", "mass"), "B(m) of the bootstrapped tables"
        ),
        "likelihood/band": Dataset(ratio.band(), "", ("edge", "mass"), "16 and 84% of the bootstrapped B(m)"),
    }
    trials = analysis.trials
    parameters = ("trial", "parameter")
    result |= {
        "trials/sample_id": Dataset(
            samples.sample_id[trials.rows], "", ("trial",), "samples that played the observation"
        ),
        "trials/truth": Dataset(trials.truth, "", parameters, "their m_th_kev and log10_m_halo_msun"),
        "trials/bounds": Dataset(trials.bounds, "keV", ("trial", "level"), "their bounds q05, q0455, q02275"),
        "trials/pit": Dataset(trials.pit, "", parameters, "rank of the truth, uniform in 0..1 if calibrated"),
        "trials/ratio": Dataset(trial_ratios(samples, analysis), "", ("trial", "mass"), "their B(m)"),
    }
    if trials.adjusted_bounds is not None and trials.adjusted_pit is not None:
        result["trials/adjusted_bounds"] = Dataset(
            trials.adjusted_bounds, "keV", ("trial", "level"), "their bounds after the regression adjustment"
        )
        result["trials/adjusted_pit"] = Dataset(trials.adjusted_pit, "", parameters, "ranks after the adjustment")
    for name, ranks in analysis.calibration.ranks.items():
        stack = np.vstack([ranks.grid, ranks.ecdf, ranks.band])
        text = "rows: rank, ECDF, lower and upper edge of its 95% band"
        result[f"ranks/{name}"] = Dataset(stack, "", ("row", "point"), text)
    for kind, values in predictive.items():
        quantiles = Dataset(values.quantiles, "", ("level", "point"), "2.5, 16, 50, 84, 97.5% of the accepted")
        result[f"predictive/{kind}/quantiles"] = quantiles
        result[f"predictive/{kind}/observed"] = Dataset(values.observed, "", ("point",), "of the observation")
    return result


def trial_ratios(samples: Table, analysis: Analysis) -> FloatArray:
    """Return B(m) of every leave-one-out trial, with the bandwidth of the observation [n_trials, n_grid]."""
    ratio = analysis.likelihood
    kernels = BoundaryKernels(ratio.m_kev, samples.m_kev, ratio.bandwidth_kev, samples.m_range_kev)
    return kernels.ratio(analysis.trials.accepted)


def answer_numbers(
    analysis: Analysis,
    predictive: Mapping[str, Predictive],
    forecasts: Sequence[Forecast],
    judgement: Judgement,
) -> dict[str, Any]:
    """Return every headline number with its error and the verdict on it, as plain values; None where unknown."""
    acceptance = analysis.acceptance
    result = {
        **judgement.numbers(),
        "headline": HEADLINE,
        "bounds": {name: dataclasses.asdict(bound) for name, bound in analysis.bounds.items()},
        "warnings": judgement.warnings,
        "acceptance": acceptance.rule,
        "fraction": acceptance.fraction,
        "n_accepted": acceptance.k,
        "n_ties": acceptance.n_tied,
        "implied_quantile": acceptance.implied_quantile,
        "other_rules": {name: _bound_or_text(bound) for name, bound in analysis.other_rules.items()},
        "other_priors": {name: _bound_or_text(bound) for name, bound in analysis.other_priors.items()},
        "likelihood_ratio": {
            "normalised_at_kev": analysis.likelihood.m_kev[-1],
            "bandwidth_kev": analysis.likelihood.bandwidth_kev,
            "falls_to": {name: dataclasses.asdict(value) for name, value in analysis.crossings.items()},
        },
        "regression_adjustment": _adjusted(
            analysis.adjusted, analysis.no_adjustment, analysis.adjusted_calibration
        ),
        "calibration": _calibration(analysis.calibration),
        "expected_limit": None if analysis.expected is None else dataclasses.asdict(analysis.expected),
        "expected_limit_truths_above_kev": CDM_LIKE_KEV,
        "threshold_convergence": {
            "raw": analysis.convergence.raw,
            "adjusted": analysis.convergence.adjusted,
            "steps": [dataclasses.asdict(step) for step in analysis.convergence.steps],
        },
        "nearest_neighbour_percentile": analysis.cloud.percentile,
        "information": dataclasses.asdict(analysis.gain),
        "forecast": [dataclasses.asdict(value) for value in forecasts],
        "posterior_predictive_p": {kind: value.p_value for kind, value in predictive.items()},
    }
    return to_json_types(result)


def _bound_or_text(bound: Bound | str) -> dict[str, Any]:
    return {"value_kev": None, "warnings": [bound]} if isinstance(bound, str) else dataclasses.asdict(bound)


def _adjusted(adjusted: Adjusted | None, reason: str, calibration: Calibration | None) -> dict[str, Any]:
    if adjusted is None:
        return {"valid": False, "reason": reason}
    if adjusted.valid:
        reason = "its own coverage test passed"
    elif calibration is None or calibration.overall[HEADLINE].n < MIN_ROWS:
        reason = f"its coverage was tested on fewer than {MIN_ROWS} rows"
    else:
        reason = "its own coverage test failed: do not quote it"
    return {
        "valid": adjusted.valid,
        "reason": reason,
        "bounds_kev": adjusted.bounds_kev,
        "mc_errors_kev": adjusted.mc_errors_kev,
        "n_components": adjusted.n_components,
        "calibration": None if calibration is None else _calibration(calibration),
    }


def _calibration(calibration: Calibration) -> dict[str, Any]:
    def rates(value: Coverage) -> dict[str, Any]:
        return {"fraction": value.fraction, **dataclasses.asdict(value)}

    return {
        "passed": calibration.passed,
        "coverage": {name: rates(value) for name, value in calibration.overall.items()},
        "coverage_by_true_mass": {name: rates(calibration.by_mass[name]) for name in MASS_BINS_KEV},
        "ranks": {
            name: {"ks_statistic": test.ks_statistic, "ks_p": test.ks_p, "ecdf_inside_band": test.inside_band}
            for name, test in calibration.ranks.items()
        },
    }


def to_json_types(value: Any) -> Any:
    """Return numpy scalars as Python's, NaN and infinities as None, tuples as lists."""
    if isinstance(value, Mapping):
        return {key: to_json_types(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_types(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
