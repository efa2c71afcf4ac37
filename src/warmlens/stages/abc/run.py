"""Stage `abc`: the whole inference on the table of samples; as HDF5, CSV, and numbers in JSON."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Dataset
from warmlens.inference.acceptance import KINDS
from warmlens.inference.analysis import Analysis, analyse
from warmlens.inference.bound import HEADLINE, TooFewError
from warmlens.inference.checks import Predictive, Rank, posterior_predictive, rank_among
from warmlens.inference.combine import Forecast, cold_ratios, forecast
from warmlens.inference.distance import correlation_distance, cumulative_distance
from warmlens.inference.null import NullTest, null_test
from warmlens.inference.summary_sets import LEARNED, SETS, Summary, kinds_of, learned_points, points, summary_set
from warmlens.inference.table import Table
from warmlens.inference.verdict import MEASURED, Reason, judge_bound
from warmlens.sampling import stream
from warmlens.stage_table import AbcSettings
from warmlens.stages.abc.null import null_datasets, null_numbers
from warmlens.stages.abc.numbers import add_columns, answer_datasets, answer_numbers, to_json_types
from warmlens.stages.abc.tables import Samples, read_samples, scalars, write_answer
from warmlens.stages.job import Job
from warmlens.types import FloatArray

log = logging.getLogger(__name__)

SUMMARY_SET_ROWS = 300  # pseudo-observations for the comparison of summary sets
MIN_RANK_P = 0.05


def run(job: Job[AbcSettings]) -> None:
    """Write the table, the posterior, and every number that comes of them; with the null test if there is one."""
    settings, block = job.settings, job.settings.abc
    samples = read_samples(job)
    kinds, learned, missing = _points(settings, samples)
    table = _headline_table(settings, samples, kinds, missing)
    analysis = _analyse(settings, table)
    predictive = _predictive(samples, analysis, null=False)
    single = scalars(samples.summaries, samples.grids)
    ranks = {name: rank_among(values.samples, float(values.observed)) for name, values in single.items()}
    null, of_null, null_arrays = _null_test(settings, samples, table, kinds, single, analysis)
    judgement = judge_bound(
        table, analysis, null, [*samples.reasons, *_rank_warnings(ranks), *_null_failures(samples)]
    )
    log.warning("the bound is %s: %s", judgement.verdict, "; ".join(judgement.because))
    for warning in judgement.warnings:
        log.warning(warning)
    rows = add_columns(samples.table, samples.good, _paper_distances(samples), single, table.kinds, analysis)
    metadata: dict[str, Any] = {
        "n_samples": len(rows),
        "n_failed": int((~samples.good).sum()),
        "summaries": block.summaries,
        "kinds": list(table.kinds),
        "distance": block.distance,
        "prior": settings.dark_matter.model_dump(mode="json"),
        **answer_numbers(analysis, predictive, _forecast(settings, table, analysis), judgement),
        "observation_among_samples": {name: dataclasses.asdict(rank) for name, rank in ranks.items()},
        "null_test": of_null,
        "summary_sets": _summary_sets(settings, samples, kinds, missing),
        "learned": learned,
    }
    datasets = answer_datasets(rows, list(single), table, analysis, predictive) | null_arrays
    write_answer(job, datasets, metadata, list(map(str, rows)))


def _points(settings: AbcSettings, samples: Samples) -> tuple[dict[str, Summary], dict[str, Any], dict[str, str]]:
    """Return every kind of summary as points, how well the learned ones predict, and why a kind is missing."""
    kinds = points(samples.summaries, samples.grids, settings.abc.distance)
    missing = {}
    if "response" not in kinds:
        missing["response"] = "the linear response needs scan.statistics: [delta_r, amplitude]"
    rng = stream(settings.seed, "abc/learned", 0)
    try:
        more, learned = learned_points(samples.parameters, samples.summaries, rng)
    except ValueError as error:  # too few samples to learn from
        return kinds, {"refused": str(error)}, missing | dict.fromkeys(LEARNED, str(error))
    described = {"r_squared": list(learned.r_squared), "penalty": list(learned.penalty)}
    return kinds | more, to_json_types(described), missing


def _headline_table(
    settings: AbcSettings, samples: Samples, kinds: Mapping[str, Summary], missing: Mapping[str, str]
) -> Table:
    """Return the samples with the summaries of the headline."""
    name = settings.abc.summaries
    for kind in SETS[name]:
        if kind in missing:
            raise ArtifactError(f"abc.summaries: {name} cannot be used: {missing[kind]}")
    return samples.points(settings, {kind: kinds[kind] for kind in SETS[name]})


def _analyse(settings: AbcSettings, table: Table) -> Analysis:
    block = settings.abc
    rng = _streams(settings.seed, "abc")
    try:
        return analyse(table, block.acceptance, block.fraction, block.bootstrap, block.leave_one_out, rng)
    except TooFewError as error:
        raise ArtifactError(str(error)) from error


def _streams(seed: int, prefix: str) -> Callable[[str], np.random.Generator]:
    """Return a function that gives the random numbers of a name."""
    return lambda name: stream(seed, f"{prefix}/{name}", 0)


def _forecast(settings: AbcSettings, table: Table, analysis: Analysis) -> tuple[Forecast, ...]:
    rng = stream(settings.seed, "abc/forecast", 0)
    ratios = cold_ratios(table, analysis.trials, analysis.likelihood, rng)
    level = analysis.bounds[HEADLINE].level
    return forecast(analysis.likelihood.m_kev, ratios, analysis.acceptance.k, level, rng)


def _predictive(samples: Samples, analysis: Analysis, null: bool) -> dict[str, Predictive]:
    """Compare the paper's summaries of the accepted samples, or of all null mocks, with the observed ones."""
    everyone = np.ones(samples.null_id.size, dtype=bool)
    return {
        kind: posterior_predictive(
            samples.summaries[kind].null if null else samples.summaries[kind].samples,
            samples.summaries[kind].observed,
            everyone if null else analysis.acceptance.accepted,
        )
        for kind in KINDS
    }


