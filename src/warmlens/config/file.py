"""Read config.yaml and its overlays; report every problem in one line."""

from __future__ import annotations

import difflib
import json
import os
import reprlib
import string
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from warmlens.config.model import Config
from warmlens.config.plausible import questions, usual_at
from warmlens.config.reference import BAND, keys
from warmlens.config.types import Block, ConfigError, plain_path
from warmlens.config.yaml import read_yaml

AnyBlock = TypeVar("AnyBlock", bound=Block)


def parse_config(raw: Mapping[str, Any]) -> Config:
    """Validate a mapping; raise `ConfigError` with one line per problem, each naming key, value and range.

    Numbers outside their usual range are problems too, unless `unusual` lists their keys.
    """
    config = parse_block(Config, raw)
    asked = dict(questions(config))
    if problems := _unknown_keys(config.unusual) + [asked[key] for key in asked if key not in config.unusual]:
        raise ConfigError(problems)
    return config


def _unknown_keys(named: Sequence[str]) -> list[str]:
    """Return a line per name that is no key."""
    known = [".".join(key.path) for key in keys()]
    problems = []
    for name in named:
        if any(_matches(key.path, name.split(".")) for key in keys()):
            continue
        nearest = difflib.get_close_matches(name, known, n=1)
        problems.append(
            f"unusual: {name!r} is no key; " + (f"did you mean {nearest[0]}?" if nearest else "remove it")
        )
    return problems


def _matches(path: Sequence[str], parts: Sequence[str]) -> bool:
    same = (part in (named, BAND) for part, named in zip(path, parts, strict=False))
    return len(path) == len(parts) and all(same)


def parse_block(kind: type[AnyBlock], raw: Mapping[str, Any]) -> AnyBlock:
    """Validate a mapping as a block of the configuration; raise `ConfigError` as `parse_config` does."""
    try:
        return kind.model_validate(dict(raw))
    except ValidationError as error:
        raise ConfigError([_problem(kind, details) for details in error.errors()]) from None


def _problem(kind: type[Block], details: ErrorDetails) -> str:
    key = ".".join(str(part) for part in details["loc"]) or "config"
    match details["type"]:
        case "extra_forbidden":
            return f"{key}: unknown key; {_remedy(details['loc'])}"
        case "missing":
            return f"{key}: missing; config.yaml shows an example"
        case "value_error":
            return f"{key}: {details['ctx']['error']}"
    usual = usual_at(kind, details["loc"])
    meant = usual.suggestion(details["input"]) if usual else ""
    return f"{key}: {details['msg'][:1].lower()}{details['msg'][1:]}, got {reprlib.repr(details['input'])}{meant}"


def _remedy(location: tuple[int | str, ...]) -> str:
    """Suggest the nearest key of the same block, or the blocks that have this key."""
    *parents, name = map(str, location)
    siblings = [
        key.path[-1]
        for key in keys()
        if len(key.path) == len(location)
        and all(part in (parent, BAND) for part, parent in zip(key.path, parents, strict=False))
    ]
    if nearest := difflib.get_close_matches(name, siblings, n=1):
        return f"did you mean {nearest[0]}?"
    if blocks := [".".join(key.path[:-1]) for key in keys() if key.path[-1] == name]:
        return "it belongs " + " or ".join(f"under {block}" if block else "at the top level" for block in blocks)
    return "remove it or correct its spelling (config.yaml lists all keys)"


def load_config(paths: Sequence[Path]) -> Config:
    """Read config.yaml and overlays (later files win, mappings are merged, lists replaced); validate."""
    merged: dict[str, Any] = {}
    for path in paths:
        merged = merge(merged, read_yaml(path))
    return parse_config(merged)


def read_stored(path: Path) -> Config:
    """Read the configuration that a campaign left in its results folder, as JSON."""
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError([f"{path}: not readable as JSON ({error}); start the campaign again"]) from None
    if not isinstance(raw, dict):
        raise ConfigError([f"{path}: expected a JSON object, found {type(raw).__name__}"])
    return parse_block(Config, raw)  # its numbers were accepted when the campaign was started


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
    except (ValueError, RuntimeError) as error:  # RuntimeError: ~ of an unknown user
        raise ConfigError([f"{text!r}: {error}"]) from None
