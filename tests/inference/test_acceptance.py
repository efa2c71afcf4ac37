from __future__ import annotations

import numpy as np
import pytest

from warmlens.inference.acceptance import (
    RULES,
    accept,
    max_rank,
    number_accepted,
    reduce_distances,
)


def test_max_rank_by_hand():
    distances = np.array([[0.1, 0.4, 0.2, 0.3, 0.2], [5.0, 1.0, 2.0, 2.0, 9.0]])
    # ranks 1 5 3 4 3 and 4 1 3 3 5: tied rows share the number of rows as close or closer
    np.testing.assert_array_equal(max_rank(distances), [4, 5, 3, 4, 5])


def test_accepted_rows_pass_both_cuts_at_the_implied_quantile():
    rng = np.random.default_rng(1)
    n = 2483
    distances = rng.exponential(size=(2, n))
    distances[1] += distances[0]
    result = accept(distances, "max_rank", 0.05, np.arange(n), rng)
    assert (result.k, result.n) == (124, n)
    cuts = np.sort(distances, axis=1)[:, round(result.implied_quantile * n) - 1]
    inside = (distances <= cuts[:, None]).all(axis=0)
    assert inside[result.accepted].all()
    # rows inside both cuts that are left out can only be rows tied at the cut
    left_out = inside & ~result.accepted
    assert (result.max_rank[left_out] == result.max_rank[result.accepted].max()).all()
    assert left_out.sum() < max(result.n_tied, 1)


def test_one_distance_alone_is_a_plain_cut():
    rng = np.random.default_rng(2)
    distances = rng.random((1, 200))
    result = accept(distances, "max_rank", 0.1, np.arange(200), rng)
    np.testing.assert_array_equal(np.flatnonzero(result.accepted), np.sort(np.argsort(distances[0])[:20]))
    assert result.n_tied == 0
    assert result.implied_quantile == pytest.approx(0.1)


def test_ties_are_broken_by_the_key_and_reported():
    distances = np.zeros((2, 100))
    distances[:, :10] = -1.0  # ten clear winners, ninety tied rows for the other ten places
    first = accept(distances, "max_rank", 0.2, np.arange(100), np.random.default_rng(3))
    again = accept(distances, "max_rank", 0.2, np.arange(100), np.random.default_rng(3))
    other = accept(distances, "max_rank", 0.2, np.arange(100), np.random.default_rng(4))
    assert first.accepted[:10].all()
    assert (first.k, first.n_tied, first.implied_quantile) == (20, 90, 1.0)
    np.testing.assert_array_equal(first.accepted, again.accepted)
    assert (first.accepted != other.accepted).any()


def test_tied_rows_all_have_the_same_chance():
    distances = np.zeros((2, 50))
    accepted = sum(
        accept(distances, "max_rank", 0.1, np.arange(50), np.random.default_rng(seed)).accepted.astype(int)
        for seed in range(600)
    )
    # 5 of 50 in 600 draws: 60 +- 7.3 for each row
    assert np.abs(accepted - 60).max() < 5 * 7.3
    assert accepted[:10].sum() < 750  # breaking by row order would give 3000


def test_order_of_the_rows_has_no_say():
    rng = np.random.default_rng(5)
    n = 300
    distances = rng.integers(0, 8, (2, n)).astype(float)  # many ties
    sample_id = rng.permutation(10 * n)[:n]
    shuffle = rng.permutation(n)
    straight = accept(distances, "max_rank", 0.1, sample_id, np.random.default_rng(6))
    shuffled = accept(distances[:, shuffle], "max_rank", 0.1, sample_id[shuffle], np.random.default_rng(6))
    assert straight.n_tied > 0
    np.testing.assert_array_equal(straight.accepted[shuffle], shuffled.accepted)
    assert (straight.n_tied, straight.implied_quantile) == (shuffled.n_tied, shuffled.implied_quantile)


