from __future__ import annotations

import numpy as np
import pytest

from warmlens.inference.exclusion import LEVEL, MAX_RATIO, Exclusion, exclusion

RELICS, HALOS = np.array([1.0, 3.0]), np.array([12.0, 12.5, 13.0])


def _grid(
    accepted: list[list[int]], per_node: int = 50, lost: dict[tuple[int, int], int] | None = None
) -> Exclusion:
    """The first samples of each node [halo mass][relic mass] are accepted; some nodes have lost samples."""
    rows = []
    for i, halo in enumerate(HALOS):
        for j, relic in enumerate(RELICS):
            n = per_node - (lost or {}).get((i, j), 0)
            rows += [(relic, halo, number < accepted[i][j]) for number in range(n)]
    m, mass, chosen = np.array(rows).T
    order = np.random.default_rng(1).permutation(len(rows))
    return exclusion(m[order], mass[order], chosen[order].astype(bool), RELICS, HALOS)


def test_counts_fractions_and_posterior() -> None:
    counts = _grid([[0, 0], [4, 6], [50, 40]])
    assert counts.n_samples.tolist() == [[50, 50]] * 3
    assert counts.n_accepted.tolist() == [[0, 0], [4, 6], [50, 40]]
    low, middle, high = counts.halo_masses
    assert (low.rate, middle.rate, high.rate) == (0.0, 0.1, 0.9)
    assert (low.probability, middle.probability, high.probability) == pytest.approx((0.0, 0.1, 0.9))
    assert (middle.cumulative, high.cumulative) == pytest.approx((0.1, 1.0))
    assert high.cumulative_interval == (1.0, 1.0)
    assert middle.ratio == pytest.approx(1 / 9)
    assert low.prior_probability == pytest.approx(1 / 3)
    # Clopper-Pearson at 95%: 0 of 100, and 10 of 100 (Clopper & Pearson 1934)
    assert low.probability_interval == pytest.approx((0.0, 1.0 - 0.025**0.01))
    assert middle.probability_interval == pytest.approx((0.0490, 0.1762), abs=1e-4)
    assert middle.ratio_interval == pytest.approx((0.0490 / 0.9510, 0.1762 / 0.8238), abs=2e-4)


def test_an_exclusion_needs_the_upper_ends() -> None:
    counts = _grid([[0, 0], [4, 6], [50, 40]])
    assert [halo.excluded for halo in counts.halo_masses] == [True, False, False]
    assert counts.excluded_up_to is counts.halo_masses[0]
    assert counts.halo_masses[0].excluded_at == pytest.approx(0.025**0.01)
    assert counts.warnings == ("the best halo mass, 10^13 Msun, is at the edge of the grid",)
    few = _grid([[0, 0], [1, 2], [12, 10]])  # the same fractions from a quarter of the samples: 13% at most
    assert few.halo_masses[0].probability_interval[1] > LEVEL
    assert not any(halo.excluded for halo in few.halo_masses)
    assert few.excluded_up_to is None
    assert (
        "25 accepted samples cannot exclude a halo mass at 95.45%, even if none of them has it: 80 are needed"
        in (few.warnings[1])
    )


def test_one_below_the_limit_of_counts() -> None:
    """79 of 80 cannot, 80 can: the number that the warning names is the smallest that suffices."""
    assert not _grid([[0, 0], [0, 0], [40, 39]]).halo_masses[0].excluded
    assert _grid([[0, 0], [0, 0], [40, 40]]).halo_masses[0].excluded


def test_a_fine_grid_excludes_nothing_by_its_prior_alone() -> None:
    """With 40 halo masses each has 2.5% before the data: below the level, but no less likely than the others."""
    halos = np.linspace(12.0, 14.0, 40)
    mass = np.repeat(halos, 200)
    m = np.tile(RELICS, mass.size // 2)
    accepted = np.arange(mass.size) % 4 == 0
    counts = exclusion(m, mass, accepted, RELICS, halos)
    halo = counts.halo_masses[7]
    assert halo.probability_interval[1] < LEVEL
    assert halo.ratio_interval[1] > MAX_RATIO
    assert not any(halo.excluded for halo in counts.halo_masses)


def test_lost_samples_do_not_count_against_a_halo_mass() -> None:
    counts = _grid([[0, 0], [10, 10], [10, 10]], lost={(2, 0): 25, (2, 1): 25})
    _, middle, high = counts.halo_masses
    assert (middle.rate, high.rate) == (0.2, 0.4)
    assert (middle.probability, high.probability) == pytest.approx((1 / 3, 2 / 3))
    assert middle.ratio == pytest.approx(0.5)
    assert middle.probability_interval[0] < 1 / 3 < middle.probability_interval[1]


@pytest.mark.parametrize(
    ("m", "mass", "accepted", "reason"),
    [
        ([1.0, 2.0], [12.0, 12.5], [1, 1], r"row 1 \(2 keV, 12.5\) lies on no node"),
        ([1.0, 9.0], [12.0, 12.5], [1, 1], "lies on no node"),
        ([1.0, 3.0], [12.0, 12.5], [1, 1], r"no sample is left at log10 M_h = 13"),
        ([1.0, 3.0, 1.0], [12.0, 12.5, 13.0], [0, 0, 0], "no sample is accepted"),
    ],
)
def test_what_is_no_grid(m: list[float], mass: list[float], accepted: list[int], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        exclusion(np.array(m), np.array(mass), np.array(accepted, dtype=bool), RELICS, HALOS)
