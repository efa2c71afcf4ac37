"""Reading the bands of an observation from a user's FITS files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from warmlens.config.file import expand_path
from warmlens.config.observation import FITS_FILES, MAX_SIDE, FitsBandBlock, ObservationBlock
from warmlens.config.types import ConfigError
from warmlens.imaging.fits import read_image
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.noise_checks import FAINT_NOISE, IGNORED_NOISE, uninformative
from warmlens.imaging.noise_correlation import checked_correlation, sky_noise
from warmlens.imaging.observation import Band, Observation, checked_band
from warmlens.imaging.sky import PIXEL_ARCSEC, TOLERANCE_PIXELS, SkyFrame, border, sky_offsets
from warmlens.products.observation import read_observation
from warmlens.types import BoolArray, FloatArray

_UNITS = {"electron/s", "electrons/s", "e-/s", "electron s-1", "electrons s-1"}  # "/" may stand between spaces
_LARGEST = 1e30  # e-/s or s: its square is a number too
_SHAPE_TOLERANCE = 1e-3  # of pixels being square and axes orthogonal
_AMBIGUOUS_SHARE = 0.05  # of the used pixels that may have a noise that hides them without being masked
_FAR_ARCSEC = 90.0 * 3600.0  # of a band on the other side of the sky


@dataclass(frozen=True)
class ReadBand:
    """A band and what its files say beyond it.

    Attributes
    ----------
    frame
        The WCS of the image; None if the configuration replaces it.
    origin
        Pixel (column, row) of the origin of positions, from 0.
    psf_sum
        Sum of the PSF as it was given; that of `band` is 1.
    mask_values
        Different values of the user's mask in use, at most 10, ascending; none without a mask.
    n_ignored
        Pixels that are masked because the noise map takes them out of the fit.
    """

    block: FitsBandBlock
    grid: PixelGrid
    band: Band
    frame: SkyFrame | None
    origin: tuple[float, float]
    psf_sum: float
    mask_values: tuple[float, ...]
    n_ignored: int


def read_files(name: str, block: FitsBandBlock) -> ReadBand:
    """Read and check image, PSF, mask and noise of one band.

    Raises
    ------
    ConfigError
        Naming the file or key, what was found, what was expected and what to do.
    """
    try:
        paths = input_files(block)
        science = paths.pop("science")
        image, header = read_image(science, block.extension, MAX_SIDE)
        maps = {key: read_image(path, 0, MAX_SIDE)[0] for key, path in paths.items()}
        _check_units(science, header, block.units)
        frame = None if block.pixel_scale_arcsec is not None else SkyFrame.from_header(science, header)
        grid, origin = _pixel_grid(science, frame, image.shape, block)
        if "sigma" in maps or "weight" in maps:
            noise, sigma = NoiseModel(None, None), _sigma_map(maps)
        else:
            noise = NoiseModel(
                background_rms=_header_number(science, header, block.background_rms, "BKGRMS", "background_rms"),
                exposure_s=_header_number(science, header, block.exposure_s, "EXPTIME", "exposure_s"),
            )
            sigma = noise.sigma(image)
        mask, n_ignored = _mask(image, maps, block), 0
        if "sigma" in maps or "weight" in maps:
            mask, n_ignored = _informative(name, block, image, sigma, mask)
        band = checked_band(name, grid, image, sigma, mask, maps["psf"], noise)
        correlation = _noise_correlation(grid, band, maps, block)
        band = replace(band, noise=replace(noise, correlation=correlation))
        values = tuple(np.unique(maps["mask"])[:10].tolist()) if "mask" in maps else ()
        return ReadBand(block, grid, band, frame, origin, float(maps["psf"].sum()), values, n_ignored)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError([str(error)]) from error


def read_band(name: str, block: FitsBandBlock) -> tuple[PixelGrid, Band]:
    """Return the pixels and the band of `read_files`."""
    read = read_files(name, block)
    return read.grid, read.band


def input_files(block: FitsBandBlock) -> dict[str, Path]:
    """Return the paths of the files that a band is read from, by the name of their key."""
    return {key: expand_path(getattr(block, key)) for key in FITS_FILES if getattr(block, key) is not None}


def _mask(image: FloatArray, maps: dict[str, FloatArray], block: FitsBandBlock) -> BoolArray:
    """Return the pixels that are used: 1 in the mask, and of positive weight."""
    mask = np.ones(image.shape, dtype=bool)
    if "mask" in maps:
        if not np.isfinite(maps["mask"]).all():
            raise ValueError(f"{block.mask}: the mask has pixels that are not finite, expected 0 and 1")
        mask = maps["mask"] > 0
    if "weight" in maps and maps["weight"].shape == mask.shape:  # of another shape: `checked_band` refuses it
        mask = mask & (maps["weight"] > 0)
    return mask


def _informative(
    name: str, block: FitsBandBlock, image: FloatArray, sigma: FloatArray, mask: BoolArray
) -> tuple[BoolArray, int]:
    """Return the mask without the pixels that a noise map takes out of the fit, and their number."""
    if sigma.shape != mask.shape:  # `checked_band` refuses it
        return mask, 0
    pixels = uninformative(image, sigma, mask)
    given = "sigma" if block.sigma is not None else "weight"
    kinds: list[tuple[BoolArray, str, float]] = [
        (pixels.ambiguous, f"more than {FAINT_NOISE:g} times", _AMBIGUOUS_SHARE),
        (pixels.too_quiet, "less than a thirtieth of", 0.0),
    ]
    for bad, what, limit in kinds:
        share = float(np.count_nonzero(bad)) / max(float(np.count_nonzero(mask)), 1.0)
        if share > limit:
            row, column = np.argwhere(bad)[0]
            raise ValueError(
                f"band {name}: {getattr(block, given)}: the noise of {np.count_nonzero(bad)} used pixels "
                f"({share:.1%}) is {what} that of the quiet ones ({pixels.quiet_sigma:.3g} e-/s), the first at "
                f"[y, x] = [{row}, {column}]; mask pixels that are not to count (above {IGNORED_NOISE:g} times "
                f"they are masked), or mend observation.fits.{name}.{given}"
            )
    return mask & ~pixels.ignored, int(np.count_nonzero(pixels.ignored))


def _sigma_map(maps: dict[str, FloatArray]) -> FloatArray:
    """Return the noise per pixel from a map of it or of the inverse variance, NaN where there is no weight."""
    if "sigma" in maps:
        return maps["sigma"]
    return 1.0 / np.sqrt(np.where(maps["weight"] > 0, maps["weight"], np.nan))


def _noise_correlation(
    grid: PixelGrid, band: Band, maps: dict[str, FloatArray], block: FitsBandBlock
) -> FloatArray | None:
    """Return the correlation of the noise from the user's file or from blank sky; None: independent pixels."""
    radius, where = block.blank_sky_arcsec, block.noise_correlation
    if radius is not None:
        where = f"observation.fits.{band.name}.blank_sky_arcsec: {radius:g}"
    if where is None:
        return None
    try:
        if radius is None:
            return checked_correlation(maps["noise_correlation"])
        return checked_correlation(sky_noise(band.image, blank_sky(grid, band, radius))[0])
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def blank_sky(grid: PixelGrid, band: Band, radius_arcsec: float) -> BoolArray:
    """Return the unmasked pixels farther than a radius from the origin [ny, nx]."""
    return (np.hypot(*grid.coordinates()) > radius_arcsec) & band.mask


