"""The table of samples: their parameters, and their summaries as points in a Euclidean space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warmlens.inference.acceptance import KINDS
from warmlens.inference.distance import squared_distances
from warmlens.types import FloatArray, IntArray

Range = tuple[float, float]


@dataclass(frozen=True)
class Table:
    """n samples from a uniform prior, their summaries, and those of the observation.

    Attributes
    ----------
    sample_id
        Identity of each row [n], ascending and all different.
    m_kev, log10_mass
        Thermal relic mass [keV] and log10 of the halo mass [Msun], each [n].
    m_range_kev, log10_mass_range
        Edges of the uniform prior.
    features
        Points of each kind of summary [n, n_features], whose squared Euclidean distance is the distance D of
        that kind (`distance.integral_features`).
    observed
        Point of the observation for each kind [n_features].
    kinds
        Names of the kinds; the paper's by default.
    """

    sample_id: IntArray
    m_kev: FloatArray
    log10_mass: FloatArray
    m_range_kev: Range
    log10_mass_range: Range
    features: tuple[FloatArray, ...]
    observed: tuple[FloatArray, ...]
    kinds: tuple[str, ...] = KINDS

    def __post_init__(self) -> None:
        n = self.sample_id.size
        if not (np.diff(self.sample_id) > 0).all():
            raise ValueError("sample_id must be ascending without repeats")
        for name, values, (low, high) in (
            ("m_kev", self.m_kev, self.m_range_kev),
            ("log10_mass", self.log10_mass, self.log10_mass_range),
        ):
            if values.shape != (n,):
                raise ValueError(f"{name} has shape {values.shape}, expected ({n},)")
            if not (low < high and values.min() >= low and values.max() <= high):
                raise ValueError(
                    f"{name} from {values.min()} to {values.max()} leaves the prior [{low}, {high}] or is NaN"
                )
        if np.ptp(self.m_kev) == 0.0:
            raise ValueError(
                f"all {n} samples have m_kev = {self.m_kev[0]}: no bound can be drawn from them; "
                "widen dark_matter.m_th_kev"
            )
        for kind, rows, row in zip(self.kinds, self.features, self.observed, strict=True):
            if rows.ndim != 2 or rows.shape[0] != n or rows.shape[1:] != row.shape:
                raise ValueError(f"features of kind {kind} have shapes {rows.shape} and {row.shape}, n = {n}")
            if not (np.isfinite(rows).all() and np.isfinite(row).all()):
                raise ValueError(f"features of kind {kind} are not finite; leave failed samples out of the table")

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.sample_id.size

    @property
    def parameters(self) -> FloatArray:
        """m_kev and log10_mass of every sample [n, 2]."""
        return np.column_stack([self.m_kev, self.log10_mass])

    @property
    def ranges(self) -> tuple[Range, Range]:
        """Edges of the prior of the columns of `parameters`."""
        return self.m_range_kev, self.log10_mass_range

    def distances(self) -> FloatArray:
        """Return the distance of every sample to the observation [n_kinds, n]."""
        return self.distances_from([row[None] for row in self.observed])[:, 0]

    def distances_between(self, rows: IntArray) -> FloatArray:
        """Return the distance of every sample to the samples in `rows` [n_kinds, n_rows, n]."""
        return self.distances_from([features[rows] for features in self.features])

    def distances_from(self, points: Sequence[FloatArray]) -> FloatArray:
        """Return distances [n_kinds, n_points, n] of all samples to points of each kind [n_points, n_features]."""
        pairs = zip(points, self.features, strict=True)
        return np.array([squared_distances(of_kind, features) for of_kind, features in pairs])

    def stacked(self) -> FloatArray:
        """Return all features side by side [n, sum of n_features]."""
        return np.concatenate(self.features, axis=1)
