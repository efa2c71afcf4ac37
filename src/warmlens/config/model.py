"""Typed blocks of config.yaml: type, range, unit and meaning of every key; `make docs` after a change."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from warmlens.config import plausible
from warmlens.config.observation import ObservationBlock
from warmlens.config.plausible import Usual
from warmlens.config.scan import ScanBlock, SummariesBlock
from warmlens.config.smooth_model import SmoothModelBlock
from warmlens.config.types import (
    MAX_IN_FILE_NAMES,
    MAX_PORTIONS,
    Ascending,
    Block,
    FileNumber,
    Finite,
    Fraction,
    Interval,
    NonNegative,
    Positive,
    ResultsFolder,
)

BRANCHING_SETS = ("pch08", "benson17", "pch_plus")


def _branching(value: object) -> object:
    numbers = (
        isinstance(value, list | tuple) and len(value) == 4 and all(isinstance(v, int | float) for v in value)
    )
    if value not in BRANCHING_SETS and not numbers:
        raise ValueError(f"must be one of {', '.join(BRANCHING_SETS)} or four numbers, got {value!r}")
    return tuple(value) if isinstance(value, list) else value


class GridBlock(Block):
    """Nodes for design: grid, each relic mass with each halo mass (workflow/configs/pilot.yaml)."""

    m_th_kev: Annotated[list[Positive], Ascending, plausible.RELIC] = Field(
        min_length=2, description="Relic masses [keV], ascending"
    )
    log10_m_halo_msun: Annotated[list[Finite], Ascending, plausible.HOST] = Field(
        min_length=2, description="Host masses log10(M200c / Msun), ascending"
    )
    realizations: int = Field(ge=1, description="Samples at each node; n_samples is nodes x realizations")

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.m_th_kev) * len(self.log10_m_halo_msun)


class CampaignBlock(Block):
    """What is sampled, and in which portions."""

    seed: int = Field(ge=0, description="Root of all random streams, keyed by (seed, stage, sample, band)")
    n_samples: FileNumber = Field(description="Number of samples; it may be raised later, nothing is recomputed")
    chunk_size: FileNumber = Field(description="Samples per job; fix it at the start: file names hold it")
    design: Literal["prior", "grid"] = Field(
        "prior", description="prior: draw each sample from dark_matter; grid: use the nodes of `grid`"
    )
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

    H0: Annotated[Positive, Usual(50, 100, "km/s/Mpc", plausible.HUBBLE, plausible.PER_KPC)] = Field(
        description="Hubble constant [km/s/Mpc]"
    )
    Om0: Annotated[Fraction, Usual(0.1, 0.6, "", plausible.PERCENT)] = Field(
        description="Matter density over the critical density, today"
    )
    Ob0: Annotated[Fraction, Usual(0.03, 0.08, "of the critical density, not Ob0 h^2", plausible.PERCENT)] = Field(
        description="Baryon density over the critical density, today; below Om0"
    )
    sigma8: Annotated[Positive, Usual(0.5, 1.2, "", plausible.PERCENT)] = Field(
        description="rms of the linear density contrast in spheres of 8 Mpc/h, today"
    )
    ns: Annotated[Positive, Usual(0.8, 1.1, "", plausible.PERCENT)] = Field(
        description="Spectral index of the primordial power spectrum"
    )
    Tcmb0: Annotated[Positive, Usual(2, 3.5, "K", plausible.MILLI, plausible.MICRO)] = Field(
        description="Temperature of the CMB [K]; the paper does not give it"
    )

    @model_validator(mode="after")
    def _baryons(self) -> CosmologyBlock:
        if self.Ob0 >= self.Om0:
            raise ValueError(f"Ob0 = {self.Ob0:g} must be below Om0 = {self.Om0:g}")
        return self


class RedshiftBlock(Block):
    """Redshifts of the lens and of the source."""

    lens: Annotated[Positive, Usual(0.01, 3, "", plausible.RECESSION)] = Field(
        description="Redshift of the host halo; halos along the line of sight are left out"
    )
    source: Annotated[Positive, Usual(0.05, 12, "", plausible.RECESSION)] = Field(
        description="Redshift of the source, behind the lens"
    )

    @model_validator(mode="after")
    def _order(self) -> RedshiftBlock:
        if self.source <= self.lens:
            raise ValueError(f"source = {self.source:g} must lie behind lens = {self.lens:g}")
        return self


class DarkMatterBlock(Block):
    """Prior of the inferred parameters: uniform and independent."""

    m_th_kev: Annotated[Interval, plausible.RELIC] = Field(description="Thermal relic mass [keV]")
    log10_m_halo_msun: Annotated[Interval, plausible.HOST] = Field(
        description="Host mass log10(M200c / Msun) at the lens, within [10, 16]"
    )

    @model_validator(mode="after")
    def _ranges(self) -> DarkMatterBlock:
        if self.m_th_kev[0] <= 0:
            raise ValueError(f"m_th_kev must be above 0, got {self.m_th_kev[0]:g}")
        low, high = self.log10_m_halo_msun
        if not 10 <= low < high <= 16:
            meant = plausible.HOST.suggestion((low, high))
            raise ValueError(f"log10_m_halo_msun must lie within [10, 16], got [{low:g}, {high:g}]{meant}")
        return self


class HalosBlock(Block):
    """Physics of the halo realizations (docs/decisions.md explains each choice)."""

    preset: Literal["paper", "calibrated", "custom"] = Field(
        description="paper: tau_dyn = 0.1 / H, positions: nfw_host; calibrated: tau_dyn of Jiang & van den Bosch "
        "2016, positions: nfw_infall; custom: as given by the next two keys"
    )
    tau_dyn: Literal["paper", "jvdb16"] | None = Field(
        None, description="Preset custom: dynamical time paper (0.1 / H) | jvdb16 (Jiang & van den Bosch 2016)"
    )
    positions: Literal["nfw_host", "nfw_infall", "orbit_infall"] | None = Field(
        None, description="Preset custom: nfw_host (profile at the lens) | nfw_infall (at infall) | orbit_infall"
    )
    transfer_function: Literal["viel05", "bode01", "vogel23"] = Field(
        description="viel05 (Viel+ 2005) | bode01 (Bode+ 2001) | vogel23 (Vogel & Abazajian 2023)"
    )
    field_half_width_arcsec: Annotated[Positive, plausible.EXTENT] = Field(
        description="Subhalos are kept to this |x|, |y| [arcsec]: image half-width + 3 filter widths"
    )
    min_mass_msun: Annotated[Positive, plausible.MASS] = Field(
        description="Floor of the trees' resolution and of the bound mass [Msun]"
    )
    branching: Annotated[str | tuple[float, float, float, float], BeforeValidator(_branching)] = Field(
        description="pch08 (Parkinson et al. 2008) | benson17 | pch_plus | [G0, gamma1, gamma2, gamma3]"
    )
    sharp_k_a: Annotated[Positive, Usual(1, 5)] = Field(
        description="k_s R of the sharp-k filter (Benson et al. 2013)"
    )
    barrier_factor: Annotated[Positive, Usual(0.5, 2, "", plausible.PERCENT)] = Field(
        description="Factor on the collapse barrier (Benson et al. 2013)"
    )
    stripping_amplitude: Annotated[NonNegative, Usual(0, 20)] = Field(
        description="A_ts of tidal stripping (Giocoli et al. 2008)"
    )
    stripping_slope: Annotated[Positive, Usual(0.001, 1, "", plausible.PERCENT)] = Field(
        description="zeta of tidal stripping (Giocoli et al. 2008)"
    )
    friction_amplitude: Annotated[NonNegative, Usual(0.01, 10)] = Field(
        description="A_df of dynamical friction (Boylan-Kolchin et al. 2008)"
    )
    friction_mass_slope: Annotated[Finite, Usual(0, 3, "", plausible.SIGN)] = Field(
        description="b_df of dynamical friction"
    )
    friction_circularity_slope: Annotated[Finite, Usual(0, 5, "", plausible.SIGN)] = Field(
        description="c_df of dynamical friction"
    )
    concentration: Literal["paper", "duffy08"] = Field(
        description="paper (power law of the keys below) | duffy08 (Duffy et al. 2008, 200c, full sample)"
    )
    concentration_scatter_dex: Annotated[NonNegative, Usual(0, 0.5, "dex", plausible.PERCENT)] = Field(
        description="Log-normal scatter of the subhalos' values [dex]"
    )
    concentration_amplitude: Annotated[Positive, Usual(1, 50)] = Field(description="A_c of c(M, z) of cold halos")
    concentration_mass_slope: Annotated[Finite, Usual(-0.3, 0, "", plausible.SIGN)] = Field(
        description="B_c of c(M, z) of cold halos"
    )
    concentration_redshift_slope: Annotated[Finite, Usual(-2, 0, "", plausible.SIGN)] = Field(
        description="C_c of c(M, z) of cold halos"
    )
    concentration_pivot_msun: Annotated[
        Positive, Usual(1e8, 1e16, "Msun", plausible.LOG10, plausible.TEN_BILLIONS)
    ] = Field(description="Pivot mass of c(M, z) [Msun]")
    concentration_min: Annotated[Positive, Usual(0.5, 10)] = Field(
        description="Smallest concentration of any halo"
    )
    formation_mass_cap_msun: Annotated[Positive, plausible.HEAVY_MASS] = Field(
        description="Heaviest cold halo that a warm one is mapped to [Msun] (Schneider 2015)"
    )
    z_max: Annotated[Positive, Usual(3, 100)] = Field(description="Redshift at which the trees end")

    @model_validator(mode="after")
    def _preset(self) -> HalosBlock:
        for key in ("tau_dyn", "positions"):
            given = getattr(self, key) is not None
            if given != (self.preset == "custom"):
                need = "is needed with" if self.preset == "custom" else "is set by"
                raise ValueError(f"{key} {need} preset: {self.preset}; use preset: custom to choose it")
        return self


class DeflectionsBlock(Block):
    """High-pass filter of the subhalos' deflection, and what deflects."""

    filter: Literal["gaussian", "starlet", "median_wavelet"] = Field(
        description="gaussian | starlet | median_wavelet: the smooth part of the deflection is subtracted"
    )
    filter_arcsec: Annotated[Positive, Usual(0.01, 10, "arcsec", plausible.MAS, plausible.DEGREES)] = Field(
        description="Gaussian width [arcsec], the scale of the smooth lens; others use their nearest scale"
    )
    smooth_host: bool = Field(False, description="Let the host's smooth NFW profile deflect too, before filtering")


