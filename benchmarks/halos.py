"""Time and peak memory of halo realizations and of merger trees, by resolution and by mass of the host.

Every case runs in a process of its own, so that peaks do not mix; compilation is not timed. One thread is the
fair setting: OPENBLAS_NUM_THREADS=1 python benchmarks/halos.py --json FILE
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.halos.dark_matter import ColdDarkMatter
from warmlens.halos.lens_halo import HaloGenerator, HaloModel
from warmlens.halos.merger_tree import BRANCHING, branching_table, grow_tree
from warmlens.halos.power_spectrum import cdm_power, filtered_variance

Z_LENS, Z_SOURCE, Z_END = 0.295, 0.658, 20.0
RESOLUTIONS = (1e-3, 1e-4, 1e-5, 1e-6)  # of the host
HOSTS = (12.0, 12.5, 13.0, 13.5)  # log10(M/Msun)
HALF_WIDTH_ARCSEC = 6.0


def realization(log10_host: float, m_th_kev: float, resolution_msun: float, repeats: int) -> dict[str, float]:
    """Draw whole realizations: tree, evolution, structure and positions."""
    cosmology = Cosmology()
    geometry = LensGeometry.from_redshifts(cosmology, Z_LENS, Z_SOURCE)
    generator = HaloGenerator(cosmology, geometry, HaloModel(min_mass_msun=resolution_msun))
    rng = np.random.default_rng(1)
    return timed(lambda: generator.draw(m_th_kev, 10.0**log10_host, HALF_WIDTH_ARCSEC, rng), repeats)


def cold_tree(log10_host: float, resolution_msun: float, repeats: int) -> dict[str, float]:
    """Grow trunks of cold dark matter; the table, which they share, is timed apart."""
    cosmology, host = Cosmology(), 10.0**log10_host
    variance = filtered_variance(ColdDarkMatter().transfer, cdm_power(cosmology), cosmology, 2.5)
    clocks = float(cosmology.collapse_clock(Z_LENS)), float(cosmology.collapse_clock(Z_END))
    rng = np.random.default_rng(1)
    branching_table(variance, host, resolution_msun, BRANCHING["pch08"], 1.197, np.ones_like)  # compiles
    start = time.perf_counter()
    table = branching_table(variance, host, resolution_msun, BRANCHING["pch08"], 1.197, np.ones_like)
    table_seconds = time.perf_counter() - start
    return {"table_seconds": table_seconds, **timed(lambda: grow_tree(table, *clocks, rng), repeats)}


def timed(work: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median time [s] of a call after the first, and peak memory [MiB] of this process."""
    work()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    unit = 2**20 if sys.platform == "darwin" else 2**10  # of ru_maxrss in a MiB
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    return {"seconds": statistics.median(seconds), "peak_rss_mib": peak}


def main() -> None:
    """Run all cases, print a table, write the numbers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path, help="file to write")
    parser.add_argument("--repeats", type=int, default=21, help="calls of which the median is taken")
    arguments = parser.parse_args()

    repeats = arguments.repeats
    cases: list[tuple[str, Callable[..., dict[str, float]], tuple[float, ...]]] = [
        ("realization, 10^13.25, 5 keV, > 1e7 Msun", realization, (13.25, 5.0, 1e7, repeats)),
        *(
            (f"tree, 10^13, cold, > {share:.0e} of it", cold_tree, (13.0, share * 1e13, repeats))
            for share in RESOLUTIONS
        ),
        *((f"tree, 10^{host:g}, cold, > 1e7 Msun", cold_tree, (host, 1e7, repeats)) for host in HOSTS),
    ]
    context = multiprocessing.get_context("spawn")
    results = []
    for _, run, parameters in track(cases, "cases", console=Console(stderr=True)):
        with context.Pool(1) as pool:
            results.append(pool.apply(run, parameters))

    table = Table("case", "seconds", "table s", "peak MiB", title=f"median of {repeats}, one core")
    for (name, _, _), result in zip(cases, results, strict=True):
        table_seconds = f"{result['table_seconds']:.4f}" if "table_seconds" in result else ""
        table.add_row(name, f"{result['seconds']:.4f}", table_seconds, f"{result['peak_rss_mib']:.0f}")
    Console().print(table)

    trees = [
        {"log10_host": parameters[0], "resolution_msun": parameters[1], **result}
        for (_, _, parameters), result in zip(cases[1:], results[1:], strict=True)
    ]
    by_resolution, by_host = trees[: len(RESOLUTIONS)], trees[len(RESOLUTIONS) :]
    report: dict[str, Any] = {
        "seconds_per_realization": results[0]["seconds"],
        "peak_rss_mib": results[0]["peak_rss_mib"],
        "repeats": repeats,
        "tree_seconds": {
            f"{share:.0e}": tree["seconds"] for share, tree in zip(RESOLUTIONS, by_resolution, strict=True)
        },
        "trees_by_resolution": by_resolution,
        "trees_by_host": by_host,
    }
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
