"""Checks of images and positions before the first job: `warmlens validate`."""

from __future__ import annotations

import numpy as np

from warmlens.campaign.physics_check import checked_physics
from warmlens.config.file import ConfigError
from warmlens.config.model import Config
from warmlens.config.observation import FitsBandBlock
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise_correlation import neighbours, sky_noise
from warmlens.imaging.observation import Band
from warmlens.physics import check_field
from warmlens.products.images import blank_sky, read_fits
from warmlens.types import FloatArray

PEAK_WITHIN_ARCSEC = 0.3  # of a quasar image its brightest pixel is looked for
_FAR_IN_PIXELS = 2.0


def check_observation(config: Config) -> list[str]:
    """Read the images as the campaign will, and describe their pixels and the quasar images on them.

    Returns
    -------
    lines
        Grid and orientation of a FITS observation, one line per quasar image and band, and one per band whose
        noise is correlated. Empty for an observation that another campaign makes.

    Raises
    ------
    ConfigError
        One line per problem: a file that cannot be used, a field of subhalos that does not cover the image, a
        quasar image outside of it.
    """
    observation = config.observation
    if observation.kind == "artifact":
        return checked_physics(config, None)
    lines: list[str] = []
    problems: list[str] = []
    if observation.kind == "simulated":
        assert observation.simulated is not None  # config: kind simulated comes with its block
        grid = PixelGrid.centred(observation.simulated.shape, observation.simulated.pixel_scale_arcsec)
    else:
        assert observation.fits is not None
        observed = read_fits({name: observation.fits[name] for name in observation.bands})
        grid = observed.grid
        lines.append(describe_grid(grid))
        quasars = np.array(config.smooth_model.quasar_images, dtype=np.float64).reshape(-1, 2)
        problems += _quasars_off_the_image(grid, quasars)
        if not problems:
            lines += [line for band in observed.bands for line in _quasar_lines(grid, band, quasars)]
        lines += [
            line for band in observed.bands for line in _noise_lines(band, observation.fits[band.name], grid)
        ]
    try:
        lines += checked_physics(config, grid)
    except ConfigError as error:
        problems += error.problems
    try:
        check_field(config.halos.field_half_width_arcsec, grid, config.deflections.filter_arcsec)
    except ValueError as error:
        problems.append(str(error))
    if problems:
        raise ConfigError(problems)
    return lines


def describe_grid(grid: PixelGrid) -> str:
    """Return size, origin and orientation of an image as a viewer shows it, row 0 at the bottom."""
    axes = np.array(grid.axes)
    north = np.rad2deg(
        np.arctan2(axes[1, 0], axes[1, 1])
    )  # of the sky's y axis, clockwise from the rows' direction
    east = "left" if np.linalg.det(axes) > 0.0 else "right (mirrored)"
    column, row = (float(value) for value in grid.to_pixel(np.array(0.0), np.array(0.0)))
    return (
        f"{grid.nx} x {grid.ny} pixels of {grid.pixel_scale:.4f} arcsec; origin at pixel [x, y] = "
        f"[{column:.1f}, {row:.1f}], from 0; north {north:.1f} degrees clockwise from up, east to its {east}"
    )


def _quasars_off_the_image(grid: PixelGrid, quasars: FloatArray) -> list[str]:
    problems = []
    columns, rows = (np.rint(pixels).astype(int) for pixels in grid.to_pixel(quasars[:, 0], quasars[:, 1]))
    for number, (x, y), column, row in zip(range(len(quasars)), quasars, columns, rows, strict=True):
        if not (0 <= column < grid.nx and 0 <= row < grid.ny):
            problems.append(
                f"smooth_model.quasar_images[{number}]: [{x:g}, {y:g}] arcsec to the West and the North of the "
                f"origin lies outside the image, at pixel [x, y] = [{column}, {row}] from 0; correct it, or the "
                "origin of the image"
            )
    return problems


def _quasar_lines(grid: PixelGrid, band: Band, quasars: FloatArray) -> list[str]:
    """Return how far each quasar image is from the brightest pixel near it: far if positions or axes are wrong."""
    x, y = grid.coordinates()
    lines = []
    for number, (quasar_x, quasar_y) in enumerate(quasars):
        distance = np.hypot(x - quasar_x, y - quasar_y)
        near = np.where((distance < PEAK_WITHIN_ARCSEC) & band.mask, band.image, -np.inf)
        peak = float(distance.flat[int(np.argmax(near))])
        column, row = grid.to_pixel(quasar_x, quasar_y)
        line = (
            f"{band.name}: quasar image {number} at [{quasar_x:g}, {quasar_y:g}] is pixel "
            f"[{column:.1f}, {row:.1f}], {peak:.2f} arcsec from the brightest pixel about it"
        )
        if peak > max(_FAR_IN_PIXELS * grid.pixel_scale, 0.5 * PEAK_WITHIN_ARCSEC):
            line += "; FAR: are positions to the West and the North, the origin and the orientation right?"
        lines.append(line)
    return lines


def _noise_lines(band: Band, block: FitsBandBlock, grid: PixelGrid) -> list[str]:
    """Return how noise is correlated, and its rms if it was measured in the image."""
    if band.noise.correlation is None:
        return []
    row, column, diagonal = neighbours(band.noise.correlation)
    line = (
        f"{band.name}: the noise of neighbouring pixels correlates by {row:.2f} along rows, {column:.2f} along "
        f"columns, {diagonal:.2f} across; mocks have the same"
    )
    if block.blank_sky_arcsec is not None:
        sky = blank_sky(grid, band, block.blank_sky_arcsec)
        _, rms = sky_noise(band.image, sky)
        line += f" ({np.count_nonzero(sky)} pixels of sky, rms {rms:.3g} e-/s"
        line += f"; taken: {np.median(band.sigma[sky]):.3g})"
    return [line]
