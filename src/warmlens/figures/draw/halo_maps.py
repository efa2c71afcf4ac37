"""Substructure of the simulated haloes: projected mass and the deflections it makes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage

from warmlens.figures.draw.sky import add_colour_bar, draw_diverging, draw_image
from warmlens.imaging.grid import PixelGrid
from warmlens.types import FloatArray

DECADES = 3.0


def draw_halo_map(
    ax: Axes,
    surface_density_msun_kpc2: FloatArray,
    grid: PixelGrid,
    limits: tuple[float, float] | None = None,
) -> AxesImage:
    """Projected mass of the subhaloes, on a logarithmic scale.

    Parameters
    ----------
    ax
        Where to draw.
    surface_density_msun_kpc2
        Sigma [Msun/kpc^2], [ny, nx]; 0 (no subhalo) has the first colour.
    grid
        Its pixels.
    limits
        Sigma of the first and last colour; unless given, the last is the largest value and the first
        `DECADES` decades below it.
    """
    low, high = density_limits([surface_density_msun_kpc2]) if limits is None else limits
    return draw_image(ax, surface_density_msun_kpc2, grid, "log", (low, high), cmap="magma")


def density_limits(maps: Sequence[FloatArray]) -> tuple[float, float]:
    """First and last colour of maps of Sigma [Msun/kpc^2] that share a scale."""
    high = max(float(np.max(sigma)) for sigma in maps)
    if not 0.0 < high < np.inf:
        raise ValueError(f"the largest surface density is {high}: there is no substructure to show")
    return high / 10.0**DECADES, high


def draw_halo_panels(
    axes: np.ndarray, maps: Sequence[FloatArray], grid: PixelGrid, titles: Sequence[str]
) -> list[AxesImage]:
    """Projected mass of several haloes on one scale, with one colour bar.

    Parameters
    ----------
    axes
        Panels, object array [n].
    maps
        Sigma [Msun/kpc^2] of each, [n][ny, nx].
    grid
        Pixels of every map.
    titles
        Parameters of each halo.
    """
    limits = density_limits(maps)
    artists = [draw_halo_map(ax, sigma, grid, limits) for ax, sigma in zip(axes, maps, strict=True)]
    _label_panels(axes, titles)
    add_colour_bar(artists[0], list(axes), r"$\Sigma_{\rm sub}$ [M$_\odot$ kpc$^{-2}$]")
    return artists


def draw_halo_grid(
    axes: np.ndarray,
    maps: Sequence[Sequence[FloatArray]],
    grid: PixelGrid,
    m_kev: Sequence[float],
    log10_mass_msun: Sequence[float],
) -> list[list[AxesImage]]:
    """Projected mass over thermal relic mass (columns) and halo mass (rows); one scale and colour bar a row.

    Parameters
    ----------
    axes
        Panels, object array [n_mass, n_m].
    maps
        Sigma [Msun/kpc^2] of each panel, [n_mass][n_m][ny, nx].
    grid
        Pixels of every map.
    m_kev
        Thermal relic mass of each column [keV].
    log10_mass_msun
        Log10 of the halo mass of each row [Msun].

    Reference: Birrer+2017, Fig. 1.
    """
    artists = []
    for row_axes, row, log10_mass in zip(axes, maps, log10_mass_msun, strict=True):
        limits = density_limits(row)
        artists.append([draw_halo_map(ax, sigma, grid, limits) for ax, sigma in zip(row_axes, row, strict=True)])
        label = rf"$10^{{{log10_mass:g}}}$ M$_\odot$"
        row_axes[0].text(0.05, 0.94, label, transform=row_axes[0].transAxes, color="white", va="top")
        add_colour_bar(artists[-1][0], row_axes[-1], r"$\Sigma_{\rm sub}$ [M$_\odot$ kpc$^{-2}$]")
    _label_columns(axes, m_kev)
    return artists


def draw_deflection_grid(
    axes: np.ndarray,
    maps: Sequence[Sequence[FloatArray]],
    grid: PixelGrid,
    m_kev: Sequence[float],
    log10_mass_msun: Sequence[float],
    limit_arcsec: float,
) -> list[list[AxesImage]]:
    """First component of the filtered deflection over relic and halo mass; one scale, the peak beside it.

    Parameters
    ----------
    axes
        Panels, object array [n_mass, n_m].
    maps
        Delta alpha_1 [arcsec] of each panel, [n_mass][n_m][ny, nx].
    grid, m_kev, log10_mass_msun
        As in `draw_halo_grid`.
    limit_arcsec
        Deflection of full colour.

    Reference: Birrer+2017, Fig. 2.
    """
    artists = []
    for row_axes, row, log10_mass in zip(axes, maps, log10_mass_msun, strict=True):
        artists.append(
            [draw_diverging(ax, alpha, grid, limit_arcsec) for ax, alpha in zip(row_axes, row, strict=True)]
        )
        label = rf"$10^{{{log10_mass:g}}}$ M$_\odot$"
        row_axes[0].text(0.05, 0.94, label, transform=row_axes[0].transAxes, va="top")
        for ax, alpha in zip(row_axes, row, strict=True):  # a weak map is pale on the common scale
            peak = f"{1e3 * np.abs(alpha).max():.2g} mas"
            ax.text(0.95, 0.05, peak, transform=ax.transAxes, ha="right", va="bottom", fontsize=7)
    flat = [artist for row in artists for artist in row]
    strongest = int(np.argmax([np.abs(alpha).max() for row in maps for alpha in row]))
    add_colour_bar(flat[strongest], list(axes.ravel()), r"$\Delta\alpha_1$ [arcsec]")
    _label_columns(axes, m_kev)
    return artists


def draw_deflection_panels(
    axes: np.ndarray,
    maps: Sequence[FloatArray],
    grid: PixelGrid,
    titles: Sequence[str],
    limit_arcsec: float,
) -> list[AxesImage]:
    """One component of the filtered deflection [arcsec], full colour at `limit_arcsec`; as `draw_halo_panels`."""
    artists = [draw_diverging(ax, alpha, grid, limit_arcsec) for ax, alpha in zip(axes, maps, strict=True)]
    _label_panels(axes, titles)
    add_colour_bar(artists[0], list(axes), r"$\Delta\alpha_x$ [arcsec]")
    return artists


def _label_columns(axes: np.ndarray, m_kev: Sequence[float]) -> None:
    for ax, m in zip(axes[0], m_kev, strict=True):
        ax.set_title(f"{m:g} keV")
    for ax in axes.ravel():
        ax.label_outer()


def _label_panels(axes: np.ndarray, titles: Sequence[str]) -> None:
    for ax, title in zip(axes, titles, strict=True):
        ax.set_title(title)
        ax.label_outer()
