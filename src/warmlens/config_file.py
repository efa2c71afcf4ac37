"""Reading config.yaml and its overlays, with one clear line for every problem."""

from __future__ import annotations

import os
import string
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from warmlens.config import Config


class ConfigError(ValueError):
    """Problems of a configuration, one line each, every line beginning with the key."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = list(problems)
        super().__init__("\n".join(self.problems))


def parse_config(raw: Mapping[str, Any]) -> Config:
    """Validate a mapping; raise `ConfigError` with one line per problem, each naming key, value and range."""
    try:
        return Config.model_validate(dict(raw))
    except ValidationError as error:
        raise ConfigError([_problem(item) for item in error.errors()]) from None


def _problem(item: Mapping[str, Any]) -> str:
    key = ".".join(str(part) for part in item["loc"]) or "config"
    match item["type"]:
        case "extra_forbidden":
            return f"{key}: unknown key; remove it or correct its spelling (config.yaml lists all keys)"
        case "missing":
            return f"{key}: missing; config.yaml shows an example"
        case "value_error":
            return f"{key}: {item['ctx']['error']}"
    return f"{key}: {_lower(item['msg'])}, got {item['input']!r}"


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]


def load_config(paths: Sequence[Path]) -> Config:
    """Read config.yaml and overlays (later files win, mappings are merged, lists replaced); validate."""
    merged: dict[str, Any] = {}
    for path in paths:
        try:
            layer = yaml.safe_load(path.read_text())
        except FileNotFoundError:
            raise ConfigError([f"{path}: no such file"]) from None
        except yaml.YAMLError as error:
            raise ConfigError([f"{path}: not valid YAML: {' '.join(str(error).split())}"]) from None
        if not isinstance(layer, dict):
            raise ConfigError([f"{path}: expected a mapping of keys, found {type(layer).__name__}"])
        merged = _merge(merged, layer)
    return parse_config(merged)


def _merge(base: Mapping[str, Any], layer: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in layer.items():
        both_maps = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merge(merged[key], value) if both_maps else value
    return merged


def expand_path(text: str) -> Path:
    """Replace environment variables in a path of the configuration; an unset variable is an error."""
    try:
        return Path(string.Template(text).substitute(os.environ)).expanduser()
    except KeyError as error:
        variable = error.args[0]
        raise ConfigError(
            [f"{text}: the environment variable {variable} is not set; set it to the folder with the data"]
        ) from None
    except ValueError as error:
        raise ConfigError([f"{text}: {error}; write $NAME or ${{NAME}}"]) from None
