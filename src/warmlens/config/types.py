"""Types that the blocks of the configuration share: ranges of numbers, names, paths, and the block itself."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from itertools import pairwise
from pathlib import PurePath
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
)

MAX_IN_FILE_NAMES = 9_999_999  # samples and positions: names of chunks and shards have seven digits
MAX_PORTIONS = 10_000  # chunks or shards: Snakemake needs hours for more
FileNumber = Annotated[int, Field(ge=1, le=MAX_IN_FILE_NAMES)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Negative = Annotated[float, Field(lt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Point = tuple[Finite, Finite]
# a part of paths: no dot or dash in front
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_+][A-Za-z0-9_.+-]*$", max_length=64)]


class ConfigError(ValueError):
    """Problems of a configuration, one line each; every line begins with the key."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = list(problems)
        super().__init__("\n".join(self.problems))


def _band_name(name: str) -> str:
    if name in _RESERVED_NAMES:
        raise ValueError(f"{name!r} is the name of other groups in artifacts; give the band another name")
    return name


_RESERVED_NAMES = (
    *("combined", "deflection", "pair_counts", "parameters", "positions", "quasars", "raster", "rays"),
    *("residuals", "samples", "sensitivity", "separation", "thresholds", "truth"),
)
BandName = Annotated[Name, AfterValidator(_band_name)]


def plain_path(text: str) -> str:
    """Refuse a path that Snakemake or a shell would misread."""
    if not text.strip():
        raise ValueError("an empty path")
    if not text.isprintable():
        raise ValueError(f"{text!r} holds characters that cannot be printed; rename the file or folder")
    if "{" in text or "}" in text:
        raise ValueError(f"{text!r} holds braces, which Snakemake takes for wildcards; rename the file or folder")
    return text


def _results_folder(text: str) -> str:
    path = PurePath(plain_path(text))
    if ".." in path.parts or path == PurePath(path.anchor) or text.startswith(("~", "-", "//")):
        raise ValueError(
            f"must be a folder of its own: within the working folder, or an absolute path; without '..', '~' or a "
            f"dash in front; got {text!r}"
        )
    return str(path)  # one spelling of it: Snakemake compares texts


ResultsFolder = Annotated[str, AfterValidator(_results_folder)]


def _model_kwargs(kwargs: dict[str, Any]) -> dict[str, Any]:
    """Accept numbers and lists of numbers, as lenstronomy's models do."""
    pending = list(kwargs.items())
    while pending:
        key, value = pending.pop()
        if isinstance(value, list | tuple):
            pending += [(key, element) for element in value]
        elif isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _LARGEST:
            raise ValueError(f"{key} must be a finite number, or a list of these, got {value!r}")
    return kwargs


_LARGEST = 1e100
ModelKwargs = Annotated[dict[str, Any], AfterValidator(_model_kwargs)]


def _interval(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise ValueError(f"the lower end {value[0]:g} must be below the upper end {value[1]:g}")
    return value


Interval = Annotated[tuple[Finite, Finite], AfterValidator(_interval)]


def _ascending(values: list[float]) -> list[float]:
    if any(low >= high for low, high in pairwise(values)):
        raise ValueError(f"must rise from value to value, got {values}")
    return values


Ascending = AfterValidator(_ascending)


class Block(BaseModel):
    """A frozen mapping with a fixed set of keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, ser_json_inf_nan="constants")

    @field_validator("*", mode="before")
    @classmethod
    def _reject_booleans(cls, value: object, info: ValidationInfo) -> object:
        """Reject booleans where a number is expected (pydantic reads `true` as 1)."""
        assert info.field_name is not None
        if cls.model_fields[info.field_name].annotation is not bool and _holds_boolean(value):
            raise ValueError(f"{reprlib.repr(value)} holds a truth value, expected something else")
        return value


def _holds_boolean(value: object) -> bool:
    return isinstance(value, bool) or (isinstance(value, list | tuple) and any(map(_holds_boolean, value)))


def same_length(name: str, first: Sequence[object], other: str, second: Sequence[object]) -> None:
    """Refuse two lists that describe the same things and differ in length."""
    if len(first) != len(second):
        raise ValueError(f"{name} has {len(first)} entries, {other} has {len(second)}; they must match")
