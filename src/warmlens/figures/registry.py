"""All figures by name, and how one is written."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("agg")

import pandas as pd

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import open_artifact
from warmlens.campaign.derived import drawn_figures, figure_files, record_made
from warmlens.campaign.status import read_campaign
from warmlens.config.model import Config
from warmlens.figures import (
    calibration,
    convergence,
    correlation,
    correlation_by_halo,
    cumulative_functions,
    delta_r,
    halo_grid,
    halo_maps,
    information,
    likelihood,
    mocks,
    posterior,
    predictive,
    psf,
    scan_plane,
    smooth_model,
)
from warmlens.figures.inputs import Inputs, find_inputs
from warmlens.figures.recipe import Recipe, panel_table
from warmlens.text import MEANING

logging.getLogger("fontTools").setLevel(logging.WARNING)  # it reports every glyph of a PDF

# What is read as a DataFrame, or as one per panel, needs no `tabulate` of its own.
FROM_ARTIFACTS: dict[str, Recipe[Inputs, Any]] = {
    "smooth_model": Recipe(smooth_model.read, smooth_model.draw, smooth_model.tabulate),
    "psf": Recipe(psf.read, psf.draw, psf.tabulate),
    "halo_maps": Recipe(halo_maps.read_masses, halo_maps.draw_masses, halo_maps.tabulate),
    "deflection_maps": Recipe(halo_maps.read_deflections, halo_maps.draw_deflections, halo_maps.tabulate),
    "mocks": Recipe(mocks.read, mocks.draw, mocks.tabulate),
    "delta_r": Recipe(delta_r.read, delta_r.draw, delta_r.tabulate),
    "scan_plane": Recipe(scan_plane.read_bands, scan_plane.draw, scan_plane.tabulate),
    "correlation": Recipe(correlation.read, correlation.draw, correlation.tabulate),
    "posterior": Recipe(posterior.read, posterior.draw, posterior.tabulate),
    "likelihood": Recipe(likelihood.read, likelihood.draw, panel_table),
    "calibration": Recipe(calibration.read, calibration.draw, panel_table),
    "convergence": Recipe(convergence.read, convergence.draw, convergence.tabulate),
    "predictive": Recipe(predictive.read, predictive.draw, panel_table),
    "information": Recipe(information.read, information.draw, pd.DataFrame),
    "3": Recipe(delta_r.read_heavy_and_light, delta_r.draw, delta_r.tabulate),
    "4": Recipe(correlation_by_halo.read, correlation_by_halo.draw, correlation_by_halo.tabulate),
    "5": Recipe(posterior.read, posterior.draw, posterior.tabulate),
    "6": Recipe(scan_plane.read_lenses, scan_plane.draw, scan_plane.tabulate),
    "7": Recipe(scan_plane.read_sources, scan_plane.draw, scan_plane.tabulate),
}
FROM_CONFIG: dict[str, Recipe[Config, Any]] = {
    "1": Recipe(halo_grid.read_masses, halo_grid.draw_masses, halo_grid.tabulate_masses),
    "2": Recipe(halo_grid.read_deflections, halo_grid.draw_deflections, halo_grid.tabulate_deflections),
    "8": Recipe(cumulative_functions.read, cumulative_functions.draw, panel_table),
}


def write_from_artifacts(name: str, inputs: Inputs, output: Path) -> None:
    """Write a figure of given artifacts and its data."""
    recipe = _recipe(name)
    recipe.write(inputs, output, _verdict(inputs))


def write_from_results(name: str, results: Sequence[Path], output: Path) -> None:
    """Write a figure of one campaign (Figs. 6 and 7: of several) and its data.

    One of the campaign's own figures gets a ledger.
    """
    _recipe(name)  # refuses a name that is none
    write_from_artifacts(name, find_inputs(name, results), output)
    config = read_campaign(results[0])
    if name in drawn_figures(config) and output.resolve() == figure_files(config, name)[0].resolve():
        record_made(config, name)


def write_from_config(name: str, config: Config, output: Path) -> None:
    """Write a figure that needs no campaign and its data."""
    FROM_CONFIG[name].write(config, output)


def _verdict(inputs: Inputs) -> str:
    """Return the verdict on the bound that a figure shows; "" for a figure of something else."""
    if "abc" not in inputs:
        return ""
    with open_artifact(inputs["abc"], "abc") as artifact:
        verdict = artifact.metadata["verdict"]
    return f"{verdict}: {MEANING[verdict]}"


def _recipe(name: str) -> Recipe[Inputs, Any]:
    if name not in FROM_ARTIFACTS:
        names = ", ".join([*FROM_ARTIFACTS, *FROM_CONFIG])
        raise ArtifactError(f"there is no figure {name!r}; the figures are {names}")
    return FROM_ARTIFACTS[name]
