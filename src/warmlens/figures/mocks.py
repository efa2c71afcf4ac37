"""Figure of a mock: beside the observation, and both without the smooth model."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from warmlens.figures.draw.axes import label_panel
from warmlens.figures.draw.sky import add_colour_bar, brightness_limits, draw_diverging, draw_image
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs, input_path, open_input
from warmlens.figures.recipe import map_table
from warmlens.figures.samples import Sample, warm_to_cold
from warmlens.imaging.grid import PixelGrid
from warmlens.products.observation import read_observation
from warmlens.products.smooth_model import read_smooth_model
from warmlens.types import FloatArray

RESIDUAL_LIMIT = 5.0  # sigma


@dataclass(frozen=True)
class MocksFigure:
    """Observation and mock of a sample.

    Attributes
    ----------
    images, residuals
        By band: brightness [e-/s per pixel], and the same less the smooth model over sigma, of the observation
        and of the mock, each [ny, nx]; NaN is left blank.
    """

    images: dict[str, tuple[FloatArray, FloatArray]]
    residuals: dict[str, tuple[FloatArray, FloatArray]]
    grid: PixelGrid
    sample: Sample


def read(inputs: Inputs) -> MocksFigure:
    """Return the observation and the coldest mock of the chunk."""
    observed = read_observation(input_path(inputs, "observation"))
    model = read_smooth_model(input_path(inputs, "smooth_model"))
    images, residuals = {}, {}
    with open_input(inputs, "mocks") as artifact:
        sample = warm_to_cold(artifact)[-1]
        for band in observed.bands:
            fit = model.fits[band.name]
            mock = np.where(band.mask, artifact.array(f"{band.name}/image", sample.row).astype(np.float64), np.nan)
            image = np.where(band.mask, band.image, np.nan)
            sigma = np.where(band.mask, fit.sigma, 1.0)
            images[band.name] = (image, mock)
            residuals[band.name] = ((image - fit.model) / sigma, (mock - fit.model) / sigma)
    return MocksFigure(images, residuals, observed.grid, sample)


def draw(data: MocksFigure) -> Figure:
    """Draw observation, mock, and both without the smooth model, one row per band."""
    n = len(data.images)
    figure, axes = plt.subplots(n, 4, figsize=(FULL_WIDTH_INCH, 0.6 + 2.25 * n), squeeze=False)
    for panels, (band, images) in zip(axes, data.images.items(), strict=True):
        limits = brightness_limits(images[0])
        for ax, image, name in zip(panels[:2], images, ("observation", "mock"), strict=True):
            shown = draw_image(ax, image, data.grid, "asinh", limits)
            add_colour_bar(shown, ax, r"e$^-$ s$^{-1}$ px$^{-1}$", "top")
            label_panel(ax, f"{band}, {name}")
        for ax, residual, name in zip(panels[2:], data.residuals[band], ("observation", "mock"), strict=True):
            shown = draw_diverging(ax, residual, data.grid, RESIDUAL_LIMIT)
            bar = add_colour_bar(shown, ax, r"(image $-$ smooth) / $\sigma$", "top")
            bar.set_ticks([-4, -2, 0, 2, 4])
            label_panel(ax, name, "black", "white")
        for ax in panels:
            ax.label_outer()
    figure.suptitle(f"mock: {data.sample.label}", fontsize=10)
    return figure


def tabulate(data: MocksFigure) -> pd.DataFrame:
    """Return one column per band and map."""
    columns: dict[str, FloatArray] = {}
    names = ("observation", f"sample_{data.sample.sample_id}")
    for band in data.images:
        for unit, maps in (("electron_per_s", data.images[band]), ("residual_sigma", data.residuals[band])):
            columns |= {f"{band}_{name}_{unit}": values for name, values in zip(names, maps, strict=True)}
    return map_table(data.grid, columns)
