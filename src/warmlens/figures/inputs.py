"""Which artifacts each figure is drawn from, and where a campaign has them."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Artifact, open_artifact
from warmlens.campaign.answer import check_chain
from warmlens.campaign.derived import figure_inputs, needed_paths
from warmlens.campaign.snakemake import remaking_command
from warmlens.config.model import Config

log = logging.getLogger(__name__)

Inputs = Mapping[str, Path]

_PLANE = ("observed_scan", "smooth_model")  # of every campaign that Figs. 6 and 7 compare


def find_inputs(name: str, results: Sequence[Path]) -> dict[str, Path]:
    """Return the artifacts of a figure in results folders; Figs. 6 and 7 compare several, the others show one.

    Raises
    ------
    ArtifactError
        If one is missing, with the command that makes it, or was not made with the settings of its campaign.
    """
    from warmlens.campaign.status import read_campaign

    if name in ("6", "7"):
        compared: dict[str, Path] = {}
        for number, folder in enumerate(results):
            config = read_campaign(folder)
            inputs = needed_paths(config, (*_PLANE, "scans/*") if _shows_mocks(config, len(results)) else _PLANE)
            _check(inputs, folder, config)
            compared |= {f"{number}/{key}": path for key, path in inputs.items()}
        return compared
    if len(results) != 1:
        raise ArtifactError(f"figure {name} shows one campaign; give one --results, not {len(results)}")
    config = read_campaign(results[0])
    inputs = figure_inputs(config, name)
    _check(inputs, results[0], config)
    return inputs


def input_path(inputs: Inputs, key: str) -> Path:
    """Return the path of an input, or raise an error that says how it is given."""
    if key not in inputs:
        raise ArtifactError(
            f"the figure needs the artifact {key!r}; give --artifact {key}=PATH, or --results with the folder of "
            f"the campaign; given: {', '.join(inputs) or 'none'}"
        )
    return inputs[key]


def open_input(inputs: Inputs, stage: str) -> AbstractContextManager[Artifact]:
    """Open the one artifact of a stage that a figure needs."""
    return open_artifact(input_path(inputs, stage), stage)


def chunk_paths(inputs: Inputs, stage: str) -> list[Path]:
    """Return the paths of all chunks of a stage, in the order of their numbers."""
    keys = [key for key in inputs if key.startswith(f"{stage}/")]
    if not keys:
        return [input_path(inputs, f"{stage}/0")]
    return [inputs[key] for key in sorted(keys, key=lambda key: int(key.removeprefix(f"{stage}/")))]


def _shows_mocks(config: Config, n_campaigns: int) -> bool:
    """Return whether a plane shows mocks with the observation: of a single campaign with R_sens of mocks."""
    if n_campaigns > 1:
        return False
    if not config.scan.residual_samples:
        log.info("the observation alone is shown: R_sens of mocks needs their numbers in scan.residual_samples")
    return bool(config.scan.residual_samples)


def _check(inputs: Inputs, folder: Path, config: Config) -> None:
    missing = [path for path in inputs.values() if not path.exists()]
    if missing:
        name = str(missing[0].relative_to(folder))
        raise ArtifactError(
            f"{missing[0]}: no such artifact ({len(missing)} of {len(inputs)} are missing for this figure); make "
            f"it with: {remaking_command(folder, name)}"
        )
    check_chain(config, inputs.values())
