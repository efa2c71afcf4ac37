"""Learn summaries: the posterior mean of each parameter, regressed on all summaries.

The posterior mean is the summary that loses least (Fearnhead & Prangle 2012, JRSS B 74, 419). Here it is a
ridge regression on the table itself, cross-fitted: no sample is predicted by a model that was trained on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.types import FloatArray

PENALTIES = np.logspace(-3.0, 5.0, 25)
N_FOLDS = 10
MIN_SAMPLES = 50


@dataclass(frozen=True)
class LearnedSummaries:
    """One learned summary per parameter."""

    samples: FloatArray  # prediction for each sample by the models of the other folds [n, n_parameters]
    # Mean prediction of all folds' models for the observation, or for several [..., n_parameters]
    observed: FloatArray
    # Cross-validated fraction of the variance that is predicted [n_parameters]; <= 0 if nothing is
    r_squared: FloatArray
    penalty: FloatArray  # ridge penalty of the standardised summaries that predicts best [n_parameters]


def learned_summaries(
    parameters: FloatArray,
    features: FloatArray,
    observed: FloatArray,
    rng: np.random.Generator,
    n_folds: int = N_FOLDS,
) -> LearnedSummaries:
    """Regress every parameter on all summaries.

    Parameters
    ----------
    parameters
        [n, n_parameters]; ValueError below `MIN_SAMPLES` samples.
    features, observed
        Summaries of the samples [n, n_features] and of the observation, or of several [..., n_features]. They
        enter as asinh(x / rms), which tames their tails, standardised.
    """
    n = len(parameters)
    if n < MIN_SAMPLES:
        raise ValueError(f"learned summaries need {MIN_SAMPLES} samples, there are {n}; raise campaign.n_samples")
    x, x_observed = _standardised(features, observed.reshape(-1, features.shape[1]))
    fold = rng.permutation(np.arange(n) % n_folds)
    predictions = np.empty((PENALTIES.size, *parameters.shape))
    of_observed = np.zeros((PENALTIES.size, len(x_observed), parameters.shape[1]))
    mean = parameters.mean(axis=0)  # the same for all: a constant per fold would distinguish the folds
    for i in range(n_folds):
        train, test = fold != i, fold == i
        centred = x[train]
        centred -= centred.mean(axis=0)
        values, vectors = np.linalg.eigh(centred.T @ centred)
        projected = vectors.T @ (centred.T @ (parameters[train] - parameters[train].mean(axis=0)))
        shrunk = projected / (np.maximum(values, 0.0)[:, None] + PENALTIES[:, None, None])  # [n_penalties, p, n_y]
        predictions[:, test] = mean + x[test] @ vectors @ shrunk
        of_observed += (mean + x_observed @ vectors @ shrunk) / n_folds
    error = np.square(predictions - parameters).mean(axis=1)  # [n_penalties, n_parameters]
    best = error.argmin(axis=0)
    column = np.arange(parameters.shape[1])
    variance = parameters.var(axis=0)
    return LearnedSummaries(
        samples=predictions[best, :, column].T,
        observed=of_observed[best, :, column].T.reshape(*observed.shape[:-1], -1),
        r_squared=1.0 - error[best, column] / np.where(variance > 0.0, variance, 1.0),
        penalty=PENALTIES[best],
    )


def _standardised(features: FloatArray, observed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the features transformed to mean 0 and variance 1 over the samples, without constant ones."""
    used = np.ptp(features, axis=0) > 0.0
    if not used.any():
        return np.zeros((len(features), 1)), np.zeros((len(observed), 1))
    rows, row = features[:, used], observed[:, used]
    scale = np.sqrt(np.square(rows).mean(axis=0))
    for values in (rows, row):
        values /= scale
        np.arcsinh(values, out=values)
    mean, spread = rows.mean(axis=0), rows.std(axis=0)
    spread = np.where(spread > 0.0, spread, 1.0)
    for values in (rows, row):
        values -= mean
        values /= spread
    return rows, row
