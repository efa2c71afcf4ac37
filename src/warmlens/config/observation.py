"""Block `observation` of config.yaml: a simulated lens, images of the user, or another campaign's."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from warmlens.config.smooth_model import LensBlock, LensLightBlock
from warmlens.config.types import (
    BandName,
    Block,
    Finite,
    Interval,
    NonNegative,
    Point,
    Positive,
    same_length,
)

MAX_SIDE = 4096  # pixels of an image
ImageSide = Annotated[int, Field(ge=16, le=MAX_SIDE)]


class SimulatedBandBlock(Block):
    """One band of the simulated observation; fluxes in e-/s."""

    wavelength_nm: Positive
    exposure_s: Positive
    background_rms: Positive
    sky: Finite
    source_flux: Positive
    clump_flux_fraction: Annotated[float, Field(ge=0, le=1)]
    quasar_fluxes: list[NonNegative]
    lens_light_amplitudes: list[NonNegative]


class SimulatedSourceBlock(Block):
    """Face-on clumpy spiral: an exponential disc and Gaussian clumps along two arms [arcsec]."""

    center: Point
    disc_scale_arcsec: Positive
    n_clumps: Annotated[int, Field(ge=0)]
    clump_sigma_arcsec: Interval
    seed: Annotated[int, Field(ge=0)]


class TruthBlock(Block):
    """The known dark matter of the simulated observation; m_th_kev may be .inf (CDM)."""

    m_th_kev: Annotated[float, Field(gt=0)]
    log10_m_halo_msun: Annotated[float, Field(ge=10, le=16)]
    seed: Annotated[int, Field(ge=0)]


class SimulatedBlock(Block):
    """The embedded observation: an RXJ1131-like lens whose substructure is drawn by the halo stage."""

    shape: tuple[ImageSide, ImageSide]
    pixel_scale_arcsec: Positive
    psf_pixels: Annotated[int, Field(ge=3, le=MAX_SIDE)]
    supersampling: Annotated[int, Field(ge=1, le=8)]
    truth: TruthBlock
    lens: LensBlock
    lens_light: LensLightBlock
    quasar_images: list[Point]
    source: SimulatedSourceBlock
    bands: dict[BandName, SimulatedBandBlock]

    @model_validator(mode="after")
    def _consistent(self) -> SimulatedBlock:
        if self.psf_pixels % 2 == 0:
            raise ValueError(f"psf_pixels must be odd, got {self.psf_pixels}")
        for name, band in self.bands.items():
            same_length("quasar_images", self.quasar_images, f"{name}.quasar_fluxes", band.quasar_fluxes)
            same_length(
                "lens_light_model_list",
                self.lens_light.lens_light_model_list,
                f"{name}.lens_light_amplitudes",
                band.lens_light_amplitudes,
            )
        return self


# keys of FitsBandBlock that name a file
FITS_FILES = ("science", "psf", "mask", "sigma", "weight", "noise_correlation")


class FitsBandBlock(Block):
    """Files of one band, [y, x]; `$NAME` or `${NAME}` in a path is an environment variable."""

    science: str
    psf: str
    mask: str | None = None
    sigma: str | None = None
    weight: str | None = None
    # not written when they are not used, so that the settings of other images stay what they were
    noise_correlation: str | None = Field(default=None, exclude_if=lambda path: path is None)
    blank_sky_arcsec: Positive | None = Field(default=None, exclude_if=lambda radius: radius is None)
    extension: Annotated[int, Field(ge=0)] = 0
    exposure_s: Positive | None = None
    background_rms: Positive | None = None
    units: Literal["electron/s"] | None = None
    pixel_scale_arcsec: Positive | None = None
    center_pixel: Point | None = None

    @model_validator(mode="after")
    def _consistent(self) -> FitsBandBlock:
        if self.sigma is not None and self.weight is not None:
            raise ValueError("give either sigma or weight (inverse variance), not both")
        if self.noise_correlation is not None and self.blank_sky_arcsec is not None:
            raise ValueError("give either noise_correlation or blank_sky_arcsec, where it is measured, not both")
        if self.pixel_scale_arcsec is not None and self.center_pixel is None:
            raise ValueError("pixel_scale_arcsec replaces the WCS and needs center_pixel ([x, y], from 0) too")
        return self


class ObservationBlock(Block):
    """Where the observed image comes from."""

    kind: Literal["simulated", "fits", "artifact"]
    bands: Annotated[list[BandName], Field(min_length=1)]
    simulated: SimulatedBlock | None = None
    fits: dict[BandName, FitsBandBlock] | None = None
    # not written when it is not used, so that the settings of other kinds stay what they were
    artifact: Annotated[str, Field(min_length=1)] | None = Field(
        default=None, exclude_if=lambda path: path is None
    )

    @model_validator(mode="after")
    def _bands(self) -> ObservationBlock:
        if len(set(self.bands)) != len(self.bands):
            raise ValueError(f"bands {self.bands} names a band twice")
        if self.kind == "artifact":  # its bands are known when it is read
            if self.artifact is None:
                raise ValueError("kind: artifact needs the key 'artifact', the observation.h5 of another campaign")
            return self
        known = self.fits if self.kind == "fits" else self.simulated and self.simulated.bands
        if known is None:
            raise ValueError(f"kind: {self.kind} needs the block '{self.kind}'")
        missing = [band for band in self.bands if band not in known]
        if missing:
            raise ValueError(f"bands {missing} are not described under {self.kind}; known: {sorted(known)}")
        return self
