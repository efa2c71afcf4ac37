"""Deflection and convergence of truncated NFW halos.

The profile is rho = rho_s / [x (1 + x)^2] * tau^2 / (tau^2 + x^2) with x = r / r_s and tau = r_t / r_s
(Baltz et al. 2009, n = 1). Everything is written in s = x^2 and in the projected mass in units of
M_n = 4 pi rho_s r_s^3, called m(s), so that with the angle theta from the centre

    alpha = alpha_scale / r_s * [m(s) / s] * theta,    kappa = alpha_scale / r_s * dm/ds,
    alpha_scale = 4 rho_s r_s^2 / Sigma_cr  (as an angle; r_s here as an angle too).

Reference: Baltz et al. 2009, n = 1; docs/halos.md, item 10.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from warmlens.kernels import njit
from warmlens.types import FloatArray

X_FLOOR = 1e-4  # in units of min(r_s, r_t): m(s) loses digits below, and s there no longer matters
NODE_BITS = 4  # 2**NODE_BITS nodes per factor of two in s: cubic Hermite error < 2e-6
SEGMENT_SHIFT = 52 - NODE_BITS
FRACTION_MASK = (1 << SEGMENT_SHIFT) - 1
EXPONENT_OF_ONE = 0x3FF0000000000000  # bits of 1.0: with a mantissa they make a number in [1, 2)
BLOCK = 512  # rays


class TnfwHalos(NamedTuple):
    """Truncated NFW halos on the sky, each [n]; n may be 0.

    Attributes
    ----------
    center_x, center_y
        Positions [arcsec].
    r_s_arcsec, r_t_arcsec
        Scale and truncation radius [arcsec], > 0.
    alpha_scale
        4 rho_s r_s^2 / Sigma_cr / D_l [arcsec], >= 0; see `tnfw_angular_scales`.
    """

    center_x: FloatArray
    center_y: FloatArray
    r_s_arcsec: FloatArray
    r_t_arcsec: FloatArray
    alpha_scale: FloatArray

    def checked(self) -> TnfwHalos:
        """Return the halos as contiguous float arrays, after checking shapes and ranges.

        Raises
        ------
        ValueError
            If the arrays differ in length, or a value is impossible.
        """
        halos = TnfwHalos(*(np.ascontiguousarray(value, dtype=np.float64) for value in self))
        shape = halos.center_x.shape
        smallest = np.nextafter(0.0, 1.0)
        for name, array, lowest in zip(
            self._fields, halos, (-np.inf, -np.inf, smallest, smallest, 0.0), strict=True
        ):
            if array.ndim != 1 or array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}, expected {shape} with one axis of halos")
            bad = ~np.isfinite(array) | (array < lowest)
            if bad.any():
                first = int(np.argmax(bad))
                raise ValueError(
                    f"{name}[{first}] = {array[first]} ({int(bad.sum())} of {array.size} bad); positions must "
                    "be finite, radii > 0, alpha_scale >= 0"
                )
        return halos


def tnfw_angular_scales(
    r_s_kpc: npt.ArrayLike,
    r_t_kpc: npt.ArrayLike,
    rho_s_msun_kpc3: npt.ArrayLike,
    kpc_per_arcsec: float,
    sigma_crit_msun_kpc2: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return r_s_arcsec, r_t_arcsec and alpha_scale of `TnfwHalos` from physical parameters.

    Parameters
    ----------
    r_s_kpc, r_t_kpc
        Scale and truncation radius [physical kpc], each [n].
    rho_s_msun_kpc3
        Characteristic density [Msun/kpc^3], [n].
    kpc_per_arcsec, sigma_crit_msun_kpc2
        Angular scale [kpc/arcsec] and critical surface density [Msun/kpc^2] of the lens.
    """
    if not (kpc_per_arcsec > 0.0 and sigma_crit_msun_kpc2 > 0.0):
        raise ValueError(
            "kpc_per_arcsec and sigma_crit_msun_kpc2 must be > 0, "
            f"got {kpc_per_arcsec!r} and {sigma_crit_msun_kpc2!r}"
        )
    r_s = np.asarray(r_s_kpc, dtype=np.float64)
    r_t = np.asarray(r_t_kpc, dtype=np.float64)
    rho_s = np.asarray(rho_s_msun_kpc3, dtype=np.float64)
    alpha_scale = 4.0 * rho_s * r_s**2 / sigma_crit_msun_kpc2 / kpc_per_arcsec
    return r_s / kpc_per_arcsec, r_t / kpc_per_arcsec, alpha_scale


