"""Linear response: the best small amplitude of the perturber at each position, and what a mass would change.

Symbols are those of docs/scan.md, "Linear response". The amplitude eps is 1 for the perturber's theta_e.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warmlens.kernels import njit
from warmlens.scan.forms import unpack
from warmlens.scan.perturber import PerturbedBasis, basis_change, perturbed_basis
from warmlens.scan.shard import OperatorShard, ScanBand
from warmlens.types import FloatArray, IntArray


@dataclass(frozen=True)
class LinearResponse:
    """Score and Fisher information of the amplitude of a perturber.

    Those of several bands add up. All are 0 where the perturber moves no unmasked pixel.

    Attributes
    ----------
    score
        -1/2 dJ/d eps at eps = 0, any shape.
    fisher
        Information on eps without what the linear columns can mimic; the variance of the score. Same shape.
    noise
        f, the mean of the part of it that the noise of the fitted source makes; shape to broadcast.
    """

    score: FloatArray
    fisher: FloatArray
    noise: FloatArray

    @property
    def amplitude(self) -> FloatArray:
        """Unbiased eps = s / (F - f); NaN where the source is not known well enough for F > f."""
        return self.significance * self.error

    @property
    def error(self) -> FloatArray:
        """Standard deviation of the amplitude, sqrt(F) / (F - f); NaN like it."""
        clean = self.fisher - self.noise
        informed = self.fisher > self.noise
        return np.divide(np.sqrt(self.fisher), clean, out=np.full_like(self.fisher, np.nan), where=informed)

    @property
    def significance(self) -> FloatArray:
        """Score in units of its error, s / sqrt(F): normal with variance 1 without perturber; NaN where F = 0."""
        out = np.full_like(self.score, np.nan)
        return np.divide(self.score, np.sqrt(self.fisher), out=out, where=self.fisher > 0.0)


def expected_delta_r(
    shard: OperatorShard, band: ScanBand, theta_e: Sequence[float], source_coefficients: FloatArray
) -> FloatArray:
    """Expected Delta R, <= 0, of an image of this source that does contain the perturber fitted to it.

    One band. With data A(theta_e) x + noise the fit with the perturber leaves noise alone; the one without
    also what the other columns cannot mimic of U dB x, which is delta.K delta whatever theta_e. No
    linearisation in theta_e, and no other operator; only the penalty of the priors is neglected.

    Parameters
    ----------
    shard, band
        As for `warmlens.scan.apply.delta_r`, the shard built with its response. The perturber's own theta_e does
        not matter.
    theta_e
        Deflections inside r_trunc [arcsec], [n].
    source_coefficients
        Of the unscaled source columns [n_source].

    Returns
    -------
    FloatArray
        [n, n_positions], 0 where the perturber moves no unmasked pixel.
    """
    source_coefficients = np.ascontiguousarray(source_coefficients, dtype=np.float64)
    check_response(shard)
    if source_coefficients.shape != (band.model.n_source,):
        raise ValueError(
            f"source_coefficients must be [n_source] = [{band.model.n_source}] for these sets, "
            f"got {source_coefficients.shape}"
        )
    perturbers = [dataclasses.replace(band.perturber, theta_e=float(value)) for value in theta_e]
    bases = [perturbed_basis(band.sets, band.rays, perturber) for perturber in perturbers]
    return np.stack([-_improvement(basis, shard, shard.response_offsets, source_coefficients) for basis in bases])


def detectable_theta_e(theta_e: FloatArray, expected: FloatArray, delta_r: float) -> FloatArray:
    """Find the smallest theta_e [arcsec] with which the expected Delta R falls to -delta_r.

    Parameters
    ----------
    theta_e
        Rising values [arcsec], [n].
    expected
        `expected_delta_r` of them, of all bands together, [n, ...].
    delta_r
        Size of a detection, > 0.

    Returns
    -------
    FloatArray
        [...]. Between the values a power law; below the first the square of theta_e, as it is for
        small deflections; NaN where even the largest is not detected.
    """
    gain = -np.asarray(expected)
    detected = gain >= delta_r
    upper = np.argmax(detected, axis=0)  # the first that is detected
    lower = np.maximum(upper - 1, 0)
    high = np.take_along_axis(gain, upper[None], axis=0)[0]
    low = np.take_along_axis(gain, lower[None], axis=0)[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        below = theta_e[upper] * np.sqrt(delta_r / high)
        slope = np.log(theta_e[upper] / theta_e[lower]) / np.log(high / low)
        between = theta_e[upper] * (delta_r / high) ** slope
    return np.where(detected.any(axis=0), np.where(upper == 0, below, between), np.nan)


def mass_within_truncation(theta_e: FloatArray, r_trunc: float, sigma_crit: float) -> FloatArray:
    """Mass of the perturber within r_trunc [Msun]: pi theta_e r_trunc Sigma_crit.

    `sigma_crit` is in Msun per square arcsec of the lens plane, theta_e and r_trunc in arcsec.
    """
    return np.pi * theta_e * r_trunc * sigma_crit


def check_response(shard: OperatorShard) -> None:
    """Raise a ValueError if the shard was built or read without the linear response."""
    if shard.responses.size != shard.response_offsets[-1]:
        raise ValueError("the shard has no linear response; build it and read it with")


@njit(cache=True)
def _improvement(
    basis: PerturbedBasis, shard: OperatorShard, response_offsets: IntArray, coefficients: FloatArray
) -> FloatArray:
    """Return delta.K delta of each position [n_positions], never negative."""
    out = np.zeros(shard.positions.shape[0])
    for position in range(out.size):
        moved = shard.pixels[shard.pixel_offsets[position] : shard.pixel_offsets[position + 1]]
        if moved.size > 0:
            change = basis_change(basis, shard.positions[position, 0], shard.positions[position, 1], moved)
            delta = np.dot(change.T, coefficients)
            K = unpack(shard.responses, response_offsets[position], moved.size)
            out[position] = max(np.dot(delta, np.dot(K, delta)), 0.0)
    return out
