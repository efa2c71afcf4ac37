"""Blocks of config.yaml that describe the smooth lens: its models, its source, and how it is fitted."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, NonNegativeInt, model_validator

from warmlens.config import plausible
from warmlens.config.plausible import Usual
from warmlens.config.types import (
    Ascending,
    Block,
    Finite,
    Fraction,
    Interval,
    ModelKwargs,
    NonNegative,
    Point,
    Positive,
    same_length,
)


class ClumpsBlock(Block):
    """Shapelets on peaks of the residuals, traced to the source plane; null: none."""

    number: int = Field(ge=0, le=200, description="Largest number of clumps")
    n_max: int = Field(ge=0, le=10, description="Order of each clump's shapelets")
    threshold: Annotated[Positive, Usual(0.5, 100, "sigma")] = Field(
        description="Significance of a residual peak, matched to the PSF"
    )
    scale_in_fwhm: Annotated[Positive, Usual(0.02, 10)] = Field(
        description="Scale in units of FWHM of the PSF / sqrt(magnification)"
    )


class SourceBlock(Block):
    """Shapelet basis of the source, common to all bands."""

    n_max: int = Field(ge=0, le=80, description="Order: (n_max + 1)(n_max + 2) / 2 shapelets")
    beta_arcsec: Annotated[Positive, plausible.SCALE] = Field(
        description="Scale [arcsec]; a fit starts there, see fit.source_beta"
    )
    center: Annotated[Point | Literal["quasars"], plausible.POSITION] = Field(
        description="Point [x, y] in the source plane [arcsec], or quasars: their mean source position"
    )
    supersampling: int = Field(ge=1, le=8, description="Sub-pixels per pixel and axis of the source")
    clumps: ClumpsBlock | None = None


class LensBlock(Block):
    """Lens in lenstronomy's names."""

    lens_model_list: list[str] = Field(description="Names of lenstronomy's lens models")
    kwargs_lens: list[ModelKwargs] = Field(description="Parameters per model; the first is centred on the lens")

    @model_validator(mode="after")
    def _lengths(self) -> LensBlock:
        same_length("lens_model_list", self.lens_model_list, "kwargs_lens", self.kwargs_lens)
        return self


class LensLightBlock(Block):
    """Light of the lens in lenstronomy's names; amplitudes are linear, free per band."""

    lens_light_model_list: list[str] = Field(description="Names of lenstronomy's light models")
    kwargs_lens_light: list[ModelKwargs] = Field(description="Parameters of each model without amp")

    @model_validator(mode="after")
    def _lengths(self) -> LensLightBlock:
        same_length(
            "lens_light_model_list", self.lens_light_model_list, "kwargs_lens_light", self.kwargs_lens_light
        )
        return self


def _free_range(value: tuple[float, float, float | None]) -> tuple[float, float, float | None]:
    if not value[0] < value[1]:
        raise ValueError(f"the lower limit {value[0]:g} must be below the upper limit {value[1]:g}")
    return value


FreeRange = Annotated[tuple[Finite, Finite, Positive | None], AfterValidator(_free_range)]


class PotentialShapeletsBlock(Block):
    """Shapelets of the lens potential about the first model's centre; they start from 0."""

    number: Literal[0, 1, 3, 6, 10, 15, 21, 28, 36, 45, 55] = Field(description="Number (paper: 0, 10 and 21)")
    beta_arcsec: Annotated[Positive, plausible.EXTENT] = Field(description="Scale of the shapelets [arcsec]")
    sigma: Annotated[Positive, Usual(1e-6, 5)] = Field(description="Width of the Gaussian prior of each amplitude")


class SearchBlock(Block):
    """Particle swarm over the lens before the fit; null: none."""

    particles: int = Field(ge=4, description="Number of particles")
    iterations: int = Field(ge=1, description="Moves of each particle")
    n_max: int = Field(ge=0, le=20, description="Order of the source during the search")


class PsfFitBlock(Block):
    """Correction of the PSF on the quasar images (workflow/configs/hst.yaml); null: none."""

    iterations: int = Field(ge=1, le=20, description="Number of corrections, each followed by a fit")
    radius_arcsec: Annotated[Positive, plausible.SCALE] = Field(
        description="The kernel is corrected within this radius [arcsec]"
    )
    relative_sigma: Annotated[Positive, Usual(0.001, 10, "", plausible.PERCENT)] = Field(
        description="Prior of a pixel's correction, as a fraction of the PSF there"
    )
    wing_radii_arcsec: Annotated[Interval, plausible.RADIUS] = Field(
        description="Radii between which the kernel turns into a smoothed one [arcsec]"
    )
    unknown_fraction: Fraction = Field(
        description="Before, pixels where this fraction of quasar light exceeds the noise are left out"
    )


