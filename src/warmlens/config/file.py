"""Reading config.yaml and its overlays, with one clear line for every problem."""

from __future__ import annotations

import json
import os
import reprlib
import string
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from warmlens.config.model import Config
from warmlens.config.types import Block, ConfigError, plain_path
from warmlens.config.yaml import read_yaml

AnyBlock = TypeVar("AnyBlock", bound=Block)


def parse_config(raw: Mapping[str, Any]) -> Config:
    """Validate a mapping; raise `ConfigError` with one line per problem, each naming key, value and range."""
    return parse_block(Config, raw)


def parse_block(kind: type[AnyBlock], raw: Mapping[str, Any]) -> AnyBlock:
    """Validate a mapping as a block of the configuration; raise `ConfigError` as `parse_config` does."""
    try:
        return kind.model_validate(dict(raw))
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
    return f"{key}: {_lower(item['msg'])}, got {reprlib.repr(item['input'])}"


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]


def load_config(paths: Sequence[Path]) -> Config:
    """Read config.yaml and overlays (later files win, mappings are merged, lists replaced); validate."""
    merged: dict[str, Any] = {}
    for path in paths:
        merged = merge(merged, read_yaml(path))
    return parse_config(merged)


def read_stored(path: Path) -> Config:
    """Read the configuration that a campaign left in its results folder, as JSON."""
    try:
        raw = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError([f"{path}: not readable as JSON ({error}); start the campaign again"]) from None
    if not isinstance(raw, dict):
        raise ConfigError([f"{path}: expected a JSON object, found {type(raw).__name__}"])
    return parse_config(raw)


def merge(base: Mapping[str, Any], layer: Mapping[str, Any]) -> dict[str, Any]:
    """Lay `layer` over `base`: mappings are merged, everything else is replaced."""
    merged = dict(base)
    for key, value in layer.items():
        both_maps = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = merge(merged[key], value) if both_maps else value
    return merged


def expand_path(text: str) -> Path:
    """Replace environment variables in a path of the configuration; an unset variable is an error."""
    try:
        expanded = string.Template(text).substitute(os.environ)
    except KeyError as error:
        variable = error.args[0]
        raise ConfigError(
            [f"{text}: the environment variable {variable} is not set; set it to the folder with the data"]
        ) from None
    except ValueError as error:
        raise ConfigError([f"{text}: {error}; write $NAME or ${{NAME}}, and $$ for a dollar sign"]) from None
    try:
        return Path(plain_path(expanded)).expanduser()
    except (ValueError, RuntimeError) as error:  # RuntimeError: ~ of a user who is not known
        raise ConfigError([f"{text!r}: {error}"]) from None
