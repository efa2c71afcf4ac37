from __future__ import annotations

import dataclasses

import numpy as np

from warmlens.campaign import stream
from warmlens.inference.summary_sets import summary_sets
from warmlens.inference.table import Table


def test_learned_summaries_are_worth_more_than_distances_swamped_by_noise():
    rng = np.random.default_rng(1)
    n = 1501
    m, log10_mass = rng.uniform(1.0, 5.0, n), rng.uniform(13.0, 13.5, n)
    first = rng.standard_normal((n, 40))
    first[:, 0] += 2.0 * m  # one of forty tells
    second = rng.standard_normal((n, 20))
    features = first, second
    table = Table(
        np.arange(n - 1),
        m[1:],
        log10_mass[1:],
        (1.0, 5.0),
        (13.0, 13.5),
        tuple(rows[1:] for rows in features),
        tuple(rows[0] for rows in features),
    )
    found = summary_sets(table, 0.05, 100, 200, lambda name: stream(1, name, 0))
    assert set(found) == {"paper", "correlation", "cumulative", "learned", "learned_m"}
    gain = {name: entry.gain.gain_nats for name, entry in found.items()}
    assert gain["learned_m"] > gain["learned"] > gain["paper"] > gain["cumulative"]
    assert abs(gain["cumulative"]) < 0.02
    assert gain["learned_m"] > 0.4
    assert found["learned"].r_squared[0] > 0.8
    assert found["paper"].r_squared is None
    swapped = dataclasses.replace(table, features=table.features[::-1], observed=table.observed[::-1])
    other = summary_sets(swapped, 0.05, 100, 200, lambda name: stream(1, name, 0))
    assert other["cumulative"].gain == found["correlation"].gain  # the same pseudo-observations
    sharper = summary_sets(table, 0.05, 100, 200, lambda name: stream(1, name, 0), m[1:, None], m[:1])
    assert sharper["learned_m"].gain.gain_nats > gain["learned_m"] + 0.3