class MocksBlock(Block):
    """Positions of the quasar images in the mocks."""

    quasar_positions: Literal["observed", "solved"] = Field(
        default="observed", description="observed: as in the observation; solved: by the perturbed lens equation"
    )


class NullTestBlock(Block):
    """Mocks without substructure that pass through all steps and play the observation."""

    n_mocks: int = Field(default=40, ge=0, description="Number of mocks, as costly as samples; 0: no null test")


class AbcBlock(Block):
    """Summaries, acceptance and bound."""

    summaries: Literal["paper", "sharper", "learned"] = Field(
        "paper",
        description="Summaries of the headline bound; those of all sets are reported. paper: C(dr) and "
        "cumulative distribution; sharper: linear response, chi2 and counts, with scan.statistics: "
        "[delta_r, amplitude]; learned: regression of the parameters on all",
    )
    acceptance: Literal["max_rank", "marginal_and", "scaled_sum", "correlation", "cumulative"] = Field(
        description="max_rank: both distances below one common quantile; marginal_and: each below its own; "
        "scaled_sum: their scaled sum; correlation, cumulative: one alone"
    )
    fraction: Annotated[float, Usual(0, 1, "", plausible.PERCENT)] = Field(
        gt=0, le=1, description="Accepted fraction (marginal_and: of each distance)"
    )
    distance: Literal["integral", "whitened"] = Field(
        "integral", description="integral: of the squared difference; whitened: by the covariance of the summaries"
    )
    bootstrap: int = Field(ge=100, description="Resampled tables for the Monte Carlo errors")
    leave_one_out: int = Field(1000, ge=10, description="Samples that calibrate the bound; 300 are needed to pass")
    max_failed_fraction: Annotated[float, Usual(0, 1, "", plausible.PERCENT)] = Field(
        ge=0, lt=1, description="Above this fraction of failures, no posterior"
    )

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

    results: ResultsFolder = Field(description="Folder of all artifacts of this campaign")
    campaign: CampaignBlock
    cosmology: CosmologyBlock
    redshifts: RedshiftBlock
    dark_matter: DarkMatterBlock
    halos: HalosBlock
    observation: ObservationBlock
    smooth_model: SmoothModelBlock
    deflections: DeflectionsBlock
    mocks: MocksBlock = MocksBlock()  # mypy accepts the call because its default is given by keyword
    scan: ScanBlock
    summaries: SummariesBlock
    null_test: NullTestBlock = NullTestBlock()
    abc: AbcBlock
    unusual: list[str] = Field(
        [],
        exclude_if=lambda keys: not keys,
        description="Keys whose numbers lie outside their usual range and are meant, such as cosmology.H0",
    )

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
