"""Figures halo_maps and deflection_maps: projected mass and deflections of samples of a campaign."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from warmlens.config.model import CosmologyBlock, RedshiftBlock
from warmlens.figures.draw.sky import DENSITY_LABEL, add_colour_bar, density_limits, draw_diverging, draw_halo_map
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs, input_path, open_input
from warmlens.figures.recipe import map_table
from warmlens.figures.samples import N_SHOWN, Sample, warm_to_cold
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.substructure import convergence_map
from warmlens.physics import geometry
from warmlens.products.halos import read_subhalos
from warmlens.products.observation import read_observation
from warmlens.types import FloatArray

_GRID = PixelGrid.centred((160, 160), 0.025)  # 4" x 4", as the paper's
_EMPTY_LIMIT = 1.0e-6  # arcsec, where no sample has subhalos


@dataclass(frozen=True)
class SampleMaps:
    """Maps [ny, nx] of some samples: Sigma [Msun/kpc^2] or Delta alpha_x [arcsec], as `quantity` names it."""

    maps: tuple[FloatArray, ...]
    samples: tuple[Sample, ...]
    grid: PixelGrid
    quantity: str


def read_masses(inputs: Inputs) -> SampleMaps:
    """Return the projected mass of the subhalos of samples across the range of m_TH."""
    with open_input(inputs, "halos") as halos:
        _, lens = geometry(
            CosmologyBlock.model_validate(halos.settings["cosmology"]),
            RedshiftBlock.model_validate(halos.settings["redshifts"]),
        )
        samples = warm_to_cold(halos)
        maps = [
            convergence_map(read_subhalos(halos, sample.row), _GRID, lens) * lens.sigma_crit_msun_kpc2
            for sample in samples
        ]
    return SampleMaps(tuple(maps), tuple(samples), _GRID, "sigma_msun_per_kpc2")


def read_deflections(inputs: Inputs) -> SampleMaps:
    """Return the West component of the filtered deflections of the same samples."""
    grid = read_observation(input_path(inputs, "observation")).grid
    with open_input(inputs, "deflections") as artifact:
        samples = warm_to_cold(artifact)
        maps = [artifact.array("delta_alpha", (sample.row, 0)).astype(np.float64) for sample in samples]
    return SampleMaps(tuple(maps), tuple(samples), grid, "delta_alpha_x_arcsec")


def draw_masses(data: SampleMaps) -> Figure:
    """Draw one panel per sample, on one scale."""
    limits = density_limits(data.maps)
    return _draw_panels(data, lambda ax, sigma: draw_halo_map(ax, sigma, data.grid, limits), DENSITY_LABEL)


def draw_deflections(data: SampleMaps) -> Figure:
    """Draw one panel per sample, on one scale about zero."""
    limit = max(float(np.abs(alpha).max()) for alpha in data.maps) or _EMPTY_LIMIT
    label = r"$\Delta\alpha_x$ [arcsec]"
    return _draw_panels(data, lambda ax, alpha: draw_diverging(ax, alpha, data.grid, limit), label)


def _draw_panels(data: SampleMaps, draw_map: Callable[[Axes, FloatArray], AxesImage], label: str) -> Figure:
    """Draw each map with its sample as title, three per row, and one colour bar."""
    figure, axes = plt.subplots(2, N_SHOWN // 2, figsize=(FULL_WIDTH_INCH, 4.7), sharex=True, sharey=True)
    panels = axes.flat[: len(data.maps)]
    for ax in axes.flat[len(data.maps) :]:
        ax.remove()
    artists = [draw_map(ax, values) for ax, values in zip(panels, data.maps, strict=True)]
    for ax, sample in zip(panels, data.samples, strict=True):
        ax.set_title(sample.label)
        ax.label_outer()
    add_colour_bar(artists[0], list(panels), label)
    return figure


def tabulate(data: SampleMaps) -> pd.DataFrame:
    """Return one column per sample."""
    pairs = zip(data.samples, data.maps, strict=True)
    return map_table(data.grid, {f"sample_{sample.sample_id}_{data.quantity}": values for sample, values in pairs})
