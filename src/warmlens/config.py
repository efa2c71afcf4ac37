"""Typed blocks of config.yaml: every key has a type and a range; unknown or impossible values are errors."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Point = tuple[Finite, Finite]
BandName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.+-]+$")]


def _ascending(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise ValueError(f"the lower end {value[0]:g} must be below the upper end {value[1]:g}")
    return value


BRANCHING_SETS = ("pch08", "benson17", "pch_plus")


def _branching(value: object) -> object:
    numbers = (
        isinstance(value, list | tuple) and len(value) == 4 and all(isinstance(v, int | float) for v in value)
    )
    if value not in BRANCHING_SETS and not numbers:
        raise ValueError(f"must be one of {', '.join(BRANCHING_SETS)} or four numbers, got {value!r}")
    return tuple(value) if isinstance(value, list) else value


Interval = Annotated[tuple[Finite, Finite], AfterValidator(_ascending)]


class Block(BaseModel):
    """A frozen mapping that knows its keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, ser_json_inf_nan="constants")


class CampaignBlock(Block):
    """What is sampled, and in which portions."""

    seed: Annotated[int, Field(ge=0)]
    n_samples: Annotated[int, Field(ge=1)]
    chunk_size: Annotated[int, Field(ge=1)]


class CosmologyBlock(Block):
    """Flat LCDM."""

    H0: Positive
    Om0: Fraction
    Ob0: Fraction
    sigma8: Positive
    ns: Positive
    Tcmb0: Positive

    @model_validator(mode="after")
    def _baryons(self) -> CosmologyBlock:
        if self.Ob0 >= self.Om0:
            raise ValueError(f"Ob0 = {self.Ob0:g} must be below Om0 = {self.Om0:g}")
        return self


class RedshiftBlock(Block):
    """Redshifts of the lens and of the source."""

    lens: Positive
    source: Positive

    @model_validator(mode="after")
    def _order(self) -> RedshiftBlock:
        if self.source <= self.lens:
            raise ValueError(f"source = {self.source:g} must lie behind lens = {self.lens:g}")
        return self


class DarkMatterBlock(Block):
    """Prior of the two parameters that are inferred."""

    m_th_kev: Interval
    log10_m_halo_msun: Interval

    @model_validator(mode="after")
    def _ranges(self) -> DarkMatterBlock:
        if self.m_th_kev[0] <= 0:
            raise ValueError(f"m_th_kev must be above 0, got {self.m_th_kev[0]:g}")
        low, high = self.log10_m_halo_msun
        if not 10 <= low < high <= 16:
            raise ValueError(f"log10_m_halo_msun must lie within [10, 16], got [{low:g}, {high:g}]")
        return self


class HalosBlock(Block):
    """Physics of the halo realizations (docs/decisions.md explains each choice)."""

    preset: Literal["paper", "calibrated", "custom"]
    tau_dyn: Literal["paper", "jvdb16"] | None = None
    positions: Literal["nfw_host", "nfw_infall", "orbit_infall"] | None = None
    transfer_function: Literal["viel05", "bode01", "vogel23"]
    field_half_width_arcsec: Positive
    min_mass_msun: Positive
    branching: Annotated[str | tuple[float, float, float, float], BeforeValidator(_branching)]
    sharp_k_a: Positive
    barrier_factor: Positive
    stripping_amplitude: NonNegative
    stripping_slope: Positive
    friction_amplitude: NonNegative
    friction_mass_slope: Finite
    friction_circularity_slope: Finite
    concentration: Literal["paper", "duffy08"]
    concentration_scatter_dex: NonNegative
    concentration_amplitude: Positive
    concentration_mass_slope: Finite
    concentration_redshift_slope: Finite
    concentration_pivot_msun: Positive
    concentration_min: Positive
    formation_mass_cap_msun: Positive
    z_max: Positive

    @model_validator(mode="after")
    def _preset(self) -> HalosBlock:
        for key in ("tau_dyn", "positions"):
            given = getattr(self, key) is not None
            if given != (self.preset == "custom"):
                need = "is needed with" if self.preset == "custom" else "is set by"
                raise ValueError(f"{key} {need} preset: {self.preset}; use preset: custom to choose it")
        return self


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
    kwargs_lens: list[dict[str, Any]]

    @model_validator(mode="after")
    def _lengths(self) -> LensBlock:
        _same_length("lens_model_list", self.lens_model_list, "kwargs_lens", self.kwargs_lens)
        return self


