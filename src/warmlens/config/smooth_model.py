"""Blocks of config.yaml that describe the smooth lens: its models, its source, and how it is fitted."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from warmlens.config.types import (
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
    """Further shapelet sets for small features of the source, found in the residuals."""

    number: Annotated[int, Field(ge=0, le=200)]
    n_max: Annotated[int, Field(ge=0, le=10)]
    threshold: Positive
    scale_in_fwhm: Positive


class SourceBlock(Block):
    """Shapelet basis of the source, common to all bands."""

    n_max: Annotated[int, Field(ge=0, le=80)]
    beta_arcsec: Positive
    center: Point | Literal["quasars"]
    supersampling: Annotated[int, Field(ge=1, le=8)]
    clumps: ClumpsBlock | None = None


class LensBlock(Block):
    """A lens in lenstronomy's names: `lens_model_list` and `kwargs_lens`."""

    lens_model_list: list[str]
    kwargs_lens: list[ModelKwargs]

    @model_validator(mode="after")
    def _lengths(self) -> LensBlock:
        same_length("lens_model_list", self.lens_model_list, "kwargs_lens", self.kwargs_lens)
        return self


class LensLightBlock(Block):
    """Light of the lens in lenstronomy's names, without `amp`: amplitudes are linear, free per band."""

    lens_light_model_list: list[str]
    kwargs_lens_light: list[ModelKwargs]

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
    """Cartesian shapelets of the lens potential, about the first component's first centre."""

    number: Literal[0, 1, 3, 6, 10, 15, 21, 28, 36, 45, 55]
    beta_arcsec: Positive
    sigma: Positive


class SearchBlock(Block):
    """Particle swarm over the lens before the fit."""

    particles: Annotated[int, Field(ge=4)]
    iterations: Annotated[int, Field(ge=1)]
    n_max: Annotated[int, Field(ge=0, le=20)]


class PsfFitBlock(Block):
    """Improvement of the PSF on the quasar images."""

    iterations: Annotated[int, Field(ge=1, le=20)]
    radius_arcsec: Positive
    relative_sigma: Positive
    wing_radii_arcsec: Interval
    unknown_fraction: Fraction


class FitBlock(Block):
    """Which parameters of the smooth lens and its light are free, and how they are fitted."""

    lens_free: list[dict[str, FreeRange]]
    lens_light_free: list[dict[str, FreeRange]]
    satellites: list[tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]]
    potential_shapelets: PotentialShapeletsBlock
    quasar_sigma_arcsec: Positive
    tie_arcsec: Positive
    source_beta: FreeRange | None
    search: SearchBlock | None
    levels: list[Annotated[int, Field(ge=0, le=80)]]
    max_steps: Annotated[int, Field(ge=1, le=200)]
    tolerance: Fraction
    psf: PsfFitBlock | None
    seed: Annotated[int, Field(ge=0)]

    @model_validator(mode="after")
    def _levels(self) -> FitBlock:
        if sorted(set(self.levels)) != self.levels:
            raise ValueError(f"levels must rise, got {self.levels}")
        return self


class SmoothModelBlock(Block):
    """Smooth model: the lens is given, or fitted from there; the amplitudes are fitted per band either way."""

    mode: Literal["given", "fit"]
    lens: LensBlock
    lens_light: LensLightBlock
    quasar_images: list[Point]
    noise_from: Literal["model", "data"]
    quasar_variance_fraction: NonNegative
    quasar_core_arcsec: NonNegative
    disc_arcsec: Positive | None
    lens_core_mask_arcsec: NonNegative
    fit_background: bool
    source: SourceBlock
    ridge: Positive
    chi2_red_range: Interval
    allow_poor_fit: bool
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
