"""Merger trees: a halo followed into the past along its trunk."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from warmlens.halos.power_spectrum import SharpKVariance
from warmlens.halos.tree_walk import walk_branch
from warmlens.kernels import njit
from warmlens.types import FloatArray

Branching = tuple[float, float, float, float]

# (G0, gamma1, gamma2, gamma3) of the branching rate: Parkinson, Cole & Helly 2008; Benson 2017; "PCH+" of
# Benson et al. 2021, the last as the public code SatGen carries it.
BRANCHING: Mapping[str, Branching] = MappingProxyType(
    {
        "pch08": (0.57, 0.38, -0.01, 0.0),
        "benson17": (0.6353, 0.1761, 0.0411, 0.0),
        "pch_plus": (0.943, -0.158, 0.0488, 0.202),
    }
)

_ROWS = 512
_STEP_BARRIER = 0.1  # eps_1 of Parkinson, Cole & Helly 2008
_FLAT = 1.0e-10  # relative gain of variance below which a halo has no progenitors


@dataclass(frozen=True)
class BranchingTable:
    """Rates of branching and smooth accretion for parents on a grid of mass.

    Row i belongs to the parent of mass 2 M_res exp(i step). Both rates lack the factor (delta_2/sigma_2)^gamma_2,
    which depends on time.

    Attributes
    ----------
    ln_resolution, step
        ln(M_res/Msun), and spacing of the rows in ln M.
    first_row
        First row whose parent has progenitors; lighter parents collapse monolithically.
    cumulative
        [i, n]: branchings of parent i into progenitors between M_res and M_res exp(n step), n <= i, per
        unit of omega.
    smooth
        Relative mass accreted below M_res per unit of omega.
    max_step
        Longest step in omega that the barrier criterion allows.
    sigma
        Linear rms at the parent's mass.
    barrier
        Threshold in units of w(z), and omega per unit of w.
    """

    ln_resolution: float
    step: float
    first_row: int
    cumulative: FloatArray
    smooth: FloatArray
    max_step: FloatArray
    sigma: FloatArray
    barrier: FloatArray
    gamma2: float


@dataclass(frozen=True)
class MergerTree:
    """History of a trunk and the halos that it accreted directly.

    Attributes
    ----------
    trunk_clock, trunk_mass_msun
        Collapse clock w (ascending) and mass of the trunk; between entries the mass varies by < 0.05%.
    m_acc_msun, host_mass_msun, clock_acc
        Of each accreted halo: its mass, the mass of the trunk just before, and w of the accretion.
    smooth_mass_msun
        Mass that the trunk accreted below the resolution. Together with the accreted halos and the last mass of
        the trunk it is the mass of the root, to rounding.
    steps
        Number of steps.
    """

    trunk_clock: FloatArray
    trunk_mass_msun: FloatArray
    m_acc_msun: FloatArray
    host_mass_msun: FloatArray
    clock_acc: FloatArray
    smooth_mass_msun: float
    steps: int

    @property
    def half_mass_clock(self) -> float:
        """Clock w at which the trunk has half the mass of the root, or at which a shorter trunk ends."""
        half = math.log(0.5 * self.trunk_mass_msun[0])
        return float(np.interp(-half, -np.log(self.trunk_mass_msun), self.trunk_clock))


def smooth_integral(u: FloatArray, gamma1: float, gamma3: float) -> FloatArray:
    """Return J(u) = int_0^u (1 + 1/v^2)^(gamma1/2) (1 + v^2)^-gamma3 dv, any shape, for gamma1 < 1.

    With v = sigma2/sqrt(S1 - S2) the factors are those of the branching rate: 1 + 1/v^2 = S1/S2 and
    1 + v^2 = 1/(1 - S2/S1). Reference: Parkinson, Cole & Helly 2008, appendix A, where gamma3 = 0.
    """
    from scipy.special import hyp2f1  # slow to import

    half = 0.5 * (1.0 - gamma1)
    return u ** (1.0 - gamma1) / (1.0 - gamma1) * hyp2f1(gamma3 - 0.5 * gamma1, half, half + 1.0, -(u**2))


def branching_table(
    variance: SharpKVariance,
    root_mass_msun: float,
    resolution_msun: float,
    branching: Branching,
    barrier_factor: float,
    barrier_ratio: Callable[[FloatArray], FloatArray],
) -> BranchingTable:
    """Integrate the branching rate of Parkinson, Cole & Helly 2008 for all parents of a tree.

    Parameters
    ----------
    root_mass_msun, resolution_msun
        Mass of the root and smallest mass that is followed [Msun].
    branching
        (G0, gamma1, gamma2, gamma3), with gamma1 < 1; see `BRANCHING`.
    barrier_factor
        Factor of the collapse threshold that goes with the sharp-k filter (Benson et al. 2013).
    barrier_ratio
        Threshold of collapse as a function of mass [Msun], in units of that of cold dark matter.

    Notes
    -----
    The rate dN/dq = sqrt(2/pi) S1/(S1-S2)^1.5 alpha(M1) q^-2 G0 (sigma1/sigma2)^gamma1 (1-S2/S1)^gamma3 is
    integrated without approximating S(M). The table therefore holds for any S(M), also one that flattens, and no
    branching is rejected. References: Parkinson, Cole & Helly 2008, eqs. 3-5; Benson et al. 2021 for gamma3.
    """
    if not root_mass_msun > 2.0 * resolution_msun > 0.0:
        raise ValueError(
            f"root_mass_msun must exceed twice resolution_msun = {resolution_msun!r}, got {root_mass_msun!r}"
        )
    g0, gamma1, gamma2, gamma3 = branching
    if not gamma1 < 1.0:
        raise ValueError(f"gamma1 of branching must be < 1, got {gamma1!r}")
    step = math.log(0.5 * root_mass_msun / resolution_msun) / (_ROWS - 1)
    progenitor = resolution_msun * np.exp(step * np.arange(_ROWS))
    parent = 2.0 * progenitor
    s_half, s_parent = variance.variance(progenitor), variance.variance(parent)
    s_res = s_half[0]
    flat = (s_half - s_parent < _FLAT * s_parent) | (s_res - s_parent < _FLAT * s_parent)
    first_row = int(np.max(np.flatnonzero(flat), initial=-1)) + 1
    sigma = np.sqrt(s_parent)

    norm = math.sqrt(2.0 / math.pi) * g0
    weight = variance.log_slope(progenitor) * s_half ** (1.0 + 0.5 * gamma1) / progenitor
    factor = norm * parent * sigma**-gamma1
    cumulative = _accumulate(weight, s_half, s_parent, factor, gamma3, first_row, step)
    smooth, max_step = np.zeros(_ROWS), np.zeros(_ROWS)
    used = slice(first_row, None)
    u_res = sigma[used] / np.sqrt(s_res - s_parent[used])
    smooth[used] = norm * smooth_integral(u_res, gamma1, gamma3) / sigma[used]  # PCH08, appendix A
    max_step[used] = _STEP_BARRIER * np.sqrt(2.0 * (s_half[used] - s_parent[used]))
    barrier = barrier_factor * barrier_ratio(parent)
    return BranchingTable(
        math.log(resolution_msun), step, first_row, cumulative, smooth, max_step, sigma, barrier, gamma2
    )


def grow_tree(table: BranchingTable, clock_root: float, clock_end: float, rng: np.random.Generator) -> MergerTree:
    """Follow the trunk from the root into the past and collect the halos that it accreted.

    The clocks are the collapse clock w at the root and at the earliest time that is followed. At a branching the
    heavier progenitor continues the trunk, the lighter one is a subhalo. The trunk ends at clock_end or where it
    cannot branch any more (2 M_res, or monolithic collapse).
    """
    trunk, accreted, smooth_mass, steps = walk_branch(
        rng, clock_root, clock_end, ln_root_mass(table), False, kernel_arguments(table)
    )
    return MergerTree(
        trunk_clock=trunk[0].copy(),
        trunk_mass_msun=np.exp(trunk[1]),
        m_acc_msun=accreted[0].copy(),
        host_mass_msun=accreted[1].copy(),
        clock_acc=accreted[2].copy(),
        smooth_mass_msun=smooth_mass,
        steps=steps,
    )


def ln_root_mass(table: BranchingTable) -> float:
    """Return ln(M/Msun) of the root, the parent of the last row."""
    return table.ln_resolution + math.log(2.0) + table.step * (table.smooth.size - 1)


def kernel_arguments(table: BranchingTable) -> tuple[float | FloatArray, ...]:
    """Return the fields of a table in the order in which `walk_branch` takes them."""
    return tuple(vars(table).values())


@njit(cache=True)
def _accumulate(weight, s_progenitor, s_parent, factor, gamma3, first_row, step):  # type: ignore[no-untyped-def]
    """Sum over ln M1, by trapezoids, factor * weight / (S1 - S2)^1.5 * (1 - S2/S1)^gamma3, one row per parent."""
    rows = weight.size
    cumulative = np.zeros((rows, rows))
    for i in range(first_row, rows):
        before, total = 0.0, 0.0
        for n in range(i + 1):
            gap = s_progenitor[n] - s_parent[i]
            rate = weight[n] / (gap * math.sqrt(gap)) * (gap / s_progenitor[n]) ** gamma3
            if n > 0:
                total += 0.5 * step * factor[i] * (before + rate)
                cumulative[i, n] = total
            before = rate
    return cumulative
