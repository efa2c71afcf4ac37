"""What each stage reads of the configuration: its `params` in the workflow, and no more.

A change of a key reruns exactly the stages whose settings hold it. `stage_version` is raised when the
code of a stage changes its numbers, which reruns that stage and what depends on it.
"""

from __future__ import annotations

import json
from typing import Any, Literal

from warmlens.artifacts import settings_digest
from warmlens.config import (
    AbcBlock,
    Config,
    CosmologyBlock,
    DarkMatterBlock,
    DeflectionsBlock,
    HalosBlock,
    MocksBlock,
    NullTestBlock,
    RedshiftBlock,
    ScanBlock,
    SummariesBlock,
)
from warmlens.config_observation import ObservationBlock
from warmlens.config_smooth_model import SmoothModelBlock
from warmlens.config_types import Block


class StageSettings(Block):
    """Settings of one stage."""

    stage_version: int = 1

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON and the digest."""
        return json.loads(self.model_dump_json())


class ObservationSettings(StageSettings):
    """A FITS observation needs its block alone; a simulated one draws its substructure with the rest."""

    stage_version: int = 2
    observation: ObservationBlock
    cosmology: CosmologyBlock | None
    redshifts: RedshiftBlock | None
    halos: HalosBlock | None
    deflections: DeflectionsBlock | None


class SmoothModelSettings(StageSettings):
    """Lens, light and source basis of the smooth model."""

    stage_version: int = 4
    smooth_model: SmoothModelBlock


class ScanSettings(StageSettings):
    """Perturber, nested shapelets and raster; for masses, the observed scan's also cosmology and redshifts."""

    stage_version: int = 3
    scan: ScanBlock
    cosmology: CosmologyBlock | None = None
    redshifts: RedshiftBlock | None = None

    def without_samples(self) -> ScanSettings:
        """What design and operator depend on: the same for every sample, and for the observation."""
        scan = self.scan.model_copy(update={"residual_samples": [], "sensitivity": None})
        return self.model_copy(update={"scan": scan, "cosmology": None, "redshifts": None})

    def without_sensitivity(self) -> ScanSettings:
        """What the scans of samples depend on."""
        return self.model_copy(update={"scan": self.scan.model_copy(update={"sensitivity": None})})


class GridNodes(Block):
    """Nodes of a grid campaign, in place of the prior; how often each is realized changes no sample."""

    design: Literal["grid"]
    m_th_kev: list[float]
    log10_m_halo_msun: list[float]


class HalosSettings(StageSettings):
    """Prior or nodes, and halo physics."""

    seed: int
    dark_matter: DarkMatterBlock | GridNodes
    cosmology: CosmologyBlock
    redshifts: RedshiftBlock
    halos: HalosBlock


class DeflectionsSettings(StageSettings):
    """Lens geometry and high-pass filter."""

    stage_version: int = 2
    cosmology: CosmologyBlock
    redshifts: RedshiftBlock
    deflections: DeflectionsBlock


class MocksSettings(StageSettings):
    """Seed of the noise, and how the quasars are placed."""

    seed: int
    mocks: MocksBlock


class NullMocksSettings(StageSettings):
    """Seed of the noise, and how many."""

    seed: int
    null_test: NullTestBlock


class SummariesSettings(StageSettings):
    """Raster and summary statistics."""

    stage_version: int = 3
    scan: ScanBlock
    summaries: SummariesBlock


class AbcSettings(StageSettings):
    """Acceptance, and the digests of the settings that every stage above must have had."""

    stage_version: int = 3
    seed: int
    n_samples: int
    dark_matter: DarkMatterBlock
    abc: AbcBlock
    upstream: dict[str, str]


class ExclusionSettings(StageSettings):
    """Acceptance on a grid, and the digests of the settings that every stage above must have had."""

    seed: int
    n_samples: int
    dark_matter: DarkMatterBlock
    nodes: GridNodes
    abc: AbcBlock
    upstream: dict[str, str]


