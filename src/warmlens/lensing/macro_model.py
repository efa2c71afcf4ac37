"""The smooth lens and its light, in lenstronomy's names and kwargs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from warmlens.imaging.grid import PixelGrid
from warmlens.types import FloatArray


def deflection(
    lens_model_list: Sequence[str], kwargs_lens: Sequence[Mapping[str, Any]], x: FloatArray, y: FloatArray
) -> FloatArray:
    """Return the deflection [2, ...] (x, y) [arcsec] of a lenstronomy lens at positions [arcsec] of any shape.

    Raises
    ------
    ValueError
        If a model or one of its arguments is unknown to lenstronomy, or the deflection is not finite.
    """
    from lenstronomy.LensModel.lens_model import LensModel  # slow to import

    try:
        model = LensModel(list(lens_model_list))
        alpha = np.array(model.alpha(np.ravel(x), np.ravel(y), [dict(kw) for kw in kwargs_lens]))
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(
            f"lenstronomy refuses the lens {list(lens_model_list)}: {error}; "
            "check smooth_model.lens (lens_model_list and kwargs_lens)"
        ) from error
    if not np.isfinite(alpha).all():
        raise ValueError(
            f"the deflection of {list(lens_model_list)} is not finite at {np.sum(~np.isfinite(alpha[0]))} "
            "positions; move the centre off the pixel centres or soften the profile"
        )
    return alpha.reshape(2, *np.shape(x))


def lens_light(
    lens_light_model_list: Sequence[str],
    kwargs_lens_light: Sequence[Mapping[str, Any]],
    x: FloatArray,
    y: FloatArray,
) -> FloatArray:
    """Return the surface brightness [component, ...] of each light component for amplitude 1, per square arcsec.

    Raises
    ------
    ValueError
        If a model or one of its arguments is unknown to lenstronomy.
    """
    from lenstronomy.LightModel.light_model import LightModel  # slow to import

    components = []
    for name, kwargs in zip(lens_light_model_list, kwargs_lens_light, strict=True):
        try:
            light = LightModel([name]).surface_brightness(np.ravel(x), np.ravel(y), [{"amp": 1.0, **kwargs}])
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(
                f"lenstronomy refuses the light model {name}: {error}; check smooth_model.lens_light"
            ) from error
        components.append(np.reshape(light, np.shape(x)))
    return np.array(components).reshape(len(components), *np.shape(x))


def light_images(
    lens_light_model_list: Sequence[str],
    kwargs_lens_light: Sequence[Mapping[str, Any]],
    grid: PixelGrid,
    supersampling: int,
) -> FloatArray:
    """Return the light per pixel of each component for amplitude 1, before the PSF [component, ny, nx]."""
    x, y = grid.subpixel_coordinates(supersampling)
    light = lens_light(lens_light_model_list, kwargs_lens_light, x, y)
    return light.mean(axis=-1).reshape(len(light), *grid.shape) * grid.pixel_scale**2