def _check_units(path: Path, header: fits.Header, given: str | None) -> None:
    unit = given or header.get("BUNIT")
    if unit is None:
        raise ValueError(f"{path}: no BUNIT; set observation.fits.BAND.units: electron/s if that is the unit")
    if str(unit).strip().lower().replace(" / ", "/") not in _UNITS:
        raise ValueError(
            f"{path}: BUNIT is {unit!r}, expected electron/s; convert the image, or set "
            "observation.fits.BAND.units: electron/s if that is its unit all the same"
        )


def _header_number(path: Path, header: fits.Header, given: float | None, keyword: str, key: str) -> float:
    value: Any = given if given is not None else header.get(keyword)
    if value is None:
        raise ValueError(f"{path}: no keyword {keyword}; set observation.fits.BAND.{key}, sigma or weight")
    if not (isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < _LARGEST):
        raise ValueError(f"{path}: {keyword} is {value!r}, expected a positive number below {_LARGEST:g}")
    return float(value)


def _pixel_grid(
    path: Path, frame: SkyFrame | None, shape: tuple[int, ...], block: FitsBandBlock
) -> tuple[PixelGrid, tuple[float, float]]:
    """Return the pixels on the sky, and the pixel (column, row) of the origin."""
    ny, nx = shape
    origin = block.center_pixel or (None if frame is None else frame.crpix)
    assert origin is not None  # config: a pixel scale comes with a centre
    if not (0 <= origin[0] < nx and 0 <= origin[1] < ny):
        raise ValueError(
            f"{path}: the frame's origin is pixel [x, y] = [{origin[0]:.1f}, {origin[1]:.1f}], outside the "
            f"{nx} x {ny} image; set observation.fits.BAND.center_pixel to the pixel of the lens centre"
        )
    if frame is None:
        assert block.pixel_scale_arcsec is not None
        step = block.pixel_scale_arcsec * np.eye(2)
    else:
        step = frame.linear_step(origin, (ny, nx))
    step = _square_step(path, step, origin, (ny, nx))
    scale = float(np.hypot(*step[:, 0]))
    axes = step / scale
    first = -step @ np.array(origin)
    rows = ((float(axes[0, 0]), float(axes[0, 1])), (float(axes[1, 0]), float(axes[1, 1])))
    return PixelGrid(ny, nx, scale, float(first[0]), float(first[1]), rows), origin


