"""Settings of the stages as files that their jobs read."""

from __future__ import annotations

import json
from pathlib import Path

from warmlens.artifacts.file import atomic_path
from warmlens.artifacts.names import SETTINGS
from warmlens.config.digest import canonical_json
from warmlens.config.file import parse_block
from warmlens.config.model import Config
from warmlens.config.types import ConfigError
from warmlens.stage_table import STAGES, StageSettings, campaign_stages, stage_settings


def write_settings(config: Config) -> None:
    """Write the settings of every stage of a campaign into its results folder."""
    for name in campaign_stages(config):
        with atomic_path(Path(config.results) / SETTINGS.format(stage=name)) as temporary:
            temporary.write_text(canonical_json(stage_settings(config, name).as_dict()) + "\n", encoding="utf-8")


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