def tnfw_deflection(x: npt.ArrayLike, y: npt.ArrayLike, halos: TnfwHalos) -> FloatArray:
    """Return the summed deflection (alpha_x, alpha_y) [2, *x.shape] [arcsec] of all halos at rays (x, y) [arcsec].

    The radial function of each halo is tabulated (cubic Hermite, exact values and slopes at the nodes); the error
    is below 2e-6 of the deflection itself. At the centre of a lone halo the deflection is exactly 0.
    Reference: Birrer+2017 sec. 3.2, alpha_dm; docs/halos.md, item 10.
    """
    rays_x, rays_y = _checked_rays(x, y)
    alpha_x, alpha_y = _sum_deflections(rays_x.ravel(), rays_y.ravel(), halos.checked())
    return np.stack([alpha_x.reshape(rays_x.shape), alpha_y.reshape(rays_x.shape)])


def tnfw_convergence(x: npt.ArrayLike, y: npt.ArrayLike, halos: TnfwHalos) -> FloatArray:
    """Return the summed convergence kappa = Sigma / Sigma_cr of all halos at positions (x, y) [arcsec], any shape.

    It is the value at the point itself, not a mean over a pixel; the logarithmic cusp is cut at x = `X_FLOOR`.
    """
    rays_x, rays_y = _checked_rays(x, y)
    return _sum_convergences(rays_x.ravel(), rays_y.ravel(), halos.checked()).reshape(rays_x.shape)


