"""What each stage reads of the configuration: its `params` in the workflow, and no more.

A change of a key reruns exactly the stages whose settings hold it. `stage_version` is raised when the
code of a stage changes its numbers, which reruns that stage and what depends on it.
"""

from __future__ import annotations

import json
from typing import Any, Literal

from warmlens.config.model import (
    AbcBlock,
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
from warmlens.config.observation import ObservationBlock
from warmlens.config.smooth_model import SmoothModelBlock
from warmlens.config.types import Block


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
