"""Apply other priors to a table by weights of its samples, which were drawn from a uniform prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy  # scipy.stats takes 1 s to import; scipy loads it on first use

from warmlens.inference.table import Range, Table
from warmlens.types import FloatArray

MAX_OUTSIDE = 0.01

# Density in m up to a factor. The half-mode mass is a power of m (Viel+2005: alpha ~ m^-1.11), so that a prior
# uniform in its logarithm is the one uniform in log m.
MASS_PRIORS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "uniform_m": np.ones_like,
    "uniform_log_m": lambda m: 1.0 / m,
    "uniform_inverse_m": lambda m: 1.0 / m**2,
    "uniform_log_half_mode_mass": lambda m: 1.0 / m,
}


@dataclass(frozen=True)
class HaloMassPrior:
    """Prior of log10(M / Msun): normal with `mean` and `sigma` [dex], or flat between these two as edges."""

    mean: float
    sigma: float
    flat: bool = False

    def density(self, log10_mass: FloatArray) -> FloatArray:
        """Return the density up to a factor, in the shape of `log10_mass`."""
        if self.flat:
            return ((log10_mass >= self.mean) & (log10_mass <= self.sigma)).astype(np.float64)
        return scipy.stats.norm.pdf(log10_mass, self.mean, self.sigma)

    def outside(self, box: Range) -> float:
        """Return the probability of this prior outside the box of the samples."""
        if self.flat:
            inside = min(self.sigma, box[1]) - max(self.mean, box[0])
            return 1.0 - max(inside, 0.0) / (self.sigma - self.mean)
        below = np.asarray(scipy.stats.norm.cdf(np.array(box), self.mean, self.sigma))
        return float(1.0 - (below[1] - below[0]))


HALO_MASS_PRIORS = {
    "flat_13_13.5": HaloMassPrior(13.0, 13.5, flat=True),
    "normal_13.36_0.14": HaloMassPrior(13.36, 0.14),
    "normal_13.9_0.3": HaloMassPrior(13.9, 0.3),
}


@dataclass(frozen=True)
class Reweighting:
    """Weights of the samples under another prior [n], largest 1, and warnings."""

    weights: FloatArray
    warnings: tuple[str, ...]


def reweightings(table: Table) -> dict[str, Reweighting]:
    """Return weights per prior of `MASS_PRIORS` and `HALO_MASS_PRIORS`; the other parameter stays uniform."""
    by_name = {}
    for name, density in MASS_PRIORS.items():
        weights = density(table.m_kev)
        by_name[name] = Reweighting(weights / weights.max(), ())
    low, high = box = table.log10_mass_range
    for name, prior in HALO_MASS_PRIORS.items():
        weights = prior.density(table.log10_mass)
        outside = prior.outside(box)
        warnings = []
        if outside > MAX_OUTSIDE:
            warnings.append(
                f"prior {name}: {outside:.0%} of it lies outside the sampled halo masses [{low:g}, {high:g}] and "
                "is cut off; widen dark_matter.log10_m_halo_msun"
            )
        by_name[name] = Reweighting(weights / max(weights.max(), np.finfo(float).tiny), tuple(warnings))
    return by_name
