"""What the jobs of the stages read beside artifacts: files of settings, and lists of inputs."""

from __future__ import annotations

import json
from pathlib import Path

from warmlens.artifacts.atomic import atomic_path
from warmlens.artifacts.names import FILES, SETTINGS
from warmlens.campaign.files import stage_files
from warmlens.config.digest import canonical_json
from warmlens.config.file import parse_block
from warmlens.config.model import Config
from warmlens.config.types import ConfigError
from warmlens.stage_table import STAGES, StageSettings, campaign_stages, stage_settings

LISTED = {
    name: source for row in STAGES.values() for name, source in row.inputs.items() if row.reads_all_of(source)
}


def write_settings(config: Config) -> None:
    """Write the settings of every stage, and lists of the artifacts that are read together, to the results folder.

    A campaign may have thousands of chunks, and the shell takes 128 KiB of arguments.
    """
    for name in campaign_stages(config):
        _write(config, SETTINGS.format(stage=name), canonical_json(stage_settings(config, name).as_dict()))
        if name in LISTED.values():
            paths = [str(path) for path in stage_files(config, name)]
            _write(config, FILES.format(stage=name), json.dumps(paths, indent=0))


def _write(config: Config, name: str, text: str) -> None:
    with atomic_path(Path(config.results) / name) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def read_paths(text: str) -> list[Path]:
    """Return the path that `text` is, or, of @FILE, the paths that the JSON list in the file holds.

    Raises
    ------
    ConfigError
        If there is no such file, or it does not hold a list of texts.
    """
    if not text.startswith("@"):
        return [Path(text)]
    try:
        paths = json.loads(Path(text[1:]).read_text(encoding="utf-8"))
        if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
            raise ValueError("expected a JSON list of paths")
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError([f"{text}: no list of files ({error}); a start of the campaign writes it"]) from None
    return [Path(path) for path in paths]


def read_settings(name: str, source: str) -> StageSettings:
    """Read the settings of a stage from a JSON file, or from JSON itself.

    Raises
    ------
    ConfigError
        If there is no such stage or file, or it does not hold the settings of this stage.
    """
    if name not in STAGES:
        raise ConfigError([f"{name}: no stage of this name; stages are {', '.join(STAGES)}"])
    try:
        raw = json.loads(source if source.lstrip().startswith("{") else Path(source).read_text(encoding="utf-8"))
        if not isinstance(raw, dict):
            raise ValueError(f"expected a JSON object, found {type(raw).__name__}")
    except (OSError, ValueError, RecursionError) as error:
        remedy = f"`warmlens params {name} > FILE` writes the settings of this stage"
        raise ConfigError([f"{source}: not readable as JSON ({error}); {remedy}"]) from None
    version = STAGES[name].version
    if (given := raw.setdefault("stage_version", version)) != version:
        raise ConfigError(
            [f"{source}: stage_version is {given}, the code of {name} has {version}; write it again"]
        )
    return parse_block(STAGES[name].settings, raw)
