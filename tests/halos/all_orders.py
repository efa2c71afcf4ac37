"""Merger trees of all orders, walked branch by branch with the kernel of the trunk: published fits count them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from warmlens.halos.merger_tree import BranchingTable, kernel_arguments, ln_root_mass
from warmlens.halos.tree_walk import enlarged, walk_branch
from warmlens.types import FloatArray, IntArray


@dataclass(frozen=True)
class AllOrderTree:
    """A halo with every branch above the resolution, one entry each; entry 0 is the root.

    Attributes
    ----------
    m_acc_msun, clock_acc
        Mass and collapse clock w of the accretion; of the root, where the tree starts.
    host_mass_msun
        Mass of the parent branch just before the accretion (further back in time); nan for the root.
    m_end_msun
        Mass at the earliest time, or where the branch could not branch any more.
    smooth_mass_msun
        Mass that the branch accreted below the resolution.
    order, parent
        Order (1: accreted by the trunk) and entry of the branch that accreted it; 0 and -1 for the root.
        Parents come before their branches.
    """

    m_acc_msun: FloatArray
    host_mass_msun: FloatArray
    clock_acc: FloatArray
    m_end_msun: FloatArray
    smooth_mass_msun: FloatArray
    order: IntArray
    parent: IntArray


def grow_all_orders(
    table: BranchingTable, clock_root: float, clock_end: float, rng: np.random.Generator
) -> AllOrderTree:
    """Follow every branch above the resolution; parameters as in `grow_tree`.

    Branches end at clock_end itself, so that `m_end_msun` above twice the resolution are the progenitors at that
    time. A branch lighter than that has none of its own.
    """
    values, links = walk_all(rng, clock_root, clock_end, ln_root_mass(table), kernel_arguments(table))
    return AllOrderTree(*(row.copy() for row in values), *(row.copy() for row in links))


@njit(cache=True)
def walk_all(rng, clock, clock_end, ln_mass, table):
    """Walk the root and, one after the other, every branch that an earlier walk has accreted.

    Returns ([m_acc, host mass, clock_acc, last mass, smooth mass], [order, parent]), one column per branch.
    """
    values, links = np.empty((5, 256)), np.empty((2, 256), np.int64)
    values[0, 0], values[1, 0], values[2, 0] = math.exp(ln_mass), math.nan, clock
    links[0, 0], links[1, 0] = 0, -1
    n_branches, branch = 1, 0
    while branch < n_branches:
        trunk, accreted, smooth_mass, _ = walk_branch(
            rng, values[2, branch], clock_end, math.log(values[0, branch]), True, table
        )
        values[3, branch], values[4, branch] = math.exp(trunk[1, -1]), smooth_mass
        new = accreted.shape[1]
        if n_branches + new > values.shape[1]:
            room = 2 * (n_branches + new)
            values, links = enlarged(values, room), enlarged(links, room)
        for i in range(new):
            for row in range(3):
                values[row, n_branches + i] = accreted[row, i]
            links[0, n_branches + i], links[1, n_branches + i] = links[0, branch] + 1, branch
        n_branches += new
        branch += 1
    return values[:, :n_branches], links[:, :n_branches]
