"""Summaries of the linear-response map: how large the best small perturbations are, and how they cluster.

At each position the scan gives the score s and the Fisher information F of the amplitude of a perturber
(docs/scan.md): s / F estimates the amplitude with variance 1 / F, and z = s / sqrt(F) is its significance. No
threshold is involved, so that anomalies too weak to stand out count together.
"""

from __future__ import annotations

import numpy as np

from warmlens.summaries.correlation import PairGeometry, lagged_sums
from warmlens.types import BoolArray, FloatArray


def mean_square_significance(score: FloatArray, fisher: FloatArray, valid: BoolArray) -> FloatArray:
    """Average z^2 = s^2 / F over the valid positions with information, [...]; 1 in the mean for noise alone.

    Score and Fisher information are [..., ny, nx], already summed over the bands.
    """
    s, f = _clean(score, fisher, valid)
    informed = f > 0.0
    squares = np.divide(s**2, f, out=np.zeros_like(s), where=informed)
    number = informed.sum(axis=(-2, -1))
    if not (number > 0).all():
        raise ValueError("a map has no valid position with Fisher information")
    return np.asarray(squares.sum(axis=(-2, -1)) / number)


def amplitude_correlation(score: FloatArray, fisher: FloatArray, geometry: PairGeometry) -> FloatArray:
    """Correlate the amplitude, every pair weighted by the sensitivity of both positions.

    C(dr) = sum w w' a a' / sum w w' over the pairs of the bin, with a = s / F and w = F the inverse variance:
    sum s s' / sum F F', which is finite where F is 0. Bin 0 holds the variance of the noise too, 1 / F.

    Score and Fisher information are [..., ny, nx], already summed over the bands. The correlation [..., n_dr] is
    in units of the perturber's amplitude squared; 0 for bins without information.
    """
    s, f = _clean(score, fisher, geometry.valid)
    weights = np.maximum(lagged_sums(f, geometry), 0.0)  # F >= 0: what is negative is rounding
    informed = weights > 1e-12 * weights[..., :1]
    return np.divide(lagged_sums(s, geometry), weights, out=np.zeros_like(weights), where=informed)


def _clean(score: FloatArray, fisher: FloatArray, valid: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return both maps, 0 where not valid; refuse values that are not finite and negative information."""
    if score.shape != fisher.shape or score.shape[-2:] != valid.shape:
        raise ValueError(f"score has shape {score.shape}, fisher {fisher.shape}, the raster {valid.shape}")
    s, f = np.where(valid, score, 0.0), np.where(valid, fisher, 0.0)
    if not (np.isfinite(s).all() and np.isfinite(f).all() and (f >= 0.0).all()):
        raise ValueError("score or fisher is not finite, or fisher is negative, at a valid position")
    return s, f
