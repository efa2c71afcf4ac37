"""Two-point correlation C(dr) of the negative excess residuals of a scan.

C(dr) is the mean of R(r) R(r + dr) over all pairs of valid raster positions whose separation falls into the
bin of dr, with R = Delta R where Delta R lies below a threshold and 0 elsewhere. Zeros take part in the mean:
the normalisation of C counts the anomalies, its slope says how they cluster (Birrer+2017 sec. 4.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from warmlens.types import BoolArray, FloatArray, IntArray

THRESHOLD = -4.0  # Birrer+2017 sec. 4.2
MAX_DR_ARCSEC = 2.5
BATCH_ELEMENTS = 2_000_000


@dataclass(frozen=True)
class PairGeometry:
    """Pairs of raster positions per bin of separation; made once by `from_raster`.

    Attributes
    ----------
    valid
        Positions that take part [ny, nx].
    step_arcsec
        Separation of neighbouring positions.
    dr_arcsec
        Nominal separation of each bin [arcsec], [n_dr]: bin 0 is a position with itself, bin b holds the
        separations within half a bin width of b widths (and bin 1 also all shorter ones).
    counts
        Valid pairs in each bin [n_dr], each unordered pair once; counts[0] is the number of valid positions.
    lag_rows, lag_columns
        Lags of one half plane [n_lag], sorted by bin.
    bin_starts
        Where each bin begins among the lags [n_dr].
    """

    valid: BoolArray
    step_arcsec: float
    dr_arcsec: FloatArray
    counts: IntArray
    lag_rows: IntArray
    lag_columns: IntArray
    bin_starts: IntArray

    @classmethod
    def from_raster(
        cls,
        valid: BoolArray,
        step_arcsec: float,
        max_dr_arcsec: float = MAX_DR_ARCSEC,
        bin_width_arcsec: float | None = None,
    ) -> PairGeometry:
        """Bin all pairs of the valid positions of a regular raster.

        Parameters
        ----------
        valid
            Positions that take part [ny, nx].
        max_dr_arcsec
            Separation of the last bin [arcsec], rounded to a whole number of bins; the paper's 2.5".
        bin_width_arcsec
            Width of a bin [arcsec]; the step unless given, and never below it.
        """
        width = step_arcsec if bin_width_arcsec is None else bin_width_arcsec
        if not (0.0 < step_arcsec <= width <= max_dr_arcsec < np.inf):
            raise ValueError(
                "need 0 < step_arcsec <= bin_width_arcsec <= max_dr_arcsec, "
                f"got {step_arcsec!r}, {width!r}, {max_dr_arcsec!r}"
            )
        if valid.ndim != 2 or valid.dtype != np.bool_:
            raise ValueError(f"valid must be a boolean [ny, nx] array, got {valid.dtype} {valid.shape}")
        n_dr = 1 + round(max_dr_arcsec / width)
        reach = int(np.ceil((n_dr - 0.5) * width / step_arcsec))
        reach_rows, reach_columns = min(reach, valid.shape[0] - 1), min(reach, valid.shape[1] - 1)
        rows, columns = np.mgrid[0 : reach_rows + 1, -reach_columns : reach_columns + 1]
        half_plane = (rows > 0) | (columns >= 0)  # the other half holds the same pairs again
        rows, columns = rows[half_plane], columns[half_plane]
        bins = np.rint(np.hypot(rows, columns) * (step_arcsec / width)).astype(np.int64)
        bins[(bins == 0) & ((rows != 0) | (columns != 0))] = 1
        order = np.argsort(bins, kind="stable")
        order = order[bins[order] < n_dr]
        rows, columns, bins = rows[order], columns[order], bins[order]
        starts = np.searchsorted(bins, np.arange(n_dr))
        pairs = np.rint(_autocorrelation(valid[None].astype(np.float64), rows, columns)[0]).astype(np.int64)
        counts = np.bincount(bins, weights=pairs, minlength=n_dr).astype(np.int64)
        dr_arcsec = width * np.arange(n_dr, dtype=np.float64)
        if (counts == 0).any():
            raise ValueError(
                f"no pair of the {int(valid.sum())} valid positions is {dr_arcsec[np.argmin(counts)]:.3g} "
                f"arcsec apart; lower max_dr_arcsec = {max_dr_arcsec} or widen the bins"
            )
        return cls(valid, step_arcsec, dr_arcsec, counts, rows, columns, starts)


def correlation_function(delta_r: FloatArray, geometry: PairGeometry, threshold: float = THRESHOLD) -> FloatArray:
    """Compute C(dr) of one or many scan maps, [..., n_dr] at `geometry.dr_arcsec`; never negative.

    C(dr) = (sum of R(r) R(r + dr) over the valid pairs of the bin) / (number of those pairs).

    Parameters
    ----------
    delta_r
        Relative excess distance Delta R, [..., ny, nx]; its value where a position is not valid is ignored.
    threshold
        Only Delta R below it counts (must be <= 0); the paper's -4.

    Reference: Birrer+2017 sec. 4.2.
    """
    r = excess_residuals(delta_r, geometry.valid, threshold)
    sums = np.maximum(lagged_sums(r, geometry), 0.0)  # products of two R <= 0: what is negative is rounding
    return sums / geometry.counts  # C(dr) = <R(r) R(r + dr)>_r


def lagged_sums(maps: FloatArray, geometry: PairGeometry) -> FloatArray:
    """Sum the products over the pairs per bin, [..., n_dr], of finite maps [..., ny, nx], 0 where not valid."""
    flat = maps.reshape(-1, *geometry.valid.shape)
    result = np.empty((flat.shape[0], geometry.counts.size))
    batch = max(1, BATCH_ELEMENTS // geometry.valid.size)
    for start in range(0, flat.shape[0], batch):
        lagged = _autocorrelation(flat[start : start + batch], geometry.lag_rows, geometry.lag_columns)
        result[start : start + batch] = np.add.reduceat(lagged, geometry.bin_starts, axis=1)
    return result.reshape(*maps.shape[:-2], geometry.counts.size)


def excess_residuals(delta_r: FloatArray, valid: BoolArray, threshold: float = THRESHOLD) -> FloatArray:
    """Return R = Delta R where that is valid and below the threshold, 0 elsewhere, [..., ny, nx]."""
    if delta_r.shape[-2:] != valid.shape:
        raise ValueError(f"delta_r has shape {delta_r.shape}, the raster {valid.shape}")
    if not threshold <= 0.0:
        raise ValueError(f"threshold must be <= 0, got {threshold!r}")
    if not np.isfinite(delta_r[..., valid]).all():
        raise ValueError("delta_r is not finite at a valid position")
    below = valid & (np.where(valid, delta_r, 0.0) < threshold)
    return np.where(below, delta_r, 0.0)


def _autocorrelation(maps: FloatArray, lag_rows: IntArray, lag_columns: IntArray) -> FloatArray:
    """Sum R(r) R(r + lag) over r for maps [n, ny, nx] at the lags, [n, n_lag]; by zero-padded FFT."""
    ny, nx = maps.shape[-2:]
    shape = (
        next_fast_len(ny + int(np.abs(lag_rows).max()), real=True),
        next_fast_len(nx + int(np.abs(lag_columns).max()), real=True),
    )
    spectrum = rfft2(maps, shape)
    power = irfft2(spectrum.real**2 + spectrum.imag**2, shape)
    return power[:, lag_rows, lag_columns]
