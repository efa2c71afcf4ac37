"""Figures of the paper that need no campaign: haloes drawn with the physics of a configuration."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from warmlens.config.model import Config
from warmlens.figures.draw.halo_functions import draw_cumulative_functions
from warmlens.figures.draw.halo_maps import draw_deflection_grid, draw_halo_grid
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.recipe import map_table, panel_table
from warmlens.halos.dark_matter import ThermalRelic, dark_matter
from warmlens.halos.lens_halo import HaloGenerator, HaloRealization
from warmlens.halos.population import MASS_BINS, VMAX_BINS, HaloPopulation
from warmlens.halos.suppression import lovell14, lovell20
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.substructure import convergence_map, filtered_deflection
from warmlens.physics import check_field, geometry, halo_generator, halo_model, smooth_host
from warmlens.sampling import stream
from warmlens.types import FloatArray

log = logging.getLogger(__name__)

RELICS_KEV = (1.0, 2.0, 3.3, 5.0, 10.0)
HOSTS_LOG10 = (12.0, 12.5, 13.0, 13.5)
MAP_GRID = PixelGrid.centred((160, 160), 0.025)
DEFLECTION_LIMIT_ARCSEC = 0.04
FUNCTION_HOST_LOG10, FUNCTION_REDSHIFT, N_REALIZATIONS = 12.5, 0.0, 5  # Birrer+2017, appendix B
_FITS = {"Lovell+14": lovell14, "Lovell 20": lovell20}


@dataclass(frozen=True)
class HaloGrid:
    """A map of each halo over `HOSTS_LOG10` (rows) and `RELICS_KEV` (columns).

    Attributes
    ----------
    maps
        Sigma [Msun/kpc^2] or Delta alpha_1 [arcsec], [n_host][n_relic][ny, nx].
    column
        Which of them, with its unit, for the table.
    """

    maps: tuple[tuple[FloatArray, ...], ...]
    column: str

    def table(self) -> pd.DataFrame:
        """A column a halo."""
        columns = {
            f"{self.column}_{m_th:g}keV_log10m{log10_m_halo:g}": data
            for log10_m_halo, row in zip(HOSTS_LOG10, self.maps, strict=True)
            for m_th, data in zip(RELICS_KEV, row, strict=True)
        }
        return map_table(MAP_GRID, columns)


def read_halo_grid(config: Config) -> HaloGrid:
    """Fig. 1: projected mass over thermal relic mass and halo mass, 4" x 4"."""
    _, lens = geometry(config.cosmology, config.redshifts)
    halos = _halos(config, halo_generator(config.cosmology, config.redshifts, config.halos))
    maps = (
        tuple(convergence_map(halo.subhalos, MAP_GRID, lens) * lens.sigma_crit_msun_kpc2 for halo in row)
        for row in halos
    )
    return HaloGrid(tuple(maps), "sigma_msun_per_kpc2")


def draw_halo_grid_figure(data: HaloGrid) -> Figure:
    """One scale and one colour bar a row."""
    figure, axes = _grid_of_panels(6.0)
    draw_halo_grid(axes, data.maps, MAP_GRID, RELICS_KEV, HOSTS_LOG10)
    return figure


def read_deflection_grid(config: Config) -> HaloGrid:
    """Fig. 2: first component of the filtered deflection of the haloes of Fig. 1."""
    block = config.deflections
    check_field(config.halos.field_half_width_arcsec, MAP_GRID, block.filter_arcsec)
    _, lens = geometry(config.cosmology, config.redshifts)
    generator = halo_generator(config.cosmology, config.redshifts, config.halos)
    maps: list[tuple[FloatArray, ...]] = []
    for row, log10_m_halo in zip(_halos(config, generator), HOSTS_LOG10, strict=True):
        deltas = []
        for halo in row:
            host = smooth_host(generator, log10_m_halo, halo.f_sub) if block.smooth_host else None
            delta = filtered_deflection(halo.subhalos, MAP_GRID, lens, block.filter_arcsec, block.filter, host)
            deltas.append(delta[0])
        maps.append(tuple(deltas))
    return HaloGrid(tuple(maps), "delta_alpha_1_arcsec")


def draw_deflection_grid_figure(data: HaloGrid) -> Figure:
    """One scale for all panels, that of the paper."""
    figure, axes = _grid_of_panels(5.4)
    draw_deflection_grid(axes, data.maps, MAP_GRID, RELICS_KEV, HOSTS_LOG10, DEFLECTION_LIMIT_ARCSEC)
    return figure


def _halos(config: Config, generator: HaloGenerator) -> list[list[HaloRealization]]:
    """The haloes of Figs. 1 and 2, [n_host][n_relic]."""
    halos: list[list[HaloRealization]] = []
    for row, host in enumerate(HOSTS_LOG10):
        halos.append([])
        for column, m_th in enumerate(RELICS_KEV):
            rng = stream(config.campaign.seed, "figure_1", len(RELICS_KEV) * row + column)
            halo = generator.draw(m_th, 10.0**host, config.halos.field_half_width_arcsec, rng)
            halos[row].append(halo)
            log.info("10^%g Msun, %g keV: %d subhaloes", host, m_th, len(halo.subhalos.m_bound))
    return halos


def _grid_of_panels(height: float) -> tuple[Figure, np.ndarray]:
    size = (FULL_WIDTH_INCH, height)
    return plt.subplots(len(HOSTS_LOG10), len(RELICS_KEV), figsize=size, sharex=True, sharey=True)


@dataclass(frozen=True)
class CumulativeFunctions:
    """Cumulative functions of subhaloes by dark matter model.

    Attributes
    ----------
    m_bound_msun, v_max_kms
        Values above which subhaloes are counted, [n_mass] and [n_v].
    mass_counts, vmax_counts
        N(> value) of each realization, [n_realization, n].
    references
        Published suppressions times the mean of CDM, by name of the fit and model [n_mass].
    """

    m_bound_msun: FloatArray
    v_max_kms: FloatArray
    mass_counts: dict[str, FloatArray]
    vmax_counts: dict[str, FloatArray]
    references: dict[str, dict[str, FloatArray]]

    def table(self) -> pd.DataFrame:
        """Mean, every realization and the references, a row a model and value."""
        mass, v_max = [], []
        for model in self.mass_counts:
            frame = _counts("m_bound_msun", self.m_bound_msun, model, self.mass_counts[model])
            fits = {fit: curves[model] for fit, curves in self.references.items() if model in curves}
            mass.append(frame.assign(**{f"n_above_{fit}": values for fit, values in fits.items()}))
            v_max.append(_counts("v_max_kms", self.v_max_kms, model, self.vmax_counts[model]))
        return panel_table({"mass": pd.concat(mass), "v_max": pd.concat(v_max)})


def _counts(column: str, values: FloatArray, model: str, counts: FloatArray) -> pd.DataFrame:
    numbered = {f"n_above_realization_{number}": row for number, row in enumerate(counts, start=1)}
    return pd.DataFrame({column: values, "model": model, "n_above_mean": counts.mean(axis=0), **numbered})


def read_cumulative_functions(config: Config) -> CumulativeFunctions:
    """Fig. 8: cumulative mass and v_max functions of subhaloes at z = 0, five realizations a model."""
    cosmology, _ = geometry(config.cosmology, config.redshifts)
    population = HaloPopulation(cosmology, FUNCTION_REDSHIFT, halo_model(config.halos))
    mass_counts: dict[str, FloatArray] = {}
    vmax_counts: dict[str, FloatArray] = {}
    half_mode: dict[str, float] = {}
    for number, m_th in enumerate((*RELICS_KEV, math.inf)):
        model = dark_matter(m_th, cosmology, config.halos.transfer_function)
        name = f"{m_th:g} keV" if isinstance(model, ThermalRelic) else "CDM"
        halos = [
            population.draw(
                model,
                10.0**FUNCTION_HOST_LOG10,
                stream(config.campaign.seed, "figure_8", N_REALIZATIONS * number + realization),
            )
            for realization in range(N_REALIZATIONS)
        ]
        mass_counts[name] = np.array([halo.cumulative_mass_function for halo in halos])
        vmax_counts[name] = np.array([halo.cumulative_vmax_function for halo in halos])
        if isinstance(model, ThermalRelic):
            half_mode[name] = model.half_mode_mass_msun
        log.info("%s: %.0f subhaloes", name, np.mean([halo.n_surviving for halo in halos]))
    cold = mass_counts["CDM"].mean(axis=0)
    resolved = math.log10(config.halos.min_mass_msun) <= MASS_BINS
    return CumulativeFunctions(
        m_bound_msun=10.0 ** MASS_BINS[resolved],
        v_max_kms=np.asarray(VMAX_BINS),
        mass_counts={name: counts[:, resolved] for name, counts in mass_counts.items()},
        vmax_counts=vmax_counts,
        references={
            label: {name: suppressed(cold, fit, m_hm)[resolved] for name, m_hm in half_mode.items()}
            for label, fit in _FITS.items()
        },
    )


def draw_cumulative_figure(data: CumulativeFunctions) -> Figure:
    """Mass function beside v_max function."""
    figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 3.4))
    label = r"$m_{\rm bound}$ [M$_\odot$]"
    draw_cumulative_functions(axes[0], data.m_bound_msun, data.mass_counts, data.references, label)
    axes[0].set_ylabel(r"subhaloes above $m_{\rm bound}$")
    draw_cumulative_functions(axes[1], data.v_max_kms, data.vmax_counts, {}, r"$v_{\rm max}$ [km s$^{-1}$]")
    axes[1].set_ylabel(r"subhaloes above $v_{\rm max}$")
    axes[1].set_xlim(left=3.0)
    for ax in axes:
        ax.set_ylim(bottom=0.2)
    return figure


def suppressed(cold: FloatArray, fit: Callable[[FloatArray, float], FloatArray], m_hm: float) -> FloatArray:
    """Cumulative counts of cold haloes [n], at `MASS_BINS`, with a published suppression of each bin."""
    per_bin = cold - np.append(cold[1:], 0.0)
    middle = 10.0 ** (MASS_BINS + 0.5 * (MASS_BINS[1] - MASS_BINS[0]))
    return np.cumsum((per_bin * fit(middle, m_hm))[::-1])[::-1]
