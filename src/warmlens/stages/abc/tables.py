"""What the stage `abc` reads: the table of samples, and the summaries of samples, observation and null test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from warmlens.artifacts.file import Artifact, ArtifactError, open_artifact
from warmlens.inference.summary_sets import COUNTS, PAPER, RESPONSE, Summary
from warmlens.inference.table import Table
from warmlens.products.samples import OK, null
from warmlens.stages.settings import AbcSettings
from warmlens.stages.summaries import COMBINED
from warmlens.types import BoolArray, FloatArray, IntArray

_SAMPLES = ("sample_id", "m_th_kev", "log10_m_halo_msun", "status")
_GRIDS = {"correlation": "separation", "cumulative": "thresholds", "counts": "count_thresholds"}


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


def usable_table(
    summaries: Sequence[Path], smooth_model: Path, n_samples: int, max_failed_fraction: float
) -> tuple[pd.DataFrame, BoolArray, list[str]]:
    """Table of all samples, which of them did not fail [n], and what to warn of: smooth model, failures.

    Raises
    ------
    ArtifactError
        If samples are missing, or more than `max_failed_fraction` of them failed.
    """
    with open_artifact(smooth_model, "smooth_model") as artifact:
        warnings = list(artifact.metadata["warnings"])
    table = read_table(summaries, n_samples)
    good = (table["status"] == OK).to_numpy()
    n_failed = int((~good).sum())
    if n_failed > max_failed_fraction * len(table):
        first = table[~good].iloc[0]
        raise ArtifactError(
            f"{n_failed} of {len(table)} samples failed, more than abc.max_failed_fraction = "
            f"{max_failed_fraction:g} allows; sample {first['sample_id']}: {first['message']} (the tracebacks are "
            "in the artifacts)"
        )
    if n_failed:
        warnings.append(f"{n_failed} of {len(table)} samples failed and are left out")
    return table, good, warnings


def read_summaries(
    summaries: Sequence[Path], observed: Path, null_summaries: Path | None, good: BoolArray
) -> tuple[dict[str, Summary], dict[str, FloatArray]]:
    """Summaries of all bands together by name, and the grids that they are taken on.

    Parameters
    ----------
    summaries
        Of the chunks of samples, in order.
    observed, null_summaries
        Of the observation, and of the null test if there is one.
    good
        Samples that have summaries [n]; those after the n-th are left out too.
    """
    with open_artifact(observed, "observed_summary") as artifact:
        response = RESPONSE if "amplitude" in artifact.settings["scan"]["statistics"] else ()
        names = (*PAPER, *COUNTS, *response)
        grids = {name: artifact.array(grid) for name, grid in _GRIDS.items()}
        target = _arrays(artifact, names)
    chunks = []
    for path in summaries:
        with open_artifact(path, "summaries") as artifact:
            chunks.append(_arrays(artifact, names))
    nulls = {name: np.empty((0, *values.shape)) for name, values in target.items()}
    if null_summaries is not None:
        with open_artifact(null_summaries, null("summaries")) as artifact:
            done = artifact.array("samples/status") == OK
            nulls = {name: values[done] for name, values in _arrays(artifact, names).items()}
    found = {}
    for name in names:
        rows = np.concatenate([chunk[name] for chunk in chunks])[: len(good)][good]
        found[name] = Summary(rows, target[name], nulls[name])
    return found, grids


def read_null_table(null_summaries: Path) -> tuple[IntArray, int]:
    """Numbers of the null test's mocks that have summaries, and how many failed."""
    with open_artifact(null_summaries, null("summaries")) as artifact:
        done = artifact.array("samples/status") == OK
        return artifact.array("samples/sample_id")[done], int((~done).sum())


def _arrays(artifact: Artifact, names: Sequence[str]) -> dict[str, FloatArray]:
    return {name: artifact.array(f"{COMBINED}/{name}").astype(np.float64) for name in names}


def scalars(summaries: Mapping[str, Summary], grids: Mapping[str, FloatArray]) -> dict[str, Summary]:
    """Single numbers of the summaries that tell at a glance where the observation lies."""
    found = {
        f"positions_below_{threshold:g}": summaries["counts"].each(lambda values, i=i: values[..., i])  # type: ignore[misc]
        for i, threshold in enumerate(grids["counts"])
    }
    found["correlation_at_0"] = summaries["correlation"].each(lambda values: values[..., 0])
    found["chi2"] = summaries["chi2"]
    if "mean_z2" in summaries:
        found["mean_z2"] = summaries["mean_z2"]
    return found


def make_table(settings: AbcSettings, table: pd.DataFrame, points: Mapping[str, Summary]) -> Table:
    """The good samples with some kinds of summaries as points, by name."""
    try:
        return Table(
            table["sample_id"].to_numpy(),
            table["m_th_kev"].to_numpy(),
            table["log10_m_halo_msun"].to_numpy(),
            settings.dark_matter.m_th_kev,
            settings.dark_matter.log10_m_halo_msun,
            tuple(item.samples for item in points.values()),
            tuple(item.observed for item in points.values()),
            tuple(points),
        )
    except ValueError as error:
        raise ArtifactError(f"the table of samples cannot be used: {error}") from error
