from __future__ import annotations

import numpy as np
import pytest

from warmlens.imaging.source import SpiralSource


@pytest.mark.parametrize("clump_fraction", [0.0, 0.4, 1.0])
def test_flux(clump_fraction: float) -> None:
    source = SpiralSource.draw((0.1, -0.2), 0.15, 20, (0.04, 0.08), np.random.default_rng(1))
    axis = np.arange(-3.0, 3.0, 0.01)
    x, y = np.meshgrid(axis + 0.1, axis - 0.2)
    light = source.surface_brightness(x, y, 50.0, clump_fraction)
    assert light.min() >= 0.0
    assert light.sum() * 0.01**2 == pytest.approx(50.0, rel=1e-3)


def test_clumps_lie_on_two_arms() -> None:
    source = SpiralSource.draw((0.0, 0.0), 0.2, 400, (0.04, 0.08), np.random.default_rng(2))
    radius = np.hypot(source.clump_x, source.clump_y)
    assert radius.min() >= 0.1
    assert radius.max() <= 0.7
    phase = np.angle(np.exp(2j * (np.arctan2(source.clump_y, source.clump_x) - np.log(radius / 0.2) / 0.45))) / 2
    assert np.std(phase) == pytest.approx(0.15, rel=0.15)


def test_no_clumps() -> None:
    source = SpiralSource.draw((0.0, 0.0), 0.2, 0, (0.04, 0.08), np.random.default_rng(2))
    assert source.surface_brightness(np.zeros(1), np.zeros(1), 1.0, 0.0)[0] > 0.0
