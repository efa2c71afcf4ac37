from __future__ import annotations

import numpy as np
import pytest

from warmlens.halos.tree_walk import split_mass

MASS, RESOLUTION = 1e13, 1e8


def test_split_shares_out_the_whole_mass():
    rng = np.random.default_rng(3)
    for _ in range(5000):
        mass = 10 ** rng.uniform(8.31, 13.5)
        progenitor = RESOLUTION * (0.5 * mass / RESOLUTION) ** rng.random()
        accretion = rng.choice([0.0, 1e-9, 0.5 * rng.random(), 0.5])
        heavy, light, smooth = split_mass(mass, accretion, progenitor, RESOLUTION)
        assert heavy + light + smooth == pytest.approx(mass, rel=1e-15)
        assert heavy >= light
        assert light == 0.0 or light > RESOLUTION
        assert smooth >= accretion * mass - 1e-15 * mass


@pytest.mark.parametrize("progenitor", [0.5 * MASS, np.nextafter(0.5 * MASS, MASS), 0.5 * MASS - 0.5 * RESOLUTION])
def test_nothing_resolved_is_left_beside_half_the_mass_at_the_cap(progenitor):
    # accretion of 1/2 and a progenitor of M/2: the remainder, zero or even negative by rounding, is no halo
    heavy, light, smooth = split_mass(MASS, 0.5, progenitor, RESOLUTION)
    assert heavy == progenitor
    assert light == 0.0
    assert smooth == MASS - progenitor


def test_the_lighter_progenitor_is_the_light_one_whichever_was_drawn():
    assert split_mass(MASS, 0.0, 0.3 * MASS, RESOLUTION) == pytest.approx((0.7 * MASS, 0.3 * MASS, 0.0), abs=1.0)
    assert split_mass(MASS, 0.4, 0.4 * MASS, RESOLUTION) == pytest.approx((0.4 * MASS, 0.2 * MASS, 0.4 * MASS))
