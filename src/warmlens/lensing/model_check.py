"""What is wrong with lens and light models in lenstronomy's names, before anything is computed with them.

`macro_model` evaluates models that are right; here every component is looked at on its own, and each problem is a
line with what was meant.
"""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from warmlens.config import plausible
from warmlens.config.plausible import Usual, as_text, keep
from warmlens.types import FloatArray

MAX_PIXELS = 300_000  # of larger images only a part is evaluated
_NEAREST = 9  # pixels about the centre of a component, which are never left out

_EQUAL_TO = {"PEMD": ", or use EPL, the same profile", "SPEMD": ", or use EPL, the same profile without a core"}
_PAIRS = (("center_x", "center_y"), ("ra_0", "dec_0"), ("e1", "e2"))
_SLOPED = ("EPL", "EPL_NUMBA", "EPL_Q_PHI", "PEMD", "SPEMD", "SPEP", "SPP")
# usual ranges of parameters by name; centres, ellipticities and slopes have limits of their own
_USUAL = {
    "theta_E": Usual(0, 100, "arcsec", plausible.MAS),
    "q": Usual(0.1, 1),
    "gamma1": Usual(-0.6, 0.6, "", plausible.PERCENT),
    "gamma2": Usual(-0.6, 0.6, "", plausible.PERCENT),
    "kappa": Usual(-1, 1),
    "R_sersic": Usual(0.001, 100, "arcsec", plausible.MAS),
    "n_sersic": Usual(0.1, 15),
    "Rs": Usual(0.001, 1000, "arcsec", plausible.MAS),
    "alpha_Rs": Usual(0, 100, "arcsec", plausible.MAS),
    "center_x": plausible.POSITION,
    "center_y": plausible.POSITION,
    "ra_0": plausible.POSITION,
    "dec_0": plausible.POSITION,
}


@dataclass(frozen=True)
class Components:
    """Models of one kind, as a block of the configuration has them."""

    kind: Literal["lens", "light"]
    key: str  # of the block that has them, such as smooth_model.lens
    names: Sequence[str]
    kwargs: Sequence[Mapping[str, Any]]

    @property
    def key_of_names(self) -> str:
        """Key of the list of names."""
        return f"{self.key}.{'lens' if self.kind == 'lens' else 'lens_light'}_model_list"

    @property
    def key_of_kwargs(self) -> str:
        """Key of the list of parameters."""
        return f"{self.key}.kwargs_{'lens' if self.kind == 'lens' else 'lens_light'}"


def model_problems(components: Components, x: FloatArray, y: FloatArray, unusual: Sequence[str]) -> list[str]:
    """Return a line per problem of the components, evaluated at the pixels x, y [arcsec] of an image.

    Parameters
    ----------
    unusual
        Keys whose unusual numbers are meant.
    """
    problems = []
    for number, (name, kwargs) in enumerate(zip(components.names, components.kwargs, strict=True)):
        where = f"{components.key_of_kwargs}[{number}]"
        profile = _profile(components, number)
        if isinstance(profile, str):
            problems.append(profile)
            continue
        lines = list(_wrong_names(where, name, kwargs, profile)) or list(_impossible(where, name, kwargs))
        lines = lines or list(_not_finite(components, number, x, y))
        problems += lines
        if not lines and components.key_of_kwargs not in unusual:
            asked = [*_unusual(where, kwargs), *_off_the_image(components, number, x, y)]
            problems += [line + keep(components.key_of_kwargs) for line in asked]
    return problems


def unusual_limits(key: str, free: Sequence[Mapping[str, tuple[float, float, float | None]]]) -> Iterator[str]:
    """Yield a line per free parameter whose limits reach beyond what it may be."""
    for number, ranges in enumerate(free):
        for name, (lower, upper, _) in ranges.items():
            usual = Usual(-0.95, 0.95) if name in ("e1", "e2") else _USUAL.get(name)
            if usual is not None and not usual.holds((lower, upper)):
                meant = usual.suggestion((lower, upper))
                yield f"{key}[{number}].{name}: limits [{lower:g}, {upper:g}], expected {usual}{meant}{keep(key)}"