STAGES = (  # of a campaign that draws from the prior
    "observation",
    "smooth_model",
    "scan_design",
    "scan_operator",
    "observed_scan",
    "observed_summary",
    "halos",
    "deflections",
    "mocks",
    "scans",
    "summaries",
    "null_mocks",
    "null_scans",
    "null_summaries",
    "abc",
)


GRID_STAGES = (*(stage for stage in STAGES if stage != "abc" and not stage.startswith("null_")), "exclusion")


def campaign_stages(config: Config) -> tuple[str, ...]:
    """Stages that a campaign runs; the last one gives its answer: `abc`, or `exclusion` on a grid."""
    return GRID_STAGES if config.campaign.design == "grid" else STAGES


def grid_nodes(config: Config) -> GridNodes | None:
    """Nodes of a grid campaign; None for one that draws from the prior."""
    grid = config.campaign.grid
    if grid is None:
        return None
    return GridNodes(design="grid", m_th_kev=grid.m_th_kev, log10_m_halo_msun=grid.log10_m_halo_msun)


def stage_settings(config: Config, stage: str) -> StageSettings:
    """Settings of `stage` under `config`."""
    c = config
    simulated = c.observation.kind == "simulated"
    match stage:
        case "observation":
            others = {kind: None for kind in ("simulated", "fits", "artifact") if kind != c.observation.kind}
            return ObservationSettings(
                observation=c.observation.model_copy(update=others),
                cosmology=c.cosmology if simulated else None,
                redshifts=c.redshifts if simulated else None,
                halos=c.halos if simulated else None,
                deflections=c.deflections if simulated else None,
            )
        case "smooth_model":
            return SmoothModelSettings(smooth_model=c.smooth_model)
        case "scan_design" | "scan_operator" | "null_scans":
            return ScanSettings(scan=c.scan).without_samples()
        case "observed_scan":
            scan = c.scan.model_copy(update={"residual_samples": []})
            weighed = scan.sensitivity is not None
            return ScanSettings(
                scan=scan, cosmology=c.cosmology if weighed else None, redshifts=c.redshifts if weighed else None
            )
        case "scans":
            return ScanSettings(scan=c.scan).without_sensitivity()
        case "observed_summary" | "summaries" | "null_summaries":
            scan = ScanSettings(scan=c.scan).without_samples().scan
            return SummariesSettings(scan=scan, summaries=c.summaries)
        case "halos":
            return HalosSettings(
                seed=c.campaign.seed,
                dark_matter=grid_nodes(c) or c.dark_matter,
                cosmology=c.cosmology,
                redshifts=c.redshifts,
                halos=c.halos,
            )
        case "deflections":
            return DeflectionsSettings(cosmology=c.cosmology, redshifts=c.redshifts, deflections=c.deflections)
        case "mocks":
            return MocksSettings(seed=c.campaign.seed, mocks=c.mocks)
        case "null_mocks":
            return NullMocksSettings(seed=c.campaign.seed, null_test=c.null_test)
        case "abc":
            return AbcSettings(
                seed=c.campaign.seed,
                n_samples=c.campaign.n_samples,
                dark_matter=c.dark_matter,
                abc=c.abc,
                upstream={name: _digest(c, name) for name in STAGES if name != "abc"},
            )
        case "exclusion" if (nodes := grid_nodes(c)) is not None:
            return ExclusionSettings(
                seed=c.campaign.seed,
                n_samples=c.campaign.n_samples,
                dark_matter=c.dark_matter,
                nodes=nodes,
                abc=c.abc,
                upstream={name: _digest(c, name) for name in GRID_STAGES if name != "exclusion"},
            )
        case "exclusion":
            raise ValueError("stage 'exclusion' belongs to campaign.design: grid, and this campaign has none")
    raise ValueError(f"unknown stage {stage!r}; stages are {', '.join((*STAGES, 'exclusion'))}")


def stage_digests(config: Config) -> dict[str, str]:
    """Digest of the settings of every stage under `config`."""
    return {stage: _digest(config, stage) for stage in campaign_stages(config)}


def _digest(config: Config, stage: str) -> str:
    return settings_digest(stage_settings(config, stage).as_dict())
