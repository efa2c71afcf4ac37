"""Read YAML as plain data; whatever YAML would guess, repeat or run is an error that names the line."""

from __future__ import annotations

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from warmlens.config.types import ConfigError

_MAX_BYTES = 2**18
_MAX_VALUES = 20_000  # aliases count as often as they are used
_MAX_DEPTH = 30
_TOO_DEEP = f"nested more than {_MAX_DEPTH} deep"
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9_]{0,39})")
_RUNS_CODE = "__use_yte__"  # Snakemake evaluates expressions in a file that has this key


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping that a YAML file holds: text, numbers, true, false, null, lists and mappings of these.

    Raises
    ------
    ConfigError
        If the file is missing, no YAML, or holds what is not plain data or ambiguous: tags, a key given twice,
        merge keys, dates, yes and no for true and false, octal or sexagesimal numbers.
    """
    if not path.exists():
        raise ConfigError([f"{path}: no such file"])
    if not path.is_file():
        raise ConfigError([f"{path}: not a file"])
    with path.open("rb") as handle:
        content = handle.read(_MAX_BYTES + 1)
    if len(content) > _MAX_BYTES:
        raise ConfigError([f"{path}: larger than {_MAX_BYTES // 1024} kB, which no configuration is"])
    try:
        layer = yaml.load(content.decode(), Loader=_PlainLoader)
        _check_extent(layer)
    except UnicodeDecodeError as error:
        raise ConfigError([f"{path}: not text in UTF-8 ({error})"]) from None
    except RecursionError:
        raise ConfigError([f"{path}: {_TOO_DEEP}"]) from None
    except yaml.YAMLError as error:
        raise ConfigError([f"{path}: not valid YAML: {' '.join(str(error).split())[:500]}"]) from None
    except ValueError as error:
        raise ConfigError([f"{path}: {error}"]) from None
    if not isinstance(layer, dict):
        raise ConfigError([f"{path}: expected a mapping of keys, found {type(layer).__name__}"])
    if _RUNS_CODE in layer:
        raise ConfigError([f"{path}: {_RUNS_CODE} is refused: Snakemake would run code that the file holds"])
    return layer


def _check_extent(value: Any) -> None:
    """Refuse data that aliases blow up: they cost nothing to load, but everything to walk through."""
    n_values = 0
    pending = [(value, 0)]
    while pending:
        node, depth = pending.pop()
        n_values += 1
        if n_values > _MAX_VALUES:
            raise ValueError(f"holds more than {_MAX_VALUES} values, counting what aliases repeat")
        if depth > _MAX_DEPTH:
            raise ValueError(_TOO_DEEP)
        children = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
        pending += [(child, depth + 1) for child in children]


class _PlainLoader(yaml.SafeLoader):
    """Safe loader of plain data that refuses what is ambiguous, and deep nesting, which is slow."""

    def fetch_flow_collection_start(self, TokenClass: type[yaml.Token]) -> None:
        if self.flow_level > _MAX_DEPTH:
            raise ValueError(_TOO_DEEP)
        super().fetch_flow_collection_start(TokenClass)

    def add_indent(self, column: int) -> bool:
        if len(self.indents) > _MAX_DEPTH:
            raise ValueError(_TOO_DEEP)
        return super().add_indent(column)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        mapping: dict[Hashable, Any] = {}
        for key_node, value_node in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                raise _refused(key_node, "merge keys (<<) are not read; write the keys out")
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise _refused(key_node, f"the key {key!r} is not text; put it in quotes if it is meant")
            if key in mapping:
                raise _refused(key_node, f"the key {key!r} is given twice; remove one")
            mapping[key] = self.construct_object(value_node, deep=deep)
        return mapping


def _refused(node: yaml.Node, reason: str) -> ValueError:
    return ValueError(f"line {node.start_mark.line + 1}: {reason}")


def _construct_boolean(_: _PlainLoader, node: yaml.ScalarNode) -> bool:
    if node.value.lower() not in ("true", "false"):
        raise _refused(node, f"{node.value} is a truth value to YAML; write true or false, or put it in quotes")
    return node.value.lower() == "true"


def _construct_integer(_: _PlainLoader, node: yaml.ScalarNode) -> int:
    if not _INTEGER.fullmatch(node.value):
        raise _refused(node, f"{node.value[:50]} is not a plain whole number; put it in quotes if it is text")
    return int(node.value)


def _construct_float(loader: _PlainLoader, node: yaml.ScalarNode) -> float:
    if ":" in node.value:
        raise _refused(node, f"{node.value[:50]} is not a plain number; put it in quotes if it is text")
    return loader.construct_yaml_float(node)


def _construct_other(_: _PlainLoader, node: yaml.Node) -> Any:
    what = "is a date to YAML; put it in quotes" if node.tag.endswith(":timestamp") else "is not read"
    raise _refused(node, f"{getattr(node, 'value', '')[:50]!r} ({node.tag}) {what}")


_PlainLoader.add_constructor("tag:yaml.org,2002:bool", _construct_boolean)
_PlainLoader.add_constructor("tag:yaml.org,2002:int", _construct_integer)
_PlainLoader.add_constructor("tag:yaml.org,2002:float", _construct_float)
for _kind in ("timestamp", "binary", "omap", "pairs", "set"):
    _PlainLoader.add_constructor(f"tag:yaml.org,2002:{_kind}", _construct_other)
