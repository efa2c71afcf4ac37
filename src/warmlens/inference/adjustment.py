"""Local-linear regression adjustment: shift the accepted parameters to the observed summaries.

The parameters are logit-transformed between the edges of the prior, so that nothing leaves it, and regressed on
the summaries of the accepted samples with Epanechnikov weights. Residuals are widened by the degrees of freedom
that the regression takes, sqrt(ESS / (ESS - n_components - 1)). The adjusted bound is listed with that of the
plain acceptance and is valid only if its own coverage test passes (`calibration`).

Reference: Beaumont, Zhang & Balding 2002, Genetics 162, 2025; Blum 2010, JASA 105, 1178.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logit

from warmlens.inference.bootstrap import Counts, reached
from warmlens.inference.bound import TooFewError
from warmlens.inference.memory import row_batches
from warmlens.types import BoolArray, FloatArray

MIN_FOR_REGRESSION = 100
SAMPLES_PER_COMPONENT = 20
RIDGE = 1e-3
_MAX_PRODUCTS = 32_000_000  # of an array for all fits at once, 256 MB; above it is one fit after the other


@dataclass(frozen=True)
class Adjustment:
    """Adjusted parameters of the accepted samples.

    Attributes
    ----------
    values, weights
        Parameters within the prior [k, n_parameters], and their Epanechnikov weights [k]: 0 for the sample at
        the cut.
    n_components
        Number of principal components of the summaries in the regression.
    """

    values: FloatArray
    weights: FloatArray
    n_components: int


def kernel_weights(distances: FloatArray, accepted: BoolArray) -> FloatArray:
    """Return Epanechnikov weights 1 - max_i(d_i / h_i) of the accepted rows [k]; distances d are squared already.

    h_i is the largest accepted distance of kind i, so that the accepted rows are those of weight >= 0. The
    distances [n_cut, n] are those that the rule cut on, from `acceptance.reduce_distances`.
    """
    chosen = distances[:, accepted]
    cut = chosen.max(axis=1, keepdims=True)
    return 1.0 - (chosen / np.where(cut > 0.0, cut, 1.0)).max(axis=0)


def adjust(
    parameters: FloatArray,
    ranges: Sequence[tuple[float, float]],
    features: FloatArray,
    observed: FloatArray,
    distances: FloatArray,
    accepted: BoolArray,
) -> Adjustment:
    """Adjust the parameters of the accepted rows.

    Parameters
    ----------
    parameters
        Parameters of the samples [n, n_parameters], from the uniform prior within `ranges`.
    features, observed
        Summaries of the samples [n, n_features] and of the observation [n_features].
    distances, accepted
        Distances that the rule cut on [n_cut, n], and the rows that it accepted [n].

    Raises
    ------
    TooFewError
        Below `MIN_FOR_REGRESSION` accepted samples.
    """
    k = int(accepted.sum())
    if k < MIN_FOR_REGRESSION:
        raise TooFewError(
            f"the regression adjustment needs {MIN_FOR_REGRESSION} accepted samples, there are {k}; raise "
            "abc.fraction or campaign.n_samples",
            np.nan,
        )
    weights = kernel_weights(distances, accepted)
    if not weights.any():
        weights = np.ones(k)  # all at the cut: equally far
    scores = local_scores(features[accepted], features[accepted], observed)
    y = _to_logit(parameters[accepted], ranges)
    coefficients = _regress(weights[None], scores, y)
    adjusted = _predict(coefficients, weights[None], scores, y)[0]
    return Adjustment(_from_logit(adjusted, ranges), weights, scores.shape[1])


def local_scores(rows: FloatArray, accepted_rows: FloatArray, observed: FloatArray) -> FloatArray:
    """Return principal components of rows minus the observation [n, n_components].

    The components are those of the accepted rows [k, n_features] in units of their MAD (of their standard
    deviation where that is 0), the k / 20 of largest variance, each scaled to unit variance.
    """
    k = accepted_rows.shape[0]
    scale = 1.4826 * np.median(np.abs(accepted_rows - np.median(accepted_rows, axis=0)), axis=0)
    spread = accepted_rows.std(axis=0)
    scale = np.where(scale > 0.0, scale, spread)
    used = spread > 1e-12 * np.abs(accepted_rows).max(axis=0, initial=0.0)
    if not used.any():
        return np.zeros((rows.shape[0], 0))
    centred = (accepted_rows[:, used] - accepted_rows[:, used].mean(axis=0)) / scale[used]
    values, vectors = np.linalg.eigh(centred.T @ centred / k)
    n_components = min(k // SAMPLES_PER_COMPONENT, int((values > 1e-10 * values[-1]).sum()))
    values, vectors = values[::-1][:n_components], vectors[:, ::-1][:, :n_components]
    return (rows[:, used] - observed[used]) / scale[used] @ (vectors / np.sqrt(values))


def adjusted_quantiles_of_counts(
    values: FloatArray,
    value_range: tuple[float, float],
    scores: FloatArray,
    distances: FloatArray,
    counts: Counts,
    levels: FloatArray,
) -> FloatArray:
    """Return quantiles of one adjusted parameter in bootstrapped tables [n_bootstrap, n_levels].

    Parameters
    ----------
    values, value_range
        Parameter of each sample [n] and the edges of its prior.
    scores
        From `local_scores` for all rows [n, n_components]; the bootstrap keeps the components of the table.
    distances
        Distances that the rule cut on [n_cut, n].
    counts
        From `bootstrap_counts` [n_bootstrap, n].
    """
    used = counts.any(axis=0)
    values, scores, distances, counts = values[used], scores[used], distances[:, used], counts[:, used]
    batches = row_batches(*counts.shape)
    return np.concatenate(
        [_adjusted_quantiles(values, value_range, scores, distances, counts[batch], levels) for batch in batches]
    )


def _adjusted_quantiles(
    values: FloatArray,
    value_range: tuple[float, float],
    scores: FloatArray,
    distances: FloatArray,
    counts: Counts,
    levels: FloatArray,
) -> FloatArray:
    nearness = np.zeros(counts.shape)
    for distance in distances:
        cut = np.where(counts > 0, distance, 0.0).max(axis=1, keepdims=True)
        np.maximum(nearness, distance / np.where(cut > 0.0, cut, 1.0), out=nearness)
    weights: FloatArray = counts.astype(np.float64) * np.clip(1.0 - nearness, 0.0, 1.0)
    equal = ~weights.any(axis=1)  # all at the cut
    weights[equal] = counts[equal]
    y = _to_logit(values[:, None], [value_range])
    adjusted = _predict(_regress(weights, scores, y), weights, scores, y)[:, :, 0]  # [n_bootstrap, n]
    order = np.argsort(adjusted, axis=1)
    adjusted = np.take_along_axis(adjusted, order, axis=1)
    cumulative = np.cumsum(np.take_along_axis(weights, order, axis=1), axis=1)
    quantiles = [
        adjusted[np.arange(len(adjusted)), np.argmax(cumulative >= level * cumulative[:, -1:], axis=1)]
        for level in reached(levels)
    ]
    return _from_logit(np.stack(quantiles, axis=1)[..., None], [value_range])[..., 0]


def _predict(coefficients: FloatArray, weights: FloatArray, scores: FloatArray, y: FloatArray) -> FloatArray:
    """Return the fit at the observation plus widened residuals [n_fits, n, n_y]."""
    ess = weights.sum(axis=1) ** 2 / np.square(weights).sum(axis=1)
    widening = np.sqrt(ess / np.maximum(ess - scores.shape[1] - 1.0, 1.0))[:, None, None]
    intercept, slopes = coefficients[:, :1], coefficients[:, 1:]
    return intercept + widening * (y - intercept - scores @ slopes)


def _regress(weights: FloatArray, scores: FloatArray, y: FloatArray) -> FloatArray:
    """Return intercept and slopes of a ridge regression per row of weights [n_fits, 1 + n_components, n_y]."""
    design = np.column_stack([np.ones(len(scores)), scores])
    size, total = design.shape[1], weights.sum(axis=1)[:, None, None]
    if len(design) * size**2 <= _MAX_PRODUCTS:
        products = (design[:, :, None] * design[:, None, :]).reshape(len(design), -1)
        normal = (weights @ products).reshape(-1, size, size)
    else:
        normal = np.stack([design.T @ (weight[:, None] * design) for weight in weights])
    right = (weights @ (design[:, :, None] * y[:, None, :]).reshape(len(design), -1)).reshape(-1, size, y.shape[1])
    penalty = RIDGE * np.eye(size)
    penalty[0, 0] = 0.0
    return np.linalg.solve(normal / total + penalty, right / total)


def _to_logit(parameters: FloatArray, ranges: Sequence[tuple[float, float]]) -> FloatArray:
    """Return the logit of parameters [..., n_parameters] between the edges of their prior."""
    low, high = np.array(ranges).T
    return logit(np.clip((parameters - low) / (high - low), 1e-9, 1.0 - 1e-9))


def _from_logit(y: FloatArray, ranges: Sequence[tuple[float, float]]) -> FloatArray:
    low, high = np.array(ranges).T
    return low + (high - low) * expit(y)