def test_too_few_samples_are_refused_with_n_and_fraction():
    with pytest.raises(ValueError, match=r"fraction 0.05 of n = 20 samples accepts 1"):
        accept(np.zeros((2, 20)), "max_rank", 0.05, np.arange(20), np.random.default_rng(0))
    assert number_accepted(2483, 0.05) == 124
    with pytest.raises(ValueError, match=r"\(0, 1\]"):
        number_accepted(100, 1.5)


def test_bad_input_is_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="1 of 50 rows"):
        accept(np.where(np.arange(50) == 3, np.nan, 1.0)[None], "max_rank", 0.1, np.arange(50), rng)
    with pytest.raises(ValueError, match="sample_id 7"):
        accept(np.ones((2, 50)), "max_rank", 0.1, np.where(np.arange(50) == 3, 7, np.arange(50)), rng)
    with pytest.raises(ValueError, match="n_kinds"):
        max_rank(np.ones(5))


def test_the_other_rules_by_hand():
    distances = np.array([[1.0, 2.0, 3.0, 4.0, 9.0], [10.0, 50.0, 20.0, 90.0, 30.0]])
    rng, ids = np.random.default_rng(0), np.arange(5)

    def rows(rule, fraction):
        return np.flatnonzero(accept(distances, rule, fraction, ids, rng).accepted).tolist()

    assert rows("correlation", 0.4) == [0, 1]
    assert rows("cumulative", 0.4) == [0, 2]
    assert rows("marginal_and", 0.4) == [0]
    assert rows("marginal_and", 0.6) == [0, 2]
    # MADs are 1 and 20: sums 1.5, 4.5, 4, 8.5, 10.5
    np.testing.assert_allclose(reduce_distances(distances, "scaled_sum"), [[1.5, 4.5, 4.0, 8.5, 10.5]])
    assert rows("scaled_sum", 0.6) == [0, 1, 2]
    assert rows("max_rank", 0.4) == [0, 2]


def test_rules_agree_on_one_and_the_same_distance_and_differ_otherwise():
    rng, ids = np.random.default_rng(7), np.arange(500)
    same = np.tile(rng.random(500), (2, 1))
    accepted = [accept(same, rule, 0.1, ids, np.random.default_rng(1)).accepted for rule in RULES]
    assert all((row == accepted[0]).all() for row in accepted)
    apart = rng.random((2, 500))
    distinct = {accept(apart, rule, 0.1, ids, np.random.default_rng(1)).accepted.tobytes() for rule in RULES}
    assert len(distinct) == len(RULES)
    # independent distances: 0.1^2 of the rows pass both cuts, while max_rank widens the cuts until 10% pass
    assert accept(apart, "marginal_and", 0.1, ids, rng).k < 15
    widened = accept(apart, "max_rank", 0.1, ids, rng)
    assert widened.k == 50
    assert widened.implied_quantile == pytest.approx(np.sqrt(0.1), abs=0.05)


def test_ties_in_marginal_cuts_are_all_in_and_counted():
    distances = np.zeros((2, 100))
    distances[1] = np.arange(100)
    result = accept(distances, "marginal_and", 0.1, np.arange(100), np.random.default_rng(0))
    np.testing.assert_array_equal(np.flatnonzero(result.accepted), np.arange(10))
    assert result.n_tied == 90


def test_rules_refuse_what_they_cannot_do():
    zero = np.zeros((2, 50))
    zero[1] = np.arange(50)
    with pytest.raises(ValueError, match=r"abc\.acceptance: scaled_sum is undefined; use max_rank"):
        accept(zero, "scaled_sum", 0.1, np.arange(50), np.random.default_rng(0))
    with pytest.raises(ValueError, match="unknown rule 'best'"):
        accept(zero, "best", 0.1, np.arange(50), np.random.default_rng(0))
    with pytest.raises(ValueError, match="needs the distances"):
        accept(zero[:1], "cumulative", 0.1, np.arange(50), np.random.default_rng(0))
