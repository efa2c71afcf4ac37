"""Checks of an observation before the first job: each takes the images and returns problems and notes.

A problem stops the campaign. A note is a question that a person answers by looking. What is a problem by evidence,
not by logic, is a note under `smooth_model.allow_poor_fit`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from warmlens.config.model import Config
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise_checks import DEEP, IGNORED_NOISE, Scatter, measure_scatter
from warmlens.imaging.observation import Band
from warmlens.imaging.psf import core_offset
from warmlens.physics import check_field
from warmlens.products.images import ReadBand
from warmlens.scan.raster import Raster
from warmlens.types import FloatArray

PEAK_WITHIN_ARCSEC = 0.3  # of a quasar image its brightest pixel is looked for
_FAR_IN_PIXELS = 2.0
# Scatter of the sky over sigma: beyond the first a note, beyond the second a problem
_NOTED_SCATTER, _REFUSED_SCATTER = 1.25, 3.0
_NEIGHBOURS_SCATTER = 0.8  # of neighbouring pixels, that sigma is too small and not the sky full of structure
_NOTED_BRIGHT, _REFUSED_BRIGHT = 0.5, 0.25  # of the brightest quarter, whose structure raises it only
_SAME_SCATTER = 1.5  # within this factor a likely mistake explains the scatter
_PSF_NOTED = 0.1  # pixels
_PSF_RIM = 0.1  # of the sum of a PSF in a level like that of its rim
_ARCS = (0.7, 1.3)  # Einstein radii between which the arcs lie
_ARCS_USED = 0.25  # of their pixels: fewer, and the mask may be inverted
_ARCS_FAVOURED = 2.0  # share of the arcs' pixels over that of all, of a mask that is cut out along the arcs
_WINDOW_OUTSIDE = 0.1  # of the scan's positions


@dataclass
class Findings:
    """What a check has to say."""

    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Images:
    """The images of a campaign as it will take them.

    Attributes
    ----------
    bands
        None of a simulated observation that is not made yet.
    files
        What the files of each band say beyond it; empty unless the observation is read from FITS.
    """

    config: Config
    grid: PixelGrid
    bands: tuple[Band, ...]
    files: tuple[ReadBand, ...] = ()

    @property
    def quasars(self) -> FloatArray:
        """Positions of the quasar images [n, 2] [arcsec]."""
        return np.array(self.config.smooth_model.quasar_images, dtype=np.float64).reshape(-1, 2)

    @property
    def lens(self) -> tuple[float, float, float | None]:
        """Centre (x, y) and Einstein radius [arcsec] of the first lens model.

        Without theta_E the radius is the mean one of the quasar images, None without these.
        """
        kwargs = self.config.smooth_model.lens.kwargs_lens
        first = kwargs[0] if kwargs else {}
        x, y = (float(first.get(key, 0.0)) for key in ("center_x", "center_y"))
        radius = first.get("theta_E")
        if radius is None and len(self.quasars):
            radius = np.hypot(*(self.quasars - [x, y]).T).mean()
        return x, y, None if radius is None else float(radius)

    @cached_property
    def scatter(self) -> dict[str, Scatter | None]:
        """Scatter of each band's image over its noise; None where it cannot be measured."""
        return {band.name: measure_scatter(band.image, band.sigma, band.mask) for band in self.bands}

    def doubt(self, found: Findings, text: str) -> None:
        """Add a problem that rests on evidence: a note if the configuration accepts a poor fit."""
        if self.config.smooth_model.allow_poor_fit:
            found.notes.append(text)
        else:
            found.problems.append(f"{text} (smooth_model.allow_poor_fit: true goes on all the same)")


Check = Callable[[Images], Findings]


def check_substructure_field(images: Images) -> Findings:
    """Refuse a field of subhalos that does not cover the image."""
    config = images.config
    try:
        check_field(config.halos.field_half_width_arcsec, images.grid, config.deflections.filter_arcsec)
    except ValueError as error:
        return Findings([str(error)])
    return Findings()


def image_box(grid: PixelGrid) -> tuple[float, float, float, float]:
    """Return smallest x, largest x, smallest y, largest y of an image [arcsec], to the rims of its pixels."""
    corners = [(c, r) for c in (-0.5, grid.nx - 0.5) for r in (-0.5, grid.ny - 0.5)]
    x, y = grid.to_sky(*np.array(corners).T)
    return float(x.min()), float(x.max()), float(y.min()), float(y.max())


def share_outside(grid: PixelGrid, points: FloatArray) -> float:
    """Return the share of points [n, 2] [arcsec] that lie beyond the pixels of an image."""
    columns, rows = grid.to_pixel(points[:, 0], points[:, 1])
    inside = (np.abs(columns - 0.5 * (grid.nx - 1)) <= 0.5 * grid.nx) & (
        np.abs(rows - 0.5 * (grid.ny - 1)) <= 0.5 * grid.ny
    )
    return 1.0 - float(np.mean(inside))


