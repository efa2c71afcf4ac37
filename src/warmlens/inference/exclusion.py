"""Exclude halo masses of a grid by the counts of accepted samples on its nodes, with their errors.

A grid is no draw from the prior: a quantile of the accepted samples would follow the spacing of the nodes. The
fraction accepted at each node is the likelihood of the node up to a factor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.inference.bound import HEADLINE, LEVELS, MIN_FOR_BOUND
from warmlens.inference.calibration import CONFIDENCE, clopper_pearson
from warmlens.types import BoolArray, FloatArray, IntArray

LEVEL = LEVELS[HEADLINE]  # a halo mass that is less probable than this is excluded
MAX_RATIO = float(np.exp(-2.0))  # its likelihood over the best one, as 2 sigma of a Gaussian


@dataclass(frozen=True)
class HaloMass:
    """One halo mass of the grid, all relic masses together.

    Attributes
    ----------
    rate, rate_interval
        Fraction accepted, with its Clopper-Pearson interval.
    probability, probability_interval
        Posterior probability under a uniform prior on the nodes.
    cumulative, cumulative_interval
        Posterior probability of this and all lower halo masses of the grid.
    ratio, ratio_interval
        Likelihood over that of the best halo mass; the interval is of the two counts given their sum.
    excluded
        The upper ends of `probability_interval` and of `ratio_interval` are at most `LEVEL` and `MAX_RATIO`.
    """

    log10_m_halo_msun: float
    n_samples: int
    n_accepted: int
    rate: float
    rate_interval: tuple[float, float]
    probability: float
    probability_interval: tuple[float, float]
    prior_probability: float
    cumulative: float
    cumulative_interval: tuple[float, float]
    ratio: float
    ratio_interval: tuple[float, float]
    excluded: bool

    @property
    def excluded_at(self) -> float:
        """Smallest probability of the exclusion, counting errors included."""
        return 1.0 - self.probability_interval[1]


@dataclass(frozen=True)
class Exclusion:
    """Counts at each node [n_halo_masses, n_relic_masses], and the halo masses in ascending order."""

    n_samples: IntArray
    n_accepted: IntArray
    halo_masses: tuple[HaloMass, ...]
    warnings: tuple[str, ...]

    @property
    def excluded_up_to(self) -> HaloMass | None:
        """Highest halo mass that is excluded with all lower ones, each and together; None if there is none."""
        last = None
        for halo_mass in self.halo_masses:
            if not (halo_mass.excluded and halo_mass.cumulative_interval[1] <= LEVEL):
                break
            last = halo_mass
        return last


def exclusion(
    m_kev: FloatArray,
    log10_mass: FloatArray,
    accepted: BoolArray,
    m_nodes_kev: FloatArray,
    log10_mass_nodes: FloatArray,
) -> Exclusion:
    """Count the accepted samples on the nodes of a grid.

    Parameters
    ----------
    m_kev, log10_mass
        Thermal relic mass [keV] and log10 of the halo mass [Msun] of each sample [n]: values of the nodes.
    accepted
        Which are accepted [n].
    m_nodes_kev, log10_mass_nodes
        The nodes, ascending.

    Raises
    ------
    ValueError
        If a sample lies on no node, a halo mass has no sample, or none is accepted.
    """
    relic, halo = np.searchsorted(m_nodes_kev, m_kev), np.searchsorted(log10_mass_nodes, log10_mass)
    inside = (relic < m_nodes_kev.size) & (halo < log10_mass_nodes.size)
    on_node = inside.copy()
    on_node[inside] = (m_nodes_kev[relic[inside]] == m_kev[inside]) & (
        log10_mass_nodes[halo[inside]] == log10_mass[inside]
    )
    if not on_node.all():
        row = int(np.argmin(on_node))
        raise ValueError(
            f"sample in row {row} ({m_kev[row]:g} keV, {log10_mass[row]:g}) lies on no node of the grid"
        )
    shape = (log10_mass_nodes.size, m_nodes_kev.size)
    n_samples, n_accepted = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    np.add.at(n_samples, (halo, relic), 1)
    np.add.at(n_accepted, (halo[accepted], relic[accepted]), 1)
    sizes, counts = n_samples.sum(axis=1), n_accepted.sum(axis=1)
    if not sizes.all():
        raise ValueError(f"no sample is left at log10 M_h = {log10_mass_nodes[np.argmin(sizes)]:g}")
    if not counts.any():
        raise ValueError("no sample is accepted")
    halo_masses = tuple(_halo_mass(i, log10_mass_nodes, sizes, counts) for i in range(sizes.size))
    return Exclusion(n_samples, n_accepted, halo_masses, _warnings(counts, sizes, log10_mass_nodes))


def _halo_mass(i: int, nodes: FloatArray, sizes: IntArray, counts: IntArray) -> HaloMass:
    best = int(np.argmax(counts / sizes))
    one = np.arange(sizes.size) == i
    probability, probability_interval = _probability(one, sizes, counts)
    cumulative, cumulative_interval = _probability(np.arange(sizes.size) <= i, sizes, counts)
    ratio, ratio_interval = _ratio(i, best, sizes, counts)
    return HaloMass(
        log10_m_halo_msun=float(nodes[i]),
        n_samples=int(sizes[i]),
        n_accepted=int(counts[i]),
        rate=float(counts[i] / sizes[i]),
        rate_interval=clopper_pearson(int(counts[i]), int(sizes[i])),
        probability=probability,
        probability_interval=probability_interval,
        prior_probability=1.0 / sizes.size,
        cumulative=cumulative,
        cumulative_interval=cumulative_interval,
        ratio=ratio,
        ratio_interval=ratio_interval,
        excluded=probability_interval[1] <= LEVEL and ratio_interval[1] <= MAX_RATIO,
    )


def _probability(chosen: BoolArray, sizes: IntArray, counts: IntArray) -> tuple[float, tuple[float, float]]:
    """Return the posterior probability of some halo masses under equal prior probabilities, and its interval.

    It is the fraction of the accepted samples if all masses have equally many; failed samples make them uneven.
    """
    if chosen.all():
        return 1.0, (1.0, 1.0)
    n_chosen, n_others = _size(sizes[chosen], counts[chosen]), _size(sizes[~chosen], counts[~chosen])

    def of_fraction(fraction: float) -> float:
        weight, other = fraction / n_chosen, (1.0 - fraction) / n_others
        return weight / (weight + other)

    k = int(counts.sum())
    inside = int(counts[chosen].sum())
    low, high = clopper_pearson(inside, k)
    return of_fraction(inside / k), (of_fraction(low), of_fraction(high))


def _size(sizes: IntArray, counts: IntArray) -> float:
    """Return the samples per halo mass, averaged with the accepted samples as weights."""
    if not counts.any():
        return float(sizes.mean())
    return float(counts.sum() / (counts / sizes).sum())


def _ratio(i: int, best: int, sizes: IntArray, counts: IntArray) -> tuple[float, tuple[float, float]]:
    """Return the likelihood of halo mass i over that of the best one, and its interval."""
    if i == best:
        return 1.0, (1.0, 1.0)
    total = int(counts[i] + counts[best])
    low, high = clopper_pearson(int(counts[i]), total)  # high < 1: the best one has some
    scale = float(sizes[best] / sizes[i])
    return float(counts[i] / counts[best]) * scale, (low / (1.0 - low) * scale, high / (1.0 - high) * scale)


def _warnings(counts: IntArray, sizes: IntArray, nodes: FloatArray) -> tuple[str, ...]:
    warnings = []
    k, level = int(counts.sum()), f"{100 * (1 - LEVEL):.2f}%"
    if k < MIN_FOR_BOUND:
        warnings.append(f"only {k} samples are accepted (fewer than {MIN_FOR_BOUND})")
    needed = int(np.ceil(np.log(0.5 * (1.0 - CONFIDENCE)) / np.log1p(-LEVEL)))
    if k < needed:
        warnings.append(
            f"{k} accepted samples cannot exclude a halo mass at {level}, even if none of them has it: {needed} "
            "are needed; raise abc.fraction or campaign.grid.realizations"
        )
    best = int(np.argmax(counts / sizes))
    if best in (0, sizes.size - 1):
        warnings.append(f"the best halo mass, 10^{nodes[best]:g} Msun, is at the edge of the grid")
    return tuple(warnings)
