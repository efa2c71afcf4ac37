"""Images and maps on the sky."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import AsinhNorm, LogNorm, Normalize
from matplotlib.image import AxesImage
from matplotlib.transforms import Affine2D

from warmlens.imaging.grid import PixelGrid
from warmlens.types import FloatArray

MASKED_COLOUR = "0.85"
DENSITY_LABEL = r"$\Sigma_{\rm sub}$ [M$_\odot$ kpc$^{-2}$]"
DECADES = 3.0  # of the surface density
EMPTY_PEAK = 1.0e8  # Msun/kpc^2, as of a subhalo of 10^9 Msun
Stretch = Literal["linear", "asinh", "log"]


def draw_image(
    ax: Axes,
    image: FloatArray,
    grid: PixelGrid,
    stretch: Stretch = "linear",
    limits: tuple[float, float] | None = None,
    linear_width: float | None = None,
    cmap: str = "inferno",
) -> AxesImage:
    """Draw an image on the sky: x to the West on the right, y to the North up, whatever the axes of the grid.

    Parameters
    ----------
    ax, image, grid
        Where to draw what [ny, nx], NaN shown as masked, and its pixels.
    stretch
        Scale of the colours: linear, asinh (linear below `linear_width`), or log (limits must be > 0).
    limits
        Values of the first and last colour; the finite extremes of the image unless given.
    linear_width
        Of the asinh stretch, in the units of the image; 2% of the span of the limits unless given.
    cmap
        Name of the colour map.
    """
    if image.shape != grid.shape:
        raise ValueError(f"image has shape {image.shape}, its grid {grid.shape}")
    low, high = limits if limits is not None else (float(np.nanmin(image)), float(np.nanmax(image)))
    if stretch == "log":
        norm: Normalize = LogNorm(low, high, clip=True)
    elif stretch == "asinh":
        norm = AsinhNorm(linear_width if linear_width is not None else 0.02 * (high - low), low, high)
    else:
        norm = Normalize(low, high)
    (xx, xy), (yx, yy) = grid.axes
    scale = grid.pixel_scale
    x_row, y_row = [scale * xx, scale * xy, grid.origin_x], [scale * yx, scale * yy, grid.origin_y]
    to_sky = Affine2D([x_row, y_row, [0.0, 0.0, 1.0]])  # of (column, row); PixelGrid.to_sky
    right, upper = grid.nx - 0.5, grid.ny - 0.5
    artist = ax.imshow(
        np.ma.masked_invalid(image),
        norm=norm,
        cmap=cmap,
        origin="lower",
        interpolation="nearest",
        extent=(-0.5, right, -0.5, upper),
        transform=to_sky + ax.transData,
    )
    corners = to_sky.transform([(column, row) for column in (-0.5, right) for row in (-0.5, upper)])
    ax.set_xlim(corners[:, 0].min(), corners[:, 0].max())
    ax.set_ylim(corners[:, 1].min(), corners[:, 1].max())
    ax.set_facecolor(MASKED_COLOUR)
    ax.minorticks_off()  # nobody measures between them, and they take most of the time of a drawing
    ax.set_aspect("equal")
    ax.set_xlabel("$x$ [arcsec]")
    ax.set_ylabel("$y$ [arcsec]")
    return artist


def draw_diverging(
    ax: Axes, field: FloatArray, grid: PixelGrid, limit: float | None = None, cmap: str = "RdBu_r"
) -> AxesImage:
    """Draw a map of a signed quantity, centred on zero: residuals, Delta R, one component of a deflection.

    Full colour is at `limit` on both sides, the largest magnitude unless given; the rest as in `draw_image`.
    """
    full = float(np.nanmax(np.abs(field))) if limit is None else limit
    if not 0.0 < full < np.inf:
        raise ValueError(f"limit of a diverging map must be finite and > 0, got {full!r}; give one")
    return draw_image(ax, field, grid, limits=(-full, full), cmap=cmap)


def draw_halo_map(
    ax: Axes, surface_density_msun_kpc2: FloatArray, grid: PixelGrid, limits: tuple[float, float] | None = None
) -> AxesImage:
    """Draw the projected mass of subhalos [ny, nx] on a logarithmic scale; 0 (no subhalo) has the first colour.

    Unless given, limits are the `density_limits` of this map; the rest is as in `draw_image`.
    """
    low, high = density_limits([surface_density_msun_kpc2]) if limits is None else limits
    return draw_image(ax, surface_density_msun_kpc2, grid, "log", (low, high), cmap="magma")


def density_limits(maps: Iterable[FloatArray]) -> tuple[float, float]:
    """Return the first and last colour of maps of Sigma [Msun/kpc^2] on one scale: the peak is the last.

    Maps without any subhalo have the scale of `EMPTY_PEAK`.
    """
    high = max(float(np.max(sigma)) for sigma in maps) or EMPTY_PEAK
    if not 0.0 < high < np.inf:
        raise ValueError(f"the largest surface density must be finite and >= 0, got {high}")
    return high / 10.0**DECADES, high


def brightness_limits(image: FloatArray) -> tuple[float, float]:
    """Return the first and last colour of an image of bright sources, NaN where it is blank."""
    finite = image[np.isfinite(image)]
    return float(min(0.0, np.percentile(finite, 1.0))), float(np.percentile(finite, 99.8))


def draw_compass(ax: Axes, colour: str = "white", length: float = 0.12) -> None:
    """Draw North up and East to the left in the lower right corner; length in units of the panel."""
    corner = (0.94, 0.06)
    for (dx, dy), name in (((0.0, length), "N"), ((-length, 0.0), "E")):
        tip = (corner[0] + dx, corner[1] + dy)
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.0, "shrinkA": 0, "shrinkB": 0}
        ax.annotate("", tip, corner, "axes fraction", "axes fraction", arrowprops=arrow)
        label = (corner[0] + 1.35 * dx, corner[1] + 1.35 * dy)
        ax.text(*label, name, transform=ax.transAxes, color=colour, ha="center", va="center", fontsize=8)


def add_colour_bar(
    artist: ScalarMappable,
    axes: Axes | list[Axes],
    label: str,
    location: Literal["right", "top"] = "right",
) -> Colorbar:
    """Add a colour bar along its panel, or to the right of a list of panels; the label carries the unit.

    An end of the bar is pointed where the data go beyond it.
    """
    data: FloatArray = np.ma.compressed(np.ma.asarray(artist.get_array()))
    low, high = artist.get_clim()
    below, above = data.min() < low, data.max() > high
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[int(below), int(above)]
    if isinstance(axes, list):
        bar = axes[0].figure.colorbar(artist, ax=axes, label=label, extend=extend, pad=0.02, aspect=30)
    else:
        box = (1.03, 0.0, 0.05, 1.0) if location == "right" else (0.0, 1.03, 1.0, 0.05)
        cax = axes.inset_axes(box)
        bar = axes.figure.colorbar(artist, cax=cax, location=location, label=label, extend=extend)
    if not isinstance(artist.norm, LogNorm):
        bar.minorticks_off()
    if isinstance(artist.norm, AsinhNorm):
        bar.set_ticks(_asinh_ticks(artist.norm.linear_width, low, high), minor=False)
        bar.long_axis.set_major_formatter("{x:g}")
    return bar


def _asinh_ticks(linear_width: float, low: float, high: float) -> list[float]:
    """Return 0 and the powers of ten above the linear part of the scale, of both signs, within its limits."""
    top = max(abs(low), abs(high))
    decades = 10.0 ** np.arange(np.ceil(np.log10(linear_width)), np.floor(np.log10(top)) + 1.0)
    ticks = np.concatenate([-decades[::-1], [0.0], decades])
    return ticks[(ticks >= low) & (ticks <= high)].tolist()
