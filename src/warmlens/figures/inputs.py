"""Which artifacts each figure is drawn from, and where a campaign has them."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

from warmlens.artifacts.chain import check_chains
from warmlens.artifacts.file import ArtifactError
from warmlens.artifacts.names import FIGURE_GROUPS, SINGLE
from warmlens.campaign.files import stage_files
from warmlens.campaign.snakemake import remaking_command
from warmlens.config.model import Config
from warmlens.stage_table import campaign_stages, stage_digests

log = logging.getLogger(__name__)

Inputs = Mapping[str, Path]

# A stage with one artifact by its name; of a chunked stage the first chunk, or with "/*" all of them.
NEEDED: dict[str, tuple[str, ...]] = {
    "smooth_model": ("observation", "smooth_model"),
    "psf": ("observation", "smooth_model"),
    "halo_maps": ("halos",),
    "deflection_maps": ("observation", "deflections"),
    "mocks": ("observation", "smooth_model", "mocks"),
    "delta_r": ("observed_scan", "scans"),
    "scan_plane": ("observed_scan",),
    "correlation": ("observed_summary", "summaries/*"),
    "posterior": ("abc",),
    "likelihood": ("abc",),
    "calibration": ("abc",),
    "convergence": ("abc",),
    "predictive": ("observed_summary", "abc"),
    "information": ("abc",),
    "3": ("observed_scan", "scans/*"),
    "4": ("observed_summary", "summaries/*"),
    "5": ("abc",),
}
_PLANE = ("observed_scan", "smooth_model")  # of every campaign that is compared


def drawn_groups(config: Config) -> dict[str, list[str]]:
    """Figures that a campaign draws, those whose stages it has, by the job that draws them."""
    stages = campaign_stages(config)
    groups = {
        group: [name for name in names if all(need.removesuffix("/*") in stages for need in NEEDED[name])]
        for group, names in FIGURE_GROUPS.items()
    }
    return {group: names for group, names in groups.items() if names}


def drawn_figures(config: Config) -> list[str]:
    """Names of all figures that a campaign draws."""
    return [name for names in drawn_groups(config).values() for name in names]


def figure_inputs(config: Config, name: str) -> dict[str, Path]:
    """Artifacts of figure `name` of a campaign by stage; "STAGE/i" where it needs all chunks of a stage."""
    return _located(config, NEEDED[name])


def find_inputs(name: str, results: Sequence[Path]) -> dict[str, Path]:
    """Artifacts of figure `name` in results folders; Figs. 6 and 7 compare several, the others show one.

    Raises
    ------
    ArtifactError
        If one is missing, with the command that makes it; if one was not made with the settings of its campaign.
    """
    from warmlens.campaign.status import read_campaign

    if name in ("6", "7"):
        found: dict[str, Path] = {}
        for number, folder in enumerate(results):
            config = read_campaign(folder)
            here = _located(config, (*_PLANE, "scans/*") if _shows_mocks(config, len(results)) else _PLANE)
            _check(here, folder, config)
            found |= {f"{number}/{key}": path for key, path in here.items()}
        return found
    if len(results) != 1:
        raise ArtifactError(f"figure {name} shows one campaign; give one --results, not {len(results)}")
    config = read_campaign(results[0])
    inputs = figure_inputs(config, name)
    _check(inputs, results[0], config)
    return inputs


def _located(config: Config, needed: Sequence[str]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for need in needed:
        stage = need.removesuffix("/*")
        files = stage_files(config, stage)
        if stage in SINGLE or stage == need:
            found[stage] = files[0]
        else:
            found |= {f"{stage}/{number}": path for number, path in enumerate(files)}
    return found


def _shows_mocks(config: Config, n_campaigns: int) -> bool:
    """Whether a plane shows mocks beside the observation: of a single campaign, if R_sens was asked for."""
    if n_campaigns > 1:
        return False
    if not config.scan.residual_samples:
        log.info("the observation alone is shown: R_sens of mocks needs their numbers in scan.residual_samples")
    return bool(config.scan.residual_samples)


def _check(inputs: Inputs, folder: Path, config: Config) -> None:
    missing = [path for path in inputs.values() if not path.exists()]
    if missing:
        name = str(missing[0].relative_to(folder))
        raise ArtifactError(
            f"{missing[0]}: no such artifact ({len(missing)} of {len(inputs)} are missing for this figure); make "
            f"it with: {remaking_command(folder, name)}"
        )
    check_chains(inputs.values(), stage_digests(config))
