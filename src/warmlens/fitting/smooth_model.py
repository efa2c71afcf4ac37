"""The smooth model of one band: lens given, amplitudes of source, quasars and light solved for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from warmlens.fitting.linear import LinearModel, build_linear_model, physical_coefficients, solve
from warmlens.imaging.noise import with_quasar_variance
from warmlens.imaging.observation import Band
from warmlens.imaging.psf import Convolution
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.rays import SmoothRays
from warmlens.types import FloatArray


@dataclass(frozen=True)
class FixedColumns:
    """Columns of the model that a perturber does not move, already blurred.

    Attributes
    ----------
    names
        One a column: quasar_0.., light_0.., background.
    images
        [npix, n_fixed], for amplitude 1.
    n_quasars
        The leading columns are the quasar images.
    """

    names: tuple[str, ...]
    images: FloatArray
    n_quasars: int


@dataclass(frozen=True)
class BandFit:
    """Best amplitudes of one band.

    Attributes
    ----------
    source_coefficients, fixed_coefficients
        [n_source] and [n_fixed], in e-/s per pixel and per unit of the columns.
    fixed_image, model
        Light that is not the source's, and everything, [ny, nx] [e-/s per pixel].
    sigma
        Noise with the quasars' PSF error, [ny, nx] [e-/s per pixel].
    chi2, n_pixels, n_columns
        Sum over the unmasked pixels of (data - model)^2 / sigma^2, their number, and the amplitudes fitted.
    """

    source_coefficients: FloatArray
    fixed_coefficients: FloatArray
    fixed_image: FloatArray
    model: FloatArray
    sigma: FloatArray
    chi2: float
    n_pixels: int
    n_columns: int

    @property
    def chi2_red(self) -> float:
        """chi2 per degree of freedom."""
        return self.chi2 / (self.n_pixels - self.n_columns)


def linear_model(
    sets: Sequence[ShapeletSet],
    rays: SmoothRays,
    fixed: FixedColumns,
    convolution: Convolution,
    weights: FloatArray,
    ridge: float,
) -> LinearModel:
    """Whitened design of one band: source shapelets along the smooth rays, then the fixed columns."""
    source = pixel_basis(sets, rays.source_x, rays.source_y)
    return build_linear_model(source, fixed.images, convolution, weights, ridge)


def fit_band(
    band: Band,
    sets: Sequence[ShapeletSet],
    rays: SmoothRays,
    fixed: FixedColumns,
    convolution: Convolution,
    ridge: float,
    quasar_variance_fraction: float,
) -> BandFit:
    """Solve for all amplitudes of a band.

    With `quasar_variance_fraction` > 0 the fluxes of a first fit set the variance near the quasars, and the
    fit is repeated with it.

    Raises
    ------
    ValueError
        If there are not more pixels than amplitudes.
    """
    n_columns = sum(item.n_coefficients for item in sets) + fixed.images.shape[1]
    n_pixels = int(band.mask.sum())
    if n_pixels <= n_columns:
        raise ValueError(
            f"band {band.name}: {n_columns} amplitudes for {n_pixels} unmasked pixels; "
            "lower smooth_model.source.n_max or unmask more pixels"
        )
    weighted = band
    passes = 2 if quasar_variance_fraction > 0 else 1
    for number in range(passes):
        weights = weighted.weights
        model = linear_model(sets, rays, fixed, convolution, weights, ridge)
        whitened = (weights * band.image).reshape(-1, 1)
        fit = solve(model, whitened)
        coefficients = physical_coefficients(model, fit.coefficients)[:, 0]
        fixed_coefficients = coefficients[model.n_source :]
        if number + 1 < passes:
            quasars = fixed.images[:, : fixed.n_quasars] @ fixed_coefficients[: fixed.n_quasars]
            sigma = with_quasar_variance(band.sigma, quasars.reshape(band.image.shape), quasar_variance_fraction)
            weighted = replace(band, sigma=sigma)
    source = coefficients[: model.n_source]
    light = pixel_basis(sets, rays.source_x, rays.source_y) @ source
    fixed_image = (fixed.images @ fixed_coefficients).reshape(band.image.shape)
    return BandFit(
        source_coefficients=source,
        fixed_coefficients=fixed_coefficients,
        fixed_image=fixed_image,
        model=convolution.forward(light.reshape(band.image.shape)) + fixed_image,
        sigma=weighted.sigma,
        chi2=float(fit.chi2[0]),
        n_pixels=n_pixels,
        n_columns=n_columns,
    )