class LensLightBlock(Block):
    """Light of the lens in lenstronomy's names, without `amp`: amplitudes are linear, free per band."""

    lens_light_model_list: list[str]
    kwargs_lens_light: list[dict[str, Any]]

    @model_validator(mode="after")
    def _lengths(self) -> LensLightBlock:
        _same_length(
            "lens_light_model_list", self.lens_light_model_list, "kwargs_lens_light", self.kwargs_lens_light
        )
        return self


def _same_length(name: str, first: Sequence[object], other: str, second: Sequence[object]) -> None:
    if len(first) != len(second):
        raise ValueError(f"{name} has {len(first)} entries, {other} has {len(second)}; they must match")


def _free_range(value: tuple[float, float, float | None]) -> tuple[float, float, float | None]:
    if not value[0] < value[1]:
        raise ValueError(f"the lower limit {value[0]:g} must be below the upper limit {value[1]:g}")
    return value


FreeRange = Annotated[tuple[Finite, Finite, Positive | None], AfterValidator(_free_range)]


class PotentialShapeletsBlock(Block):
    """Cartesian shapelets of the lens potential, about the first component's first centre."""

    number: Literal[0, 1, 3, 6, 10, 15, 21, 28, 36]
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
        _same_length("lens.lens_model_list", self.fitted_lens.lens_model_list, "fit.lens_free", self.fit.lens_free)
        _same_length(
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

    shape: tuple[Annotated[int, Field(ge=16)], Annotated[int, Field(ge=16)]]
    pixel_scale_arcsec: Positive
    psf_pixels: Annotated[int, Field(ge=3)]
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
            _same_length("quasar_images", self.quasar_images, f"{name}.quasar_fluxes", band.quasar_fluxes)
            _same_length(
                "lens_light_model_list",
                self.lens_light.lens_light_model_list,
                f"{name}.lens_light_amplitudes",
                band.lens_light_amplitudes,
            )
        return self


class FitsBandBlock(Block):
    """Files of one band, [y, x]; `$NAME` or `${NAME}` in a path is an environment variable."""

    science: str
    psf: str
    mask: str | None = None
    sigma: str | None = None
    weight: str | None = None
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
        if self.pixel_scale_arcsec is not None and self.center_pixel is None:
            raise ValueError("pixel_scale_arcsec replaces the WCS and needs center_pixel ([x, y], from 0) too")
        return self


class ObservationBlock(Block):
    """Where the observed image comes from."""

    kind: Literal["simulated", "fits"]
    bands: Annotated[list[BandName], Field(min_length=1)]
    simulated: SimulatedBlock | None = None
    fits: dict[BandName, FitsBandBlock] | None = None

    @model_validator(mode="after")
    def _bands(self) -> ObservationBlock:
        if len(set(self.bands)) != len(self.bands):
            raise ValueError(f"bands {self.bands} names a band twice")
        known = self.fits if self.kind == "fits" else self.simulated and self.simulated.bands
        if known is None:
            raise ValueError(f"kind: {self.kind} needs the block '{self.kind}'")
        missing = [band for band in self.bands if band not in known]
        if missing:
            raise ValueError(f"bands {missing} are not described under {self.kind}; known: {sorted(known)}")
        return self


class DeflectionsBlock(Block):
    """High-pass filter of the subhaloes' deflection, and what is deflecting."""

    filter: Literal["gaussian", "starlet", "median_wavelet"]
    filter_arcsec: Positive
    smooth_host: bool = False


class MocksBlock(Block):
    """Where the mocks' quasar images stand."""

    quasar_positions: Literal["observed", "solved"] = "observed"


class PerturberBlock(Block):
    """The scan's perturber: an isothermal deflection with a linear truncation."""

    theta_e_arcsec: Positive
    r_trunc_arcsec: Positive


class NestedBlock(Block):
    """Source shapelets at each position's source point, in both fits of the scan."""

    n_max: Annotated[int, Field(ge=0, le=12)]
    ridge: Positive
    beta_range_arcsec: tuple[Positive, Positive]

    @model_validator(mode="after")
    def _range(self) -> NestedBlock:
        low, high = self.beta_range_arcsec
        if low > high:
            raise ValueError(f"beta_range_arcsec: the lower end {low:g} must not be above the upper end {high:g}")
        return self


class SensitivityBlock(Block):
    """Deflections for which the scan of the observation says what it would see."""

    theta_e_arcsec: Annotated[list[Positive], Field(min_length=1)]
    delta_r: Positive

    @model_validator(mode="after")
    def _order(self) -> SensitivityBlock:
        if any(low >= high for low, high in pairwise(self.theta_e_arcsec)):
            raise ValueError(f"theta_e_arcsec must rise from value to value, got {self.theta_e_arcsec}")
        return self


class ScanBlock(Block):
    """Raster of the substructure scan and freedom of its fits."""

    perturber: PerturberBlock
    nested: NestedBlock | None
    marginalise_lens: bool = False
    step_arcsec: Positive
    window_arcsec: tuple[Positive, Positive] | None
    center: Point
    shard_size: Annotated[int, Field(ge=1)]
    residual_samples: list[Annotated[int, Field(ge=0)]] = []
    statistics: list[Literal["delta_r", "amplitude"]] = ["delta_r"]
    sensitivity: SensitivityBlock | None = None

    @model_validator(mode="after")
    def _statistics(self) -> ScanBlock:
        if self.statistics not in (["delta_r"], ["delta_r", "amplitude"]):
            raise ValueError(f"statistics must be [delta_r] or [delta_r, amplitude], got {self.statistics}")
        if self.sensitivity is not None and "amplitude" not in self.statistics:
            raise ValueError(
                "sensitivity is made from the linear response; with it set statistics: [delta_r, amplitude]"
            )
        return self

    @model_validator(mode="after")
    def _window(self) -> ScanBlock:
        for side in self.window_arcsec or ():
            if side < self.step_arcsec:
                raise ValueError(f"window_arcsec {side:g} is smaller than step_arcsec {self.step_arcsec:g}")
        if self.window_arcsec is None and self.center != (0.0, 0.0):
            raise ValueError("center is that of window_arcsec; with window_arcsec: null leave it at [0.0, 0.0]")
        if len(set(self.residual_samples)) != len(self.residual_samples):
            raise ValueError(f"residual_samples names a sample twice: {self.residual_samples}")
        return self


class SummariesBlock(Block):
    """Two-point correlation function and cumulative distribution of Delta R."""

    threshold: Annotated[float, Field(lt=0, allow_inf_nan=False)]
    max_separation_arcsec: Positive
    cumulative_min: Annotated[float, Field(lt=0, allow_inf_nan=False)]
    cumulative_bins: Annotated[int, Field(ge=2)]

    @model_validator(mode="after")
    def _order(self) -> SummariesBlock:
        if self.cumulative_min >= self.threshold:
            raise ValueError(f"cumulative_min {self.cumulative_min:g} must be below threshold {self.threshold:g}")
        return self


class AbcBlock(Block):
    """Acceptance and bound."""

    acceptance: Literal["max_rank", "marginal_and", "scaled_sum", "correlation", "cumulative"]
    fraction: Annotated[float, Field(gt=0, le=1)]
    distance: Literal["integral", "whitened"] = "integral"
    bootstrap: Annotated[int, Field(ge=100)]
    leave_one_out: Annotated[int, Field(ge=10)] = 1000
    max_failed_fraction: Annotated[float, Field(ge=0, lt=1)]


class Config(Block):
    """The whole configuration of a campaign."""

    results: Annotated[str, Field(min_length=1)]
    campaign: CampaignBlock
    cosmology: CosmologyBlock
    redshifts: RedshiftBlock
    dark_matter: DarkMatterBlock
    halos: HalosBlock
    observation: ObservationBlock
    smooth_model: SmoothModelBlock
    deflections: DeflectionsBlock
    mocks: MocksBlock = MocksBlock()
    scan: ScanBlock
    summaries: SummariesBlock
    abc: AbcBlock

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        beyond = [i for i in self.scan.residual_samples if i >= self.campaign.n_samples]
        if beyond:
            raise ValueError(
                f"scan.residual_samples {beyond} do not exist: campaign.n_samples = {self.campaign.n_samples}, "
                "samples are counted from 0"
            )
        if self.scan.marginalise_lens and self.smooth_model.mode == "given":
            raise ValueError(
                "scan.marginalise_lens needs the errors of the lens, which smooth_model.mode: given has not; "
                "use mode: fit"
            )
        return self
