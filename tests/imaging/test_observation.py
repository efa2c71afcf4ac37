from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.observation import Band, checked_band

GRID = PixelGrid.centred((8, 10), 0.05)


def _band(**changes: Any) -> Band:
    psf = np.zeros((3, 3))
    psf[1, 1] = 2.0
    parts: dict[str, Any] = {
        "name": "F814W",
        "grid": GRID,
        "image": np.ones(GRID.shape),
        "sigma": np.full(GRID.shape, 0.5),
        "mask": np.ones(GRID.shape, dtype=bool),
        "psf": psf,
        "noise": NoiseModel(0.01, 1000.0),
    }
    return checked_band(**{**parts, **changes})


def _with(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    array[2, 3] = value
    return array


def test_weights_vanish_where_masked() -> None:
    mask = np.ones(GRID.shape, dtype=bool)
    mask[2, 3] = False
    band = _band(mask=mask, image=_with(np.ones(GRID.shape), np.nan), sigma=_with(np.full(GRID.shape, 0.5), 0.0))
    assert band.weights[2, 3] == 0.0
    assert band.image[2, 3] == 0.0
    assert np.all(np.delete(band.weights.ravel(), 23) == 2.0)
    assert band.psf.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"sigma": np.ones((8, 9))}, r"the sigma has shape \(8, 9\), the science image \(8, 10\)"),
        (
            {"image": _with(np.ones(GRID.shape), np.nan)},
            r"not finite, the first at \[y, x\] = \[2, 3\]; mask",
        ),
        ({"sigma": _with(np.ones(GRID.shape), 0.0)}, r"noise of 1 unmasked pixels is not positive"),
        ({"mask": np.zeros(GRID.shape, dtype=bool)}, "leaves no pixel"),
        ({"psf": np.ones((4, 4))}, "odd"),
    ],
)
def test_errors_name_the_band(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=rf"band F814W.*{reason}"):
        _band(**changes)
