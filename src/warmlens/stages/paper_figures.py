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
from warmlens.halos.suppression import lovell14, lovell20
from warmlens.halos.whole_halo import MASS_BINS, VMAX_BINS, HaloPopulation
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.substructure import convergence_map
from warmlens.plots.halo_functions import draw_cumulative_functions
from warmlens.plots.halo_maps import draw_halo_grid
from warmlens.plots.style import house_style
from warmlens.stages.halos import geometry, halo_generator, halo_model
from warmlens.types import FloatArray

log = logging.getLogger(__name__)

RELICS_KEV = (1.0, 2.0, 3.3, 5.0, 10.0)
HOSTS_LOG10 = (12.0, 12.5, 13.0, 13.5)
FUNCTION_HOST_LOG10, FUNCTION_REDSHIFT, N_REALIZATIONS = 12.5, 0.0, 5  # Birrer+2017, appendix B
_FITS = {"Lovell+14": lovell14, "Lovell 20": lovell20}


def run(name: str, config: Config, output: Path) -> None:
    """Draw figure `name` (the paper's number) and write it as PNG."""
    with house_style():
        figure = {"1": _halo_grid, "8": _cumulative_functions}[name](config)
        with atomic_path(output) as temporary:
            figure.savefig(temporary, format="png")
        plt.close(figure)


def _halo_grid(config: Config) -> Figure:
    """Fig. 1: projected mass over thermal relic mass and halo mass, 4" x 4"."""
    generator = halo_generator(config.cosmology, config.redshifts, config.halos)
    _, lens = geometry(config.cosmology, config.redshifts)
    grid = PixelGrid.centred((160, 160), 0.025)
    maps: list[list[FloatArray]] = []
    for row, host in enumerate(HOSTS_LOG10):
        maps.append([])
        for column, m_th in enumerate(RELICS_KEV):
            rng = stream(config.campaign.seed, "figure_1", len(RELICS_KEV) * row + column)
            halo = generator.draw(m_th, 10.0**host, config.halos.field_half_width_arcsec, rng)
            maps[row].append(convergence_map(halo.subhalos, grid, lens) * lens.sigma_crit_msun_kpc2)
            log.info("10^%g Msun, %g keV: %d subhaloes", host, m_th, len(halo.subhalos.m_bound))
    figure, axes = plt.subplots(len(HOSTS_LOG10), len(RELICS_KEV), figsize=(7.2, 6.0), sharex=True, sharey=True)
    draw_halo_grid(axes, maps, grid, RELICS_KEV, HOSTS_LOG10)
    return figure


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
