"""What the stages `abc` and `exclusion` share: the samples with their summaries, and the files of the answer."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from warmlens.artifacts.atomic import ArtifactError, atomic_path
from warmlens.artifacts.chain import check_chains
from warmlens.artifacts.code_version import code_commit
from warmlens.artifacts.file import Artifact, Dataset, Header, open_artifact, open_input
from warmlens.inference.memory import peak_mb
from warmlens.inference.summary_sets import COUNTS, PAPER, RESPONSE, Summary
from warmlens.inference.table import Table
from warmlens.inference.verdict import Reason, code_reasons, failure_reasons, misfit_reasons
from warmlens.products.answer import answer_numbers, table_text
from warmlens.products.samples import OK
from warmlens.stage_table import AbcSettings
from warmlens.stages.job import Job
from warmlens.stages.summaries import COMBINED
from warmlens.types import BoolArray, FloatArray, IntArray

log = logging.getLogger(__name__)

_PARAMETERS = ("m_th_kev", "log10_m_halo_msun")
_SAMPLES = ("sample_id", *_PARAMETERS, "status")
_GRIDS = {"correlation": "separation", "cumulative": "thresholds", "counts": "count_thresholds"}


@dataclass(frozen=True)
class Samples:
    """The samples of a campaign and their summaries, all bands together."""

    table: pd.DataFrame  # parameters and fate of all samples, one row each
    good: BoolArray  # rows that did not fail [n]; only these have summaries
    # Summaries of samples, observation and null test by name, and the grids that they are taken on
    summaries: Mapping[str, Summary]
    grids: Mapping[str, FloatArray]
    # Numbers of the null test's mocks that have summaries, and how many failed
    null_id: IntArray
    n_null_failed: int
    reasons: list[Reason]  # for the verdict, from the smooth model, the failed samples and the code

    @property
    def parameters(self) -> FloatArray:
        """Relic mass [keV] and log10 of the halo mass of the good samples [n_good, 2]."""
        return self.table[self.good][list(_PARAMETERS)].to_numpy()

    def points(self, settings: AbcSettings, kinds: Mapping[str, Summary]) -> Table:
        """Return the good samples with some kinds of summaries as points, by name."""
        rows, prior = self.table[self.good], settings.dark_matter
        try:
            return Table(
                rows["sample_id"].to_numpy(),
                rows["m_th_kev"].to_numpy(),
                rows["log10_m_halo_msun"].to_numpy(),
                prior.m_th_kev,
                prior.log10_m_halo_msun,
                tuple(kind.samples for kind in kinds.values()),
                tuple(kind.observed for kind in kinds.values()),
                tuple(kinds),
            )
        except ValueError as error:
            raise ArtifactError(f"the table of samples cannot be used: {error}") from error


def read_samples(job: Job[Any]) -> Samples:
    """Read the samples of a campaign, after checking the chain of all that they come from.

    Raises
    ------
    ArtifactError
        If the chain does not hold, samples are missing, or more failed than `abc.max_failed_fraction` allows.
    """
    settings: AbcSettings = job.settings
    headers = check_chains(job.sources.values(), settings.upstream)
    table = read_table(job.paths("summaries"), settings.n_samples)
    good = (table["status"] == OK).to_numpy()
    with job.open("smooth_model") as smooth_model:
        reasons = misfit_reasons(smooth_model.metadata["problems"], smooth_model.metadata["notes"])
    _check_failures(table, good, settings.abc.max_failed_fraction)
    reasons += failure_reasons({name: table[name].to_numpy() for name in _PARAMETERS}, ~good)
    reasons += _code_reasons(job.stage.name, headers)
    with job.open("observed_summary") as observed:
        response = RESPONSE if "amplitude" in observed.settings["scan"]["statistics"] else ()
        names = (*PAPER, *COUNTS, *response)
        grids = {name: observed.array(grid) for name, grid in _GRIDS.items()}
        target = _arrays(observed, names)
    chunks = []
    for path in job.paths("summaries"):
        with open_input(path, "summaries") as artifact:
            chunks.append(_arrays(artifact, names))
    nulls = {name: np.empty((0, *values.shape)) for name, values in target.items()}
    null_id, n_null_failed = np.empty(0, dtype=np.int64), 0
    if "null_summaries" in job.inputs:
        with job.open("null_summaries") as artifact:
            done = artifact.array("samples/status") == OK
            nulls = {name: values[done] for name, values in _arrays(artifact, names).items()}
            null_id, n_null_failed = artifact.array("samples/sample_id")[done], int((~done).sum())
    summaries = {}
    for name in names:
        rows = np.concatenate([chunk[name] for chunk in chunks])[: len(good)]  # chunks may reach beyond the last
        summaries[name] = Summary(rows[good], target[name], nulls[name])
    n_numbers = sum(values.size for values in target.values())
    expected = peak_mb(len(table), n_numbers, settings.abc.bootstrap, settings.abc.leave_one_out)
    log.info("%d samples with %d numbers each: at most %d MB of memory", len(table), n_numbers, expected)
    return Samples(table, good, summaries, grids, null_id, n_null_failed, reasons)


def read_table(summaries: Sequence[Path], n_samples: int) -> pd.DataFrame:
    """Read parameters and fate of samples 0..n_samples-1, in order.

    Raises
    ------
    ArtifactError
        If a sample is missing or occurs twice.
    """
    frames = []
    for path in summaries:
        with open_input(path, "summaries") as artifact:
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


def _code_reasons(stage: str, headers: Sequence[Header]) -> list[Reason]:
    """Judge the code that made all samples, and that of this stage."""
    codes: dict[str, set[str]] = {}
    for header in headers:
        codes.setdefault(header.stage, set()).add(header.code)
    uncommitted = {header.stage for header in headers if header.git_dirty}
    return code_reasons(codes, uncommitted | ({stage} if code_commit()[1] else set()))


def _check_failures(table: pd.DataFrame, good: BoolArray, max_failed_fraction: float) -> None:
    """Refuse a table of which too many samples failed."""
    n_failed = int((~good).sum())
    if n_failed > max_failed_fraction * len(table):
        first = table[~good].iloc[0]
        raise ArtifactError(
            f"{n_failed} of {len(table)} samples failed, more than abc.max_failed_fraction = "
            f"{max_failed_fraction:g} allows; sample {first['sample_id']}: {first['message']} (the tracebacks are "
            "in the artifacts)"
        )


def _arrays(artifact: Artifact, names: Sequence[str]) -> dict[str, FloatArray]:
    return {name: artifact.array(f"{COMBINED}/{name}").astype(np.float64) for name in names}


def scalars(summaries: Mapping[str, Summary], grids: Mapping[str, FloatArray]) -> dict[str, Summary]:
    """Return single numbers of the summaries, which show at a glance where the observation lies."""
    numbers = {
        f"positions_below_{threshold:g}": summaries["counts"].each(lambda values, i=i: values[..., i])  # type: ignore[misc]
        for i, threshold in enumerate(grids["counts"])
    }
    numbers["correlation_at_0"] = summaries["correlation"].each(lambda values: values[..., 0])
    numbers["chi2"] = summaries["chi2"]
    if "mean_z2" in summaries:
        numbers["mean_z2"] = summaries["mean_z2"]
    return numbers


def write_answer(
    job: Job[Any], datasets: Mapping[str, Dataset], metadata: Mapping[str, Any], columns: Sequence[str]
) -> None:
    """Write the artifact of an answer, and beside it what is made from it: its table as CSV, its numbers as JSON.

    `columns` is the order of the columns of the CSV; that of the keys of the JSON is that of `metadata`.
    """
    job.write(datasets, metadata, seed_key=f"{job.settings.seed}/{job.stage.name}")
    with open_artifact(job.output) as artifact:
        table, numbers = table_text(artifact, columns), answer_numbers(artifact, metadata)
    with atomic_path(job.output.with_suffix(".csv")) as temporary:
        temporary.write_bytes(table)
    with atomic_path(job.output.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(numbers, indent=2, allow_nan=False) + "\n", encoding="utf-8")