def check_scan_window(images: Images) -> Findings:
    """Refuse a window of the scan that is larger than the image; a null one follows from the masks."""
    scan, found = images.config.scan, Findings()
    if scan.window_arcsec is None:
        return found
    left, right, low, high = image_box(images.grid)
    (width, height), (x, y) = scan.window_arcsec, scan.center
    try:
        outside = share_outside(images.grid, Raster(width, height, scan.step_arcsec, (x, y)).coordinates())
    except ValueError as error:
        return Findings([f"scan.window_arcsec: {error}"])
    rounding = 1e-9 * (right - left)
    if width > right - left + rounding or height > high - low + rounding or outside > _WINDOW_OUTSIDE:
        found.problems.append(
            f"scan.window_arcsec: {width:g} x {height:g} arcsec about [{x:g}, {y:g}], {outside:.0%} of its "
            f"positions outside the image, which reaches from x = {left:.2f} to {right:.2f} and from y = "
            f"{low:.2f} to {high:.2f}; narrow it to the arcs, or set it to null: around the pixels that are used"
        )
    elif outside > 0.0:
        found.notes.append(f"scan.window_arcsec: {outside:.1%} of its positions lie outside the image")
    return found


def check_quasar_positions(images: Images) -> Findings:
    """Refuse quasar images off the image; far from light, ask for positions, origin and orientation."""
    found, grid = Findings(), images.grid
    for number, (x, y) in enumerate(images.quasars):
        column, row = (round(float(pixel)) for pixel in grid.to_pixel(x, y))
        if not (0 <= column < grid.nx and 0 <= row < grid.ny):
            found.problems.append(
                f"smooth_model.quasar_images[{number}]: [{x:g}, {y:g}] arcsec to the West and the North of the "
                f"origin lies outside the image, at pixel [x, y] = [{column}, {row}] from 0; correct it, or the "
                "origin of the image"
            )
    if not found.problems:
        for band in images.bands:
            for number, peak in enumerate(quasar_peaks(images, band)):
                if peak is not None and peak > far_from_quasar(grid):
                    found.notes.append(
                        f"{band.name}: quasar image {number} is FAR, {peak:.2f} arcsec, from the brightest pixel "
                        "about it: are positions to the West and the North, the origin and the orientation right?"
                    )
    return found


def far_from_quasar(grid: PixelGrid) -> float:
    """Return the distance [arcsec] of a quasar image from its brightest pixel that is too large."""
    return max(_FAR_IN_PIXELS * grid.pixel_scale, 0.5 * PEAK_WITHIN_ARCSEC)


def quasar_peaks(images: Images, band: Band) -> list[float | None]:
    """Return the distance [arcsec] of each quasar image from the brightest pixel near it; None: it is masked."""
    x, y = images.grid.coordinates()
    peaks: list[float | None] = []
    for quasar_x, quasar_y in images.quasars:
        distance = np.hypot(x - quasar_x, y - quasar_y)
        near = distance < PEAK_WITHIN_ARCSEC
        core = distance < max(1.5 * images.grid.pixel_scale, 0.5 * PEAK_WITHIN_ARCSEC)
        if np.mean(band.mask[core]) > 0.5:
            brightest = int(np.argmax(np.where(near & band.mask, band.image, -np.inf)))
            peaks.append(float(distance.flat[brightest]))
        else:
            peaks.append(None)
    return peaks


def check_masks(images: Images) -> Findings:
    """Ask whether a mask that leaves out the arcs is inverted, or no mask but flags."""
    found = Findings()
    x, y, radius = images.lens
    if radius is None:
        return found
    distance = np.hypot(*(axis - centre for axis, centre in zip(images.grid.coordinates(), (x, y), strict=True)))
    arcs = (distance >= _ARCS[0] * radius) & (distance <= _ARCS[1] * radius)
    for number, band in enumerate(images.bands):
        values = images.files[number].mask_values if images.files else ()
        flags = len(values) > 2 and max(values) > 1
        used, of_arcs = float(band.mask.mean()), float(band.mask[arcs].mean()) if arcs.any() else 1.0
        share = (
            f"{band.name}: {used:.1%} of the pixels are used, and {of_arcs:.1%} of those where the arcs are, "
            f"{_ARCS[0] * radius:.2f} to {_ARCS[1] * radius:.2f} arcsec from the lens"
        )
        some = f"; the mask has values like {', '.join(f'{value:g}' for value in values[:4])}"
        if of_arcs < _ARCS_USED and of_arcs <= _ARCS_FAVOURED * used:
            question = "is it a data-quality array (0 = good)" if flags else "is the mask inverted"
            images.doubt(found, f"{share}{some if flags else ''}: {question}? 1 marks pixels that are used")
        elif flags:
            found.notes.append(
                f"{share}{some}: is it a data-quality array (0 = good)? Pixels above 0 are used; write 1 and 0"
            )
    return found


