"""What came out of a finished grid campaign, in words."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import (
    CONFIG,
    EXCLUSION_NUMBERS,
    EXCLUSION_TABLE,
    SINGLE,
)
from warmlens.config.file import read_stored


def is_grid(results: Path) -> bool:
    """Whether the campaign of a results folder was run on a grid."""
    path = results / CONFIG
    return path.is_file() and read_stored(path).campaign.design == "grid"


def print_exclusion(results: Path) -> None:
    """Print warnings, which halo masses are excluded, what that rests on, and where to look."""
    path = results / SINGLE["exclusion"]
    with open_artifact(path, "exclusion") as artifact:
        meta = artifact.metadata
    console = Console(highlight=False, soft_wrap=True)
    for warning in meta["warnings"]:
        console.print(f"[bold red]WARNING[/] {escape(warning)}")
    console.print(f"[bold]{escape(meta['statement'])}[/]")
    for line in exclusion_lines(meta):
        console.print(line, markup=False)
    console.print(f"nodes:        {path} and {results / EXCLUSION_TABLE}")
    console.print(f"all numbers:  {results / EXCLUSION_NUMBERS}")


def exclusion_lines(meta: Mapping[str, Any]) -> list[str]:
    """What the statement rests on, a line each."""
    confidence = f"{100 * meta['confidence']:g}%"
    lines = [
        f"{meta['n_accepted']} of {meta['n_samples']} samples on the grid accepted; a grid is no draw from the "
        "prior and gives no bound on the relic mass"
    ]
    for item in meta["halo_masses"]:
        low, high = item["probability_interval"]
        ratio = item["ratio_interval"]
        verdict = f"; EXCLUDED at {item['excluded_at']:.1%}" if item["excluded"] else ""
        lines.append(
            f"10^{item['log10_m_halo_msun']:g} Msun: {item['n_accepted']} of {item['n_samples']} accepted, "
            f"posterior {item['probability']:.1%} [{low:.1%}, {high:.1%}], the prior alone "
            f"{item['prior_probability']:.1%}; likelihood {item['ratio']:.2f} [{ratio[0]:.2f}, {ratio[1]:.2f}] of "
            f"the best{verdict}"
        )
    lines.append(f"intervals hold the counting error at {confidence}; an exclusion needs their upper ends")
    near = ", ".join(f"{value:.0f}% ({kind})" for kind, value in meta["nearest_neighbour_percentile"].items())
    lines.append(f"in the cloud: the nearest sample is farther than those of {near} of the samples")
    return lines
