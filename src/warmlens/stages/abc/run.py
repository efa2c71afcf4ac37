"""Stage `abc`: the whole inference on the table of samples; as HDF5, CSV, and numbers in JSON."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from warmlens import __version__
from warmlens.artifacts.chain import check_chains
from warmlens.artifacts.file import ArtifactError, Dataset, Provenance, atomic_path, write_artifact
from warmlens.inference.acceptance import KINDS
from warmlens.inference.analysis import Analysis, analyse
from warmlens.inference.bound import HEADLINE, TooFewError
from warmlens.inference.checks import Rank, posterior_predictive, rank_among
from warmlens.inference.combine import cold_ratios, forecast
from warmlens.inference.distance import correlation_distance, cumulative_distance
from warmlens.inference.null import null_test
from warmlens.inference.summary_sets import LEARNED, SETS, Summary, kinds_of, learned_points, points, summary_set
from warmlens.inference.table import Table
from warmlens.sampling import stream
from warmlens.stages.abc.null import null_datasets, null_numbers, null_warnings
from warmlens.stages.abc.numbers import add_columns, datasets, numbers, plain
from warmlens.stages.abc.tables import (
    make_table,
    read_null_table,
    read_summaries,
    scalars,
    usable_table,
)
from warmlens.stages.settings import AbcSettings
from warmlens.types import FloatArray

log = logging.getLogger(__name__)

SUMMARY_SET_ROWS = 300  # pseudo-observations for the comparison of summary sets
MIN_RANK_P = 0.05


def run(
    settings: AbcSettings,
    summaries: Sequence[Path],
    observed_summary: Path,
    smooth_model: Path,
    output: Path,
    table_csv: Path,
    numbers_json: Path,
    null_summaries: Path | None = None,
) -> None:
    """Write the table, the posterior, and every number that comes of them; with the null test if there is one."""
    inputs = {"observed_summary": observed_summary, "smooth_model": smooth_model}
    if null_summaries is not None:
        inputs["null_summaries"] = null_summaries
    inputs |= {f"summaries/{path.stem}": path for path in summaries}
    provenance = Provenance("abc", settings.as_dict(), inputs, seed_key=f"{settings.seed}/abc")
    check_chains(inputs.values(), settings.upstream)
    table, good, upstream_warnings = usable_table(
        summaries, smooth_model, settings.n_samples, settings.abc.max_failed_fraction
    )
    compared, grids = read_summaries(summaries, observed_summary, null_summaries, good)
    known, learned, missing = _points(settings, table[good], compared, grids)
    samples = _headline_table(settings, table[good], known, missing)
    block = settings.abc
    try:
        found = analyse(
            samples,
            block.acceptance,
            block.fraction,
            block.bootstrap,
            block.leave_one_out,
            lambda name: stream(settings.seed, f"abc/{name}", 0),
        )
    except TooFewError as error:
        raise ArtifactError(str(error)) from error
    rng = stream(settings.seed, "abc/forecast", 0)
    forecasts = forecast(
        found.likelihood.m_kev,
        cold_ratios(samples, found.trials, found.likelihood, rng),
        found.acceptance.k,
        found.bounds[HEADLINE].level,
        rng,
    )
    predictive = {
        kind: posterior_predictive(compared[kind].samples, compared[kind].observed, found.acceptance.accepted)
        for kind in KINDS
    }
    single = scalars(compared, grids)
    ranks = {name: rank_among(item.samples, float(item.observed)) for name, item in single.items()}
    null_found, null_arrays, warnings = _null_test(
        settings, null_summaries, samples, known, compared, single, found
    )
    warnings = [*found.warnings, *_rank_warnings(ranks), *warnings, *upstream_warnings]
    for warning in warnings:
        log.warning(warning)
    add_columns(table, good, _paper_distances(compared, grids), single, samples.kinds, found)
    metadata: dict[str, Any] = {
        "n_samples": len(table),
        "n_failed": int((~good).sum()),
        "summaries": block.summaries,
        "kinds": list(samples.kinds),
        "distance": block.distance,
        "prior": settings.dark_matter.model_dump(mode="json"),
        **numbers(found, predictive, forecasts, warnings),
        "observation_among_samples": {name: dataclasses.asdict(rank) for name, rank in ranks.items()},
        "null_test": null_found,
        "summary_sets": _summary_sets(settings, table[good], known, missing),
        "learned": learned,
    }
    arrays = datasets(table, list(single), samples, found, predictive) | null_arrays
    digest = write_artifact(output, provenance, arrays, metadata)
    with atomic_path(table_csv) as temporary:
        table.to_csv(temporary, index=False)
    with atomic_path(numbers_json) as temporary:
        whole = {"package_version": __version__, "artifact": output.name, "artifact_digest": digest, **metadata}
        temporary.write_text(json.dumps(whole, indent=2, allow_nan=False) + "\n")


def _points(
    settings: AbcSettings, table: pd.DataFrame, compared: Mapping[str, Summary], grids: Mapping[str, FloatArray]
) -> tuple[dict[str, Summary], dict[str, Any], dict[str, str]]:
    """Every kind of summary as points, how well the learned ones predict, and why a kind is missing."""
    known = points(compared, grids, settings.abc.distance)
    missing = {}
    if "response" not in known:
        missing["response"] = "the linear response needs scan.statistics: [delta_r, amplitude]"
    parameters = table[["m_th_kev", "log10_m_halo_msun"]].to_numpy()
    try:
        more, learned = learned_points(parameters, compared, stream(settings.seed, "abc/learned", 0))
    except ValueError as error:  # too few samples to learn from
        return known, {"refused": str(error)}, missing | dict.fromkeys(LEARNED, str(error))
    described = {"r_squared": list(learned.r_squared), "penalty": list(learned.penalty)}
    return known | more, plain(described), missing


def _headline_table(
    settings: AbcSettings, table: pd.DataFrame, known: Mapping[str, Summary], missing: Mapping[str, str]
) -> Table:
    """Samples with the summaries of the headline."""
    name = settings.abc.summaries
    for kind in SETS[name]:
        if kind in missing:
            raise ArtifactError(f"abc.summaries: {name} cannot be used: {missing[kind]}")
    return make_table(settings, table, {kind: known[kind] for kind in SETS[name]})


def _paper_distances(compared: Mapping[str, Summary], grids: Mapping[str, FloatArray]) -> FloatArray:
    """Integrals of the squared difference of samples and observation [2, n]."""
    of_kind = {"correlation": correlation_distance, "cumulative": cumulative_distance}
    return np.array(
        [of_kind[kind](grids[kind], compared[kind].samples, compared[kind].observed) for kind in KINDS]
    )


def _rank_warnings(ranks: Mapping[str, Rank]) -> list[str]:
    """Summaries in which hardly any sample is like the observation."""
    return [
        f"the observation is at the edge of the samples in {name}: {rank.rank:.1%} of them lie below its "
        f"{rank.observed:.4g} (p = {rank.p_value:.2g}); mocks and observation may differ in more than substructure"
        for name, rank in ranks.items()
        if rank.p_value < MIN_RANK_P
    ]


def _null_test(
    settings: AbcSettings,
    path: Path | None,
    samples: Table,
    known: Mapping[str, Summary],
    compared: Mapping[str, Summary],
    single: Mapping[str, Summary],
    found: Analysis,
) -> tuple[dict[str, Any] | None, dict[str, Dataset], list[str]]:
    """Numbers, arrays and warnings of the null test; nothing if there is none."""
    if path is None:
        return None, {}, []
    mock_id, n_failed = read_null_table(path)
    if not mock_id.size:
        return None, {}, [f"null test: all {n_failed} mocks without substructure failed"]
    test = null_test(
        samples,
        [known[kind].null for kind in samples.kinds],
        found.cloud,
        settings.abc.acceptance,
        settings.abc.fraction,
        stream(settings.seed, "abc/null", 0),
    )
    ranks = {name: rank_among(item.null, float(item.observed)) for name, item in single.items()}
    everyone = np.ones(mock_id.size, dtype=bool)
    predictive = {
        kind: posterior_predictive(compared[kind].null, compared[kind].observed, everyone) for kind in KINDS
    }
    described = null_numbers(test, samples.kinds, found, ranks, predictive, n_failed)
    arrays = null_datasets(mock_id, test, single, predictive)
    return described, arrays, null_warnings(test, found, n_failed)


def _summary_sets(
    settings: AbcSettings, table: pd.DataFrame, known: Mapping[str, Summary], missing: Mapping[str, str]
) -> dict[str, Any]:
    """Information and bound of every set of summaries, or why there is none."""
    block = settings.abc
    result: dict[str, Any] = {}
    for name in SETS:
        kinds = kinds_of(name, known)
        if not kinds:
            result[name] = {"refused": missing[SETS[name][0]]}
            continue
        worth = summary_set(
            make_table(settings, table, {kind: known[kind] for kind in kinds}),
            block.fraction,
            block.bootstrap,
            min(block.leave_one_out, SUMMARY_SET_ROWS),
            lambda name: stream(settings.seed, f"abc/sets/{name}", 0),
        )
        result[name] = plain(dataclasses.asdict(worth))
    return result
