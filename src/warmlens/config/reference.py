"""docs/configuration.md from the typed configuration and the comments of config.yaml.

Types and ranges come from the models in `warmlens.config.model`, values and explanations from config.yaml, so that
nothing is written twice. A comment belongs to the key on its line; lines of comment alone go on with it. A key
that config.yaml leaves out is explained there as a comment in its place: `# key: value   # explanation`. A block
without a comment has the docstring of its model.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import yaml

from warmlens.config.model import Config

Path = tuple[str, ...]

_KEY = re.compile(r"(?P<indent> *)(?P<off># *)?(?P<item>- )?(?P<key>[A-Za-z_]\w*):(?P<rest>.*)")
_COMMENT = re.compile(r"(?P<before>.*?)(?:^|\s)# ?(?P<text>.*)")
_CONTINUED_FROM = 20  # column: a comment that begins farther left is a key that is switched off, or a heading
_LONGEST_VALUE = 44
_LARGE = 1.0e5  # written with an exponent
BAND = "BAND"  # stands for the names of bands
HEADER = """# Configuration

Made by `make docs` from the types in `src/warmlens/config` and the comments in `config.yaml`; do not edit.
`config.yaml` is read first, overlays change single keys: mappings are merged, lists are replaced whole.
`warmlens validate --configfile mine.yaml` checks a configuration. Angles in arcsec, masses in Msun without h,
fluxes in e-/s; positions in the frame x = West, y = North. `BAND` stands for the name of a band.
"""


@dataclass(frozen=True)
class Key:
    """One key of the configuration.

    Attributes
    ----------
    path
        From the top, bands as `BAND`.
    owner
        Name of the block's model, and of the key in it; keys of equal owner are explained once.
    kind
        Type, range and choices in words.
    default
        Value if it is neither in config.yaml nor an overlay, as text; None if it has to be given.
    is_block
        Whether other keys lie below.
    about
        What the code says of a block; empty for other keys, which config.yaml explains.
    """

    path: Path
    owner: tuple[str, str]
    kind: str
    default: str | None
    is_block: bool
    about: str


def comments(text: str) -> dict[Path, str]:
    """Explanation of every key of a YAML text that has one, keys that are switched off by a `#` included."""
    found: dict[Path, str] = {}
    stack: list[tuple[int, str]] = []
    path: Path = ()
    for line in text.splitlines():
        start = len(line) - len(line.lstrip())
        if line.lstrip().startswith("#") and start >= _CONTINUED_FROM:
            found[path] = f"{found.get(path, '')} {line.strip('# ')}".strip()
            continue
        match = _KEY.fullmatch(line)
        if match is None or match["item"] or "{" in line[:start]:
            continue
        indent = len(match["indent"]) + max(len(match["off"] or "") - 2, 0)
        stack = [(depth, key) for depth, key in stack if depth < indent] + [(indent, match["key"])]
        path = tuple(key for _, key in stack)
        comment = _COMMENT.fullmatch(match["rest"])
        if comment is not None and path not in found:
            found[path] = comment["text"].strip()
    return found


def keys() -> list[Key]:
    """All keys of the configuration, in the order of the models."""
    schema = Config.model_json_schema()
    return list(_below(schema, schema["$defs"], (), "Config"))


def _below(block: Mapping[str, Any], models: Mapping[str, Any], above: Path, name: str) -> Iterator[Key]:
    required = block.get("required", [])
    for key, node in block["properties"].items():
        path = (*above, key)
        children = list(_blocks(node))
        default = None if key in required else json.dumps(node.get("default"))
        about = models[children[0][0]]["description"].splitlines()[0] if children else ""
        yield Key(path, (name, key), _words(node), default, bool(children), about)
        for model, of_bands in children:
            yield from _below(models[model], models, (*path, BAND) if of_bands else path, model)


def _blocks(node: Mapping[str, Any]) -> Iterator[tuple[str, bool]]:
    """Models that a key holds, and whether by band."""
    if "$ref" in node:
        yield _model(node), False
    for option in node.get("anyOf", []):
        yield from _blocks(option)
    if "$ref" in _of_bands(node):
        yield _model(_of_bands(node)), True


def _model(node: Mapping[str, Any]) -> str:
    return node["$ref"].rpartition("/")[2]


def _of_bands(node: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a mapping by band holds; empty for any other key."""
    return next(iter(node.get("patternProperties", {}).values()), {})


