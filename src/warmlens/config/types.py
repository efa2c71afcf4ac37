"""Types that the blocks of the configuration share: ranges of numbers, intervals, a frozen mapping."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from pathlib import PurePath
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo, field_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Point = tuple[Finite, Finite]
# a part of paths: no dot or dash in front
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_+][A-Za-z0-9_.+-]*$", max_length=64)]


class ConfigError(ValueError):
    """Problems of a configuration, one line each, every line beginning with the key."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = list(problems)
        super().__init__("\n".join(self.problems))


def _band_name(name: str) -> str:
    if name in _BESIDE_BANDS:
        raise ValueError(f"{name!r} is what artifacts call something else; give the band another name")
    return name


_BESIDE_BANDS = (
    *("combined", "deflection", "pair_counts", "parameters", "positions", "quasars", "raster", "rays"),
    *("residuals", "samples", "sensitivity", "separation", "thresholds", "truth"),
)
BandName = Annotated[Name, AfterValidator(_band_name)]


def plain_path(text: str) -> str:
    """Refuse a path that Snakemake or a shell would take for something else."""
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
    """Numbers and lists of numbers, as lenstronomy's models take them."""
    pending = list(kwargs.items())
    while pending:
        key, value = pending.pop()
        if isinstance(value, list | tuple):
            pending += [(key, item) for item in value]
        elif isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _LARGEST:
            raise ValueError(f"{key} must be a finite number, or a list of these, got {value!r}")
    return kwargs


_LARGEST = 1e100
ModelKwargs = Annotated[dict[str, Any], AfterValidator(_model_kwargs)]


def _ascending(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise ValueError(f"the lower end {value[0]:g} must be below the upper end {value[1]:g}")
    return value


Interval = Annotated[tuple[Finite, Finite], AfterValidator(_ascending)]


class Block(BaseModel):
    """A frozen mapping that knows its keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, ser_json_inf_nan="constants")

    @field_validator("*", mode="before")
    @classmethod
    def _no_truth_for_a_number(cls, value: object, info: ValidationInfo) -> object:
        """Pydantic takes true for 1."""
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
