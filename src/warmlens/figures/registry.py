"""All figures by name, and how one is written."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("agg")

from warmlens.artifacts.file import ArtifactError
from warmlens.config.model import Config
from warmlens.figures import calibration, checks, halos, maps, planes, posterior, scans, smooth, summaries
from warmlens.figures.inputs import Inputs, find_inputs
from warmlens.figures.recipe import Recipe

logging.getLogger("fontTools").setLevel(logging.WARNING)  # tells of every glyph of a PDF

FROM_ARTIFACTS: dict[str, Recipe[Inputs, Any]] = {
    "smooth_model": Recipe(smooth.read_smooth_model_figure, smooth.draw_smooth_model_figure),
    "psf": Recipe(smooth.read_psf_figure, smooth.draw_psf_figure),
    "halo_maps": Recipe(maps.read_halo_maps, maps.draw_halo_maps),
    "deflection_maps": Recipe(maps.read_deflection_maps, maps.draw_deflection_maps),
    "mocks": Recipe(smooth.read_mocks_figure, smooth.draw_mocks_figure),
    "delta_r": Recipe(scans.read_delta_r, scans.draw_scan_figure),
    "scan_plane": Recipe(planes.read_scan_plane, planes.draw_plane_figure),
    "correlation": Recipe(summaries.read_summaries, summaries.draw_summaries),
    "posterior": Recipe(posterior.read_posterior, posterior.draw_posterior),
    "likelihood": Recipe(posterior.read_likelihood, posterior.draw_likelihood),
    "calibration": Recipe(calibration.read_calibration, calibration.draw_calibration),
    "convergence": Recipe(checks.read_convergence, checks.draw_convergence),
    "predictive": Recipe(checks.read_predictive, checks.draw_predictive),
    "information": Recipe(checks.read_information, checks.draw_information),
    "3": Recipe(scans.read_paper_delta_r, scans.draw_scan_figure),
    "4": Recipe(summaries.read_paper_correlations, summaries.draw_paper_correlations),
    "5": Recipe(posterior.read_posterior, posterior.draw_posterior),
    "6": Recipe(planes.read_lens_planes, planes.draw_plane_figure),
    "7": Recipe(planes.read_source_planes, planes.draw_plane_figure),
}
FROM_CONFIG: dict[str, Recipe[Config, Any]] = {
    "1": Recipe(halos.read_halo_grid, halos.draw_halo_grid_figure),
    "2": Recipe(halos.read_deflection_grid, halos.draw_deflection_grid_figure),
    "8": Recipe(halos.read_cumulative_functions, halos.draw_cumulative_figure),
}


def write_from_artifacts(name: str, inputs: Inputs, output: Path) -> None:
    """Write a figure of given artifacts and its data."""
    FROM_ARTIFACTS[_known(name)].write(inputs, output)


def write_from_results(name: str, results: Sequence[Path], output: Path) -> None:
    """Write a figure of one campaign (Figs. 6 and 7: of several) and its data."""
    FROM_ARTIFACTS[_known(name)].write(find_inputs(name, results), output)


def write_from_config(name: str, config: Config, output: Path) -> None:
    """Write a figure that needs no campaign and its data."""
    FROM_CONFIG[name].write(config, output)


def _known(name: str) -> str:
    if name not in FROM_ARTIFACTS:
        names = ", ".join([*FROM_ARTIFACTS, *FROM_CONFIG])
        raise ArtifactError(f"there is no figure {name!r}; the figures are {names}")
    return name
