"""`warmlens show`: one HTML file about one sample."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from warmlens.artifacts.names import sample_page
from warmlens.figures.draw.halo_functions import draw_cumulative_functions
from warmlens.figures.draw.sample import draw_summary, mark_subhalos
from warmlens.figures.draw.scan import draw_scan_row
from warmlens.figures.draw.sky import add_colour_bar, draw_diverging, draw_halo_map, draw_image
from warmlens.figures.draw.style import FULL_WIDTH_INCH, house_style
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.substructure import convergence_map
from warmlens.products.halos import COLUMNS
from warmlens.report.render import picture, render, write_page
from warmlens.report.sample import SampleRecord, read_sample
from warmlens.types import FloatArray

N_SUBHALOS = 20
_MAP_PIXELS = 240
_MARGIN = 1.1  # of the mass map about the image
_RESIDUAL_LIMIT = 5.0  # sigma
_DELTA_R_LIMIT = 25.0

CAPTIONS = {
    "subhalos": (
        "Left: projected mass Σ_sub [M☉ kpc⁻²] of the subhalos, the twenty heaviest circled, the image framed "
        "dashed. Right: number of subhalos above a bound mass [M☉], in the whole halo and in the field about the "
        "image."
    ),
    "deflection": (
        "High-pass filtered deflection by the subhalos [arcsec], towards the West (left) and the North (right)."
    ),
    "mocks": (
        "Mock image [e⁻ s⁻¹ px⁻¹], and what is left of the mock and of the observation without the smooth model, "
        "in units of the noise σ; one row per band."
    ),
    "scan": (
        "ΔR of the observation and of this sample (blue: a perturber improves the fit), and R_sens of the "
        "observation; one row per band and one for their sum."
    ),
    "summaries": (
        "Correlation function C(dr) of ΔR below the threshold against separation dr [arcsec], and fraction of "
        "positions with ΔR below each value: this sample, the observation, and 68% and 95% of the accepted "
        "samples."
    ),
}


def write_sample(results: Path, sample: int, output: Path | None = None) -> Path:
    """Write the page of a sample to `output`, or under `samples` in the results folder; return where it is.

    Raises
    ------
    ArtifactError
        See `read_sample`.
    """
    record = read_sample(results, sample)
    target = output or results / sample_page(sample)
    write_page(target, sample_html(record, results))
    return target


def sample_html(record: SampleRecord, results: Path) -> str:
    """Render the page."""
    figures = {
        name: {"label": f"Figure {i}", "caption": CAPTIONS[name], "picture": picture(png, CAPTIONS[name])}
        for i, (name, png) in enumerate(draw_sample(record).items(), start=1)
    }
    return render(
        "sample.html.j2",
        record=record,
        name=results.resolve().name,
        folder=str(results),
        figures=figures,
        failed_stage=next((entry["stage"] for entry in record.stages if entry["status"] == "failed here"), None),
        subhalos=heaviest(record),
    )


def heaviest(record: SampleRecord) -> list[dict[str, float]]:
    """Return the subhalos of largest bound mass in the field, columns as in the artifact."""
    if record.halo is None:
        return []
    subhalos = record.halo["subhalos"]
    rows = np.argsort(subhalos.m_bound)[::-1][:N_SUBHALOS]
    return [{name: float(getattr(subhalos, name)[row]) for name in COLUMNS} for row in rows]


def draw_sample(record: SampleRecord) -> dict[str, bytes]:
    """Draw the figures that the sample got far enough for, as PNG by name."""
    with house_style():
        figures = {}
        if record.halo is not None:
            figures["subhalos"] = _draw_subhalos(record, record.halo)
        if record.delta_alpha is not None:
            figures["deflection"] = _draw_deflection(record, record.delta_alpha)
        if record.mocks:
            figures["mocks"] = _draw_mocks(record)
        if record.scan:
            figures["scan"] = _draw_scan(record)
        figures["summaries"] = _draw_summaries(record)
        return {name: _png(figure) for name, figure in figures.items()}


def _png(figure: Figure) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    plt.close(figure)
    return buffer.getvalue()


def _draw_subhalos(record: SampleRecord, halo: dict[str, Any]) -> Figure:
    image = record.observation.grid
    x, y = image.coordinates()
    half = _MARGIN * float(max(np.abs(x).max(), np.abs(y).max()))
    grid = PixelGrid.centred((_MAP_PIXELS, _MAP_PIXELS), 2.0 * half / _MAP_PIXELS)
    subhalos = halo["subhalos"]
    sigma = convergence_map(subhalos, grid, record.lens) * record.lens.sigma_crit_msun_kpc2
    figure, (sky, function) = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 3.3), width_ratios=(1.15, 1.0))
    if sigma.max() > 0.0:
        shown = draw_halo_map(sky, sigma, grid)
        add_colour_bar(shown, sky, r"$\Sigma_{\rm sub}$ [M$_\odot$ kpc$^{-2}$]")
        mark_subhalos(sky, subhalos.x_arcsec, subhalos.y_arcsec, subhalos.m_bound, image)
    else:
        sky.set_axis_off()
        sky.text(0.5, 0.5, "no subhalo in the field", transform=sky.transAxes, ha="center")
    resolved = halo["mass_bins"] >= np.log10(halo["min_mass_msun"]) - 1e-9
    masses = 10.0 ** halo["mass_bins"][resolved]
    in_field = (subhalos.m_bound[None, :] >= masses[:, None]).sum(axis=1).astype(np.float64)
    counts = {"in the field": in_field[None], "whole halo": halo["mass_function"][resolved][None]}
    draw_cumulative_functions(function, masses, counts, {}, r"$m_{\rm bound}$ [M$_\odot$]")
    function.set_ylabel(r"subhalos above $m_{\rm bound}$")
    function.set_ylim(bottom=0.7)
    return figure


def _draw_deflection(record: SampleRecord, delta_alpha: FloatArray) -> Figure:
    figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 3.1), sharex=True, sharey=True)
    limit = float(np.abs(delta_alpha).max()) or 1e-6
    for ax, component, name in zip(axes, delta_alpha, "xy", strict=True):
        shown = draw_diverging(ax, component, record.observation.grid, limit)
        ax.set_title(rf"$\Delta\alpha_{name}$")
        ax.label_outer()
    add_colour_bar(shown, list(axes), r"$\Delta\alpha$ [arcsec]")
    return figure


def _three_columns(n_rows: int, titles: Sequence[str]) -> tuple[Figure, np.ndarray]:
    size = (FULL_WIDTH_INCH, 0.45 + 1.9 * n_rows)
    figure, axes = plt.subplots(n_rows, 3, figsize=size, sharex=True, sharey=True, squeeze=False)
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title)
    return figure, axes


def _draw_mocks(record: SampleRecord) -> Figure:
    bands, grid = record.observation.bands, record.observation.grid
    figure, axes = _three_columns(len(bands), ("mock", "mock", "observation"))
    for panels, band in zip(axes, bands, strict=True):
        model, sigma = record.fits[band.name]
        used = band.mask & np.isfinite(sigma)
        mock, image = (np.where(band.mask, data, np.nan) for data in (record.mocks[band.name], band.image))
        low, high = np.nanpercentile(image, (1.0, 99.8))
        shown = draw_image(panels[0], mock, grid, "asinh", (min(0.0, float(low)), float(high)))
        add_colour_bar(shown, panels[0], rf"{band.name} [e$^-$ s$^{{-1}}$ px$^{{-1}}$]")
        for ax, data in zip(panels[1:], (mock, image), strict=True):
            residual = np.where(used, (data - model) / np.where(used, sigma, 1.0), np.nan)
            shown = draw_diverging(ax, residual, grid, _RESIDUAL_LIMIT)
        add_colour_bar(shown, panels[2], r"(image $-$ smooth model) / $\sigma$")
        for ax in panels:
            ax.label_outer()
    return figure


def _draw_scan(record: SampleRecord) -> Figure:
    figure, axes = _three_columns(len(record.scan), ("observation", "this sample", "observation"))
    for panels, row in zip(axes, record.scan, strict=True):
        lit = row.r_sens[np.isfinite(row.r_sens)]
        brightest = float(np.percentile(lit, 99.5)) if lit.size else 0.0
        draw_scan_row(panels, row, record.scan_grid, _DELTA_R_LIMIT, brightest if brightest > 0.0 else 1.0)
    return figure


def _draw_summaries(record: SampleRecord) -> Figure:
    labels = {
        "correlation": (r"${\rm d}r$ [arcsec]", r"$C({\rm d}r)$"),
        "cumulative": (r"$\Delta R$", r"fraction of positions below $\Delta R$"),
    }
    figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 3.1))
    for ax, (kind, (x_label, y_label)) in zip(axes, labels.items(), strict=True):
        own = record.summaries.get(kind)
        draw_summary(ax, record.grids[kind], record.accepted[kind], record.observed[kind], own)
        ax.set_xlabel(x_label)
        ax.set_ylabel(y_label)
    axes[0].legend()
    return figure
