"""Merger trees: the trunk of a halo, followed into the past, and what it accreted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from warmlens.halos.barrier import barrier_ratio
from warmlens.halos.power_spectrum import SharpKVariance
from warmlens.types import FloatArray

_ROWS = 512
_STEP_BARRIER = 0.1  # eps_1 of Parkinson, Cole & Helly 2008
_STEP_BRANCHING = 0.1  # eps_2
_MAX_SMOOTH = 0.5  # largest share of the mass that a step accretes smoothly
_FLAT = 1.0e-10  # relative gain of variance below which a halo has no progenitors
_TRUNK_RESOLUTION = 5.0e-4  # change of ln M between stored points of the trunk


@dataclass(frozen=True)
class BranchingTable:
    """Rates of branching and smooth accretion for parents on a grid of mass.

    Row i belongs to the parent of mass 2 M_res exp(i step); the factor (delta_2/sigma_2)^gamma_2, which
    depends on time, is left out of both rates.

    Attributes
    ----------
    ln_resolution
        ln(M_res/Msun).
    step
        Spacing of the rows in ln M.
    first_row
        First row whose parent has progenitors: lighter ones collapse monolithically.
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
    gamma2
        Exponent gamma_2.
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
    """History of a trunk and the haloes that it accreted directly.

    Attributes
    ----------
    trunk_clock, trunk_mass_msun
        Collapse clock w (ascending) and mass of the trunk; what lies between varies by < 0.05%.
    m_acc_msun, host_mass_msun, clock_acc
        Of each accreted halo: its mass, the mass of the trunk just before, and w of the accretion.
    steps
        Number of steps taken.
    """

    trunk_clock: FloatArray
    trunk_mass_msun: FloatArray
    m_acc_msun: FloatArray
    host_mass_msun: FloatArray
    clock_acc: FloatArray
    steps: int

    @property
    def half_mass_clock(self) -> float:
        """Clock w at which the trunk has half the mass of the root, or at which a shorter trunk ends."""
        half = math.log(0.5 * self.trunk_mass_msun[0])
        return float(np.interp(-half, -np.log(self.trunk_mass_msun), self.trunk_clock))


def smooth_integral(u: FloatArray, gamma1: float) -> FloatArray:
    """J(u) = int_0^u (1 + 1/v^2)^(gamma1/2) dv, for gamma1 < 1 (Parkinson, Cole & Helly 2008, appendix A)."""
    from scipy.special import hyp2f1

    half = 0.5 * (1.0 - gamma1)
    return u ** (1.0 - gamma1) / (1.0 - gamma1) * hyp2f1(-0.5 * gamma1, half, half + 1.0, -(u**2))


def branching_table(
    variance: SharpKVariance,
    root_mass_msun: float,
    resolution_msun: float,
    branching: tuple[float, float, float],
    barrier_factor: float,
    jeans_mass_msun: float,
) -> BranchingTable:
    """Integrate the branching rate of Parkinson, Cole & Helly 2008 for all parents of a tree.

    Parameters
    ----------
    variance
        S(M) of the dark matter.
    root_mass_msun, resolution_msun
        Mass of the root and smallest mass that is followed [Msun].
    branching
        (G0, gamma1, gamma2), with gamma1 < 1.
    barrier_factor
        Factor of the collapse threshold that goes with the sharp-k filter (Benson et al. 2013).
    jeans_mass_msun
        Effective Jeans mass of the warm dark matter [Msun]; 0 for cold.

    Notes
    -----
    The rate dN/dq = sqrt(2/pi) S1/(S1-S2)^1.5 alpha(M1) q^-2 G0 (sigma1/sigma2)^gamma1 is integrated as
    it is, so the table is exact for any S(M), also one that flattens, and no branching is rejected.
    """
    if not root_mass_msun > 2.0 * resolution_msun > 0.0:
        raise ValueError(
            f"root_mass_msun must exceed twice resolution_msun = {resolution_msun!r}, got {root_mass_msun!r}"
        )
    g0, gamma1, gamma2 = branching
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
    cumulative = _accumulate(weight, s_half, s_parent, norm * parent * sigma**-gamma1, first_row, step)
    smooth, max_step = np.zeros(_ROWS), np.zeros(_ROWS)
    used = slice(first_row, None)
    u_res = sigma[used] / np.sqrt(s_res - s_parent[used])
    smooth[used] = norm * smooth_integral(u_res, gamma1) / sigma[used]  # PCH08 appendix A, per unit of omega
    max_step[used] = _STEP_BARRIER * np.sqrt(2.0 * (s_half[used] - s_parent[used]))
    barrier = barrier_factor * barrier_ratio(parent, jeans_mass_msun)
    return BranchingTable(
        math.log(resolution_msun), step, first_row, cumulative, smooth, max_step, sigma, barrier, gamma2
    )


