from __future__ import annotations

import numpy as np
from scipy import stats

from warmlens.sampling import chunk_spans, draw_parameters, grid_parameters, shard_spans, span_name, stream


def test_streams_depend_on_every_part_of_the_key() -> None:
    keys = [(1, "halos", 0, ""), (2, "halos", 0, ""), (1, "mocks", 0, ""), (1, "halos", 1, "")]
    keys += [(1, "mocks", 0, "F814W"), (1, "mocks", 0, "F555W")]
    first = [stream(*key).random() for key in keys]
    assert len(set(first)) == len(keys)
    assert first == [stream(*key).random() for key in keys]


def test_parameters_do_not_depend_on_the_span() -> None:
    prior = (1.0, 5.0), (13.0, 13.5)
    whole = draw_parameters(3, (0, 40), *prior)
    parts = [draw_parameters(3, span, *prior) for span in ((0, 7), (7, 33), (33, 40))]
    assert np.array_equal(whole.m_th_kev, np.concatenate([part.m_th_kev for part in parts]))
    assert np.array_equal(whole.sample_id, np.arange(40))


def test_parameters_are_uniform_and_independent() -> None:
    drawn = draw_parameters(7, (0, 2000), (1.0, 5.0), (13.0, 13.5))
    assert stats.kstest(drawn.m_th_kev, stats.uniform(1.0, 4.0).cdf).pvalue > 1e-3
    assert stats.kstest(drawn.log10_m_halo_msun, stats.uniform(13.0, 0.5).cdf).pvalue > 1e-3
    assert stats.spearmanr(drawn.m_th_kev, drawn.log10_m_halo_msun).pvalue > 1e-3
    assert stats.kstest(drawn.m_th_kev, stats.uniform(1.0, 3.5).cdf).pvalue < 1e-6  # a wrong prior is seen


def test_chunks_are_full_and_shards_are_cut() -> None:
    assert chunk_spans(2483, 250)[-1] == (2250, 2500)
    assert chunk_spans(5000, 250)[:10] == chunk_spans(2483, 250)
    assert shard_spans(6400, 600)[-1] == (6000, 6400)
    names = [span_name(span) for span in chunk_spans(10**6, 10**5)]
    assert names == sorted(names)


def test_a_grid_brings_all_nodes_before_the_next_realization() -> None:
    nodes = (1.0, 2.0, 5.0), (12.0, 13.0)
    grid = grid_parameters((0, 14), *nodes)
    assert grid.m_th_kev[:7].tolist() == [1.0, 2.0, 5.0, 1.0, 2.0, 5.0, 1.0]
    assert grid.log10_m_halo_msun[:7].tolist() == [12.0, 12.0, 12.0, 13.0, 13.0, 13.0, 12.0]
    later = grid_parameters((5, 9), *nodes)
    assert np.array_equal(later.m_th_kev, grid.m_th_kev[5:9])
    assert later.sample_id.tolist() == [5, 6, 7, 8]