def _profile(components: Components, number: int) -> Any:
    """Return lenstronomy's profile of a component, or why there is none."""
    from lenstronomy.LensModel.profile_list_base import _SUPPORTED_MODELS, ProfileListBase  # slow to import
    from lenstronomy.LightModel.light_model_base import _MODELS_SUPPORTED, LightModelBase

    name, where = components.names[number], f"{components.key_of_names}[{number}]"
    known = _SUPPORTED_MODELS if components.kind == "lens" else _MODELS_SUPPORTED
    if name not in known:
        nearest = difflib.get_close_matches(name.upper(), known, n=1)
        remedy = f"did you mean {nearest[0]}?" if nearest else "its documentation lists them"
        return f"{where}: {name!r} is no {components.kind} model of lenstronomy; {remedy}"
    try:
        return (ProfileListBase if components.kind == "lens" else LightModelBase)([name]).func_list[0]
    except ImportError as error:
        reason = str(error).partition(". ")[0]
        return f"{where}: {name} needs another library ({reason}); install it{_EQUAL_TO.get(name, '')}"
    except Exception as error:  # whatever a profile's own arguments are
        return f"{where}: {name} cannot be made from numbers alone ({_first_line(error)}); use another model"


def _wrong_names(where: str, name: str, kwargs: Mapping[str, Any], profile: Any) -> Iterator[str]:
    """Yield the parameters that a profile lacks or does not know."""
    known = [key for key in profile.param_names if key != "amp"]
    for key in kwargs:
        if key not in profile.param_names:
            yield f"{where}.{key}: {name} has no such parameter; {_instead(key, kwargs, known)}"
    method = getattr(profile, "derivatives", None) or profile.function
    arguments = inspect.signature(method).parameters
    needed = {key for key in known if key in arguments and arguments[key].default is inspect.Parameter.empty}
    for pair in _PAIRS:
        if any(key in kwargs for key in pair):
            needed |= {key for key in pair if key in known}
    for key in known:
        if key in needed and key not in kwargs:
            yield f"{where}.{key}: missing; {name} has {', '.join(known)}"


def _instead(key: str, kwargs: Mapping[str, Any], known: Sequence[str]) -> str:
    q, phi = kwargs.get("q"), kwargs.get("phi", kwargs.get("phi_G", 0.0))
    if key in ("q", "phi", "phi_G") and "e1" in known:
        text = "give e1, e2 = (1 - q)/(1 + q) [cos 2 phi, sin 2 phi]"
        if isinstance(q, int | float) and isinstance(phi, int | float) and q > 0:
            size = (1.0 - q) / (1.0 + q)
            e1, e2 = size * math.cos(2.0 * phi), size * math.sin(2.0 * phi)
            text += f", here {e1:.4g}, {e2:.4g} if phi is in radians"
        return text
    nearest = difflib.get_close_matches(key, [name for name in known if name not in kwargs], n=1)
    return f"did you mean {nearest[0]}?" if nearest else f"it has {', '.join(known)}"


def _impossible(where: str, name: str, kwargs: Mapping[str, Any]) -> Iterator[str]:
    """Yield values that lenstronomy silently changes, or answers with numbers that mean nothing."""
    ellipticity = math.hypot(_number(kwargs, "e1"), _number(kwargs, "e2"))
    if ellipticity >= 1.0:
        yield (f"{where}: |e| = {ellipticity:.4g} of e1 and e2, expected below 1: it is (1 - q)/(1 + q)")
    gamma = kwargs.get("gamma")
    if name in _SLOPED and isinstance(gamma, int | float) and not 1.0 < gamma < 3.0:
        yield f"{where}.gamma = {gamma:g}, expected above 1 and below 3; 2 is isothermal"
    for key in ("theta_E", "R_sersic", "n_sersic", "Rs"):
        positive = key != "theta_E"
        value = _number(kwargs, key, 1.0)
        if value < 0.0 or (positive and value == 0.0):
            yield f"{where}.{key} = {value:g}, expected {'above 0' if positive else '0 or more'}"


