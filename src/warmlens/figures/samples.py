"""Samples that figures show, how they are named, and the summaries of all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Artifact, open_artifact
from warmlens.figures.inputs import Inputs, chunk_paths, open_input
from warmlens.products.samples import OK
from warmlens.stages.summaries import COMBINED
from warmlens.types import FloatArray, IntArray

N_SHOWN = 6
MIN_TO_GROUP = 3
SUMMARY_GRIDS = {"correlation": ("separation", "dr_arcsec"), "cumulative": ("thresholds", "delta_r")}
_COLUMNS = ["row", "sample_id", "m_th_kev", "log10_m_halo_msun"]  # as the attributes of `Sample`


@dataclass(frozen=True)
class Sample:
    """One sample of a chunk: its row there, its number and its parameters."""

    row: int
    sample_id: int
    m_th_kev: float
    log10_m_halo_msun: float

    @property
    def label(self) -> str:
        """Its parameters as a title."""
        return rf"{relic_name(self.m_th_kev)}, $10^{{{self.log10_m_halo_msun:.2f}}}$ M$_\odot$"


def relic_name(m_th_kev: float) -> str:
    """Return a thermal relic mass with its unit, or CDM for an infinite one."""
    return f"{m_th_kev:.1f} keV" if np.isfinite(m_th_kev) else "CDM"


def read_samples(artifact: Artifact) -> pd.DataFrame:
    """Return row, number and parameters of the samples of a chunk that have not failed."""
    good = np.flatnonzero(artifact.array("samples/status") == OK)
    return pd.DataFrame({"row": good, **{name: artifact.array(f"samples/{name}")[good] for name in _COLUMNS[1:]}})


def sample_list(table: pd.DataFrame) -> list[Sample]:
    """Return each row of a table of `read_samples`."""
    return [Sample(*values) for values in table[_COLUMNS].itertuples(index=False)]


def warm_to_cold(artifact: Artifact) -> list[Sample]:
    """Return up to six good samples of a chunk across its range of m_TH, warm to cold."""
    table = read_samples(artifact)
    if table.empty:
        raise ArtifactError(f"{artifact.path}: no sample of this chunk is left to show")
    ordered = table.sort_values("m_th_kev", kind="stable")
    places = np.linspace(0, len(ordered) - 1, min(N_SHOWN, len(ordered))).round().astype(int)
    return sample_list(ordered.iloc[places])


def split_by_value(values: FloatArray, n_groups: int) -> list[IntArray]:
    """Return the rows of each group, from the lowest values to the highest; sizes differ by at most one."""
    if not 1 <= n_groups <= values.size:
        raise ValueError(f"n_groups must lie in [1, {values.size}], got {n_groups}")
    return np.array_split(np.argsort(values, kind="stable"), n_groups)


@dataclass(frozen=True)
class Summaries:
    """Summaries of all bands together, by kind: correlation C(dr), and cumulative N(< Delta R)."""

    grids: dict[str, FloatArray]  # separations [arcsec] or values of Delta R [n_grid]
    # Summaries of the samples that have not failed [n, n_grid], and of the observation [n_grid]
    samples: dict[str, FloatArray]
    observed: dict[str, FloatArray]
    parameters: pd.DataFrame  # sample_id, m_th_kev, log10_m_halo_msun of these samples


def read_summaries(inputs: Inputs) -> Summaries:
    """Return the summaries of all samples and of the observation."""
    grids, observed = read_observed_summary(inputs)
    tables, values = [], []
    for path in chunk_paths(inputs, "summaries"):
        with open_artifact(path, "summaries") as artifact:
            table = read_samples(artifact)
            rows = table["row"].to_numpy()
            tables.append(table)
            values.append({kind: artifact.array(f"{COMBINED}/{kind}")[rows] for kind in grids})
    parameters = pd.concat(tables, ignore_index=True)[_COLUMNS[1:]]
    if len(parameters) < MIN_TO_GROUP:
        raise ArtifactError(
            f"{len(parameters)} samples are left, fewer than {MIN_TO_GROUP}: too few to be grouped"
        )
    samples = {kind: np.concatenate([chunk[kind] for chunk in values]) for kind in grids}
    return Summaries(grids, samples, observed, parameters)


def read_observed_summary(inputs: Inputs) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Return the grid of each kind of summary, and the summary of the observation on it, each [n_grid]."""
    with open_input(inputs, "observed_summary") as artifact:
        grids = {kind: artifact.array(dataset) for kind, (dataset, _) in SUMMARY_GRIDS.items()}
        return grids, {kind: artifact.array(f"{COMBINED}/{kind}") for kind in grids}
