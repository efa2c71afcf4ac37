"""Stage `abc`: the whole inference on the table of samples; as HDF5, CSV, and numbers in JSON."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from warmlens import __version__
from warmlens.artifacts import (
    Artifact,
    ArtifactError,
    Provenance,
    atomic_path,
    open_artifact,
    write_artifact,
)
from warmlens.audit import check_chain
from warmlens.campaign import stream
from warmlens.inference.acceptance import KINDS
from warmlens.inference.analysis import analyse
from warmlens.inference.bound import HEADLINE, TooFewError
from warmlens.inference.checks import posterior_predictive
from warmlens.inference.combine import cold_ratios, forecast
from warmlens.inference.distance import (
    correlation_distance,
    cumulative_distance,
    integral_features,
    whitened_features,
)
from warmlens.inference.summary_sets import summary_sets
from warmlens.inference.table import Table
from warmlens.stages.abc_numbers import add_columns, datasets, numbers, plain
from warmlens.stages.samples import OK
from warmlens.stages.settings import AbcSettings
from warmlens.stages.summaries import COMBINED
from warmlens.types import BoolArray, FloatArray

log = logging.getLogger(__name__)

SHARPER = ("n_below", "chi2", "mean_z2", "amplitude_correlation")  # the last two with the statistic `amplitude`
_SAMPLES = ("sample_id", "m_th_kev", "log10_m_halo_msun", "status")
SUMMARY_SET_ROWS = 300  # pseudo-observations for the comparison of summary sets


def run(
    settings: AbcSettings,
    summaries: Sequence[Path],
    observed_summary: Path,
    smooth_model: Path,
    output: Path,
    table_csv: Path,
    numbers_json: Path,
) -> None:
    """Write the table, the posterior, and every number that comes of them."""
    inputs = {"observed_summary": observed_summary, "smooth_model": smooth_model}
    inputs |= {f"summaries/{path.stem}": path for path in summaries}
    provenance = Provenance("abc", settings.as_dict(), inputs, seed_key=f"{settings.seed}/abc")
    for path in inputs.values():
        check_chain(path, settings.upstream)
    with open_artifact(smooth_model, "smooth_model") as artifact:
        upstream_warnings = list(artifact.metadata["warnings"])
    table = read_table(summaries, settings.n_samples)
    good = (table["status"] == OK).to_numpy()
    n_failed = int((~good).sum())
    _refuse_failures(table, n_failed, settings.abc.max_failed_fraction)
    if n_failed:
        upstream_warnings.append(f"{n_failed} of {len(table)} samples failed and are left out")
    grids, values, observed = _read_summaries(summaries, observed_summary, good)
    samples = _samples(settings, table[good], grids, values, observed)
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
        kind: posterior_predictive(rows, row, found.acceptance.accepted)
        for kind, rows, row in zip(KINDS, values, observed, strict=True)
    }
    warnings = [*found.warnings, *upstream_warnings]
    for warning in warnings:
        log.warning(warning)
    paper = np.array(
        [
            correlation_distance(grids[0], values[0], observed[0]),
            cumulative_distance(grids[1], values[1], observed[1]),
        ]
    )
    add_columns(table, good, paper, found)
    metadata: dict[str, Any] = {
        "n_samples": len(table),
        "n_failed": n_failed,
        "distance": block.distance,
        "prior": settings.dark_matter.model_dump(mode="json"),
        **numbers(found, predictive, forecasts, warnings),
        "summary_sets": _summary_sets(settings, samples, *_read_sharper(summaries, observed_summary, good)),
    }
    digest = write_artifact(output, provenance, datasets(table, samples, found, predictive), metadata)
    with atomic_path(table_csv) as temporary:
        table.to_csv(temporary, index=False)
    with atomic_path(numbers_json) as temporary:
        whole = {"package_version": __version__, "artifact": output.name, "artifact_digest": digest, **metadata}
        temporary.write_text(json.dumps(whole, indent=2, allow_nan=False) + "\n")


def _summary_sets(
    settings: AbcSettings, samples: Table, sharper: FloatArray, sharper_observed: FloatArray
) -> dict[str, Any]:
    """Information and bound of every set of summaries, or why there is none."""
    block = settings.abc
    try:
        found = summary_sets(
            samples,
            block.fraction,
            block.bootstrap,
            min(block.leave_one_out, SUMMARY_SET_ROWS),
            lambda name: stream(settings.seed, f"abc/sets/{name}", 0),
            sharper,
            sharper_observed,
        )
    except ValueError as error:  # too few samples for learned summaries
        return {"refused": str(error)}
    return {name: plain(dataclasses.asdict(entry)) for name, entry in found.items()}


def read_table(summaries: Sequence[Path], n_samples: int) -> pd.DataFrame:
    """Parameters and fate of samples 0..n_samples-1, in order.

    Raises
    ------
    ArtifactError
        If a sample is missing or occurs twice.
    """
    frames = []
    for path in summaries:
        with open_artifact(path, "summaries") as artifact:
            frame = pd.DataFrame({name: artifact.array(f"samples/{name}") for name in _SAMPLES})
            frame["message"] = artifact.strings("samples/message")
        frames.append(frame)
    table = pd.concat(frames, ignore_index=True)
    table = table[table["sample_id"] < n_samples].reset_index(drop=True)
    if not np.array_equal(table["sample_id"], np.arange(n_samples)):
        missing = sorted(set(range(n_samples)) - set(table["sample_id"]))
        raise ArtifactError(
            f"the summaries do not hold samples 0..{n_samples - 1} once each, in order; missing: {missing[:5]}. "
            "Run the campaign, which makes what is missing"
        )
    return table


def _refuse_failures(table: pd.DataFrame, n_failed: int, limit: float) -> None:
    if n_failed > limit * len(table):
        first = table[table["status"] != OK].iloc[0]
        raise ArtifactError(
            f"{n_failed} of {len(table)} samples failed, more than abc.max_failed_fraction = {limit:g} allows; "
            f"sample {first['sample_id']}: {first['message']} (the tracebacks are in the artifacts)"
        )


def _read_summaries(
    summaries: Sequence[Path], observed: Path, good: BoolArray
) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...], tuple[FloatArray, ...]]:
    """Grids, summaries of the good samples [n_good, n_grid] and of the observation [n_grid], one a kind."""
    with open_artifact(observed, "observed_summary") as artifact:
        grids = artifact.array("separation"), artifact.array("thresholds")
        target = _summary_pair(artifact)
    rows: list[tuple[FloatArray, ...]] = []
    for path in summaries:
        with open_artifact(path, "summaries") as artifact:
            rows.append(_summary_pair(artifact))
    values = tuple(np.concatenate(parts)[: len(good)][good] for parts in zip(*rows, strict=True))
    return grids, values, target


def _read_sharper(summaries: Sequence[Path], observed: Path, good: BoolArray) -> tuple[FloatArray, FloatArray]:
    """What the paper does not use, for the learned summaries: of good samples [n_good, k] and observation [k]."""
    with open_artifact(observed, "observed_summary") as artifact:
        kinds = SHARPER if "amplitude" in artifact.settings["scan"]["statistics"] else SHARPER[:2]
        names = [f"{COMBINED}/{kind}" for kind in kinds]
        target = np.concatenate([np.atleast_1d(artifact.array(name)) for name in names])
    rows = []
    for path in summaries:
        with open_artifact(path, "summaries") as artifact:
            arrays = [artifact.array(name) for name in names]
        rows.append(np.hstack([array.reshape(len(array), -1) for array in arrays]))
    return np.concatenate(rows)[: len(good)][good], target


def _summary_pair(artifact: Artifact) -> tuple[FloatArray, ...]:
    return tuple(artifact.array(f"{COMBINED}/{kind}") for kind in KINDS)


def _samples(
    settings: AbcSettings,
    table: pd.DataFrame,
    grids: tuple[FloatArray, ...],
    values: tuple[FloatArray, ...],
    observed: tuple[FloatArray, ...],
) -> Table:
    """The good samples as points whose squared distance is the one that the settings ask for."""
    pairs = []
    for grid, rows, row in zip(grids, values, observed, strict=True):
        if settings.abc.distance == "whitened":
            pairs.append(whitened_features(rows, row))
        else:
            pairs.append((integral_features(grid, rows), integral_features(grid, row)))
    try:
        return Table(
            table["sample_id"].to_numpy(),
            table["m_th_kev"].to_numpy(),
            table["log10_m_halo_msun"].to_numpy(),
            settings.dark_matter.m_th_kev,
            settings.dark_matter.log10_m_halo_msun,
            tuple(rows for rows, _ in pairs),
            tuple(row for _, row in pairs),
        )
    except ValueError as error:
        raise ArtifactError(f"the table of samples cannot be used: {error}") from error
