"""Command lines that the pages and their errors name."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from warmlens.artifacts import Artifact, ArtifactError, open_artifact
from warmlens.config import Config
from warmlens.layout import CONFIG, EXCLUSION_NUMBERS
from warmlens.status import read_campaign


def read_inferred(results: Path) -> Config:
    """Configuration of a campaign that has a posterior.

    Raises
    ------
    ArtifactError
        For a campaign on a grid.
    """
    config = read_campaign(results)
    if config.campaign.design == "grid":
        raise ArtifactError(f"{results}: a campaign on a grid has no posterior to show; see {EXCLUSION_NUMBERS}")
    return config


def recorded_results(results: Path) -> Path:
    """Results folder as the configuration names it, from the folder that Snakemake runs in."""
    return Path(json.loads((results / CONFIG).read_text())["results"])


def snakemake_command(results: Path, *names: str) -> str:
    """What makes the campaign of a results folder, or some of its files, with the configuration of its last run.

    Parameters
    ----------
    results
        Results folder with the configuration in it.
    names
        Paths under it; the whole campaign unless given.
    """
    root = recorded_results(results)
    words = ["snakemake", "--cores", "all", "--workflow-profile", "workflow/profiles/local"]
    words += ["--configfile", str(root / CONFIG)]
    words += ["--", *(str(root / name) for name in names)] if names else []
    return shlex.join(words)


@contextmanager
def open_of_campaign(results: Path, name: str, stage: str) -> Iterator[Artifact]:
    """Open an artifact of a campaign.

    Raises
    ------
    ArtifactError
        If it is missing, with the command that makes it.
    """
    path = results / name
    if not path.exists():
        raise ArtifactError(f"{path}: no such artifact; make it with: {snakemake_command(results, name)}")
    with open_artifact(path, stage) as artifact:
        yield artifact
