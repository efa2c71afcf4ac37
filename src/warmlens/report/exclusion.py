"""`warmlens result` of a campaign on a grid: which halo masses are excluded."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from warmlens.artifacts.names import CONFIG, EXCLUSION_NUMBERS, EXCLUSION_TABLE, SINGLE
from warmlens.campaign.answer import open_answer
from warmlens.config.file import read_stored
from warmlens.report.result import nearest_line, print_verdict
from warmlens.text import Terminal


def is_grid(results: Path) -> bool:
    """Return whether the campaign of a results folder was run on a grid."""
    path = results / CONFIG
    return path.is_file() and read_stored(path).campaign.design == "grid"


def print_exclusion(results: Path) -> None:
    """Print warnings, which halo masses are excluded, the evidence for it, and where to look."""
    path = results / SINGLE["exclusion"]
    with open_answer(results, "exclusion") as artifact:
        meta = artifact.metadata
    console = Terminal()
    print_verdict(console, meta)
    console.print(meta["statement"], style="bold", markup=False)
    for line in [
        *exclusion_lines(meta),
        f"nodes:        {path} and {results / EXCLUSION_TABLE}",
        f"all numbers:  {results / EXCLUSION_NUMBERS}",
    ]:
        console.print(line, markup=False)


def exclusion_lines(meta: Mapping[str, Any]) -> list[str]:
    """Return the evidence for the statement, one line per halo mass."""
    lines = [
        f"{meta['n_accepted']} of {meta['n_samples']} samples on the grid accepted; a grid is no draw from the "
        "prior and gives no bound on the relic mass"
    ]
    for node in meta["halo_masses"]:
        low, high = node["probability_interval"]
        ratio_low, ratio_high = node["ratio_interval"]
        verdict = f"; EXCLUDED at {node['excluded_at']:.1%}" if node["excluded"] else ""
        lines.append(
            f"10^{node['log10_m_halo_msun']:g} Msun: {node['n_accepted']} of {node['n_samples']} accepted, "
            f"posterior {node['probability']:.1%} [{low:.1%}, {high:.1%}], the prior alone "
            f"{node['prior_probability']:.1%}; likelihood {node['ratio']:.2f} [{ratio_low:.2f}, {ratio_high:.2f}] "
            f"of the best{verdict}"
        )
    return [
        *lines,
        f"intervals hold the counting error at {100 * meta['confidence']:g}%; an exclusion needs their upper ends",
        nearest_line(meta),
    ]