def _square_step(path: Path, step: FloatArray, origin: tuple[float, float], shape: tuple[int, int]) -> FloatArray:
    """Return the sky steps of columns and rows [2, 2] as those of square pixels.

    A small distortion is left out if no pixel of the image moves by more than the tolerance of the WCS.
    """
    columns_and_rows = np.hypot(*step)
    if not all(PIXEL_ARCSEC[0] <= side <= PIXEL_ARCSEC[1] for side in columns_and_rows):
        raise ValueError(
            f"{path}: pixels of {columns_and_rows[0]:g} x {columns_and_rows[1]:g} arcsec; "
            "correct its WCS, or observation.fits.BAND.pixel_scale_arcsec"
        )
    axes = step / columns_and_rows[0]
    if np.allclose(axes.T @ axes, np.eye(2), atol=_SHAPE_TOLERANCE):
        return step
    left, sides, right = np.linalg.svd(step)
    mean, turned = float(sides.mean()), left @ right
    columns, rows = border(shape)
    moved = (mean * turned - step) @ np.array([columns - origin[0], rows - origin[1]])
    if np.hypot(*moved).max() <= TOLERANCE_PIXELS * mean:
        return mean * turned
    sides = np.hypot(*step)
    raise ValueError(
        f"{path}: pixels are not square ({sides[0]:.5f} x {sides[1]:.5f} arcsec, axes' scalar product "
        f"{axes[:, 0] @ axes[:, 1]:.4f}); resample the image to square pixels"
    )


def read_all(blocks: dict[str, FitsBandBlock]) -> tuple[ReadBand, ...]:
    """Read all bands; they must share one pixel grid, that of the first."""
    bands: list[ReadBand] = []
    for name, block in blocks.items():
        bands.append(read_files(name, block))
        _check_alignment(bands[0], bands[-1])
    return tuple(bands)


def read_fits(blocks: dict[str, FitsBandBlock]) -> Observation:
    """Return the observation of `read_all`."""
    bands = read_all(blocks)
    return Observation("fits", bands[0].grid, tuple(read.band for read in bands))


