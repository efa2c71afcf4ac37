"""What is sampled: parameters of sample i, random streams, spans of chunks and shards."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warmlens.types import FloatArray, IntArray

Span = tuple[int, int]


def stream(seed: int, stage: str, sample: int, band: str = "") -> np.random.Generator:
    """Return a generator of random numbers that depend on (seed, stage, sample, band) alone.

    Names enter by their CRC-32, so that a stage or band keeps its numbers when others are added.
    """
    key = (zlib.crc32(stage.encode()), sample, zlib.crc32(band.encode()))
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


@dataclass(frozen=True)
class Parameters:
    """Parameters of a span of samples, each [n]."""

    sample_id: IntArray
    m_th_kev: FloatArray
    log10_m_halo_msun: FloatArray


def draw_parameters(
    seed: int, span: Span, m_th_kev: tuple[float, float], log10_m_halo_msun: tuple[float, float]
) -> Parameters:
    """Draw the parameters of samples start..stop-1 from the uniform prior, each from a stream of its own."""
    ids = np.arange(*span)
    uniforms = np.array([stream(seed, "parameters", int(i)).random(2) for i in ids]).reshape(-1, 2)
    lower = np.array([m_th_kev[0], log10_m_halo_msun[0]])
    upper = np.array([m_th_kev[1], log10_m_halo_msun[1]])
    theta = lower + (upper - lower) * uniforms
    return Parameters(ids, theta[:, 0], theta[:, 1])


def grid_parameters(span: Span, m_th_kev: Sequence[float], log10_m_halo_msun: Sequence[float]) -> Parameters:
    """Return the parameters of samples start..stop-1 of a grid.

    All nodes come once, relic mass fastest, before the next realization begins, so that more realizations do not
    change earlier samples.
    """
    ids = np.arange(*span)
    halo, relic = np.divmod(ids % (len(m_th_kev) * len(log10_m_halo_msun)), len(m_th_kev))
    return Parameters(
        ids, np.array(m_th_kev, dtype=np.float64)[relic], np.array(log10_m_halo_msun, dtype=np.float64)[halo]
    )


def chunk_spans(n: int, size: int) -> list[Span]:
    """Return full spans [c * size, (c + 1) * size) that cover 0..n-1; the last one may reach beyond n."""
    return [(start, start + size) for start in range(0, n, size)]


def shard_spans(n: int, size: int) -> list[Span]:
    """Return spans of `size` that cover 0..n-1 exactly; the last one ends at n."""
    return [(start, min(start + size, n)) for start in range(0, n, size)]


def span_name(span: Span) -> str:
    """Return the span as part of a file name, of fixed width, so that names sort."""
    return f"{span[0]:07d}-{span[1]:07d}"
