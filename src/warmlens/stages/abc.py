"""Stage `abc`: distances of all samples to the observation, accepted samples, bound; as HDF5 and CSV."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from warmlens.artifacts import (
    Artifact,
    ArtifactError,
    Dataset,
    Provenance,
    atomic_path,
    open_artifact,
    write_artifact,
)
from warmlens.audit import check_chain
from warmlens.campaign import stream
from warmlens.inference.acceptance import Acceptance, accept_max_rank
from warmlens.inference.bound import HEADLINE, lower_bounds
from warmlens.inference.distance import correlation_distance, cumulative_distance
from warmlens.stages.samples import OK
from warmlens.stages.settings import AbcSettings
from warmlens.stages.summaries import COMBINED
from warmlens.types import BoolArray, FloatArray

log = logging.getLogger(__name__)

_SAMPLES = ("sample_id", "m_th_kev", "log10_m_halo_msun", "status")


def run(
    settings: AbcSettings,
    summaries: Sequence[Path],
    observed_summary: Path,
    smooth_model: Path,
    output: Path,
    table_csv: Path,
) -> None:
    """Write the table, the posterior and the bound."""
    inputs = {"observed_summary": observed_summary, "smooth_model": smooth_model}
    inputs |= {f"summaries/{path.stem}": path for path in summaries}
    provenance = Provenance("abc", settings.as_dict(), inputs, seed_key=f"{settings.seed}/abc")
    for path in inputs.values():
        check_chain(path, settings.upstream)
    with open_artifact(smooth_model, "smooth_model") as artifact:
        warnings = list(artifact.metadata["warnings"])
    table = read_table(summaries, settings.n_samples)
    good = (table["status"] == OK).to_numpy()
    n_failed = int((~good).sum())
    _refuse_failures(table, n_failed, settings.abc.max_failed_fraction)
    if n_failed:
        warnings.append(f"{n_failed} of {len(table)} samples failed and are left out")
    distances = _distances(summaries, observed_summary, good)
    samples = table["sample_id"].to_numpy()[good]
    accepted = accept_max_rank(distances, settings.abc.fraction, samples, stream(settings.seed, "abc/ties", 0))
    bounds = lower_bounds(
        table["m_th_kev"].to_numpy()[good],
        accepted,
        distances,
        samples,
        settings.dark_matter.m_th_kev,
        stream(settings.seed, "abc/bootstrap", 0),
        n_bootstrap=settings.abc.bootstrap,
    )
    warnings += bounds[HEADLINE].warnings
    if accepted.n_tied:
        warnings.append(f"{accepted.n_tied} samples tie at the acceptance threshold; a seeded key decided")
    for warning in warnings:
        log.warning(warning)
    _add_results(table, good, distances, accepted)
    metadata: dict[str, Any] = {
        "n_samples": len(table),
        "n_failed": n_failed,
        "n_accepted": accepted.k,
        "n_ties": accepted.n_tied,
        "implied_quantile": accepted.implied_quantile,
        "acceptance": settings.abc.acceptance,
        "bounds": {name: dataclasses.asdict(bound) for name, bound in bounds.items()},
        "headline": HEADLINE,
        "warnings": warnings,
    }
    write_artifact(output, provenance, _datasets(table), metadata)
    with atomic_path(table_csv) as temporary:
        table.to_csv(temporary, index=False)


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


def _distances(summaries: Sequence[Path], observed: Path, good: BoolArray) -> FloatArray:
    """Distance in C(dr) and in the cumulative distribution of each good sample, [2, n_good]."""
    with open_artifact(observed, "observed_summary") as artifact:
        grids = artifact.array("separation"), artifact.array("thresholds")
        target = _summary_pair(artifact)
    rows: list[tuple[FloatArray, FloatArray]] = []
    for path in summaries:
        with open_artifact(path, "summaries") as artifact:
            rows.append(_summary_pair(artifact))
    correlation, cumulative = (np.concatenate(parts)[: len(good)][good] for parts in zip(*rows, strict=True))
    return np.array(
        [
            correlation_distance(grids[0], correlation, target[0]),
            cumulative_distance(grids[1], cumulative, target[1]),
        ]
    )


def _summary_pair(artifact: Artifact) -> tuple[FloatArray, FloatArray]:
    return artifact.array(f"{COMBINED}/correlation"), artifact.array(f"{COMBINED}/cumulative")


def _add_results(table: pd.DataFrame, good: BoolArray, distances: FloatArray, acceptance: Acceptance) -> None:
    for name, values in zip(("distance_correlation", "distance_cumulative"), distances, strict=True):
        table.loc[good, name] = values
    table["accepted"] = False
    table.loc[good, "accepted"] = acceptance.accepted
    table["weight"] = table["accepted"].astype(float)


def _datasets(table: pd.DataFrame) -> dict[str, Dataset]:
    described = {
        "sample_id": ("", "number of the sample"),
        "m_th_kev": ("keV", "thermal relic mass"),
        "log10_m_halo_msun": ("dex(Msun)", "log10 of M200c of the host halo"),
        "status": ("", "0 done, otherwise failed"),
        "message": ("", "why the sample failed"),
        "distance_correlation": ("arcsec", "integral of the squared difference of C(dr)"),
        "distance_cumulative": ("", "integral of the squared difference of the cumulative distributions"),
        "accepted": ("", "1 for accepted samples"),
        "weight": ("", "posterior weight"),
    }
    datasets = {}
    for name, (unit, description) in described.items():
        column = table[name]
        data: Any = column.tolist() if name == "message" else column.to_numpy()
        datasets[f"table/{name}"] = Dataset(data, unit, ("sample",), description)
    return datasets