def _unusual(where: str, kwargs: Mapping[str, Any]) -> Iterator[str]:
    for key, usual in _USUAL.items():
        if key in kwargs and not usual.holds(kwargs[key]):
            yield f"{where}.{key} = {as_text(kwargs[key])}, expected {usual}{usual.suggestion(kwargs[key])}"


def _off_the_image(components: Components, number: int, x: FloatArray, y: FloatArray) -> Iterator[str]:
    """Yield an Einstein radius beyond the image, and a first lens that is not on it."""
    kwargs = components.kwargs[number]
    centre = _number(kwargs, "center_x"), _number(kwargs, "center_y")
    on_image = x.min() <= centre[0] <= x.max() and y.min() <= centre[1] <= y.max()
    where = f"{components.key_of_kwargs}[{number}]"
    reach = float(np.hypot(x - centre[0], y - centre[1]).max())
    theta_e = _number(kwargs, "theta_E")
    if components.kind == "lens" and on_image and reach < theta_e <= _USUAL["theta_E"].high:
        yield f"{where}.theta_E = {theta_e:g} arcsec, but the image ends {reach:.3g} arcsec from there"
    if components.kind == "lens" and number == 0 and not on_image and _USUAL["center_x"].holds(centre):
        yield (
            f"{where}: the first lens is centred on [{centre[0]:g}, {centre[1]:g}] arcsec, outside the image "
            "(positions are arcsec from the origin, not pixels)"
        )


def _not_finite(components: Components, number: int, x: FloatArray, y: FloatArray) -> Iterator[str]:
    """Evaluate a component at the pixels; yield the line if that fails or is not finite."""
    name, kwargs = components.names[number], dict(components.kwargs[number])
    where = f"{components.key_of_kwargs}[{number}]"
    evaluate: Callable[..., Any]
    if components.kind == "lens":
        from lenstronomy.LensModel.lens_model import LensModel  # slow to import

        evaluate, what = LensModel([name]).alpha, "deflection"
    else:
        from lenstronomy.LightModel.light_model import LightModel

        evaluate, what = LightModel([name]).surface_brightness, "surface brightness"
        kwargs = {"amp": 1.0, **kwargs}
    stride = max(1, math.ceil(x.size / MAX_PIXELS))
    distance = np.hypot(x - _number(kwargs, "center_x"), y - _number(kwargs, "center_y")).ravel()
    near = np.argpartition(distance, min(_NEAREST, x.size - 1))[:_NEAREST]
    chosen = np.union1d(np.arange(0, x.size, stride), near)
    try:
        with np.errstate(all="ignore"):
            values = np.asarray(evaluate(x.ravel()[chosen], y.ravel()[chosen], [kwargs]), dtype=np.float64)
    except Exception as error:  # lenstronomy raises whatever numpy and its own code raise
        yield f"{where}: lenstronomy refuses these parameters of {name} ({_first_line(error)}); correct them"
        return
    wrong = ~np.isfinite(values).all(axis=tuple(range(values.ndim - 1)))
    if wrong.any():
        at = int(chosen[np.flatnonzero(wrong)[0]])
        yield (
            f"{where}: the {what} of {name} is not finite at {np.count_nonzero(wrong)} pixels, such as that at "
            f"[{x.flat[at]:.4g}, {y.flat[at]:.4g}] arcsec; move the centre off the pixel's or soften the profile"
        )


def _number(kwargs: Mapping[str, Any], key: str, default: float = 0.0) -> float:
    value = kwargs.get(key, default)
    return float(value) if isinstance(value, int | float) else default


def _first_line(error: Exception) -> str:
    lines = f"{type(error).__name__}: {error}".splitlines()
    return lines[0][:150]
