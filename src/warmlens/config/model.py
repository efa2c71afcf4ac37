"""Typed blocks of config.yaml: every key has a type and a range; unknown or impossible values are errors."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from warmlens.config.observation import ObservationBlock
from warmlens.config.smooth_model import SmoothModelBlock
from warmlens.config.types import (
    Block,
    Finite,
    Fraction,
    Interval,
    NonNegative,
    Point,
    Positive,
    ResultsFolder,
)

BRANCHING_SETS = ("pch08", "benson17", "pch_plus")
MAX_IN_FILE_NAMES = 9_999_999  # samples and positions: names of chunks and shards have seven digits
MAX_PORTIONS = 10_000  # chunks or shards: Snakemake needs hours for more
MIN_STEP_ARCSEC = 1e-4


def _branching(value: object) -> object:
    numbers = (
        isinstance(value, list | tuple) and len(value) == 4 and all(isinstance(v, int | float) for v in value)
    )
    if value not in BRANCHING_SETS and not numbers:
        raise ValueError(f"must be one of {', '.join(BRANCHING_SETS)} or four numbers, got {value!r}")
    return tuple(value) if isinstance(value, list) else value


class GridBlock(Block):
    """Nodes of a grid campaign: every relic mass with every halo mass, each realized so many times."""

    m_th_kev: Annotated[list[Positive], Field(min_length=2)]
    log10_m_halo_msun: Annotated[list[Finite], Field(min_length=2)]
    realizations: Annotated[int, Field(ge=1)]

    @model_validator(mode="after")
    def _order(self) -> GridBlock:
        for name in ("m_th_kev", "log10_m_halo_msun"):
            values = getattr(self, name)
            if any(low >= high for low, high in pairwise(values)):
                raise ValueError(f"{name} must rise from value to value, got {values}")
        return self

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.m_th_kev) * len(self.log10_m_halo_msun)


class CampaignBlock(Block):
    """What is sampled, and in which portions."""

    seed: Annotated[int, Field(ge=0)]
    n_samples: Annotated[int, Field(ge=1, le=MAX_IN_FILE_NAMES)]
    chunk_size: Annotated[int, Field(ge=1, le=MAX_IN_FILE_NAMES)]
    design: Literal["prior", "grid"] = "prior"
    grid: GridBlock | None = None

    @model_validator(mode="after")
    def _portions(self) -> CampaignBlock:
        n_chunks = -(-self.n_samples // self.chunk_size)
        if n_chunks > MAX_PORTIONS or n_chunks * self.chunk_size > MAX_IN_FILE_NAMES:
            raise ValueError(
                f"n_samples = {self.n_samples} in chunks of {self.chunk_size} are {n_chunks} chunks up to sample "
                f"{n_chunks * self.chunk_size}; at most are {MAX_PORTIONS} chunks and {MAX_IN_FILE_NAMES} samples"
            )
        return self

    @model_validator(mode="after")
    def _design(self) -> CampaignBlock:
        if self.design == "prior":
            if self.grid is not None:
                raise ValueError("grid is given with design: prior; set design: grid or remove the block 'grid'")
            return self
        if self.grid is None:
            raise ValueError("design: grid needs the block 'grid'")
        wanted = self.grid.n_nodes * self.grid.realizations
        if self.n_samples != wanted:
            raise ValueError(
                f"n_samples = {self.n_samples}, but the grid has {self.grid.n_nodes} nodes x "
                f"{self.grid.realizations} realizations = {wanted}; set n_samples: {wanted}"
            )
        return self


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
    shard_size: Annotated[int, Field(ge=1, le=MAX_IN_FILE_NAMES)]
    residual_samples: list[Annotated[int, Field(ge=0)]] = Field(default=[])
    statistics: list[Literal["delta_r", "amplitude"]] = Field(default=["delta_r"])
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
        if self.step_arcsec < MIN_STEP_ARCSEC:
            raise ValueError(f"step_arcsec {self.step_arcsec:g} must be at least {MIN_STEP_ARCSEC:g}")
        for side in self.window_arcsec or ():
            if side / self.step_arcsec > MAX_IN_FILE_NAMES:
                raise ValueError(f"window_arcsec {side:g} holds too many steps of {self.step_arcsec:g} arcsec")
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
    count_thresholds: Annotated[list[Annotated[float, Field(lt=0, allow_inf_nan=False)]], Field(min_length=1)] = (
        Field(default=[-25.0, -10.0, -4.0])
    )

    @model_validator(mode="after")
    def _order(self) -> SummariesBlock:
        if self.cumulative_min >= self.threshold:
            raise ValueError(f"cumulative_min {self.cumulative_min:g} must be below threshold {self.threshold:g}")
        if any(low >= high for low, high in pairwise(self.count_thresholds)):
            raise ValueError(f"count_thresholds must rise from value to value, got {self.count_thresholds}")
        return self


class NullTestBlock(Block):
    """Mocks without substructure that go through every step; 0: no null test."""

    n_mocks: Annotated[int, Field(ge=0)] = 40


class AbcBlock(Block):
    """Summaries, acceptance and bound."""

    summaries: Literal["paper", "sharper", "learned"] = "paper"
    acceptance: Literal["max_rank", "marginal_and", "scaled_sum", "correlation", "cumulative"]
    fraction: Annotated[float, Field(gt=0, le=1)]
    distance: Literal["integral", "whitened"] = "integral"
    bootstrap: Annotated[int, Field(ge=100)]
    leave_one_out: Annotated[int, Field(ge=10)] = 1000
    max_failed_fraction: Annotated[float, Field(ge=0, lt=1)]

    @model_validator(mode="after")
    def _one_distance(self) -> AbcBlock:
        if self.summaries != "paper" and self.acceptance in ("correlation", "cumulative"):
            raise ValueError(
                f"acceptance: {self.acceptance} is a distance of summaries: paper; with summaries: "
                f"{self.summaries} use max_rank, marginal_and or scaled_sum"
            )
        return self


class Config(Block):
    """The whole configuration of a campaign."""

    results: ResultsFolder
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
    null_test: NullTestBlock = NullTestBlock()
    abc: AbcBlock

    @model_validator(mode="after")
    def _grid_within_ranges(self) -> Config:
        for name in ("m_th_kev", "log10_m_halo_msun") if self.campaign.grid is not None else ():
            low, high = getattr(self.dark_matter, name)
            outside = [value for value in getattr(self.campaign.grid, name) if not low <= value <= high]
            if outside:
                raise ValueError(
                    f"campaign.grid.{name} {outside} lie outside dark_matter.{name} = [{low:g}, {high:g}]"
                )
        return self

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        beyond = [i for i in self.scan.residual_samples if i >= self.campaign.n_samples]
        if beyond:
            raise ValueError(
                f"scan.residual_samples {beyond} do not exist: campaign.n_samples = {self.campaign.n_samples}, "
                "samples are counted from 0"
            )
        if self.abc.summaries == "sharper" and "amplitude" not in self.scan.statistics:
            raise ValueError(
                "abc.summaries: sharper needs the linear response of the scan; set scan.statistics: "
                "[delta_r, amplitude]"
            )
        if self.scan.marginalise_lens and self.smooth_model.mode == "given":
            raise ValueError(
                "scan.marginalise_lens needs the errors of the lens, which smooth_model.mode: given has not; "
                "use mode: fit, or set it to false"
            )
        return self
