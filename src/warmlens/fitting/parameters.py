"""The non-linear parameters of the smooth model: lens, shapes of its light, quasar images, scale of the source."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from warmlens.types import BoolArray, FloatArray

POTENTIAL_SHAPELETS = "SHAPELETS_CART"


@dataclass(frozen=True)
class Macro:
    """One smooth model without its amplitudes, in lenstronomy's names."""

    # One mapping per lens model and per light model; of light without `amp`
    kwargs_lens: tuple[dict[str, Any], ...]
    kwargs_light: tuple[dict[str, Any], ...]
    quasars: FloatArray  # image positions (x, y) [n, 2] [arcsec]
    beta: float  # scale of the source's global shapelets [arcsec]


@dataclass(frozen=True)
class Parameter:
    """One free parameter.

    Attributes
    ----------
    kind, component, key, element
        Where its value stands in a `Macro`: kwargs_lens[component][key], kwargs_light[component][key],
        quasars[component, element] or beta; `element` also counts the coefficients of potential shapelets.
    start, lower, upper
        First value and hard limits.
    sigma
        Width of the Gaussian prior about `start`, inf for none.
    """

    kind: Literal["lens", "light", "quasar", "source"]
    component: int
    key: str
    element: int | None
    start: float
    lower: float
    upper: float
    sigma: float

    @property
    def name(self) -> str:
        """Such as lens_0.theta_E, lens_3.coeffs_7, light_1.R_sersic, quasar_2.x, source_0.beta."""
        tail = "xy"[self.element or 0] if self.kind == "quasar" else self.key
        if self.key == "coeffs":
            tail += f"_{self.element}"
        return f"{self.kind}_{self.component}.{tail}"

    @property
    def step(self) -> float:
        """Half-width of the central difference for a derivative, where there is no closed form."""
        return 1e-4 * max(1.0, abs(self.start))

    def __post_init__(self) -> None:
        if not self.lower < self.start < self.upper:
            raise ValueError(
                f"smooth_model: {self.name} starts at {self.start:g}, which must lie inside its limits "
                f"({self.lower:g}, {self.upper:g}); change one of them"
            )
        if not self.sigma > 0:
            raise ValueError(f"smooth_model: the prior of {self.name} must be wider than 0, got {self.sigma:g}")


@dataclass(frozen=True)
class ParameterSpace:
    """Free parameters about a first model."""

    base: Macro  # model that holds all values that are not free
    parameters: tuple[Parameter, ...]  # in the order of every parameter vector [n]
    # Pairs (lens component, light component) that share their centre: the light follows the lens
    satellites: tuple[tuple[int, int], ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the vector."""
        return tuple(p.name for p in self.parameters)

    @property
    def start(self) -> FloatArray:
        """First values [n]."""
        return np.array([p.start for p in self.parameters])

    @property
    def limits(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limits, each [n]."""
        return np.array([p.lower for p in self.parameters]), np.array([p.upper for p in self.parameters])

    @property
    def prior_sigma(self) -> FloatArray:
        """Widths of the Gaussian priors about the first values, inf for none [n]."""
        return np.array([p.sigma for p in self.parameters])

    def macro(self, vector: FloatArray) -> Macro:
        """Return the model of a parameter vector [n]."""
        lens = copy.deepcopy(self.base.kwargs_lens)
        light = copy.deepcopy(self.base.kwargs_light)
        quasars, beta = self.base.quasars.copy(), self.base.beta
        for p, value in zip(self.parameters, vector, strict=True):
            if p.kind == "quasar":
                quasars[p.component, p.element] = value
            elif p.kind == "source":
                beta = float(value)
            elif p.element is not None:
                lens[p.component][p.key][p.element] = float(value)
            else:
                (lens if p.kind == "lens" else light)[p.component][p.key] = float(value)
        for of_lens, of_light in self.satellites:
            for key in ("center_x", "center_y"):
                light[of_light][key] = lens[of_lens][key]
        return Macro(lens, light, quasars, beta)

    def at_limit(self, vector: FloatArray) -> BoolArray:
        """Return whether each parameter lies within 1e-3 of its range of a limit [n]."""
        lower, upper = self.limits
        return np.minimum(vector - lower, upper - vector) < 1e-3 * (upper - lower)


def free_parameters(
    kind: Literal["lens", "light"],
    models: Sequence[Mapping[str, Any]],
    free: Sequence[Mapping[str, tuple[float, float, float | None]]],
) -> list[Parameter]:
    """Return the parameters that the configuration sets free.

    Parameters
    ----------
    models
        kwargs of each component: the first values.
    free
        One mapping per component: name to (lower, upper, prior sigma or None).

    Raises
    ------
    ValueError
        If a name is not among the component's kwargs.
    """
    parameters = []
    for component, (kwargs, ranges) in enumerate(zip(models, free, strict=True)):
        for key, (lower, upper, sigma) in ranges.items():
            if key not in kwargs or not isinstance(kwargs[key], int | float):
                raise ValueError(
                    f"smooth_model.fit: {kind} model {component} has no number '{key}' to free; "
                    f"it has {', '.join(kwargs)}"
                )
            start = float(kwargs[key])
            parameters.append(Parameter(kind, component, key, None, start, lower, upper, sigma or math.inf))
    return parameters


def quasar_parameters(positions: FloatArray, sigma: float) -> list[Parameter]:
    """Return the image positions [n, 2] with a Gaussian prior of `sigma` and hard limits at ten of it [arcsec]."""
    return [
        Parameter("quasar", i, "position", axis, float(value), value - 10 * sigma, value + 10 * sigma, sigma)
        for i, position in enumerate(positions)
        for axis, value in enumerate(position)
    ]


def shapelet_parameters(component: int, coefficients: Sequence[float], sigma: float) -> list[Parameter]:
    """Return the coefficients of potential shapelets, priors about 0 or about those given, limits at 20 sigma."""
    return [
        Parameter("lens", component, "coeffs", i, float(v), v - 20 * sigma, v + 20 * sigma, sigma)
        for i, v in enumerate(coefficients)
    ]


def beta_parameter(start: float, free: tuple[float, float, float | None]) -> Parameter:
    """Return the scale of the source's global shapelets, with (lower, upper, prior sigma or None) [arcsec]."""
    lower, upper, sigma = free
    return Parameter("source", 0, "beta", None, start, lower, upper, sigma or math.inf)