def _checked_rays(x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the positions as contiguous float arrays of one shape."""
    rays_x = np.ascontiguousarray(x, dtype=np.float64)
    rays_y = np.ascontiguousarray(y, dtype=np.float64)
    if np.shape(x) != np.shape(y):
        raise ValueError(f"x and y must have one shape, got {np.shape(x)} and {np.shape(y)}")
    if not (np.isfinite(rays_x).all() and np.isfinite(rays_y).all()):
        raise ValueError("x and y must be finite; leave masked rays out instead of passing NaN")
    return rays_x.reshape(np.shape(x)), rays_y.reshape(np.shape(x))


@njit(cache=True, error_model="numpy")
def _mass_and_density(s: float, tau: float) -> tuple[float, float]:
    """Return the projected mass m(s) = M2 / M_n inside x = sqrt(s), and dm/ds; Baltz et al. 2009, n = 1."""
    x = math.sqrt(s)
    w = s - 1.0
    if abs(w) < 0.01:  # through x = 1: F = 1 - w/3 + w^2/5 - ..., written as F = 1 - w * deficit
        deficit = 1.0 / 3.0 - w * (1.0 / 5.0 - w * (1.0 / 7.0 - w * (1.0 / 9.0 - w * (1.0 / 11.0 - w / 13.0))))
        f = 1.0 - w * deficit
    else:
        if w < 0.0:
            f = math.log((1.0 + math.sqrt(-w)) / x) / math.sqrt(-w)  # acosh(1/x) / sqrt(1 - x^2)
        else:
            f = math.atan(math.sqrt(w)) / math.sqrt(w)  # acos(1/x) / sqrt(x^2 - 1)
        deficit = (1.0 - f) / w
    tau2 = tau * tau
    root = math.sqrt(tau2 + s)
    ell = math.log(x / (root + tau))  # L(x)
    front = tau2 / (tau2 + 1.0) ** 2
    mass = front * (
        (tau2 + 1.0 + 2.0 * w) * f
        + math.pi * tau
        + (tau2 - 1.0) * math.log(tau)
        + root * (-math.pi + (tau2 - 1.0) / tau * ell)
    )
    bracket = (tau2 + 1.0) * deficit + 2.0 * f - math.pi / root + (tau2 - 1.0) / (tau * root) * ell
    density = 0.5 * front * bracket  # Sigma / (4 rho_s r_s)
    return mass, density


@njit(cache=True, error_model="numpy")
def radial_table(s_floor: float, s_last: float, tau: float) -> FloatArray:
    """Return cubic Hermite coefficients [segment, 4] of h(s) = m(s) / s, from s_floor to beyond s_last.

    The nodes are the numbers whose mantissa ends after `NODE_BITS` bits: evenly spaced within each factor of
    two of s, so nearly even in ln s, and the segment of a ray is read off the bits of s without a logarithm.
    """
    first = np.float64(s_floor).view(np.int64) >> SEGMENT_SHIFT
    n_segments = (np.float64(s_last).view(np.int64) >> SEGMENT_SHIFT) - first + 2
    table = np.empty((n_segments, 4))
    s = np.int64(first << SEGMENT_SHIFT).view(np.float64)
    mass, density = _mass_and_density(s, tau)
    h, slope = mass / s, (density - mass / s) / s  # dh/ds
    for i in range(n_segments):
        s_next = np.int64((first + i + 1) << SEGMENT_SHIFT).view(np.float64)
        mass, density = _mass_and_density(s_next, tau)
        h_next, slope_next = mass / s_next, (density - mass / s_next) / s_next
        step = s_next - s
        table[i, 0] = h
        table[i, 1] = slope * step
        table[i, 2] = 3.0 * (h_next - h) - (2.0 * slope + slope_next) * step
        table[i, 3] = 2.0 * (h - h_next) + (slope + slope_next) * step
        s, h, slope = s_next, h_next, slope_next
    return table


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def read_table(flat: FloatArray, first: int, s: float) -> float:
    """Return h(s) of the flattened table [4 n_segments], whose first segment has the number `first`.

    The place within the segment is the mantissa below the segment's bits, read as a number in [1, 2).
    """
    bits = np.float64(s).view(np.int64)
    i = np.uint64(4 * ((bits >> SEGMENT_SHIFT) - first))  # unsigned: no wrap-around test in the inner loop
    t = np.int64(((bits & FRACTION_MASK) << NODE_BITS) | EXPONENT_OF_ONE).view(np.float64) - 1.0
    return flat[i] + t * (flat[i + np.uint64(1)] + t * (flat[i + np.uint64(2)] + t * flat[i + np.uint64(3)]))


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _sum_deflections(x: FloatArray, y: FloatArray, halos: TnfwHalos) -> tuple[FloatArray, FloatArray]:
    """Sum the deflections (x, y) at flat rays; one table per halo is read by all rays.

    Rays go in blocks and a block in four loops: `read_table`, split so that all loops but the one that reads the
    table are vector operations.
    """
    center_x, center_y, r_s, r_t, alpha_scale = halos
    alpha_x = np.zeros(x.size)
    alpha_y = np.zeros(x.size)
    if x.size == 0:
        return alpha_x, alpha_y
    x_low, x_high, y_low, y_high = x.min(), x.max(), y.min(), y.max()
    place, s, t, h = np.empty(BLOCK, np.int64), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    s_bits, t_bits = s.view(np.int64), t.view(np.int64)
    for k in range(center_x.size):
        x_k, y_k, inverse_r_s2 = center_x[k], center_y[k], 1.0 / r_s[k] ** 2
        tau = r_t[k] / r_s[k]
        s_floor = (X_FLOOR * min(1.0, tau)) ** 2
        far_x = max(abs(x_low - x_k), abs(x_high - x_k))
        far_y = max(abs(y_low - y_k), abs(y_high - y_k))
        s_last = max(s_floor, (far_x * far_x + far_y * far_y) * inverse_r_s2)
        first = np.float64(s_floor).view(np.int64) >> SEGMENT_SHIFT
        flat = (alpha_scale[k] / r_s[k] * radial_table(s_floor, s_last, tau)).ravel()
        for start in range(0, x.size, BLOCK):
            n = min(BLOCK, x.size - start)
            x_ray, y_ray = x[start : start + n], y[start : start + n]
            sum_x, sum_y = alpha_x[start : start + n], alpha_y[start : start + n]
            for j in range(n):
                value = ((x_ray[j] - x_k) ** 2 + (y_ray[j] - y_k) ** 2) * inverse_r_s2
                s[j] = value if value > s_floor else s_floor
            for j in range(n):
                place[j] = 4 * ((s_bits[j] >> SEGMENT_SHIFT) - first)
                t_bits[j] = ((s_bits[j] & FRACTION_MASK) << NODE_BITS) | EXPONENT_OF_ONE
            for j in range(n):
                i, u = np.uint64(place[j]), t[j] - 1.0
                high = flat[i + np.uint64(2)] + u * flat[i + np.uint64(3)]
                h[j] = flat[i] + u * (flat[i + np.uint64(1)] + u * high)
            for j in range(n):
                sum_x[j] += h[j] * (x_ray[j] - x_k)  # alpha = M2 / (pi Sigma_cr R^2) theta
                sum_y[j] += h[j] * (y_ray[j] - y_k)
    return alpha_x, alpha_y


@njit(cache=True, error_model="numpy")
def _sum_convergences(x: FloatArray, y: FloatArray, halos: TnfwHalos) -> FloatArray:
    """Sum the convergences at flat positions, from the exact formula."""
    center_x, center_y, r_s, r_t, alpha_scale = halos
    kappa = np.zeros(x.size)
    for k in range(center_x.size):
        tau = r_t[k] / r_s[k]
        s_floor = (X_FLOOR * min(1.0, tau)) ** 2
        for j in range(x.size):
            s = ((x[j] - center_x[k]) ** 2 + (y[j] - center_y[k]) ** 2) / r_s[k] ** 2
            kappa[j] += alpha_scale[k] / r_s[k] * _mass_and_density(max(s_floor, s), tau)[1]
    return kappa
