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
    Block,
    Config,
    CosmologyBlock,
    DarkMatterBlock,
    DeflectionsBlock,
    HalosBlock,
    ObservationBlock,
    RedshiftBlock,
    ScanBlock,
    SmoothModelBlock,
    SummariesBlock,
)


class StageSettings(Block):
    """Settings of one stage."""

    stage_version: int = 1

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON and the digest."""
        return json.loads(self.model_dump_json())


class ObservationSettings(StageSettings):
    """A FITS observation needs its block alone; a simulated one draws its substructure with the rest."""

    observation: ObservationBlock
    cosmology: CosmologyBlock | None
    redshifts: RedshiftBlock | None
    halos: HalosBlock | None
    deflections: DeflectionsBlock | None


class SmoothModelSettings(StageSettings):
    """Lens, light and source basis of the smooth model."""

    smooth_model: SmoothModelBlock


class ScanSettings(StageSettings):
    """Perturber and raster."""

    scan: ScanBlock


class HalosSettings(StageSettings):
    """Prior and halo physics."""

    seed: int
    dark_matter: DarkMatterBlock
    cosmology: CosmologyBlock
    redshifts: RedshiftBlock
    halos: HalosBlock


class DeflectionsSettings(StageSettings):
    """Lens geometry and high-pass filter."""

    cosmology: CosmologyBlock
    redshifts: RedshiftBlock
    deflections: DeflectionsBlock


class MocksSettings(StageSettings):
    """Seed of the noise."""

    seed: int


class SummariesSettings(StageSettings):
    """Raster and summary statistics."""

    scan: ScanBlock
    summaries: SummariesBlock


class AbcSettings(StageSettings):
    """Acceptance, and the digests of the settings that every stage above must have had."""

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
        case "scan_design" | "scan_operator" | "observed_scan" | "scans":
            return ScanSettings(scan=c.scan)
        case "observed_summary" | "summaries":
            return SummariesSettings(scan=c.scan, summaries=c.summaries)
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
            return MocksSettings(seed=c.campaign.seed)
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
