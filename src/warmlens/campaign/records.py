"""Snakemake's records of how it made a file."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping
from pathlib import Path

from warmlens.artifacts.chain import Chain
from warmlens.artifacts.file import ArtifactError

_METADATA = Path(".snakemake/metadata")


def check_unrecorded(
    expected_files: Mapping[Path, str], expected_settings: Mapping[str, str], folder: Path
) -> None:
    """Check the settings of the artifacts that the Snakemake of a working folder has no record of.

    Without a record in `.snakemake`, Snakemake takes an artifact as finished, whatever its settings were.

    Raises
    ------
    ArtifactError
        Naming those with other settings than the campaign has, or that cannot be read, and what to do.
    """
    chain, stale = Chain(expected_settings), []
    for path in expected_files:
        if path.exists() and not is_recorded(folder, path):
            for finding in chain.compare(path).findings:
                if finding.kind == "damaged":
                    raise finding.to_error()
                if finding.kind == "settings":
                    stale.append(path)
    if stale:
        raise ArtifactError(
            f"{len(stale)} artifacts were made with other settings or an older version of their stage, and "
            f"Snakemake has no record of them in {(folder / '.snakemake').resolve()}: it would take them as they "
            f"are; delete them and run the campaign again: {' '.join(map(str, stale))}"
        )


def is_recorded(folder: Path, output: Path) -> bool:
    """Return whether the Snakemake of a working folder has a record of how it made a file of a rule."""
    name = base64.urlsafe_b64encode(str(output).encode()).decode()
    length = os.pathconf(folder, "PC_NAME_MAX") - 1  # longer ones are split into folders
    *above, last = (name[i : i + length] for i in range(0, len(name), length))
    return (folder / _METADATA).joinpath(*(f"@{part}" for part in above), last).exists()
