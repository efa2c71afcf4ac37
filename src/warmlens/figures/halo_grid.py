"""Figs. 1 and 2: mass and deflections of halos over thermal relic mass and halo mass, from a configuration."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from warmlens.config.model import Config
from warmlens.figures.draw.sky import DENSITY_LABEL, add_colour_bar, density_limits, draw_diverging, draw_halo_map
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.recipe import map_table
from warmlens.halos.lens_halo import HaloGenerator, HaloRealization
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.substructure import convergence_map, filtered_deflection
from warmlens.physics import check_field, geometry, halo_generator, smooth_host
from warmlens.sampling import stream
from warmlens.types import FloatArray

log = logging.getLogger(__name__)

RELICS_KEV = (1.0, 2.0, 3.3, 5.0, 10.0)
HOSTS_LOG10 = (12.0, 12.5, 13.0, 13.5)
MAP_GRID = PixelGrid.centred((160, 160), 0.025)  # 4" x 4"
DEFLECTION_LIMIT_ARCSEC = 0.04  # as in the paper


def read_masses(config: Config) -> FloatArray:
    """Return Sigma [Msun/kpc^2] of each halo of Fig. 1, [n_host, n_relic, ny, nx]."""
    _, lens = geometry(config.cosmology, config.redshifts)
    maps = np.empty((len(HOSTS_LOG10), len(RELICS_KEV), *MAP_GRID.shape))
    for place, halo in _draw_halos(config, halo_generator(config.cosmology, config.redshifts, config.halos)):
        maps[place] = convergence_map(halo.subhalos, MAP_GRID, lens) * lens.sigma_crit_msun_kpc2
    return maps


def read_deflections(config: Config) -> FloatArray:
    """Return the filtered Delta alpha_1 [arcsec] of the halos of Fig. 1, [n_host, n_relic, ny, nx]."""
    block = config.deflections
    check_field(config.halos.field_half_width_arcsec, MAP_GRID, block.filter_arcsec)
    _, lens = geometry(config.cosmology, config.redshifts)
    generator = halo_generator(config.cosmology, config.redshifts, config.halos)
    maps = np.empty((len(HOSTS_LOG10), len(RELICS_KEV), *MAP_GRID.shape))
    for place, halo in _draw_halos(config, generator):
        host = smooth_host(generator, HOSTS_LOG10[place[0]], halo.f_sub) if block.smooth_host else None
        delta = filtered_deflection(halo.subhalos, MAP_GRID, lens, block.filter_arcsec, block.filter, host)
        maps[place] = delta[0]
    return maps


def draw_masses(maps: FloatArray) -> Figure:
    """Draw one row per halo mass, each with a scale and a colour bar of its own (Birrer+2017, Fig. 1)."""
    figure, axes = _make_panels(6.0, "white")
    for row_axes, row in zip(axes, maps, strict=True):
        limits = density_limits(row)
        artists = [draw_halo_map(ax, sigma, MAP_GRID, limits) for ax, sigma in zip(row_axes, row, strict=True)]
        add_colour_bar(artists[0], row_axes[-1], DENSITY_LABEL)
    for ax in axes.flat:
        ax.label_outer()
    return figure


def draw_deflections(maps: FloatArray) -> Figure:
    """Draw all panels on the scale of the paper, each with its peak (Birrer+2017, Fig. 2)."""
    figure, axes = _make_panels(5.4, "black")
    panels = maps.reshape(-1, *MAP_GRID.shape)
    peaks = np.abs(panels).max(axis=(1, 2))
    artists = []
    for ax, alpha, peak in zip(axes.flat, panels, peaks, strict=True):
        artists.append(draw_diverging(ax, alpha, MAP_GRID, DEFLECTION_LIMIT_ARCSEC))
        text = f"{1e3 * peak:.2g} mas"  # a weak map is pale on the common scale
        ax.text(0.95, 0.05, text, transform=ax.transAxes, ha="right", va="bottom", fontsize=7)
        ax.label_outer()
    add_colour_bar(artists[int(np.argmax(peaks))], list(axes.flat), r"$\Delta\alpha_1$ [arcsec]")
    return figure


def _tabulate(maps: FloatArray, quantity: str) -> pd.DataFrame:
    """Return one column per halo."""
    columns = {
        f"{quantity}_{m_th:g}keV_log10m{log10_m_halo:g}": data
        for log10_m_halo, row in zip(HOSTS_LOG10, maps, strict=True)
        for m_th, data in zip(RELICS_KEV, row, strict=True)
    }
    return map_table(MAP_GRID, columns)


tabulate_masses = partial(_tabulate, quantity="sigma_msun_per_kpc2")
tabulate_deflections = partial(_tabulate, quantity="delta_alpha_1_arcsec")


def _draw_halos(config: Config, generator: HaloGenerator) -> Iterator[tuple[tuple[int, int], HaloRealization]]:
    """Draw the halos of both figures at random, each with its row and column."""
    for row, host in enumerate(HOSTS_LOG10):
        for column, m_th in enumerate(RELICS_KEV):
            rng = stream(config.campaign.seed, "figure_1", len(RELICS_KEV) * row + column)
            halo = generator.draw(m_th, 10.0**host, config.halos.field_half_width_arcsec, rng)
            log.info("10^%g Msun, %g keV: %d subhalos", host, m_th, len(halo.subhalos.m_bound))
            yield (row, column), halo


def _make_panels(height_inch: float, colour: str) -> tuple[Figure, np.ndarray]:
    """Make panels [n_host, n_relic], the relic above each column and the halo mass in the first of each row."""
    size = (FULL_WIDTH_INCH, height_inch)
    figure, axes = plt.subplots(len(HOSTS_LOG10), len(RELICS_KEV), figsize=size, sharex=True, sharey=True)
    for ax, m_th in zip(axes[0], RELICS_KEV, strict=True):
        ax.set_title(f"{m_th:g} keV")
    for ax, log10_mass in zip(axes[:, 0], HOSTS_LOG10, strict=True):
        label = rf"$10^{{{log10_mass:g}}}$ M$_\odot$"
        ax.text(0.05, 0.94, label, transform=ax.transAxes, color=colour, va="top")
    return figure, axes
