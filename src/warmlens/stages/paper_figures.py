"""Figures of the paper that need no campaign: haloes drawn with the physics of the configuration."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl

mpl.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from warmlens.artifacts import atomic_path
from warmlens.campaign import stream
from warmlens.config import Config
from warmlens.halos.dark_matter import ThermalRelic, dark_matter
from warmlens.halos.population import HaloGenerator, HaloRealization
from warmlens.halos.suppression import lovell14, lovell20
from warmlens.halos.whole_halo import MASS_BINS, VMAX_BINS, HaloPopulation
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.substructure import convergence_map, filtered_deflection
from warmlens.plots.halo_functions import draw_cumulative_functions
from warmlens.plots.halo_maps import draw_deflection_grid, draw_halo_grid
from warmlens.plots.style import house_style
from warmlens.stages.deflections import check_field, smooth_host
from warmlens.stages.halos import geometry, halo_generator, halo_model
from warmlens.types import FloatArray

log = logging.getLogger(__name__)

RELICS_KEV = (1.0, 2.0, 3.3, 5.0, 10.0)
HOSTS_LOG10 = (12.0, 12.5, 13.0, 13.5)
MAP_GRID = PixelGrid.centred((160, 160), 0.025)
DEFLECTION_LIMIT_ARCSEC = 0.04
FUNCTION_HOST_LOG10, FUNCTION_REDSHIFT, N_REALIZATIONS = 12.5, 0.0, 5  # Birrer+2017, appendix B
_FITS = {"Lovell+14": lovell14, "Lovell 20": lovell20}


def run(name: str, config: Config, output: Path) -> None:
    """Draw figure `name` (the paper's number) and write it as PNG."""
    with house_style():
        figure = {"1": _halo_grid, "2": _deflection_grid, "8": _cumulative_functions}[name](config)
        with atomic_path(output) as temporary:
            figure.savefig(temporary, format="png")
        plt.close(figure)


def _halo_grid(config: Config) -> Figure:
    """Fig. 1: projected mass over thermal relic mass and halo mass, 4" x 4"."""
    _, lens = geometry(config.cosmology, config.redshifts)
    maps = [
        [convergence_map(halo.subhalos, MAP_GRID, lens) * lens.sigma_crit_msun_kpc2 for halo in row]
        for row in _halos(config, halo_generator(config.cosmology, config.redshifts, config.halos))
    ]
    figure, axes = _grid_of_panels(6.0)
    draw_halo_grid(axes, maps, MAP_GRID, RELICS_KEV, HOSTS_LOG10)
    return figure


def _deflection_grid(config: Config) -> Figure:
    """Fig. 2: first component of the filtered deflection of the haloes of Fig. 1."""
    block = config.deflections
    check_field(config.halos.field_half_width_arcsec, MAP_GRID, block.filter_arcsec)
    _, lens = geometry(config.cosmology, config.redshifts)
    generator = halo_generator(config.cosmology, config.redshifts, config.halos)
    maps: list[list[FloatArray]] = []
    for row, log10_m_halo in zip(_halos(config, generator), HOSTS_LOG10, strict=True):
        maps.append([])
        for halo in row:
            host = smooth_host(generator, log10_m_halo, halo.f_sub) if block.smooth_host else None
            delta = filtered_deflection(halo.subhalos, MAP_GRID, lens, block.filter_arcsec, block.filter, host)
            maps[-1].append(delta[0])
    figure, axes = _grid_of_panels(5.4)
    draw_deflection_grid(axes, maps, MAP_GRID, RELICS_KEV, HOSTS_LOG10, DEFLECTION_LIMIT_ARCSEC)
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
    return plt.subplots(len(HOSTS_LOG10), len(RELICS_KEV), figsize=(7.2, height), sharex=True, sharey=True)


def _cumulative_functions(config: Config) -> Figure:
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
    references = {
        label: {name: _suppressed(cold, fit, m_hm) for name, m_hm in half_mode.items()}
        for label, fit in _FITS.items()
    }
    resolved = math.log10(config.halos.min_mass_msun) <= MASS_BINS
    figure, axes = plt.subplots(1, 2, figsize=(7.2, 3.4))
    draw_cumulative_functions(
        axes[0],
        10.0 ** MASS_BINS[resolved],
        {name: counts[:, resolved] for name, counts in mass_counts.items()},
        {label: {name: curve[resolved] for name, curve in curves.items()} for label, curves in references.items()},
        r"$m_{\rm bound}$ [M$_\odot$]",
    )
    axes[0].set_ylabel(r"subhaloes above $m_{\rm bound}$")
    draw_cumulative_functions(axes[1], VMAX_BINS, vmax_counts, {}, r"$v_{\rm max}$ [km s$^{-1}$]")
    axes[1].set_ylabel(r"subhaloes above $v_{\rm max}$")
    axes[1].set_xlim(left=3.0)
    for ax in axes:
        ax.set_ylim(bottom=0.2)
    return figure


def _suppressed(cold: FloatArray, fit: Callable[[FloatArray, float], FloatArray], m_hm: float) -> FloatArray:
    """Cumulative counts of cold haloes [n], at `MASS_BINS`, with a published suppression of each bin."""
    per_bin = cold - np.append(cold[1:], 0.0)
    middle = 10.0 ** (MASS_BINS + 0.5 * (MASS_BINS[1] - MASS_BINS[0]))
    return np.cumsum((per_bin * fit(middle, m_hm))[::-1])[::-1]
