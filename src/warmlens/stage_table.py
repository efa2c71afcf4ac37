"""The stages of a campaign, one row per stage, and the settings that each of them reads.

A change of a configuration key reruns exactly the stages whose settings hold it, and what depends on them.
Raise `version` in the row of a stage when its code changes its numbers.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from warmlens.config.digest import settings_digest
from warmlens.config.model import (
    AbcBlock,
    Config,
    CosmologyBlock,
    DarkMatterBlock,
    DeflectionsBlock,
    HalosBlock,
    MocksBlock,
    NullTestBlock,
    RedshiftBlock,
)
from warmlens.config.observation import ObservationBlock
from warmlens.config.scan import ScanBlock, SummariesBlock
from warmlens.config.smooth_model import SmoothModelBlock
from warmlens.config.types import Block
from warmlens.inference.memory import peak_mb


class StageSettings(Block):
    """Settings of one stage: its version, as its row has it, and what it reads of the configuration."""

    stage_version: int = 1

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON and the digest."""
        return json.loads(self.model_dump_json())


class ObservationSettings(StageSettings):
    """A FITS observation needs its block alone; a simulated one draws its substructure with the others."""

    observation: ObservationBlock
    cosmology: CosmologyBlock | None
    redshifts: RedshiftBlock | None
    halos: HalosBlock | None
    deflections: DeflectionsBlock | None


class SmoothModelSettings(StageSettings):
    """Lens, light and source basis of the smooth model."""

    smooth_model: SmoothModelBlock


class ScanSettings(StageSettings):
    """Perturber, nested shapelets and raster; for masses, the observed scan's also cosmology and redshifts."""

    scan: ScanBlock
    cosmology: CosmologyBlock | None = None
    redshifts: RedshiftBlock | None = None

    def of_operator(self) -> ScanSettings:
        """Return the settings of design and operator, which serve every sample and the observation alike."""
        scan = self.scan.model_copy(update={"residual_samples": [], "sensitivity": None})
        return self.model_copy(update={"scan": scan, "cosmology": None, "redshifts": None})


class GridNodes(Block):
    """Nodes of a grid campaign, in place of the prior. How often each is realized changes no sample."""

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

    cosmology: CosmologyBlock
    redshifts: RedshiftBlock
    deflections: DeflectionsBlock


class MocksSettings(StageSettings):
    """Seed of the noise, and how the quasars are placed."""

    seed: int
    mocks: MocksBlock


class NullMocksSettings(StageSettings):
    """Seed of the noise, and number of mocks."""

    seed: int
    null_test: NullTestBlock


class SummariesSettings(StageSettings):
    """Raster and summary statistics."""

    scan: ScanBlock
    summaries: SummariesBlock


class AbcSettings(StageSettings):
    """Acceptance, and the digests of the settings that every stage before it must have had."""

    seed: int
    n_samples: int
    dark_matter: DarkMatterBlock
    abc: AbcBlock
    upstream: dict[str, str]


class ExclusionSettings(AbcSettings):
    """The same on a grid."""

    nodes: GridNodes


@dataclass(frozen=True)
class Stage:
    """A stage: what it reads, what it writes, and the code that does it.

    Attributes
    ----------
    work
        "module:function" below `warmlens.stages`.
    output
        Path below the results folder. `{span}` is a span: of samples in a chunk, of positions in a shard.
    settings
        Class of its settings. Fields take the blocks of the configuration that have their names.
    version
        Version of the numbers that its code makes.
    inputs
        Stages whose artifacts it reads, by the name that it calls them.
    narrow
        Fields of the settings that are no block of that name, or only part of it.
    """

    name: str
    work: str
    output: str
    settings: type[StageSettings]
    version: int = 1
    inputs: Mapping[str, str] = field(default_factory=dict)
    narrow: Callable[[Config], dict[str, Any]] = lambda _: {}

    @property
    def by_sample(self) -> bool:
        """Whether each artifact holds a chunk of samples."""
        return "/chunk-" in self.output

    @property
    def by_position(self) -> bool:
        """Whether each artifact holds a shard of scan positions."""
        return "/shard-" in self.output

    @property
    def of_null_test(self) -> bool:
        """Whether it works on mocks without substructure."""
        return self.name.startswith("null_")

    @property
    def needs_span(self) -> bool:
        """Whether the span of its artifact has to be given: no input has it."""
        return self.by_position or (
            self.by_sample and not any(STAGES[name].by_sample for name in self.inputs.values())
        )

    def reads_all_of(self, source: str) -> bool:
        """Return whether it reads all artifacts of another stage at once."""
        return STAGES[source].by_position or (STAGES[source].by_sample and not self.by_sample)

    def may_lack(self, source: str) -> bool:
        """Return whether it runs without the artifact of another stage: `abc` does without a null test."""
        return STAGES[source].of_null_test and not self.of_null_test


def _observation(config: Config) -> dict[str, Any]:
    block = config.observation
    others = {kind: None for kind in ("simulated", "fits", "artifact") if kind != block.kind}
    simulated = block.kind == "simulated"
    physics = {} if simulated else dict.fromkeys(("cosmology", "redshifts", "halos", "deflections"))
    return {"observation": block.model_copy(update=others), **physics}


def _operator(config: Config) -> dict[str, Any]:
    return dict(ScanSettings(scan=config.scan).of_operator())


def _observed_scan(config: Config) -> dict[str, Any]:
    masses = {} if config.scan.sensitivity is not None else {"cosmology": None, "redshifts": None}
    return {"scan": config.scan.model_copy(update={"residual_samples": []}), **masses}


def _scans(config: Config) -> dict[str, Any]:
    scan = config.scan.model_copy(update={"sensitivity": None})
    return {"scan": scan, "cosmology": None, "redshifts": None}