class FitBlock(Block):
    """Free parameters as name: [lower limit, upper limit, width of a Gaussian prior about the start | null]."""

    lens_free: list[dict[str, FreeRange]] = Field(
        description="Free parameters of each lens model except potential shapelets; others are fixed"
    )
    lens_light_free: list[dict[str, FreeRange]] = Field(description="Free parameters of each light model")
    satellites: list[tuple[NonNegativeInt, NonNegativeInt]] = Field(
        description="[lens model, light model] that share a centre"
    )
    potential_shapelets: PotentialShapeletsBlock
    quasar_sigma_arcsec: Annotated[Positive, plausible.PRECISION] = Field(
        description="Prior width of the quasar images' positions [arcsec]"
    )
    tie_arcsec: Annotated[Positive, plausible.PRECISION] = Field(
        description="Quasar images trace to one source point within this [arcsec]"
    )
    source_beta: Annotated[FreeRange | None, plausible.SCALE] = Field(
        description="Source scale: range and prior [arcsec]; null fixes it, favouring a mass sheet"
    )
    search: SearchBlock | None
    levels: Annotated[list[Annotated[int, Field(ge=0, le=80)]], Ascending] = Field(
        description="Source orders on the way to source.n_max"
    )
    max_steps: int = Field(ge=1, le=200, description="Evaluations per level; the last fit has twice as many")
    tolerance: Fraction = Field(description="Converged when a step lowers chi2 by less than this fraction")
    psf: PsfFitBlock | None
    seed: int = Field(ge=0, description="Seed of the particle swarm")


class SmoothModelBlock(Block):
    """Smooth model of the lens, its light and the source."""

    mode: Literal["given", "fit"] = Field(
        description="fit: the lens below is the start; given: it is the lens. Amplitudes are always fitted"
    )
    lens: LensBlock = Field(description="Lens in lenstronomy's names; a fit starts its potential shapelets from 0")
    lens_light: LensLightBlock
    quasar_images: Annotated[list[Point], plausible.POSITION] = Field(
        description="Quasar images [x, y] [arcsec]; [] if the lens has none"
    )
    noise_from: Literal["model", "data"] = Field(
        description="Poisson noise of the model image or of the data (biased by its noise), without a map"
    )
    quasar_variance_fraction: Annotated[NonNegative, Usual(0, 1, "", plausible.PERCENT)] = Field(
        description="Adds (this * quasar flux)^2 to a pixel's variance"
    )
    quasar_core_arcsec: Annotated[NonNegative, plausible.RADIUS] = Field(
        description="Radius about each quasar image that chi2_red of the gate leaves out [arcsec]"
    )
    disc_arcsec: Annotated[Positive | None, plausible.EXTENT] = Field(
        description="Only pixels within this distance of the lens are used [arcsec]; null: all"
    )
    lens_core_mask_arcsec: Annotated[NonNegative, plausible.RADIUS] = Field(
        description="Pixels nearer to the lens are masked [arcsec]"
    )
    fit_background: bool = Field(description="Fit a constant level per band")
    source: SourceBlock
    ridge: Annotated[Positive, plausible.RIDGE] = Field(
        description="Weak Gaussian prior on the amplitudes of the unit-norm columns"
    )
    chi2_red_range: Annotated[Interval, Usual(0, 20)] = Field(
        description="Above is an error, below a warning, far below an error"
    )
    allow_poor_fit: bool = Field(description="Only warn if a fit is at a limit, off the gate or not converged")
    fit: FitBlock | None = None

    @model_validator(mode="after")
    def _consistent(self) -> SmoothModelBlock:
        if self.source.center == "quasars" and not self.quasar_images:
            raise ValueError("source.center: quasars needs quasar_images; give a point [x, y] instead")
        if self.mode == "given":
            return self
        if self.fit is None:
            raise ValueError("mode: fit needs the block 'fit'")
        same_length("lens.lens_model_list", self.fitted_lens.lens_model_list, "fit.lens_free", self.fit.lens_free)
        same_length(
            "lens_light_model_list",
            self.lens_light.lens_light_model_list,
            "fit.lens_light_free",
            self.fit.lens_light_free,
        )
        for lens, light in self.fit.satellites:
            if lens >= len(self.fit.lens_free) or light >= len(self.fit.lens_light_free):
                raise ValueError(f"fit.satellites: [{lens}, {light}] names a component that does not exist")
            if {"center_x", "center_y"} & self.fit.lens_light_free[light].keys():
                raise ValueError(
                    f"fit.lens_light_free: light model {light} is a satellite and follows its lens model {lens}; "
                    "leave center_x and center_y out"
                )
        if self.fit.psf is not None and not self.quasar_images:
            raise ValueError("fit.psf improves the PSF on the quasar images, but quasar_images is empty")
        if self.fit.levels and self.fit.levels[-1] >= self.source.n_max:
            raise ValueError(
                f"fit.levels {self.fit.levels} must end below source.n_max = {self.source.n_max}, the last level"
            )
        return self

    @property
    def fitted_lens(self) -> LensBlock:
        """The lens without its potential shapelets, which a fit starts from 0."""
        pairs = zip(self.lens.lens_model_list, self.lens.kwargs_lens, strict=True)
        kept = [(name, kwargs) for name, kwargs in pairs if name != "SHAPELETS_CART"]
        return LensBlock(lens_model_list=[name for name, _ in kept], kwargs_lens=[kwargs for _, kwargs in kept])
