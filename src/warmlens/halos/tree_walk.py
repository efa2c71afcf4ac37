"""Compiled kernels of the merger trees: the walk of a branch into the past."""

from __future__ import annotations

import math

import numpy as np

from warmlens.kernels import njit

TRUNK_RESOLUTION = 5.0e-4  # change of ln M between stored points of a branch

_STEP_BRANCHING = 0.1  # eps_2 of Parkinson, Cole & Helly 2008
_MAX_SMOOTH = 0.5  # largest share of the mass that a step accretes smoothly


@njit(cache=True)
def split_mass(mass, accretion, progenitor, resolution):  # type: ignore[no-untyped-def]
    """Split the mass of a parent that branches into (heavy, light, smooth), whose sum is the mass.

    The second progenitor is what smooth accretion (a share <= 1/2 of the mass) and the first (<= mass/2)
    leave. A progenitor at or below the resolution counts as smooth accretion; light is 0 then.
    """
    other = mass * (1.0 - accretion) - progenitor
    light, heavy = min(progenitor, other), max(progenitor, other)
    if light <= resolution:
        light = 0.0
    return heavy, light, mass - heavy - light


@njit(cache=True)
def progenitor_position(row, last, fraction):  # type: ignore[no-untyped-def]
    """Return the position in [0, last] at which the cumulative row reaches the given fraction of its total."""
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
def enlarged(columns, room):  # type: ignore[no-untyped-def]
    """Copy the columns into an array with room for more. A loop: numba compiles slices for seconds."""
    out = np.empty((columns.shape[0], room), columns.dtype)
    for row in range(columns.shape[0]):
        for i in range(columns.shape[1]):
            out[row, i] = columns[row, i]
    return out


@njit(cache=True)
def walk_branch(rng, clock, clock_end, ln_mass, to_end, table):  # type: ignore[no-untyped-def]
    """Walk one branch from ln_mass at clock into the past.

    A last step past clock_end is shortened if to_end, as trees of all orders need it, and otherwise not taken.
    Returns ([clock, ln M], [m_acc, host mass, clock_acc], smoothly accreted mass, number of steps).
    """
    ln_resolution, step, first_row, cumulative, smooth, max_step, sigma, barrier, gamma2 = table
    last_row = smooth.size - 1
    ln_lightest = ln_resolution + math.log(2.0)
    resolution = math.exp(ln_resolution)

    trunk = np.empty((2, 2 * math.ceil(max(ln_mass - ln_lightest, 0.0) / TRUNK_RESOLUTION) + 8))
    trunk[0, 0], trunk[1, 0] = clock, ln_mass
    n_trunk = 1
    accreted = np.empty((3, 64))
    n_accreted = 0
    smooth_mass = 0.0
    mass_at_split = math.exp(ln_mass)
    steps = 0

    while clock < clock_end and ln_mass > ln_lightest + step * first_row:
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
        smooth_rate = (lower * smooth[row] + upper * smooth[row + 1]) * time_factor
        d_omega = lower * max_step[row] + upper * max_step[row + 1]
        if rate * d_omega > _STEP_BRANCHING:
            d_omega = _STEP_BRANCHING / rate
        if smooth_rate * d_omega > _MAX_SMOOTH:
            d_omega = _MAX_SMOOTH / smooth_rate
        if to_end:
            d_omega = min(d_omega, b * (clock_end - clock))
        accretion = smooth_rate * d_omega

        clock_before, ln_mass_before = clock, ln_mass
        clock += d_omega / b
        if clock > clock_end and not to_end:
            clock = clock_before
            break
        steps += 1
        if rng.random() < rate * d_omega:
            # One of the two rows is drawn, each by its share of the rate.
            drawn = row + 1 if rng.random() * (rate_low + rate_high) < rate_high else row
            part = progenitor_position(cumulative[drawn], drawn, rng.random()) / drawn
            one = math.exp(ln_resolution + part * (ln_mass - ln_lightest))
            mass = math.exp(ln_mass)
            heavy, light, unresolved = split_mass(mass, accretion, one, resolution)
            smooth_mass += mass_at_split - mass + unresolved
            mass_at_split = heavy
            ln_mass = math.log(heavy)
            if light > 0.0:
                if n_accreted == accreted.shape[1]:
                    accreted = enlarged(accreted, 2 * n_accreted)
                accreted[0, n_accreted] = light
                accreted[1, n_accreted] = heavy
                accreted[2, n_accreted] = clock
                n_accreted += 1
        else:
            ln_mass += math.log1p(-accretion)

        if trunk[1, n_trunk - 1] - ln_mass > TRUNK_RESOLUTION:
            if clock_before > trunk[0, n_trunk - 1]:
                trunk[0, n_trunk], trunk[1, n_trunk] = clock_before, ln_mass_before
                n_trunk += 1
            trunk[0, n_trunk], trunk[1, n_trunk] = clock, ln_mass
            n_trunk += 1

    if clock > trunk[0, n_trunk - 1]:
        trunk[0, n_trunk], trunk[1, n_trunk] = clock, ln_mass
        n_trunk += 1
    smooth_mass += mass_at_split - math.exp(ln_mass)
    return trunk[:, :n_trunk], accreted[:, :n_accreted], smooth_mass, steps
