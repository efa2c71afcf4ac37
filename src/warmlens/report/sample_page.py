"""`warmlens show`: one HTML file about one sample."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warmlens.artifacts.names import sample_page
from warmlens.report.render import picture, render, write_page
from warmlens.report.sample import SampleRecord, read_sample

N_SUBHALOS = 20
SECTIONS = (
    ("sample", "The sample"),
    ("subhalos", "Subhaloes"),
    ("deflection", "Deflection"),
    ("mocks", "Mock image"),
    ("scan", "Scan"),
    ("summaries", "Summaries"),
    ("stages", "Stages and seeds"),
)


def write_sample(results: Path, sample: int, output: Path | None = None) -> Path:
    """Write the page of one sample of a finished campaign.

    Parameters
    ----------
    results
        Results folder.
    sample
        Number of the sample, from 0.
    output
        Where to; a file under `samples` in the results folder unless given.

    Returns
    -------
    output
        The file.

    Raises
    ------
    ArtifactError
        If there is no such sample, or an artifact is missing; with the command that makes it.
    """
    record = read_sample(results, sample)
    target = output or results / sample_page(sample)
    write_page(target, sample_html(record, results))
    return target


def sample_html(record: SampleRecord, results: Path) -> str:
    """The page."""
    from warmlens.report.sample_figures import CAPTIONS, draw_sample

    pngs = draw_sample(record)
    figures = {
        name: {"label": f"Figure {i}", "caption": CAPTIONS[name], "picture": picture(png, CAPTIONS[name])}
        for i, (name, png) in enumerate(pngs.items(), start=1)
    }
    failed = next((item.stage for item in record.stages if item.status == "failed here"), None)
    return render(
        "sample.html.j2",
        record=record,
        name=results.resolve().name,
        folder=str(results),
        sections=SECTIONS,
        figures=figures,
        failed_stage=failed,
        subhalos=heaviest(record),
    )


def heaviest(record: SampleRecord) -> list[dict[str, float]]:
    """The subhaloes of largest bound mass in the field, columns as in the artifact."""
    if record.halo is None:
        return []
    subhalos = record.halo.subhalos
    rows = np.argsort(subhalos.m_bound)[::-1][:N_SUBHALOS]
    names = (
        "m_bound",
        "m_acc",
        "z_acc",
        "concentration",
        "v_max_kms",
        "r_s_kpc",
        "r_t_kpc",
        "x_arcsec",
        "y_arcsec",
    )
    return [{name: float(getattr(subhalos, name)[row]) for name in names} for row in rows]
