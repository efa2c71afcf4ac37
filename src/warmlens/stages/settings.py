"""What each stage reads of the configuration: its `params` in the workflow, and no more.

A change of a key reruns exactly the stages whose settings hold it. `stage_version` is raised when the
code of a stage changes its numbers, which reruns that stage and what depends on it.
"""

from __future__ import annotations

import json
from typing import Any

from warmlens.artifacts import settings_digest
from warmlens.config import (
    AbcBlock,
    Config,
    CosmologyBlock,
    DarkMatterBlock,
    DeflectionsBlock,
    HalosBlock,
    MocksBlock,
    ObservationBlock,
    RedshiftBlock,
    ScanBlock,
    SummariesBlock,
)
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

    stage_version: int = 2
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


class HalosSettings(StageSettings):
    """Prior and halo physics."""

    seed: int
    dark_matter: DarkMatterBlock
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


class SummariesSettings(StageSettings):
    """Raster and summary statistics."""

    stage_version: int = 2
    scan: ScanBlock
    summaries: SummariesBlock


class AbcSettings(StageSettings):
    """Acceptance, and the digests of the settings that every stage above must have had."""

    stage_version: int = 2
    seed: int
    n_samples: int
    dark_matter: DarkMatterBlock
    abc: AbcBlock
    upstream: dict[str, str]


STAGES = (
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
    "abc",
)


def stage_settings(config: Config, stage: str) -> StageSettings:
    """Settings of `stage` under `config`."""
    c = config
    simulated = c.observation.kind == "simulated"
    match stage:
        case "observation":
            other = "fits" if simulated else "simulated"
            return ObservationSettings(
                observation=c.observation.model_copy(update={other: None}),
                cosmology=c.cosmology if simulated else None,
                redshifts=c.redshifts if simulated else None,
                halos=c.halos if simulated else None,
                deflections=c.deflections if simulated else None,
            )
        case "smooth_model":
            return SmoothModelSettings(smooth_model=c.smooth_model)
        case "scan_design" | "scan_operator":
            return ScanSettings(scan=c.scan).without_samples()
        case "observed_scan":
            scan = c.scan.model_copy(update={"residual_samples": []})
            weighed = scan.sensitivity is not None
            return ScanSettings(
                scan=scan, cosmology=c.cosmology if weighed else None, redshifts=c.redshifts if weighed else None
            )
        case "scans":
            return ScanSettings(scan=c.scan).without_sensitivity()
        case "observed_summary" | "summaries":
            scan = ScanSettings(scan=c.scan).without_samples().scan
            return SummariesSettings(scan=scan, summaries=c.summaries)
        case "halos":
            return HalosSettings(
                seed=c.campaign.seed,
                dark_matter=c.dark_matter,
                cosmology=c.cosmology,
                redshifts=c.redshifts,
                halos=c.halos,
            )
        case "deflections":
            return DeflectionsSettings(cosmology=c.cosmology, redshifts=c.redshifts, deflections=c.deflections)
        case "mocks":
            return MocksSettings(seed=c.campaign.seed, mocks=c.mocks)
        case "abc":
            return AbcSettings(
                seed=c.campaign.seed,
                n_samples=c.campaign.n_samples,
                dark_matter=c.dark_matter,
                abc=c.abc,
                upstream={name: _digest(c, name) for name in STAGES if name != "abc"},
            )
    raise ValueError(f"unknown stage {stage!r}; stages are {', '.join(STAGES)}")


def stage_digests(config: Config) -> dict[str, str]:
    """Digest of the settings of every stage under `config`."""
    return {stage: _digest(config, stage) for stage in STAGES}


def _digest(config: Config, stage: str) -> str:
    return settings_digest(stage_settings(config, stage).as_dict())
