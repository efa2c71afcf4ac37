"""Mean unevolved first-order mass functions dN/dlog10(m/M0) of cold dark matter at z = 0.295, as a CSV.

Each bin is listed with the fit of Jiang & van den Bosch 2016, for comparison with another tree code:
python benchmarks/mass_functions.py --csv FILE --hosts 12.5 13.5 --trees 400
"""

from __future__ import annotations

import argparse
import csv
import itertools
import math
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from warmlens.cosmology import Cosmology
from warmlens.halos.dark_matter import ColdDarkMatter
from warmlens.halos.merger_tree import BRANCHING, branching_table, grow_tree
from warmlens.halos.power_spectrum import cdm_power, filtered_variance
from warmlens.types import FloatArray

Z_ROOT, Z_END = 0.295, 20.0
RESOLUTION = 1.0e-4  # of the host
BARRIER_FACTOR, SHARP_K_A = 1.197, 2.5
EDGES = np.linspace(-4.0, 0.0, 17)  # log10(m/M0)


def first_order_fit(low: float, high: float) -> float:
    """Mean dN/dlog10 x in a bin of log10 x (Jiang & van den Bosch 2016, first order)."""
    x = np.logspace(low, high, 201)
    density = (0.13 * x**-0.83 + 1.33 * x**-0.02) * np.exp(-5.67 * x**1.19)  # dN/dlnx
    return float(np.trapezoid(density, np.log(x))) / (high - low)


def count_accreted(log10_host: float, n_trees: int, branching: str, seed: int) -> FloatArray:
    """Accreted halos in the bins of `EDGES`, shape (n_trees, n_bins)."""
    cosmology, host = Cosmology(), 10.0**log10_host
    variance = filtered_variance(ColdDarkMatter().transfer, cdm_power(cosmology), cosmology, SHARP_K_A)
    table = branching_table(
        variance, host, RESOLUTION * host, BRANCHING[branching], BARRIER_FACTOR, barrier_ratio=np.ones_like
    )
    root, end = float(cosmology.collapse_clock(Z_ROOT)), float(cosmology.collapse_clock(Z_END))
    rng = np.random.default_rng(seed)
    counts = np.empty((n_trees, EDGES.size - 1))
    for i in track(range(n_trees), f"10^{log10_host:g} Msun", console=Console(stderr=True)):
        counts[i] = np.histogram(np.log10(grow_tree(table, root, end, rng).m_acc_msun / host), EDGES)[0]
    return counts


def mass_function(log10_host: float, counts: FloatArray) -> list[dict[str, float]]:
    """Mean and standard error over trees of dN/dlog10 x, one row per bin, with the published fit."""
    width = float(EDGES[1] - EDGES[0])
    mean = counts.mean(axis=0) / width
    error = counts.std(axis=0, ddof=1) / width / math.sqrt(len(counts))
    return [
        {
            "log10_host": log10_host,
            "log10_x_low": low,
            "log10_x_high": high,
            "mean": mean[i],
            "error": error[i],
            "n_trees": len(counts),
            "jvdb16_first_order": first_order_fit(low, high),
        }
        for i, (low, high) in enumerate(itertools.pairwise(EDGES.tolist()))
    ]


def main() -> None:
    """Grow the trees, write the CSV, print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--csv", type=Path, required=True, help="file to write")
    parser.add_argument("--hosts", type=float, nargs="+", default=[12.5, 13.5], help="log10 of the hosts' masses")
    parser.add_argument("--trees", type=int, default=400, help="trees a host, at least 2")
    parser.add_argument("--branching", choices=BRANCHING, default="pch08", help="parameters of the branching rate")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.trees < 2:
        parser.error(f"--trees must be at least 2, got {arguments.trees}")

    rows: list[dict[str, float]] = []
    for host in arguments.hosts:
        rows += mass_function(host, count_accreted(host, arguments.trees, arguments.branching, arguments.seed))
    with arguments.csv.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in rows)

    table = Table("log10 M0", "log10 x", "dN/dlog10 x", "fit", "ratio", title=f"{arguments.trees} trees a host")
    for row in rows:
        table.add_row(
            f"{row['log10_host']:g}",
            f"{row['log10_x_low']:.2f} to {row['log10_x_high']:.2f}",
            f"{row['mean']:.3f} ± {row['error']:.3f}",
            f"{row['jvdb16_first_order']:.3f}",
            f"{row['mean'] / row['jvdb16_first_order']:.3f}",
        )
    Console().print(table)


if __name__ == "__main__":
    main()
