"""`warmlens report`: one HTML file with the whole result of a campaign."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import UndefinedError

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.names import FIGURES, REPORT, SINGLE
from warmlens.campaign.derived import record_made
from warmlens.campaign.snakemake import remaking_command
from warmlens.figures import CAPTIONS
from warmlens.report.collect import read_report
from warmlens.report.provenance import CampaignProvenance, read_provenance
from warmlens.report.render import picture, render, write_page
from warmlens.text import CITATION, MEANING, bound_cells, confidence, prior_name

# Figures that are shown with their numbers; all others follow under "Figures".
PLACED = ("posterior", "likelihood", "information", "calibration", "convergence", "predictive")


def write_report(results: Path, output: Path | None = None) -> Path:
    """Write the report of a finished campaign to `output`, or with its ledger into its folder; return its path.

    Raises
    ------
    ArtifactError
        For an artifact that is missing or was written by other code. A missing figure is named in its place.
    """
    campaign = read_report(results)
    provenance = read_provenance(results, campaign["config"])
    target = output or results / REPORT
    try:
        html = report_html(campaign, provenance)
    except UndefinedError as error:
        raise ArtifactError(
            f"{results / SINGLE['abc']}: {error}; it was written by other code: run the campaign again"
        ) from error
    write_page(target, html)
    if target.resolve() == (results / REPORT).resolve():
        headers = provenance.artifacts.values()
        record_made(campaign["config"], "report", {header.path: header.digest for header in headers})
    return target


def report_html(campaign: Mapping[str, Any], provenance: CampaignProvenance) -> str:
    """Render the page from the values of `read_report`."""
    results, meta = campaign["results"], campaign["meta"]
    gallery = [name for name in FIGURES if name not in PLACED]
    numbered = enumerate([*(name for name in PLACED if name in FIGURES), *gallery], start=1)
    return render(
        "report.html.j2",
        campaign=campaign,
        provenance=provenance,
        name=results.resolve().name,
        folder=str(results),
        bounds=bound_rows(meta),
        figures={name: _figure(results, name, f"Figure {i}") for i, name in numbered},
        gallery=gallery,
        predictive_kinds=dict.fromkeys([*meta["posterior_predictive_p"], *meta["nearest_neighbour_percentile"]]),
        file_warnings=file_warnings(provenance),
        citation=CITATION,
        meaning=MEANING,
        verdict_class={"measured": "good", "prior only": "weak", "not usable": "bad"}[meta["verdict"]],
        infinity=math.inf,
    )


def bound_rows(meta: Mapping[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of the tables of bounds: at every level, under other rules, and under other priors."""
    headline = meta["bounds"][meta["headline"]]
    labelled = {
        "levels": [(name, f"{name} ({confidence(bound)})", bound) for name, bound in meta["bounds"].items()],
        "rules": [(name, name, bound) for name, bound in meta["other_rules"].items()],
        "priors": [(name, prior_name(name), bound) for name, bound in meta["other_priors"].items()],
    }
    return {
        table: [{"name": name, "label": label, **bound_cells(bound, headline)} for name, label, bound in bounds]
        for table, bounds in labelled.items()
    }


def file_warnings(provenance: CampaignProvenance) -> list[str]:
    """Say what is wrong with the artifacts."""
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


def _figure(results: Path, name: str, label: str) -> dict[str, Any]:
    """Return the picture of a figure (None if missing), its caption, its table and the command that draws it."""
    path, caption = results / f"figures/{name}.png", CAPTIONS[name]
    data = path.with_suffix(".csv")
    return {
        "label": label,
        "caption": caption,
        "picture": picture(path.read_bytes(), caption, str(path)) if path.exists() else None,
        "path": str(path),
        "command": remaking_command(results, f"figures/{name}.png"),
        "data": str(data) if data.exists() else "",
    }
