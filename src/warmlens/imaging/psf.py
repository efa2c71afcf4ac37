"""Point spread function: validation, convolution and its adjoint, point sources, an HST-like model."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy import fft, ndimage, special

from warmlens.imaging.grid import PixelGrid
from warmlens.types import FloatArray

MAX_OFFSET_PIXELS = 0.4  # of the core from the middle of the PSF: half a pixel is refused
_CORE_HALF, _CORE_STEPS, _FINE = 8, 30, 40  # pixels, iterations, and steps of the spline
_SPLINE_MARGIN = 12  # pixels after which a cubic cardinal spline has fallen below 2e-7


def validate_psf(psf: FloatArray, name: str) -> FloatArray:
    """Return the PSF normalised to sum 1, or raise a `ValueError` that names it by band or path.

    It must be a square image of a point source with an odd size, its core within 0.4 pixels of the middle pixel's
    centre. Slightly negative wings, as of an empirical PSF, are allowed.
    """
    psf = np.asarray(psf, dtype=np.float64)
    if psf.ndim != 2 or psf.shape[0] != psf.shape[1]:
        raise ValueError(f"PSF {name}: must be a square 2-D image, got shape {psf.shape}")
    if psf.shape[0] % 2 == 0:
        raise ValueError(
            f"PSF {name}: size must be odd, so that it has a middle pixel, got {psf.shape[0]}; "
            "cut or resample it to an odd size"
        )
    n_bad = int(np.count_nonzero(~np.isfinite(psf)))
    if n_bad:
        raise ValueError(f"PSF {name}: {n_bad} of {psf.size} pixels are not finite")
    with np.errstate(over="ignore"):
        total = float(psf.sum())
    if not 0.0 < total < np.inf:
        raise ValueError(f"PSF {name}: its sum must be positive and finite, got {total:.3g}")
    if total < 0.5 * float(np.abs(psf).sum()):
        raise ValueError(f"PSF {name}: its negative pixels nearly cancel its positive ones; mend the PSF")
    peak = np.unravel_index(int(np.argmax(psf)), psf.shape)
    middle = psf.shape[0] // 2
    if max(abs(int(peak[0]) - middle), abs(int(peak[1]) - middle)) > 1:
        raise ValueError(
            f"PSF {name}: brightest pixel at [y, x] = [{peak[0]}, {peak[1]}], expected the middle pixel "
            f"[{middle}, {middle}] or a neighbour of it; recentre the PSF"
        )
    offset = core_offset(psf)
    if math.hypot(*offset) > MAX_OFFSET_PIXELS:
        raise ValueError(
            f"PSF {name}: its core lies {offset[0]:+.2f} columns and {offset[1]:+.2f} rows off the middle of the "
            f"middle pixel, at most {MAX_OFFSET_PIXELS:g} pixels are accepted: all positions would be off by as "
            f"much; recentre the PSF (scipy.ndimage.shift by [y, x] = [{-offset[1]:.2f}, {-offset[0]:.2f}])"
        )
    return psf / total


def core_offset(psf: FloatArray) -> tuple[float, float]:
    """Return how far the core of a PSF lies from its middle pixel, (columns, rows) [pixel].

    The nearer of two estimates: the centroid under a Gaussian of the core's own width, which moves with it, and
    the peak of the interpolating spline. Wings that are not symmetric move neither, coma hardly the first.
    """
    middle = psf.shape[0] // 2
    half = min(middle, _CORE_HALF)
    core = psf[middle - half : middle + half + 1, middle - half : middle + half + 1] / psf.max()
    rows, columns = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    peak = np.unravel_index(int(np.argmax(core)), core.shape)
    centroid = np.array([columns[peak], rows[peak]])
    width = max(0.5, fwhm(psf, 1.0) / math.sqrt(8.0 * math.log(2.0)))
    for _ in range(_CORE_STEPS):
        distance2 = (columns - centroid[0]) ** 2 + (rows - centroid[1]) ** 2
        weight = np.maximum(core, 0.0) * np.exp(-0.5 * distance2 / width**2)
        if not weight.sum() > 0.0:  # it has left the light: no core
            break
        # a Gaussian core under its own Gaussian moves the centroid half of the way
        moved = [np.sum(weight * (axis - c)) for axis, c in zip((columns, rows), centroid, strict=True)]
        centroid += 2.0 * np.array(moved) / weight.sum()
        centroid = np.clip(centroid, -half, half)
    fine = np.arange(-_FINE, _FINE + 1) / _FINE * min(half, 2.0)
    grid_rows, grid_columns = np.meshgrid(fine, fine, indexing="ij")
    spline = ndimage.map_coordinates(core, [grid_rows + half, grid_columns + half], order=3, mode="nearest")
    top = np.unravel_index(int(np.argmax(spline)), spline.shape)
    estimates = [(float(centroid[0]), float(centroid[1])), (float(fine[top[1]]), float(fine[top[0]]))]
    return min(estimates, key=lambda offset: math.hypot(*offset))


class Convolution:
    """P of docs/scan.md: convolution of images of one shape (ny, nx), zero outside, with one kernel.

    The kernel [odd, odd] is centred on its middle pixel and may be larger than the image.
    """

    def __init__(self, psf: FloatArray, shape: tuple[int, int]) -> None:
        psf = np.asarray(psf, dtype=np.float64)
        if psf.ndim != 2 or psf.shape[0] % 2 == 0 or psf.shape[1] % 2 == 0:
            raise ValueError(f"convolution kernel must be 2-D with odd sizes, got shape {psf.shape}")
        self.psf = psf
        self.shape = shape
        # Pixels cannot be further apart than the image is long: drop that part of the kernel. Padding by the rest
        # keeps the wrap-around of the transform outside the image.
        reach = [min(size // 2, n - 1) for size, n in zip(psf.shape, shape, strict=True)]
        self._padded = tuple(fft.next_fast_len(n + r, real=True) for n, r in zip(shape, reach, strict=True))
        (ry, rx), (my, mx) = reach, (psf.shape[0] // 2, psf.shape[1] // 2)
        kernel = np.zeros(self._padded)
        kernel[: 2 * ry + 1, : 2 * rx + 1] = psf[my - ry : my + ry + 1, mx - rx : mx + rx + 1]
        self._transfer = fft.rfft2(np.roll(kernel, (-ry, -rx), axis=(0, 1)), workers=1)

    def forward(self, images: FloatArray) -> FloatArray:
        """Return P times each image, [..., ny, nx]."""
        return self._apply(images, self._transfer)

    def adjoint(self, images: FloatArray) -> FloatArray:
        """Return P^T times each image (correlation with the kernel), [..., ny, nx]."""
        return self._apply(images, np.conj(self._transfer))

    def _apply(self, images: FloatArray, transfer: npt.NDArray[np.complex128]) -> FloatArray:
        images = np.asarray(images, dtype=np.float64)
        if images.shape[-2:] != self.shape:
            raise ValueError(f"images must be [..., {self.shape[0]}, {self.shape[1]}], got {images.shape}")
        flat = images.reshape(-1, *self.shape)
        out = np.empty_like(flat)
        ny, nx = self.shape
        for number, image in enumerate(flat):  # one by one they stay in the cache: twice as fast as all together
            spectrum = fft.rfft2(image, s=self._padded, workers=1)
            spectrum *= transfer
            out[number] = fft.irfft2(spectrum, s=self._padded, workers=1, overwrite_x=True)[:ny, :nx]
        return out.reshape(images.shape)


def point_source(psf: FloatArray, grid: PixelGrid, x: float, y: float) -> FloatArray:
    """Return the image [ny, nx] of a point source of unit flux at the sky position (x, y) [arcsec].

    The PSF is shifted by the fraction of a pixel with its interpolating cubic spline. The cardinal function of the
    spline is a partition of unity and reproduces straight lines, so flux and centroid are kept exactly. It is also
    local: a Fourier shift of an undersampled core would ring through the whole image, a linear one would blur the
    core. Flux that falls off the image is lost.
    """
    column, row = (float(value) for value in grid.to_pixel(np.asarray(x), np.asarray(y)))
    if not (math.isfinite(column) and math.isfinite(row)):
        raise ValueError(f"point source position must be finite, got ({x}, {y})")
    nearest_column, nearest_row = round(column), round(row)
    shifted = ndimage.shift(
        np.pad(psf, _SPLINE_MARGIN), (row - nearest_row, column - nearest_column), order=3, mode="constant"
    )
    image = np.zeros(grid.shape)
    first_row = nearest_row - shifted.shape[0] // 2
    first_column = nearest_column - shifted.shape[1] // 2
    rows = slice(max(first_row, 0), max(min(first_row + shifted.shape[0], grid.ny), 0))
    columns = slice(max(first_column, 0), max(min(first_column + shifted.shape[1], grid.nx), 0))
    if rows.start < rows.stop and columns.start < columns.stop:
        image[rows, columns] = shifted[
            rows.start - first_row : rows.stop - first_row,
            columns.start - first_column : columns.stop - first_column,
        ]
    return image


def hst_like_psf(
    wavelength_nm: float,
    pixel_scale_arcsec: float,
    n_pix: int,
    *,
    diameter_m: float = 2.4,
    obscuration: float = 0.33,
    blur_arcsec: float = 0.035,
    relative_bandwidth: float = 0.25,
) -> FloatArray:
    """Return the PSF [n_pix, n_pix] of an obscured circular pupil, averaged over the pixel, sum 1.

    Parameters
    ----------
    wavelength_nm
        Middle of the band [nm].
    n_pix
        Size of the PSF [pixel], odd.
    diameter_m, obscuration
        Diameter of the pupil [m] and linear central obscuration (0 <= obscuration < 1); HST's by default.
    blur_arcsec
        Standard deviation of the Gaussian that stands for jitter, charge diffusion and drizzling [arcsec].
        The default gives F814W at 0.05" the core of the drizzled ACS image of RXJ1131-1231: 5 pixels above
        half the peak (the 0.126" often quoted), 0.11" by `fwhm`, which interpolates.
    relative_bandwidth
        Full width of the (flat) band over its middle; 0.25 for HST's wide filters.
    """
    if n_pix < 1 or n_pix % 2 == 0:
        raise ValueError(f"n_pix of a PSF must be a positive odd number, got {n_pix}")
    if not 0.0 <= obscuration < 1.0:
        raise ValueError(f"obscuration must lie in [0, 1), got {obscuration}")
    if min(wavelength_nm, pixel_scale_arcsec, diameter_m) <= 0.0 or blur_arcsec < 0.0:
        raise ValueError(
            "wavelength_nm, pixel_scale_arcsec and diameter_m must be positive and blur_arcsec >= 0, got "
            f"{wavelength_nm}, {pixel_scale_arcsec}, {diameter_m}, {blur_arcsec}"
        )
    factor = 2 * math.ceil(pixel_scale_arcsec / 0.02) + 1  # odd: a sub-pixel sits on the centre; <= 0.01"
    margin = math.ceil(5.0 * blur_arcsec / pixel_scale_arcsec)
    n_fine = (n_pix + 2 * margin) * factor
    axis = (np.arange(n_fine) - n_fine // 2) * (pixel_scale_arcsec / factor)
    radius = np.hypot(axis[:, None], axis[None, :])
    fine = np.zeros_like(radius)
    wavelengths_m = 1e-9 * wavelength_nm * (1.0 + relative_bandwidth * (np.arange(7) - 3) / 7.0)
    table = np.linspace(0.0, radius.max(), 4 * n_fine)
    for wavelength_m in wavelengths_m:
        argument = math.pi * diameter_m / wavelength_m * np.radians(table / 3600.0)
        # Born & Wolf sec. 8.6.2: amplitude of an annular aperture
        amplitude = _jinc(argument) - obscuration**2 * _jinc(obscuration * argument)
        fine += np.interp(radius, table, amplitude**2) / wavelength_m**2  # equal flux at each wavelength
    fine = ndimage.gaussian_filter(fine, blur_arcsec * factor / pixel_scale_arcsec, mode="nearest", truncate=5.0)
    n_all = n_pix + 2 * margin
    psf = fine.reshape(n_all, factor, n_all, factor).mean(axis=(1, 3))
    psf = psf[margin : n_all - margin, margin : n_all - margin]
    return psf / psf.sum()


def _jinc(x: FloatArray) -> FloatArray:
    """Return 2 J1(x) / x, 1 at 0."""
    safe = np.where(x > 1e-8, x, 1.0)
    return np.where(x > 1e-8, 2.0 * special.j1(safe) / safe, 1.0)


def fwhm(psf: FloatArray, pixel_scale_arcsec: float) -> float:
    """Return the full width at half maximum [arcsec], the diameter of a circle with the area above half the peak.

    The image is oversampled with its interpolating cubic spline, since HST's core spans 2-3 pixels.
    """
    middle = psf.shape[0] // 2
    half = min(middle, 20)
    core = psf[middle - half : middle + half + 1, middle - half : middle + half + 1]
    factor = 20
    axis = np.arange(-half * factor, half * factor + 1) / factor + half
    rows, columns = np.meshgrid(axis, axis, indexing="ij")
    fine = ndimage.map_coordinates(core, [rows, columns], order=3, mode="nearest")
    area = np.count_nonzero(fine > 0.5 * fine.max()) * (pixel_scale_arcsec / factor) ** 2
    return 2.0 * math.sqrt(area / math.pi)
