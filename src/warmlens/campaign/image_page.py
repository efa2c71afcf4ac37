"""The page that `warmlens validate` ends with: what the program believes of the images, in numbers with units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warmlens.campaign.image_checks import Images, far_from_quasar, image_box, quasar_peaks, share_outside
from warmlens.config.model import Config
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise_correlation import neighbours
from warmlens.imaging.observation import Band
from warmlens.imaging.psf import core_offset, fwhm
from warmlens.imaging.sky import border, sexagesimal
from warmlens.products.images import ReadBand, blank_sky
from warmlens.scan.raster import Raster
from warmlens.types import FloatArray

_CORNERS = 4  # the first points of `border`
_LABEL = 14  # columns
_KINDS = {
    "simulated": "simulated; here without its subhalos",
    "fits": "FITS files",
    "artifact": "of another campaign",
}


def describe_images(images: Images) -> list[str]:
    """Return the page, one line per fact: pixels and sky, each band, the lens, the scan."""
    config = images.config
    lines = [f"observation: {_KINDS[config.observation.kind]}", *_rows(_sky(images))]
    for number, band in enumerate(images.bands):
        file = images.files[number] if images.files else None
        lines += ["", f"band {band.name}", *_rows(_band(images, band, file))]
    return [*lines, "", "lens and scan", *_rows(_lens(images)), *_rows(_scan(config, images.grid))]


def draw_images(images: Images, output: Path) -> None:
    """Write the figure of the images as .png, .pdf or .svg, and its maps as CSV beside it."""
    from warmlens.figures.observation import SkyView, write_observation  # matplotlib takes a second to load

    block, scan, window = images.config.smooth_model, images.config.scan, None
    if scan.window_arcsec is not None:
        (width, height), (x, y) = scan.window_arcsec, scan.center
        window = (x - 0.5 * width, x + 0.5 * width, y - 0.5 * height, y + 0.5 * height)
    given = block.mode == "given"
    lens = block.lens if given else block.fitted_lens
    models, kwargs = lens.lens_model_list, lens.kwargs_lens
    write_observation(SkyView(images.grid, images.bands, images.quasars, window, models, kwargs, given), output)


def _rows(pairs: Iterator[tuple[str, str]]) -> list[str]:
    return [f"  {label:<{_LABEL}}{text}".rstrip() for label, text in pairs]


def describe_orientation(grid: PixelGrid) -> str:
    """Return where north and east are as a viewer shows the image, row 0 at the bottom."""
    axes = np.array(grid.axes)
    # of the sky's y axis, clockwise from the rows' direction; never -0.0
    north = round(float(np.rad2deg(np.arctan2(axes[1, 0], axes[1, 1]))), 1) + 0.0
    east = "left" if np.linalg.det(axes) > 0.0 else "right (mirrored)"
    return f"north {north:.1f} degrees clockwise from up, east to its {east}"


def _sky(images: Images) -> Iterator[tuple[str, str]]:
    grid, frame = images.grid, images.files[0].frame if images.files else None
    side_x, side_y = grid.nx * grid.pixel_scale, grid.ny * grid.pixel_scale
    yield (
        "image",
        f"{grid.nx} x {grid.ny} pixels of {grid.pixel_scale:.4f} arcsec ({side_x:.2f} x {side_y:.2f} arcsec)",
    )
    yield "orientation", describe_orientation(grid)
    column, row = (float(value) for value in grid.to_pixel(np.array(0.0), np.array(0.0)))
    origin = "" if frame is None else "   " + _radec(frame.radec(np.array([column]), np.array([row])))[0]
    yield "origin", f"{_point(column, row, 1)} pixel, from 0{origin}"
    columns, rows = (axis[:_CORNERS] for axis in border(grid.shape))
    x, y = grid.to_sky(columns, rows)
    sky = [""] * _CORNERS if frame is None else _radec(frame.radec(columns, rows))
    for number in range(_CORNERS):
        yield (
            "" if number else "corner pixels",
            f"[{columns[number]:4.0f}, {rows[number]:4.0f}]  x {x[number]:7.3f}, y {y[number]:7.3f} arcsec   "
            f"{sky[number]}",
        )
    if frame is None:
        yield "", "positions are arcsec to the West (x) and to the North (y); no WCS is read"
    else:
        name = frame.frame.name.upper() if frame.is_j2000 else "ICRS"
        yield "", f"x to the West, y to the North; RA and Dec ({name}) by the whole WCS"


def _radec(radec: FloatArray) -> list[str]:
    return [sexagesimal(ra, dec) for ra, dec in radec.T]


def _point(x: float, y: float, digits: int) -> str:
    return f"[{x:.{digits}f}, {y:.{digits}f}]"


def _band(images: Images, band: Band, file: ReadBand | None) -> Iterator[tuple[str, str]]:
    grid = images.grid
    masked = f"; {file.n_ignored} masked by the noise map" if file is not None and file.n_ignored else ""
    yield "pixels used", f"{np.count_nonzero(band.mask)} of {band.mask.size} ({band.mask.mean():.1%}){masked}"
    if band.noise.background_rms is None:
        quiet, loud = np.percentile(band.sigma[band.mask], [5.0, 95.0])
        yield "noise", f"map of the user, {quiet:.3g} to {loud:.3g} e-/s per pixel (5% to 95%)"
    else:
        yield (
            "noise",
            f"exposure {band.noise.exposure_s:g} s, background {band.noise.background_rms:.3g} e-/s per pixel",
        )
    yield "faint pixels", _scatter(images, band)
    if band.noise.correlation is not None:
        along, across, diagonal = neighbours(band.noise.correlation)
        sky = ""
        if file is not None and file.block.blank_sky_arcsec is not None:
            n_sky = np.count_nonzero(blank_sky(grid, band, file.block.blank_sky_arcsec))
            sky = f" ({n_sky} pixels beyond {file.block.blank_sky_arcsec:g} arcsec)"
        yield "correlation", f"{along:.2f} along rows, {across:.2f} along columns, {diagonal:.2f} diagonal{sky}"
    peak = int(np.argmax(np.where(band.mask, band.image, -np.inf)))
    peak_row, peak_column = divmod(peak, grid.nx)
    x, y = (float(axis.flat[peak]) for axis in grid.coordinates())
    yield (
        "brightest",
        f"{band.image.flat[peak]:.4g} e-/s, S/N {band.image.flat[peak] / band.sigma.flat[peak]:.0f}, "
        f"pixel [{peak_column}, {peak_row}], position {_point(x, y, 2)} arcsec",
    )
    width, offset = fwhm(band.psf, 1.0), core_offset(band.psf)
    given = "" if file is None else f"sum {file.psf_sum:.4g} (normalised to 1), "
    yield (
        "PSF",
        f"{band.psf.shape[1]} x {band.psf.shape[0]} pixels, {given}core at "
        f"[{offset[0] + 0.0:+.2f}, {offset[1] + 0.0:+.2f}] pixels from the middle, FWHM "
        f"{width * grid.pixel_scale:.3f} arcsec ({width:.2f} pixels)",
    )
    for number, peak_distance in enumerate(quasar_peaks(images, band)):
        quasar = images.quasars[number]
        column, row = (float(value) for value in grid.to_pixel(*quasar))
        near = (
            "masked" if peak_distance is None else f"{peak_distance:.3f} arcsec from the brightest pixel about it"
        )
        far = "  FAR" if peak_distance is not None and peak_distance > far_from_quasar(grid) else ""
        yield (
            "" if number else "quasar images",
            f"{number}: {_point(quasar[0], quasar[1], 3)} arcsec, pixel {_point(column, row, 1)}, {near}{far}",
        )


def _scatter(images: Images, band: Band) -> str:
    scatter = images.scatter[band.name]
    if scatter is None:
        return "too few used pixels in one piece to measure the scatter of the sky"
    return (
        f"scatter by {scatter.sky * scatter.sky_sigma:.3g} e-/s, {scatter.sky:.2f} of their sigma "
        f"({scatter.n_pixels} pixels 3 apart; neighbours {scatter.sky_neighbours:.2f}); bright ones by "
        f"{scatter.bright:.2f} or less"
    )


def _lens(images: Images) -> Iterator[tuple[str, str]]:
    block, (x, y, radius) = images.config.smooth_model, images.lens
    yield "lens", "as given" if block.mode == "given" else "start of the fit"
    for name, kwargs in zip(block.lens.lens_model_list, block.lens.kwargs_lens, strict=True):
        yield "", f"{name}: {_kwargs(kwargs)}"
    if len(images.quasars) and radius is not None:
        distance = np.hypot(*(images.quasars - [x, y]).T)
        yield "", f"quasar images {distance.min():.2f} to {distance.max():.2f} arcsec from its centre"
    redshifts = images.config.redshifts
    yield "redshifts", f"lens {redshifts.lens:g}, source {redshifts.source:g}"


def _kwargs(kwargs: Mapping[str, Any]) -> str:
    """Return the parameters of a model; of a list only its length."""
    parts = (
        f"{name} {value:.4g}" if isinstance(value, int | float) else f"{len(value)} {name}"
        for name, value in kwargs.items()
    )
    return ", ".join(parts)


def _scan(config: Config, grid: PixelGrid) -> Iterator[tuple[str, str]]:
    scan = config.scan
    if scan.window_arcsec is None:
        yield "scan", f"around the pixels that are used, step {scan.step_arcsec:g} arcsec"
        return
    raster = Raster(*scan.window_arcsec, scan.step_arcsec, scan.center)
    outside = share_outside(grid, raster.coordinates())
    left, right, low, high = image_box(grid)
    yield (
        "scan",
        f"{raster.width:.2f} x {raster.height:.2f} arcsec about {_point(*raster.center, 2)}, step "
        f"{raster.step:g}: {raster.n_positions} positions",
    )
    yield "", f"{outside:.1%} outside the image, x {left:.2f} to {right:.2f}, y {low:.2f} to {high:.2f} arcsec"