def _check_alignment(first: ReadBand, other: ReadBand) -> None:
    """Refuse a band whose pixels lie elsewhere on the sky than those of the first, by their whole WCS.

    A band whose WCS the configuration replaces is compared by its pixel grid.
    """
    grid = first.grid
    problem = f"band {other.band.name} lies on other pixels than band {first.band.name}"
    if other.grid.shape != grid.shape:
        sizes = " against ".join(f"{nx} x {ny}" for ny, nx in (other.grid.shape, grid.shape))
        raise ConfigError([f"{problem}: {sizes}; cut both to the same pixels"])
    pixels = border(grid.shape)
    expected = np.array(grid.to_sky(*pixels))
    offsets = [np.array(other.grid.to_sky(*pixels)) - expected]
    if first.frame is not None and other.frame is not None:
        # headers confuse ICRS and FK5: bands that agree in either reading are aligned
        mixed = first.frame.frame.name != other.frame.frame.name
        offsets = [_sky_difference(first, other, exact) for exact in ((False, True) if mixed else (False,))]
        chosen = first.block.center_pixel is not None or other.block.center_pixel is not None
        if chosen and np.hypot(*(np.array(other.origin) - first.origin)) > TOLERANCE_PIXELS:
            pixels_of = " against ".join(f"[{x:.2f}, {y:.2f}]" for x, y in (other.origin, first.origin))
            raise ConfigError([f"{problem}: the origin is pixel {pixels_of}; give both the same center_pixel"])
    worst = min(offsets, key=lambda offset: np.hypot(*offset).max())
    arcsec = float(np.hypot(*worst).max())
    if not arcsec <= TOLERANCE_PIXELS * grid.pixel_scale:
        west, north = worst.mean(axis=1)
        raise ConfigError(
            [
                f"{problem}: on the sky it is off by up to {arcsec / grid.pixel_scale:.3g} pixels ({arcsec:.3g} "
                f"arcsec; {west:+.3g} West, {north:+.3g} North on average), at most {TOLERANCE_PIXELS:g} pixels "
                "are accepted; align the images (resample both to one grid), or give both headers one WCS if "
                "only that is wrong"
            ]
        )


def _sky_difference(first: ReadBand, other: ReadBand, exact: bool) -> FloatArray:
    """Return by how much the border of a band is off that of the first, (West, North) [2, n] [arcsec]."""
    assert first.frame is not None and other.frame is not None
    pixels = border(first.grid.shape)
    origin = np.array(first.origin)[:, None]
    centre = first.frame.radec(origin[0], origin[1], exact)[:, 0]
    there, here = (sky_offsets(centre, read.frame.radec(*pixels, exact)) for read in (other, first) if read.frame)
    difference: FloatArray = there - here
    return np.where(np.isfinite(difference), difference, _FAR_ARCSEC)


def artifact_path(block: ObservationBlock) -> Path:
    """Return the path of the observation that `kind: artifact` takes its bands from; it must exist."""
    assert block.artifact is not None  # config: kind artifact comes with its path
    path = expand_path(block.artifact)
    if not path.is_file():
        raise ConfigError([f"observation.artifact: {path}: no such file; run the campaign that makes it first"])
    return path


def planned_mask(block: ObservationBlock) -> tuple[PixelGrid, BoolArray]:
    """Return the pixel grid and the pixels that some band uses [ny, nx], before the stage has run."""
    if block.kind == "simulated":
        assert block.simulated is not None  # config: kind simulated comes with its block
        grid = PixelGrid.centred(block.simulated.shape, block.simulated.pixel_scale_arcsec)
        return grid, np.ones(grid.shape, dtype=bool)
    if block.kind == "artifact":
        observed = read_observation(artifact_path(block))
    else:
        assert block.fits is not None
        observed = read_fits({name: block.fits[name] for name in block.bands})
    masks = [band.mask for band in observed.bands if band.name in block.bands]
    return observed.grid, np.logical_or.reduce(masks)