def _paper_distances(samples: Samples) -> FloatArray:
    """Return the integrals of the squared difference of samples and observation [2, n_good]."""
    distance = {"correlation": correlation_distance, "cumulative": cumulative_distance}
    of_kind = samples.summaries
    return np.array(
        [distance[kind](samples.grids[kind], of_kind[kind].samples, of_kind[kind].observed) for kind in KINDS]
    )


def _rank_warnings(ranks: Mapping[str, Rank]) -> list[Reason]:
    """Return the summaries in which hardly any sample is like the observation."""
    return [
        Reason(
            MEASURED,
            f"the observation is at the edge of the samples in {name}: {rank.rank:.1%} of them lie below its "
            f"{rank.observed:.4g} (p = {rank.p_value:.2g}); mocks and observation may differ in more than "
            "substructure",
        )
        for name, rank in ranks.items()
        if rank.p_value < MIN_RANK_P
    ]


def _null_test(
    settings: AbcSettings,
    samples: Samples,
    table: Table,
    kinds: Mapping[str, Summary],
    single: Mapping[str, Summary],
    analysis: Analysis,
) -> tuple[NullTest | None, dict[str, Any] | None, dict[str, Dataset]]:
    """Return the null test with its numbers and arrays; nothing if there is none."""
    if not samples.null_id.size:
        return None, None, {}
    block = settings.abc
    rng = stream(settings.seed, "abc/null", 0)
    nulls = [kinds[kind].null for kind in table.kinds]
    test = null_test(table, nulls, analysis.cloud, block.acceptance, block.fraction, rng)
    ranks = {name: rank_among(values.null, float(values.observed)) for name, values in single.items()}
    predictive = _predictive(samples, analysis, null=True)
    described = null_numbers(test, table.kinds, analysis, ranks, predictive, samples.n_null_failed)
    arrays = null_datasets(samples.null_id, test, single, predictive)
    return test, described, arrays


def _null_failures(samples: Samples) -> list[Reason]:
    n_failed, n = samples.n_null_failed, samples.n_null_failed + samples.null_id.size
    text = f"null test: {n_failed} of {n} mocks without substructure failed and are left out"
    return [Reason(MEASURED, text)] if n_failed else []


def _summary_sets(
    settings: AbcSettings, samples: Samples, kinds: Mapping[str, Summary], missing: Mapping[str, str]
) -> dict[str, Any]:
    """Return information and bound of every set of summaries, or why there is none."""
    block = settings.abc
    n_rows = min(block.leave_one_out, SUMMARY_SET_ROWS)
    result: dict[str, Any] = {}
    for name in SETS:
        chosen = kinds_of(name, kinds)
        if not chosen:
            result[name] = {"refused": missing[SETS[name][0]]}
            continue
        table = samples.points(settings, {kind: kinds[kind] for kind in chosen})
        rng = _streams(settings.seed, "abc/sets")
        result[name] = to_json_types(
            dataclasses.asdict(summary_set(table, block.fraction, block.bootstrap, n_rows, rng))
        )
    return result
