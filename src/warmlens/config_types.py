"""Types that the blocks of the configuration share: ranges of numbers, intervals, a frozen mapping."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Point = tuple[Finite, Finite]
BandName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.+-]+$")]


def _ascending(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise ValueError(f"the lower end {value[0]:g} must be below the upper end {value[1]:g}")
    return value


Interval = Annotated[tuple[Finite, Finite], AfterValidator(_ascending)]


class Block(BaseModel):
    """A frozen mapping that knows its keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, ser_json_inf_nan="constants")


def same_length(name: str, first: Sequence[object], other: str, second: Sequence[object]) -> None:
    """Refuse two lists that describe the same things and differ in length."""
    if len(first) != len(second):
        raise ValueError(f"{name} has {len(first)} entries, {other} has {len(second)}; they must match")
