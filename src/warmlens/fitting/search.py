"""Global search of the lens by a particle swarm, on a source of few shapelets."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from warmlens.fitting.image_model import ImageModel
from warmlens.types import BoolArray, FloatArray

log = logging.getLogger(__name__)


def particle_swarm(
    model: ImageModel, particles: int, iterations: int, searched: BoolArray, rng: np.random.Generator
) -> FloatArray:
    """Return the best parameter vector [n] that a swarm finds within the limits.

    Parameters
    ----------
    model
        Data, free parameters and a small source basis: every particle costs a linear solve.
    searched
        Which parameters take part [n]; the others stay at their start.

    Notes
    -----
    The swarm is lenstronomy's (Kennedy & Eberhart 2001; Birrer et al. 2015). Its first best particle is the start
    of the configuration, so that the result is never worse than that.
    """
    # lenstronomy takes a second to import: only where a swarm is asked for
    from lenstronomy.Sampling.Samplers.pso import ParticleSwarmOptimizer

    start = model.space.start
    lower, upper = (limit[searched] for limit in model.space.limits)

    def log_posterior(values: FloatArray) -> float:
        if np.any(values <= lower) or np.any(values >= upper):
            return -np.inf
        vector = start.copy()
        vector[searched] = values
        try:
            residuals = model.residuals(model.solve(vector))
        except ValueError as error:  # no light of the source reaches the image through this lens
            log.debug("particle refused: %s", error)
            return -np.inf
        return -0.5 * float(residuals @ residuals)

    with _seeded_global_generator(rng):
        swarm = ParticleSwarmOptimizer(log_posterior, lower, upper, particles)
        swarm.set_global_best(start[searched], np.zeros(len(lower)), log_posterior(start[searched]))
        for number, _ in enumerate(swarm.sample(iterations, verbose=False), start=1):
            best_yet = swarm.global_best.fitness
            log.info("particle swarm: move %d of %d, log posterior %.1f", number, iterations, best_yet)
        best = start.copy()
        best[searched] = swarm.global_best.position
    return best


@contextmanager
def _seeded_global_generator(rng: np.random.Generator) -> Iterator[None]:
    """Give numpy's global generator, the only one that lenstronomy's swarm knows, a seed; restore it after."""
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(int(rng.integers(2**32)))  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002
