"""Seconds of the whole inference on a table as large as the paper's, by part.

OPENBLAS_NUM_THREADS=1 python benchmarks/inference.py --json FILE
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table as Printed

from warmlens.campaign import stream
from warmlens.inference.acceptance import KINDS
from warmlens.inference.analysis import analyse
from warmlens.inference.calibration import leave_one_out
from warmlens.inference.combine import cold_ratios, forecast
from warmlens.inference.convergence import threshold_convergence
from warmlens.inference.distance import integral_features
from warmlens.inference.summary_sets import summary_sets
from warmlens.inference.table import Table

PRIOR, HALO = (1.0, 5.0), (13.0, 13.5)
LEVELS = np.array([0.05, 0.0455, 0.02275])


def synthetic_table(n: int, seed: int = 1, n_dr: int = 51, n_thresholds: int = 73) -> Table:
    """Summaries like the real ones: an exponential C(dr) and counts, with scatter as large as the signal."""
    rng = np.random.default_rng(seed)
    m, log10_mass = rng.uniform(*PRIOR, n + 1), rng.uniform(*HALO, n + 1)
    m[0], log10_mass[0] = 4.0, 13.25
    dr, thresholds = np.linspace(0.0, 2.5, n_dr), np.linspace(-40.0, -4.0, n_thresholds)
    number = np.exp(0.5 * (m - 3.0) + 1.5 * (log10_mass - 13.25) + 0.5 * rng.standard_normal(n + 1))
    length = 0.2 * np.exp(0.2 * rng.standard_normal(n + 1))
    correlation = (
        number[:, None] * np.exp(-dr / length[:, None]) * np.exp(0.1 * rng.standard_normal((n + 1, n_dr)))
    )
    below = 0.01 * number[:, None] * np.exp(thresholds / 8.0) * np.exp(0.3 * rng.standard_normal((n + 1, 1)))
    features = integral_features(dr, correlation), integral_features(thresholds, below)
    return Table(
        np.arange(n),
        m[1:],
        log10_mass[1:],
        PRIOR,
        HALO,
        tuple(rows[1:] for rows in features),
        tuple(rows[0] for rows in features),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=2483)
    parser.add_argument("--bootstrap", type=int, default=1000)
    parser.add_argument("--rows", type=int, default=1000, help="samples that play the observation")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    table = synthetic_table(arguments.samples)
    seconds = {}
    start = time.perf_counter()
    threshold_convergence(table, "max_rank", 0.05, LEVELS, 1, arguments.bootstrap, np.random.default_rng(0))
    seconds["bootstrap at all thresholds, raw and adjusted"] = time.perf_counter() - start
    start = time.perf_counter()
    leave_one_out(table, "max_rank", 0.05, arguments.rows, np.random.default_rng(0), with_adjustment=True)
    seconds["leave-one-out, raw and adjusted"] = time.perf_counter() - start
    start = time.perf_counter()
    found = analyse(
        table,
        "max_rank",
        0.05,
        arguments.bootstrap,
        arguments.rows,
        lambda name: stream(1, f"abc/{name}", 0),
    )
    seconds["bound, companions, calibration, checks"] = time.perf_counter() - start
    begun = time.perf_counter()
    sets = summary_sets(table, 0.05, arguments.bootstrap, 300, lambda name: stream(1, f"abc/sets/{name}", 0))
    seconds["comparison of summary sets"] = time.perf_counter() - begun
    begun = time.perf_counter()
    rng = np.random.default_rng(0)
    ratios = cold_ratios(table, found.trials, found.likelihood, rng)
    forecast(found.likelihood.m_kev, ratios, found.acceptance.k, 0.0455, rng)
    seconds["forecast"] = time.perf_counter() - begun
    seconds["everything"] = time.perf_counter() - start
    bound = found.bounds["q0455"]
    result = {
        "samples": table.n,
        "kinds": list(KINDS),
        "bootstrap": arguments.bootstrap,
        "leave_one_out": found.n_rows,
        "seconds": seconds,
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "bound_kev": bound.value_kev,
        "mc_error_kev": bound.mc_error_kev,
        "information_nats": {name: entry.gain.gain_nats for name, entry in sets.items()},
        "command": " ".join(sys.argv),
    }
    printed = Printed("part", "seconds", title=f"{table.n} samples, B = {arguments.bootstrap}")
    for name, value in seconds.items():
        printed.add_row(name, f"{value:.1f}")
    Console().print(printed)
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
