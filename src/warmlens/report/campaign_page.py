"""`warmlens report`: one HTML file with everything that a campaign found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import UndefinedError

from warmlens.artifacts.file import ArtifactError
from warmlens.artifacts.names import FIGURES, REPORT, SINGLE
from warmlens.figures import CAPTIONS
from warmlens.inference.calibration import MIN_ROWS
from warmlens.report.collect import Campaign, FigureFile, read_report
from warmlens.report.provenance import CampaignProvenance, read_provenance
from warmlens.report.render import picture, render, write_page
from warmlens.text import CITATION

# Figures that stand beside the numbers they show; all others follow under "Figures".
PLACED = ("posterior", "likelihood", "information", "calibration", "convergence", "predictive")
SECTIONS = (
    ("warnings", "Warnings"),
    ("bound", "The bound"),
    ("posterior", "Posterior"),
    ("companions", "Beside the bound"),
    ("calibration", "Calibration"),
    ("convergence", "Convergence"),
    ("checks", "Predictive checks"),
    ("null-test", "Null test"),
    ("smooth-model", "Smooth model"),
    ("figures", "Figures"),
    ("failed", "Failed samples"),
    ("accepted", "Accepted samples"),
    ("configuration", "Configuration"),
    ("provenance", "Provenance"),
    ("times", "Run times"),
    ("reproduce", "Reproduce and cite"),
)


def write_report(results: Path, output: Path | None = None) -> Path:
    """Write the report of a finished campaign.

    Parameters
    ----------
    results
        Results folder.
    output
        Where to; `report.html` in the results folder unless given.

    Returns
    -------
    output
        The file.

    Raises
    ------
    ArtifactError
        If an artifact that it needs is missing or was written by other code. A figure that is missing is named
        in its place.
    """
    campaign = read_report(results, CAPTIONS)
    provenance = read_provenance(results, campaign.config)
    target = output or results / REPORT
    try:
        html = report_html(campaign, provenance)
    except UndefinedError as error:
        raise ArtifactError(
            f"{results / SINGLE['abc']}: {error}; it was written by other code: run the campaign again"
        ) from error
    write_page(target, html)
    return target


def report_html(campaign: Campaign, provenance: CampaignProvenance) -> str:
    """The page."""
    placed = [name for name in PLACED if name in FIGURES]
    gallery = [name for name in FIGURES if name not in PLACED]
    by_name = {item.name: item for item in campaign.figures}
    figures = {name: _figure(by_name[name], i) for i, name in enumerate([*placed, *gallery], start=1)}
    return render(
        "report.html.j2",
        campaign=campaign,
        provenance=provenance,
        name=campaign.results.resolve().name,
        folder=str(campaign.results),
        sections=SECTIONS,
        figures=figures,
        gallery=gallery,
        predictive_kinds=list(
            dict.fromkeys(
                [*campaign.meta["posterior_predictive_p"], *campaign.meta["nearest_neighbour_percentile"]]
            )
        ),
        file_warnings=file_warnings(provenance),
        citation=CITATION,
        min_trials=MIN_ROWS,
        infinity=math.inf,
    )


def file_warnings(provenance: CampaignProvenance) -> list[str]:
    """What is wrong with the artifacts, in words."""
    warnings = []
    if provenance.chain_problem:
        warnings.append(f"the chain of artifacts is broken: {provenance.chain_problem}")
    if provenance.missing:
        warnings.append(
            f"{len(provenance.missing)} artifacts of the campaign are no longer there: {_some(provenance.missing)}"
        )
    if provenance.dirty:
        warnings.append(f"made by code with changes that were not committed: {_some(provenance.dirty)}")
    if len(provenance.commits) > 1:
        warnings.append(f"the artifacts were made by {len(provenance.commits)} commits of the code")
    return warnings


def _some(names: Sequence[str], most: int = 4) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _figure(item: FigureFile, number: int) -> dict[str, Any]:
    """Label, caption, picture and table of a figure; no picture if it is missing."""
    shown = picture(item.path.read_bytes(), item.caption, str(item.path)) if item.path.exists() else None
    data = item.path.with_suffix(".csv")
    return {
        "label": f"Figure {number}",
        "caption": item.caption,
        "picture": shown,
        "path": str(item.path),
        "command": item.command,
        "data": str(data) if data.exists() else "",
    }
