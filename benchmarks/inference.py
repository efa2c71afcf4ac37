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

from warmlens.inference.acceptance import KINDS
from warmlens.inference.analysis import analyse
from warmlens.inference.calibration import leave_one_out
from warmlens.inference.combine import cold_ratios, forecast
from warmlens.inference.convergence import threshold_convergence
from warmlens.inference.null import null_test
from warmlens.inference.summary_sets import SETS, Summary, learned_points, points, summary_set
from warmlens.inference.table import Table
from warmlens.sampling import stream
from warmlens.types import FloatArray

PRIOR, HALO = (1.0, 5.0), (13.0, 13.5)
GRIDS = {"correlation": np.linspace(0.0, 2.5, 51), "cumulative": np.linspace(-40.0, -4.0, 73)}


def synthetic(n: int, n_null: int, seed: int = 1) -> tuple[FloatArray, dict[str, Summary]]:
    """Parameters [n, 2] and summaries like the real ones, with scatter as large as the signal.

    An exponential C(dr), counts, and a linear response. The observation has 4 keV and 10^13.25 Msun; the null
    test's mocks a hundredth of the signal.
    """
    rng = np.random.default_rng(seed)
    size = n + 1 + n_null
    m, log10_mass = rng.uniform(*PRIOR, size), rng.uniform(*HALO, size)
    m[n], log10_mass[n] = 4.0, 13.25
    number = np.exp(0.5 * (m - 3.0) + 1.5 * (log10_mass - 13.25) + 0.5 * rng.standard_normal(size))
    number[n + 1 :] *= 0.01
    length = 0.2 * np.exp(0.2 * rng.standard_normal(size))
    dr, thresholds = GRIDS["correlation"], GRIDS["cumulative"]

    def decay(scatter: float) -> FloatArray:
        shape = np.exp(-dr / length[:, None])
        return number[:, None] * shape * np.exp(scatter * rng.standard_normal((size, dr.size)))

    spread = np.exp(0.3 * rng.standard_normal((size, 1)))
    below = 0.01 * number[:, None] * np.exp(thresholds / 8.0) * spread
    arrays = {
        "correlation": decay(0.1),
        "cumulative": below,
        "counts": np.rint(1e4 * below[:, [30, 60, 72]]),
        "chi2": 5e4 + 20.0 * number + 300.0 * rng.standard_normal(size),
        "mean_z2": 1.0 + 0.1 * number + 0.1 * rng.standard_normal(size),
        "amplitude_correlation": decay(0.3),
    }
    summaries = {name: Summary(rows[:n], rows[n], rows[n + 1 :]) for name, rows in arrays.items()}
    return np.column_stack([m, log10_mass])[:n], summaries


def table_of(parameters: FloatArray, known: dict[str, Summary], kinds: tuple[str, ...]) -> Table:
    chosen = [known[kind] for kind in kinds]
    features, observed = tuple(item.samples for item in chosen), tuple(item.observed for item in chosen)
    m, log10_mass = parameters.T
    return Table(np.arange(len(m)), m, log10_mass, PRIOR, HALO, features, observed, kinds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=2483)
    parser.add_argument("--bootstrap", type=int, default=1000)
    parser.add_argument("--rows", type=int, default=1000, help="samples that play the observation")
    parser.add_argument("--null", type=int, default=40, help="mocks without substructure")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    parameters, summaries = synthetic(arguments.samples, arguments.null)
    known = points(summaries, GRIDS, "integral")
    table = table_of(parameters, known, SETS["paper"])
    seconds = {}
    start = time.perf_counter()
    threshold_convergence(table, "max_rank", 0.05, arguments.bootstrap, np.random.default_rng(0))
    seconds["bootstrap at all thresholds, raw and adjusted"] = time.perf_counter() - start
    start = time.perf_counter()
    leave_one_out(table, "max_rank", 0.05, arguments.rows, np.random.default_rng(0), with_adjustment=True)
    seconds["leave-one-out, raw and adjusted"] = time.perf_counter() - start
    start, processor_start = time.perf_counter(), time.process_time()
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
    known |= learned_points(parameters, summaries, stream(1, "abc/learned", 0))[0]
    sets = {
        name: summary_set(
            table_of(parameters, known, kinds),
            0.05,
            arguments.bootstrap,
            300,
            lambda name: stream(1, f"abc/sets/{name}", 0),
        )
        for name, kinds in SETS.items()
    }
    seconds["comparison of summary sets"] = time.perf_counter() - begun
    begun = time.perf_counter()
    nulls = [known[kind].null for kind in table.kinds]
    null = null_test(table, nulls, found.cloud, "max_rank", 0.05, stream(1, "abc/null", 0))
    seconds["null test"] = time.perf_counter() - begun
    begun = time.perf_counter()
    rng = np.random.default_rng(0)
    ratios = cold_ratios(table, found.trials, found.likelihood, rng)
    forecast(found.likelihood.m_kev, ratios, found.acceptance.k, 0.0455, rng)
    seconds["forecast"] = time.perf_counter() - begun
    seconds["everything"] = time.perf_counter() - start
    processor = time.process_time() - processor_start
    bound = found.bounds["q0455"]
    result = {
        "samples": table.n,
        "kinds": list(KINDS),
        "bootstrap": arguments.bootstrap,
        "leave_one_out": found.n_rows,
        "seconds": seconds,
        "processor_seconds_of_everything": processor,
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "bound_kev": bound.value_kev,
        "mc_error_kev": bound.mc_error_kev,
        "null_bounds_kev": null.quantiles_kev,
        "information_nats": {name: entry.gain.gain_nats for name, entry in sets.items()},
        "command": " ".join(sys.argv),
    }
    seconds["of it on the processor"] = processor
    printed = Printed("part", "seconds", title=f"{table.n} samples, B = {arguments.bootstrap}")
    for name, value in seconds.items():
        printed.add_row(name, f"{value:.1f}")
    Console().print(printed)
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
