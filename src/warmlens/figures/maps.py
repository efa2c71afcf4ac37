"""Figures of substructure: projected mass and deflections of a campaign's samples."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from warmlens.artifacts.file import open_artifact
from warmlens.config.model import CosmologyBlock, RedshiftBlock
from warmlens.figures.draw.halo_maps import draw_deflection_panels, draw_halo_panels
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs
from warmlens.figures.recipe import map_table, needed
from warmlens.figures.samples import N_SHOWN, Sample, warm_to_cold
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.substructure import convergence_map
from warmlens.physics import geometry
from warmlens.products.halos import read_subhalos
from warmlens.products.observation import read_observation
from warmlens.types import FloatArray

_HALF_WIDTH_ARCSEC, _PIXELS = 2.0, 160  # 4" x 4", as the paper's


@dataclass(frozen=True)
class SampleMaps:
    """A map of each of some samples.

    Attributes
    ----------
    maps
        Sigma [Msun/kpc^2] or Delta alpha_x [arcsec], each [ny, nx].
    samples
        Whose they are.
    grid
        Their pixels.
    column
        What they are with its unit, for the table.
    """

    maps: tuple[FloatArray, ...]
    samples: tuple[Sample, ...]
    grid: PixelGrid
    column: str

    def table(self) -> pd.DataFrame:
        """A column a sample."""
        pairs = zip(self.samples, self.maps, strict=True)
        return map_table(self.grid, {f"sample_{item.sample_id}_{self.column}": data for item, data in pairs})


def read_halo_maps(inputs: Inputs) -> SampleMaps:
    """Projected mass of the subhaloes of samples across the range of m_TH."""
    with open_artifact(needed(inputs, "halos"), "halos") as halos:
        _, lens = geometry(
            CosmologyBlock.model_validate(halos.settings["cosmology"]),
            RedshiftBlock.model_validate(halos.settings["redshifts"]),
        )
        samples = warm_to_cold(halos)
        grid = PixelGrid.centred((_PIXELS, _PIXELS), 2.0 * _HALF_WIDTH_ARCSEC / _PIXELS)
        maps = [
            convergence_map(read_subhalos(halos, item.row), grid, lens) * lens.sigma_crit_msun_kpc2
            for item in samples
        ]
    return SampleMaps(tuple(maps), tuple(samples), grid, "sigma_msun_per_kpc2")


def draw_halo_maps(data: SampleMaps) -> Figure:
    """One panel a sample, on one scale."""
    figure, axes = _panels(len(data.maps))
    draw_halo_panels(axes, data.maps, data.grid, [item.label for item in data.samples])
    return figure


def read_deflection_maps(inputs: Inputs) -> SampleMaps:
    """West component of the filtered deflections of the same samples."""
    grid = read_observation(needed(inputs, "observation")).grid
    with open_artifact(needed(inputs, "deflections"), "deflections") as artifact:
        samples = warm_to_cold(artifact)
        maps = [artifact.array("delta_alpha", (item.row, 0)).astype(np.float64) for item in samples]
    return SampleMaps(tuple(maps), tuple(samples), grid, "delta_alpha_x_arcsec")


def draw_deflection_maps(data: SampleMaps) -> Figure:
    """One panel a sample, on one scale about zero."""
    figure, axes = _panels(len(data.maps))
    limit = max(float(np.abs(alpha).max()) for alpha in data.maps)
    draw_deflection_panels(axes, data.maps, data.grid, [item.label for item in data.samples], limit)
    return figure


def _panels(n: int) -> tuple[Figure, np.ndarray]:
    """Panels of n maps, three a row; those that are not needed are left out."""
    figure, axes = plt.subplots(2, N_SHOWN // 2, figsize=(FULL_WIDTH_INCH, 4.7), sharex=True, sharey=True)
    for ax in axes.ravel()[n:]:
        ax.remove()
    return figure, axes.ravel()[:n]
