"""Least squares over the parameters of the smooth model, its amplitudes solved for at every step."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, optimize

from warmlens.fitting.image_model import ImageModel, Solution
from warmlens.types import FloatArray

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outcome:
    """How a fit ended; `converged` is False if its steps, evaluations of the model, ran out before."""

    solution: Solution
    converged: bool
    steps: int
    message: str


def fit_parameters(model: ImageModel, start: FloatArray, max_steps: int, tolerance: float, label: str) -> Outcome:
    """Minimise |residuals|^2 from a parameter vector [n], by at most `max_steps` evaluations of the model.

    The fit has converged when a step lowers the cost by less than the fraction `tolerance`; `label` names it in
    the log.

    Notes
    -----
    Trust-region least squares with limits (scipy). The amplitudes are projected out of residuals and Jacobian
    (Kaufman 1975): the gradient is exact, the curvature approximate.
    """
    begin = time.monotonic()
    latest: list[Solution] = []
    count = 0

    def residuals(vector: FloatArray) -> FloatArray:
        nonlocal count
        solution = model.solve(vector)
        latest[:] = [solution]
        count += 1
        log.info(
            "%s, step %d of at most %d: chi2 per pixel %.4f, %.0f s",
            label, count, max_steps, solution.chi2 / solution.n_pixels, time.monotonic() - begin,
        )  # fmt: skip
        return model.residuals(solution)

    def jacobian(vector: FloatArray) -> FloatArray:
        solution = latest[0] if np.array_equal(latest[0].vector, vector) else model.solve(vector)
        return model.jacobian(solution)

    lower, upper = model.space.limits
    inside = np.clip(start, lower + 1e-6 * (upper - lower), upper - 1e-6 * (upper - lower))
    best = optimize.least_squares(
        residuals, inside, jacobian, (lower, upper), x_scale="jac",
        ftol=tolerance, xtol=1e-7, gtol=1e-10, max_nfev=max_steps,
    )  # fmt: skip
    solution = latest[0] if np.array_equal(latest[0].vector, best.x) else model.solve(best.x)
    return Outcome(solution, best.status > 0, count, str(best.message))


def tempered(model: ImageModel, start: FloatArray) -> ImageModel:
    """Return the model with its residuals divided by their size at `start`, if that is above the noise."""
    solution = model.solve(start)
    return replace(model, temperature=max(1.0, float(np.sqrt(solution.chi2 / solution.n_pixels))))


def prior_axes(model: ImageModel, solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Return axes along which both the errors of the fit and its prior are independent.

    Returns
    -------
    axes
        V [n, n], one per column: steps of the parameters by one sigma of the fit, V^T C^-1 V = 1.
    prior_sigma
        Width of the prior (limits of the parameters apart, the quasars' tie included) along each, in units of
        that sigma [n], >= 1; infinite where there is none.

    Notes
    -----
    The curvature C^-1 holds the prior's P. With the covariance C = R R^T, R^T P R = U diag(w) U^T and V = R U, the
    prior has the precision w <= 1 along V: the data have 1 - w.
    """
    root = np.linalg.cholesky(covariance(model, solution))
    rows = model.prior_jacobian(model.derivatives(solution)[1])
    weights, turned = np.linalg.eigh(root.T @ (rows.T @ rows) @ root)
    with np.errstate(divide="ignore"):
        return root @ turned, 1.0 / np.sqrt(np.clip(weights, 0.0, 1.0))


def covariance(model: ImageModel, solution: Solution) -> FloatArray:
    """Return the covariance of the parameters [n, n] from the curvature at the best fit, priors included.

    Raises
    ------
    ValueError
        If the data and the priors leave a direction undetermined.
    """
    jacobian = model.jacobian(solution)
    norms = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / np.where(norms > 0.0, norms, 1.0)
    factor, info = linalg.lapack.dpotrf(scaled.T @ scaled, lower=1, clean=1)
    # The square of a pivot is what the parameters before leave of one whose effect has unit norm.
    smallest = float(np.diagonal(factor).min()) ** 2 if info == 0 else 0.0
    if norms.min() <= 1e-10 * norms.max() or smallest <= norms.size * np.finfo(np.float64).eps:
        raise ValueError(
            "smooth_model.fit: data and priors do not determine all parameters; give the parameters of "
            "smooth_model.fit a prior width, or free fewer of them"
        )
    return linalg.cho_solve((factor, True), np.eye(norms.size)) / np.outer(norms, norms)