def _words(node: Mapping[str, Any]) -> str:
    """Type, range and choices of a key."""
    if "anyOf" in node:
        return " or ".join(_words(option) for option in node["anyOf"])
    if "enum" in node or "const" in node:
        return " \\| ".join(f"`{choice}`" for choice in node.get("enum", [node.get("const")]))
    if "$ref" in node:
        return "block"
    match node.get("type"):
        case "null":
            return "`null`"
        case "boolean":
            return "`true` \\| `false`"
        case "string":
            return "text"
        case "integer" | "number" as kind:
            return kind + _range(node)
        case "array" if "prefixItems" in node:
            return f"[{', '.join(_words(item) for item in node['prefixItems'])}]"
        case "array":
            return f"list of {_words(node['items'])}"
        case "object" if _of_bands(node):
            return f"a {_words(_of_bands(node))} for each band"
        case "object":
            values = node.get("additionalProperties")
            return f"mapping to {_words(values)}" if isinstance(values, dict) else "mapping"
    return "any"


def _range(node: Mapping[str, Any]) -> str:
    signs = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
    limits = [f"{sign} {node[name]:g}" for name, sign in signs.items() if name in node]
    return f" {', '.join(limits)}" if limits else ""


def explanations(text: str) -> dict[Path, str]:
    """Explanation of every key that config.yaml or an equal block in it explains.

    Raises
    ------
    ValueError
        If config.yaml explains a key that does not exist.
    """
    known = {key.path: key for key in keys()}
    bands = {path[: path.index(BAND)] for path in known if BAND in path}
    found: dict[Path, str] = {}
    for path, comment in comments(text).items():
        plain = tuple(BAND if path[:i] in bands else part for i, part in enumerate(path))
        if plain in known:
            found.setdefault(plain, comment)
        elif plain[-1] != BAND and not _is_free(plain, known):
            raise ValueError(f"config.yaml explains {'.'.join(path)}, which is no key")
    by_owner = {known[path].owner: comment for path, comment in reversed(found.items())}
    return {path: found.get(path, by_owner.get(key.owner, key.about)) for path, key in known.items()}


def _is_free(path: Path, known: Mapping[Path, Key]) -> bool:
    """Whether a path lies inside a value that is no block, such as lenstronomy's keyword arguments."""
    return any(above in known and not known[above].is_block for above in (path[:i] for i in range(1, len(path))))


def missing(text: str) -> list[str]:
    """Keys without an explanation in config.yaml."""
    return [".".join(path) for path, comment in explanations(text).items() if not comment]


def reference(text: str) -> str:
    """The document, from the text of config.yaml.

    Raises
    ------
    ValueError
        Naming keys that config.yaml does not explain, or explains without their being keys.
    """
    unexplained = missing(text)
    if unexplained:
        raise ValueError(f"config.yaml has no comment on {', '.join(unexplained)}; add one to each")
    explained, values = explanations(text), yaml.safe_load(text)
    parts = [HEADER]
    for key in keys():
        name = ".".join(key.path[1:])
        if not name:
            parts.append(f"\n## {key.path[0]}\n\n{_sentence(explained[key.path])}\n")
            if not key.is_block:
                parts.append(f"\nType: {key.kind}. In config.yaml: {_value(key, values)}.\n")
                continue
            parts.append("\n| key | type | in config.yaml | meaning |\n| --- | --- | --- | --- |\n")
            continue
        cells = (f"`{name}`", key.kind, _value(key, values), explained[key.path].replace("|", "\\|"))
        parts.append(f"| {' | '.join(cells)} |\n")
    return "".join(parts)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _value(key: Key, values: Any) -> str:
    """What config.yaml has for a key, as text; the default of the code where it has nothing."""
    for part in key.path:
        if part == BAND and isinstance(values, dict) and values:
            values = next(iter(values.values()))
        elif isinstance(values, dict) and part in values:
            values = values[part]
        else:
            return "not given" if key.default in (None, "null") else f"not given: `{key.default}`"
    if key.is_block and values is not None:
        return ""
    large = isinstance(values, float) and values >= _LARGE
    shown = f"{values:.6g}" if large else json.dumps(values)
    return f"`{shown}`" if len(shown) <= _LONGEST_VALUE else "see there"
