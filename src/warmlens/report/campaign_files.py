"""Opening what a page is made of; what is missing is named with the command that makes it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from warmlens.artifacts.file import Artifact, ArtifactError, open_artifact
from warmlens.artifacts.names import CONFIG, EXCLUSION_NUMBERS
from warmlens.campaign.snakemake import remaking_command
from warmlens.campaign.status import read_campaign
from warmlens.config.digest import settings_digest
from warmlens.config.model import Config
from warmlens.stage_table import stage_digests


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


@contextmanager
def open_of_campaign(results: Path, name: str, stage: str) -> Iterator[Artifact]:
    """Open an artifact of a campaign.

    Raises
    ------
    ArtifactError
        If it is missing or was made with other settings than the campaign now has, and how to make it.
    """
    path = results / name
    if not path.exists():
        raise ArtifactError(f"{path}: no such artifact; make it with: {remaking_command(results, name)}")
    with open_artifact(path, stage) as artifact:
        if settings_digest(artifact.settings) != stage_digests(read_campaign(results))[stage]:
            raise ArtifactError(
                f"{path}: made with other settings than those of {CONFIG}, or an older version of its stage; "
                f"make it anew with: {remaking_command(results, name)}"
            )
        yield artifact