def grow_tree(table: BranchingTable, clock_root: float, clock_end: float, rng: np.random.Generator) -> MergerTree:
    """Follow the trunk from the root into the past and collect what it accreted.

    Parameters
    ----------
    table
        Rates, see `branching_table`.
    clock_root, clock_end
        Collapse clock w at the root and at the earliest time that is followed.
    rng
        Random numbers.

    Notes
    -----
    At a branching the heavier progenitor continues the trunk, the lighter one is a subhalo. The trunk
    ends at clock_end or where it cannot branch any more (2 M_res, or monolithic collapse).
    """
    span = table.step * (table.smooth.size - 1)
    capacity = 2 * math.ceil(span / _TRUNK_RESOLUTION) + 8
    trunk, accreted, steps = _walk(
        rng,
        clock_root,
        clock_end,
        table.ln_resolution,
        table.step,
        table.first_row,
        table.cumulative,
        table.smooth,
        table.max_step,
        table.sigma,
        table.barrier,
        table.gamma2,
        capacity,
    )
    return MergerTree(
        trunk_clock=trunk[0].copy(),
        trunk_mass_msun=np.exp(trunk[1]),
        m_acc_msun=accreted[0].copy(),
        host_mass_msun=accreted[1].copy(),
        clock_acc=accreted[2].copy(),
        steps=steps,
    )


@njit(cache=True)
def _accumulate(weight, s_progenitor, s_parent, factor, first_row, step):  # type: ignore[no-untyped-def]
    """Trapezoid sums over ln M1 of factor * weight / (S1 - S2)^1.5, one row a parent."""
    rows = weight.size
    cumulative = np.zeros((rows, rows))
    for i in range(first_row, rows):
        gap = s_progenitor[0] - s_parent[i]
        before = weight[0] / (gap * math.sqrt(gap))
        total = 0.0
        for n in range(1, i + 1):
            gap = s_progenitor[n] - s_parent[i]
            rate = weight[n] / (gap * math.sqrt(gap))
            total += 0.5 * step * factor[i] * (before + rate)
            cumulative[i, n] = total
            before = rate
    return cumulative


@njit(cache=True)
def _progenitor_position(row, last, fraction):  # type: ignore[no-untyped-def]
    """Position in [0, last] at which the cumulative row reaches the given fraction of its total."""
    target = fraction * row[last]
    low, high = 0, last
    while high - low > 1:
        middle = (low + high) // 2
        if row[middle] <= target:
            low = middle
        else:
            high = middle
    return low + (target - row[low]) / (row[high] - row[low])


@njit(cache=True)
def _walk(  # type: ignore[no-untyped-def]
    rng,
    clock,
    clock_end,
    ln_resolution,
    step,
    first_row,
    cumulative,
    smooth,
    max_step,
    sigma,
    barrier,
    gamma2,
    capacity,
):
    """Walk the trunk; returns ([clock, ln M], [m_acc, host mass, clock_acc], number of steps)."""
    last_row = smooth.size - 1
    ln_lightest = ln_resolution + math.log(2.0)
    ln_mass = ln_lightest + step * last_row
    resolution = math.exp(ln_resolution)

    trunk = np.empty((2, capacity))
    trunk[0, 0], trunk[1, 0] = clock, ln_mass
    n_trunk = 1
    accreted = np.empty((3, 1024))
    n_accreted = 0
    steps = 0

    while ln_mass > ln_lightest + step * first_row:
        position = (ln_mass - ln_lightest) / step
        row = min(int(position), last_row - 1)
        upper = position - row
        lower = 1.0 - upper
        rate_low = lower * cumulative[row, row]
        rate_high = upper * cumulative[row + 1, row + 1]
        b = lower * barrier[row] + upper * barrier[row + 1]
        sigma_2 = lower * sigma[row] + upper * sigma[row + 1]
        time_factor = (b * clock / sigma_2) ** gamma2

        rate = (rate_low + rate_high) * time_factor
        d_omega = lower * max_step[row] + upper * max_step[row + 1]
        if rate * d_omega > _STEP_BRANCHING:
            d_omega = _STEP_BRANCHING / rate
        accretion = (lower * smooth[row] + upper * smooth[row + 1]) * time_factor * d_omega
        accretion = min(accretion, _MAX_SMOOTH)

        clock_before, ln_mass_before = clock, ln_mass
        clock += d_omega / b
        if clock > clock_end:
            clock = clock_before
            break
        steps += 1
        if rng.random() < rate * d_omega:
            # Each of the two rows is drawn from by its share of the rate.
            drawn = row + 1 if rng.random() * (rate_low + rate_high) < rate_high else row
            part = _progenitor_position(cumulative[drawn], drawn, rng.random()) / drawn
            one = math.exp(ln_resolution + part * (ln_mass - ln_lightest))
            other = math.exp(ln_mass) * (1.0 - accretion) - one
            light, heavy = min(one, other), max(one, other)
            ln_mass = math.log(heavy)
            if light > resolution:
                if n_accreted == accreted.shape[1]:
                    grown = np.empty((3, 2 * n_accreted))
                    grown[:, :n_accreted] = accreted
                    accreted = grown
                accreted[0, n_accreted] = light
                accreted[1, n_accreted] = heavy
                accreted[2, n_accreted] = clock
                n_accreted += 1
        else:
            ln_mass += math.log1p(-accretion)

        if trunk[1, n_trunk - 1] - ln_mass > _TRUNK_RESOLUTION:
            if clock_before > trunk[0, n_trunk - 1]:
                trunk[0, n_trunk], trunk[1, n_trunk] = clock_before, ln_mass_before
                n_trunk += 1
            trunk[0, n_trunk], trunk[1, n_trunk] = clock, ln_mass
            n_trunk += 1

    if clock > trunk[0, n_trunk - 1]:
        trunk[0, n_trunk], trunk[1, n_trunk] = clock, ln_mass
        n_trunk += 1
    return trunk[:, :n_trunk], accreted[:, :n_accreted], steps
