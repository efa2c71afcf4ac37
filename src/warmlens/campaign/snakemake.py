"""Command lines of Snakemake, for `campaign.run` and for messages."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from warmlens.artifacts.names import CONFIG

PROFILE = "workflow/profiles/local"
SNAKEMAKE = str(Path(sys.executable).parent / "snakemake")


def arguments(cores: int | str | None, overlays: Sequence[Path], extra: Sequence[str] = ()) -> list[str]:
    """Return the arguments of Snakemake for config.yaml and overlays.

    Parameters
    ----------
    cores
        Jobs at a time, or "all"; None if a profile among `extra` sets them.
    overlays
        Configuration files, later ones win.
    extra
        Targets and flags as they are; a profile among them wins.
    """
    size = [] if cores is None else ["--cores", str(cores)]
    words = [*size, "--workflow-profile", PROFILE, *extra]
    return [*words, "--configfile", *map(str, overlays)] if overlays else words


def snakemake_command(overlays: Sequence[Path], cores: int | str = "all") -> str:
    """Return the command line of a campaign, for people to type."""
    return shlex.join(["snakemake", *arguments(cores, overlays)])


def recorded_results(results: Path) -> Path:
    """Return the results folder as its configuration names it, from the folder that Snakemake runs in."""
    return Path(json.loads((results / CONFIG).read_text(encoding="utf-8"))["results"])


def remaking_command(results: Path, *names: str) -> str:
    """Return the command that makes a campaign, or some files below its folder, with its last configuration."""
    root = recorded_results(results)
    command = snakemake_command([root / CONFIG])  # as the workflow calls them
    return " ".join([command, "--", shlex.join(str(root / name) for name in names)]) if names else command
