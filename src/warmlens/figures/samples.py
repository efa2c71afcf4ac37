"""Which samples a figure shows, and how it names them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from warmlens.artifacts.file import Artifact, ArtifactError, open_artifact
from warmlens.figures.draw.correlation import group_by_mass
from warmlens.products.samples import OK
from warmlens.types import BoolArray, FloatArray, IntArray

N_SHOWN = 6
MAX_NODES = 8


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
    """Thermal relic mass with its unit; CDM without a finite one."""
    return f"{m_th_kev:.1f} keV" if np.isfinite(m_th_kev) else "CDM"


def read_samples(artifact: Artifact) -> pd.DataFrame:
    """Row, number and parameters of the samples of a chunk that have not failed."""
    good = np.flatnonzero(artifact.array("samples/status") == OK)
    names = ("sample_id", "m_th_kev", "log10_m_halo_msun")
    return pd.DataFrame({"row": good, **{name: artifact.array(f"samples/{name}")[good] for name in names}})


def warm_to_cold(artifact: Artifact) -> list[Sample]:
    """Up to six good samples of a chunk across its range of m_TH, warm to cold."""
    table = read_samples(artifact)
    if table.empty:
        raise ArtifactError(f"{artifact.path}: no sample of this chunk is left to show")
    ordered = table.sort_values("m_th_kev", kind="stable")
    places = np.linspace(0, len(ordered) - 1, min(N_SHOWN, len(ordered))).round().astype(int)
    return [_sample(ordered, place) for place in places]


def heavy_and_light(chunks: Sequence[Path], stage: str) -> list[tuple[Path, Sample]]:
    """A cold sample in a heavy and one in a light halo, each with its chunk.

    Those nearest to the corners (highest m_TH, highest or lowest M_h) of the samples' ranges, each range being
    the unit; of a grid, the first sample at the corner.
    """
    tables = []
    for number, path in enumerate(chunks):
        with open_artifact(path, stage) as artifact:
            tables.append(read_samples(artifact).assign(chunk=number))
    table = pd.concat(tables, ignore_index=True)
    if table.empty:
        raise ArtifactError(f"{chunks[0].parent}: no sample is left to show")
    cold, heavy = (_unit(table[name].to_numpy()) for name in ("m_th_kev", "log10_m_halo_msun"))
    found = []
    for corner in (1.0, 0.0):
        nearest = int(np.argmin(np.hypot(cold - 1.0, heavy - corner)))
        found.append((chunks[table["chunk"].to_numpy()[nearest]], _sample(table, nearest)))
    return found


def _unit(values: FloatArray) -> FloatArray:
    """Values over their range, 0 to 1; CDM counts as the coldest relic there is."""
    finite = values[np.isfinite(values)]
    top = finite.max() if finite.size else 1.0
    low, high = (finite.min(), top) if finite.size else (0.0, 1.0)
    return (np.minimum(values, top) - low) / (high - low if high > low else 1.0)


def _sample(table: pd.DataFrame, place: int) -> Sample:
    row, sample_id = (int(table[name].to_numpy()[place]) for name in ("row", "sample_id"))
    m_th, log10_m_halo = (float(table[name].to_numpy()[place]) for name in ("m_th_kev", "log10_m_halo_msun"))
    return Sample(row, sample_id, m_th, log10_m_halo)


@dataclass(frozen=True)
class Group:
    """Samples of similar value: a node of a grid, or a range of a continuous prior.

    Attributes
    ----------
    low, high
        Smallest and largest value; equal at a node.
    rows
        Which samples [n].
    """

    low: float
    high: float
    rows: IntArray


def group_values(values: FloatArray, n_groups: int) -> list[Group]:
    """Nodes if there are at most `MAX_NODES` different values, else `n_groups` ranges of equal numbers."""
    rounded = np.round(values, 6)
    nodes = np.unique(rounded)
    members: list[BoolArray | IntArray]
    if nodes.size <= MAX_NODES:
        members = [np.flatnonzero(rounded == node) for node in nodes]
    else:
        members = list(group_by_mass(values, n_groups))
    return [Group(float(values[rows].min()), float(values[rows].max()), np.sort(rows)) for rows in members]