def _raster(config: Config) -> dict[str, Any]:
    return {"scan": _operator(config)["scan"]}


def _halos(config: Config) -> dict[str, Any]:
    return {"dark_matter": _nodes(config)} if config.campaign.grid is not None else {}


def _nodes(config: Config) -> GridNodes:
    grid = config.campaign.grid
    if grid is None:
        raise ValueError("stage 'exclusion' belongs to campaign.design: grid, and this campaign has none")
    return GridNodes(design="grid", m_th_kev=grid.m_th_kev, log10_m_halo_msun=grid.log10_m_halo_msun)


def _upstream(config: Config) -> dict[str, Any]:
    return {"upstream": {name: _digest(config, name) for name in campaign_stages(config)[:-1]}}


def _exclusion(config: Config) -> dict[str, Any]:
    return {"nodes": _nodes(config), **_upstream(config)}


_IMAGE = {"observation": "observation", "smooth_model": "smooth_model"}
_OPERATOR = {**_IMAGE, "design": "scan_design", "shards": "scan_operator"}
_ANSWER = {"observed_summary": "observed_summary", "smooth_model": "smooth_model", "summaries": "summaries"}
_CHUNK = "chunk-{span}.h5"

STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage("observation", "observation:run", "observation.h5", ObservationSettings, 2, narrow=_observation),
        Stage(
            "smooth_model", "smooth_model:run", "smooth_model.h5", SmoothModelSettings, 5,
            {"observation": "observation"},
        ),
        Stage(
            "scan_design", "scan_operator:run_design", "scan_operator/design.h5", ScanSettings, 4,
            _IMAGE, _operator,
        ),
        Stage(
            "scan_operator", "scan_operator:run", "scan_operator/shard-{span}.h5", ScanSettings, 4,
            {**_IMAGE, "design": "scan_design"}, _operator,
        ),
        Stage(
            "observed_scan", "scans:run_observed", "observed_scan.h5", ScanSettings, 4,
            _OPERATOR, _observed_scan,
        ),
        Stage(
            "observed_summary", "summaries:run_observed", "observed_summary.h5", SummariesSettings, 3,
            {"observed_scan": "observed_scan"}, _raster,
        ),
        Stage("halos", "halos:run", f"halos/{_CHUNK}", HalosSettings, narrow=_halos),
        Stage(
            "deflections", "deflections:run", f"deflections/{_CHUNK}", DeflectionsSettings, 2,
            {"halos": "halos", "observation": "observation"},
        ),
        Stage("mocks", "mocks:run", f"mocks/{_CHUNK}", MocksSettings, 1, {"deflections": "deflections", **_IMAGE}),
        Stage("scans", "scans:run", f"scans/{_CHUNK}", ScanSettings, 4, {"mocks": "mocks", **_OPERATOR}, _scans),
        Stage(
            "summaries", "summaries:run", f"summaries/{_CHUNK}", SummariesSettings, 3,
            {"scans": "scans"}, _raster,
        ),
        Stage("null_mocks", "mocks:run_null", "null/mocks.h5", NullMocksSettings, 1, _IMAGE),
        Stage(
            "null_scans", "scans:run", "null/scans.h5", ScanSettings, 4,
            {"mocks": "null_mocks", **_OPERATOR}, _operator,
        ),
        Stage(
            "null_summaries", "summaries:run", "null/summaries.h5", SummariesSettings, 3,
            {"scans": "null_scans"}, _raster,
        ),
        Stage(
            "abc", "abc.run:run", "abc.h5", AbcSettings, 4,
            {**_ANSWER, "null_summaries": "null_summaries"}, _upstream,
        ),
        Stage("exclusion", "exclusion:run", "exclusion.h5", ExclusionSettings, 2, _ANSWER, _exclusion),
    )
}  # fmt: skip


def campaign_stages(config: Config) -> tuple[str, ...]:
    """Return the stages that a campaign runs. The last one gives its answer: `abc`, or `exclusion` on a grid."""
    on_grid = config.campaign.design == "grid"
    left_out = [name for name, stage in STAGES.items() if stage.of_null_test or name == "abc"]
    return tuple(name for name in STAGES if name not in (left_out if on_grid else ("exclusion",)))


def stage_settings(config: Config, name: str) -> StageSettings:
    """Return the settings of a stage under a configuration."""
    if name not in STAGES:
        raise ValueError(f"unknown stage {name!r}; stages are {', '.join(STAGES)}")
    stage, campaign = STAGES[name], config.campaign
    blocks = {**dict(config), "seed": campaign.seed, "n_samples": campaign.n_samples}
    values = {key: blocks[key] for key in stage.settings.model_fields if key in blocks}
    return stage.settings(**(values | stage.narrow(config) | {"stage_version": stage.version}))


def answer_memory_mb(config: Config) -> int:
    """Return the memory [MB] that the stage of the answer needs at most: it grows with the samples."""
    scan, summaries = config.scan, config.summaries
    n_maps = 2 if "amplitude" in scan.statistics else 1  # with a correlation function and a single number each
    n_separations = 1 + round(summaries.max_separation_arcsec / scan.step_arcsec)
    n_numbers = n_maps * (n_separations + 1) + summaries.cumulative_bins + len(summaries.count_thresholds)
    return peak_mb(config.campaign.n_samples, n_numbers, config.abc.bootstrap, config.abc.leave_one_out)


def stage_digests(config: Config) -> dict[str, str]:
    """Return the digest of the settings of every stage that a campaign runs."""
    return {name: _digest(config, name) for name in campaign_stages(config)}


def _digest(config: Config, name: str) -> str:
    return settings_digest(stage_settings(config, name).as_dict())
