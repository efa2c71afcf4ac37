"""Stages of a campaign, and what each of them reads of its configuration."""

from __future__ import annotations

from warmlens.artifacts.file import settings_digest
from warmlens.config.model import (
    Config,
)
from warmlens.stages.settings import (
    AbcSettings,
    DeflectionsSettings,
    ExclusionSettings,
    GridNodes,
    HalosSettings,
    MocksSettings,
    NullMocksSettings,
    ObservationSettings,
    ScanSettings,
    SmoothModelSettings,
    StageSettings,
    SummariesSettings,
)

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
