"""Usual ranges of the configuration's numbers: one outside is a question, with the likely mistake named.

A key is marked where it is defined, as in `H0: Annotated[Positive, Usual(50, 100, "km/s/Mpc")]`. Hard limits stay
with the types: they say what can be computed. A usual range says what anybody is likely to mean.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel, GetJsonSchemaHandler
from pydantic_core import CoreSchema

LIGHT_KMS = 299792.458


@dataclass(frozen=True)
class Mistake:
    """What a number outside the range may be, and the number that was meant then."""

    name: str
    mend: Callable[[float], float]


def factor(name: str, number: float) -> Mistake:
    """Return the mistake of another unit, in which `number` of ours are one."""
    return Mistake(name, lambda value: value * number)


@dataclass(frozen=True)
class Usual:
    """Usual range of a key, both ends included; marks its field. Infinity, where a type allows it, is meant."""

    low: float
    high: float
    unit: str
    mistakes: tuple[Mistake, ...]

    def __init__(self, low: float, high: float, unit: str = "", *mistakes: Mistake) -> None:
        for name, value in (("low", low), ("high", high), ("unit", unit), ("mistakes", mistakes)):
            object.__setattr__(self, name, value)

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Tell the documentation of the keys, and editors."""
        return {**handler(schema), "usual": f"{self.low:g} to {self.high:g}"}

    def holds(self, value: object) -> bool:
        """Return whether every number of a value, however nested, lies in the range."""
        return all(self.low <= number <= self.high or math.isinf(number) for number in _numbers(value))

    def suggestion(self, value: object) -> str:
        """Return "; did you mean 69.31 (h)", or "" if no known mistake leads from the range to the value."""
        mended = [(mistake.name, _mended(value, mistake.mend)) for mistake in self.mistakes]
        texts = [
            f"{as_text(other)} ({name})" for name, other in mended if any(_numbers(other)) and self.holds(other)
        ]
        return f"; did you mean {' or '.join(texts)}" if texts else ""


def question(key: str, value: object, usual: Usual) -> str:
    """Return the line that asks about a value outside its range."""
    return f"{key} = {as_text(value)}, expected {usual}{usual.suggestion(value)}{keep(key)}"


def keep(key: str) -> str:
    """Return the end of a line that asks: how the value is kept."""
    return f"; to keep it, add {key} to the list `unusual`"


def questions(block: BaseModel, above: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """Yield key and line of every number in a block, however deep, that lies outside its usual range."""
    unused = {"simulated", "fits", "artifact"} - {getattr(block, "kind", "")} if above == ("observation",) else ()
    for name, field in type(block).model_fields.items():
        value, path = getattr(block, name), (*above, name)
        if name in unused:
            continue
        usual = _marked(field.metadata)
        if usual is not None and not usual.holds(value):
            yield ".".join(path), question(".".join(path), value, usual)
        for further, child in value.items() if isinstance(value, dict) else [((), value)]:
            if isinstance(child, BaseModel):
                yield from questions(child, (*path, further) if further else path)


def usual_at(block: type[BaseModel], location: Sequence[int | str]) -> Usual | None:
    """Return the usual range at a location as pydantic reports it, None if its key has none."""
    usual: Usual | None = None
    for part in location:
        if part in block.model_fields:
            field = block.model_fields[str(part)]
            usual, block = _marked(field.metadata), next(_models(field.annotation), block)
    return usual


def _marked(metadata: Sequence[object]) -> Usual | None:
    return next((mark for mark in metadata if isinstance(mark, Usual)), None)


def _models(annotation: object) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models(argument)


def _numbers(value: object) -> Iterator[float]:
    if isinstance(value, list | tuple):
        for element in value:
            yield from _numbers(element)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value


def _mended(value: object, mend: Callable[[float], float]) -> object:
    if isinstance(value, list | tuple):
        return [_mended(element, mend) for element in value]
    if not isinstance(value, int | float):
        return value
    try:
        return mend(float(value))
    except (ValueError, OverflowError):
        return math.nan


def as_text(value: object) -> str:
    """Return a number, or the first numbers of a list, with six digits."""
    if isinstance(value, list | tuple):
        shown = [as_text(element) for element in value[:_SHOWN]]
        return f"[{', '.join(shown)}{', ...' if len(value) > _SHOWN else ''}]"
    return f"{value:.6g}" if isinstance(value, int | float) else reprlib.repr(value)


_SHOWN = 6

# ---------------------------------------------------------------------------------------------- mistakes

HUBBLE, PER_KPC = factor("h", 100.0), factor("km/s/kpc", 1e3)
MILLI, MICRO = factor("mK", 1e-3), factor("microkelvin", 1e-6)
RECESSION = factor("c z in km/s", 1.0 / LIGHT_KMS)
EV, MEV, GEV = factor("eV", 1e-3), factor("MeV", 1e3), factor("GeV", 1e6)
PERCENT = factor("percent", 0.01)
SIGN = factor("the sign", -1.0)
MAS, DEGREES, ARCMIN = factor("mas", 1e-3), factor("degrees", 3600.0), factor("arcmin", 60.0)
LOG10 = Mistake("log10", lambda value: 10.0**value)
NO_LOG10 = Mistake("Msun, not its log10", lambda value: round(math.log10(value), 4))
TEN_BILLIONS = factor("in 1e10 Msun", 1e10)
HOURS, KILOSECONDS = factor("hours", 3600.0), factor("ks", 1e3)

# -------------------------------------------------------------------------------- ranges of several keys

RELIC = Usual(0.05, 100.0, "keV", EV, MEV, GEV)
HOST = Usual(
    10.0, 16.0, "in log10(M200c / Msun)", NO_LOG10,
    Mistake("log10 in 1e10 Msun", lambda value: value + 10.0),
    Mistake("a natural logarithm", lambda value: round(value / math.log(10.0), 4)),
)  # fmt: skip
MASS = Usual(1e4, 1e10, "Msun", LOG10, TEN_BILLIONS)
HEAVY_MASS = Usual(1e10, 1e18, "Msun", LOG10, TEN_BILLIONS)
PIXEL = Usual(0.001, 0.5, "arcsec", MAS, DEGREES, ARCMIN)
POSITION = Usual(-100.0, 100.0, "arcsec, not pixels", MAS)
EXTENT = Usual(0.2, 200.0, "arcsec", MAS, DEGREES, ARCMIN)
SCALE = Usual(0.001, 20.0, "arcsec", MAS, DEGREES)
RADIUS = Usual(0.0, 20.0, "arcsec", MAS)
PRECISION = Usual(1e-6, 0.2, "arcsec", MAS)
EINSTEIN_OF_PERTURBER = Usual(1e-5, 1.0, "arcsec", MAS)
WAVELENGTH = Usual(
    100.0, 3000.0, "nm of a telescope like Hubble",
    factor("Angstrom", 0.1), factor("microns", 1e3), factor("m", 1e9),
)  # fmt: skip
EXPOSURE = Usual(5.0, 1e7, "s", HOURS, KILOSECONDS)
RMS = Usual(1e-6, 1e4, "e-/s per pixel")
FLUX = Usual(0.0, 1e8, "e-/s")
DELTA_R = Usual(-1e5, -0.01)
RIDGE = Usual(1e-16, 10.0)
