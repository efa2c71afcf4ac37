"""Block `observation` of config.yaml: a simulated lens, images of the user, or another campaign's."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from warmlens.config import plausible
from warmlens.config.plausible import Usual
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


def _is_none(value: object) -> bool:
    """Keep a key that is not given out of the settings: those of campaigns from before it was added stay equal."""
    return value is None


class SimulatedBandBlock(Block):
    """One band of the simulated observation."""

    wavelength_nm: Annotated[Positive, plausible.WAVELENGTH] = Field(
        description="Wavelength [nm], which sets the width of the PSF"
    )
    exposure_s: Annotated[Positive, plausible.EXPOSURE] = Field(
        description="Exposure time [s], which sets the Poisson noise"
    )
    background_rms: Annotated[Positive, plausible.RMS] = Field(description="Background noise per pixel [e-/s]")
    sky: Annotated[Finite, Usual(-1e3, 1e5, "e-/s per pixel")] = Field(
        description="Constant level of the image [e-/s per pixel]"
    )
    source_flux: Annotated[Positive, plausible.FLUX] = Field(description="Unlensed flux of the source [e-/s]")
    clump_flux_fraction: Annotated[float, Usual(0, 1, "", plausible.PERCENT)] = Field(
        ge=0, le=1, description="Fraction of source_flux in the clumps"
    )
    quasar_fluxes: Annotated[list[NonNegative], plausible.FLUX] = Field(
        description="Flux of each quasar image [e-/s]"
    )
    lens_light_amplitudes: Annotated[list[NonNegative], plausible.FLUX] = Field(
        description="Light at R_sersic per model [e-/s/arcsec^2]"
    )


class SimulatedSourceBlock(Block):
    """Face-on clumpy spiral: an exponential disc and Gaussian clumps along two arms."""

    center: Annotated[Point, plausible.POSITION] = Field(description="Centre [x, y] in the source plane [arcsec]")
    disc_scale_arcsec: Annotated[Positive, plausible.SCALE] = Field(
        description="Scale of the exponential disc [arcsec]"
    )
    n_clumps: int = Field(ge=0, description="Number of clumps")
    clump_sigma_arcsec: Annotated[Interval, plausible.SCALE] = Field(
        description="Range of the clumps' widths [arcsec]"
    )
    seed: int = Field(ge=0, description="Seed of the clumps")


class TruthBlock(Block):
    """The dark matter of the simulated observation, which the campaign should recover."""

    m_th_kev: Annotated[float, plausible.RELIC] = Field(
        gt=0, description="Thermal relic mass [keV]; .inf is cold dark matter"
    )
    log10_m_halo_msun: Annotated[float, plausible.HOST] = Field(
        ge=10, le=16, description="Host mass log10(M200c / Msun) at the lens"
    )
    seed: int = Field(ge=0, description="Seed of its subhalos and of the noise")


class SimulatedBlock(Block):
    """RXJ1131-like lens for kind: simulated; the halo stage draws its substructure."""

    shape: tuple[ImageSide, ImageSide] = Field(description="Pixels [y, x], centred on the lens")
    pixel_scale_arcsec: Annotated[Positive, plausible.PIXEL] = Field(description="Side of a pixel [arcsec]")
    psf_pixels: int = Field(ge=3, le=MAX_SIDE, description="Side of the PSF images [pixels], odd")
    supersampling: int = Field(ge=1, le=8, description="Sub-pixels per pixel and axis of the true image")
    truth: TruthBlock
    lens: LensBlock
    lens_light: LensLightBlock
    quasar_images: Annotated[list[Point], plausible.POSITION] = Field(
        description="Positions [x, y] of the quasar images [arcsec]"
    )
    source: SimulatedSourceBlock
    bands: dict[BandName, SimulatedBandBlock] = Field(description="Each simulated band, by name")

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
    """Files of one band; `$NAME` in a path is an environment variable."""

    science: str = Field(description="Image [y, x] in e-/s with a WCS; $NAME in a path is an environment variable")
    psf: str = Field(description="PSF on the image's pixels and in its orientation; odd side, peak in the middle")
    mask: str | None = Field(None, description="Mask: pixels above 0 are used; without it all pixels are")
    sigma: str | None = Field(None, description="Noise per pixel [e-/s]; mocks have Gaussian noise of this map")
    weight: str | None = Field(None, description="Or inverse variance per pixel; 0 masks a pixel")
    noise_correlation: str | None = Field(
        None, exclude_if=_is_none, description="Correlation of the noise: odd sides, offset 0 in the middle"
    )
    blank_sky_arcsec: Annotated[Positive | None, plausible.EXTENT] = Field(
        None,
        exclude_if=_is_none,
        description="Beyond this radius [arcsec] is only sky: the correlation of the noise between pixels "
        "(drizzling) is measured there and given to the mocks",
    )
    extension: int = Field(0, ge=0, description="Extension of the science image; others are in extension 0")
    exposure_s: Annotated[Positive | None, plausible.EXPOSURE] = Field(
        None, description="Exposure time [s] for Poisson noise, without sigma and weight; replaces EXPTIME"
    )
    background_rms: Annotated[Positive | None, plausible.RMS] = Field(
        None, description="Background noise [e-/s per pixel], without sigma and weight; replaces BKGRMS"
    )
    units: Literal["electron/s"] | None = Field(None, description="Overrides the unit of the header: electron/s")
    pixel_scale_arcsec: Annotated[Positive | None, plausible.PIXEL] = Field(
        None, description="Pixel side [arcsec], north up; instead of WCS"
    )
    center_pixel: Point | None = Field(None, description="Origin of positions, [x, y] from 0; replaces CRPIX")

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

    kind: Literal["simulated", "fits", "artifact"] = Field(
        description="simulated: by the block below; fits: your images; artifact: from another campaign"
    )
    bands: list[BandName] = Field(min_length=1, description="Bands in use, of those described below")
    simulated: SimulatedBlock | None = None
    fits: dict[BandName, FitsBandBlock] | None = Field(None, description="Files of each band, on the same pixels")
    artifact: Annotated[str, Field(min_length=1)] | None = Field(
        None, exclude_if=_is_none, description="observation.h5 of another campaign, all or some of its bands"
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