def check_noise(images: Images) -> Findings:
    """Compare the scatter of the sky with the noise, and tell what a noise map masks."""
    found = Findings()
    for read in images.files:
        if read.n_ignored:
            given = "sigma" if read.block.sigma is not None else "weight"
            found.notes.append(
                f"{read.band.name}: {read.n_ignored} pixels are masked by the {given} map: their noise is above "
                f"{IGNORED_NOISE:g} times that of the quiet pixels, and above their brightness"
            )
    for number, band in enumerate(images.bands):
        scatter = images.scatter[band.name]
        if scatter is None:
            continue
        file = images.files[number] if images.files else None
        measured = scatter.sky * scatter.sky_sigma
        text = (
            f"{band.name}: the faint pixels scatter by {measured:.3g} e-/s, {scatter.sky:.2g} times their "
            f"sigma of {scatter.sky_sigma:.3g}"
        )
        too_large, too_small = scatter.sky < 1.0 / _REFUSED_SCATTER, scatter.sky_neighbours > _REFUSED_SCATTER
        if too_large or too_small:
            images.doubt(found, f"{text}: {_likely_mistake(scatter, band, file)}")
        elif scatter.sky < 1.0 / _NOTED_SCATTER:
            found.notes.append(f"{text}: is sigma too large? chi2_red will be too small, and mocks too noisy")
        elif scatter.sky > _NOTED_SCATTER and scatter.sky_neighbours > _NEIGHBOURS_SCATTER:
            found.notes.append(f"{text}: is sigma too small, or is there no blank sky on the image?")
        if scatter.bright < _NOTED_BRIGHT and not too_large:
            text = (
                f"{band.name}: the brightest quarter of the pixels scatters by {scatter.bright:.2g} of its sigma"
            )
            if band.noise.exposure_s is None:
                found.notes.append(f"{text}: is the noise map too large where the image is bright?")
            else:
                text += f": is the exposure time of {band.noise.exposure_s:g} s too short?"
                images.doubt(found, text) if scatter.bright < _REFUSED_BRIGHT else found.notes.append(text)
        if scatter.n_deep:
            found.notes.append(
                f"{band.name}: {scatter.n_deep} used pixels lie more than {DEEP:g} sigma below the sky; mask them "
                "if they are dead"
            )
        if scatter.n_constant:
            found.notes.append(
                f"{band.name}: {scatter.n_constant} used pixels equal their neighbours exactly; mask them if they "
                "hold no data"
            )
    return found


def _likely_mistake(scatter: Scatter, band: Band, file: ReadBand | None) -> str:
    """Return the question that explains a scatter of the sky that is far off the noise, and the key to mend."""
    sigma, measured = scatter.sky_sigma, scatter.sky * scatter.sky_sigma
    where = f"observation.fits.{band.name}"
    if band.noise.background_rms is not None:
        if scatter.sky < 1.0:
            return (
                f"sigma is too large; is the exposure time of {band.noise.exposure_s:g} s right (1 in the header "
                f"of an image of rates?), and the background of {band.noise.background_rms:g} e-/s? Set "
                f"{where}.exposure_s and background_rms"
            )
        return (
            "sigma is too small; is the image in electrons instead of electrons per second? Divide it by the "
            f"exposure time, or set {where}.background_rms and exposure_s"
        )
    weight = file is not None and file.block.weight is not None
    expected = {  # what the sky scatters by if the file holds something else than its key says
        "the variance (sigma^2); give its root": 1.0 / sigma if weight else np.sqrt(sigma),
        "the noise; give it as `sigma`" if weight else "an inverse variance; give it as `weight`": (
            sigma**-2 if weight else sigma**-0.5
        ),
    }
    likely = [text for text, value in expected.items() if 1 / _SAME_SCATTER < measured / value < _SAME_SCATTER]
    guess = f"it seems to be {likely[0]}" if likely else "is it in other units than the image (counts, not rates)?"
    too = "large" if scatter.sky < 1.0 else "small"
    return f"sigma is too {too}; look at {where}.{'weight' if weight else 'sigma'}: {guess}"


def check_psf(images: Images) -> Findings:
    """Tell of a PSF off its middle pixel, and of one with a pedestal or cut off at its rim."""
    found = Findings()
    scale = images.grid.pixel_scale
    for band in images.bands:
        column, row = core_offset(band.psf)
        offset = float(np.hypot(column, row))
        if offset > _PSF_NOTED:
            found.notes.append(
                f"{band.name}: the core of the PSF lies [{column:+.2f}, {row:+.2f}] pixels off its middle: fitted "
                f"positions are off by {1e3 * offset * scale:.0f} mas; recentre it, or widen "
                "smooth_model.fit.quasar_sigma_arcsec to as much"
            )
        rim = np.concatenate([band.psf[0], band.psf[-1], band.psf[:, 0], band.psf[:, -1]])
        pedestal = float(np.median(rim)) * band.psf.size
        if band.psf.shape[0] > 1 and pedestal > _PSF_RIM:
            found.notes.append(
                f"{band.name}: {pedestal:.0%} of the PSF's light is in a level like that of its rim: is a "
                "background left in it, or is it cut too small?"
            )
    return found


CHECKS: tuple[Check, ...] = (
    check_substructure_field,
    check_scan_window,
    check_quasar_positions,
    check_masks,
    check_noise,
    check_psf,
)
