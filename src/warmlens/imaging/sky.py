"""Sky positions of pixels by the whole WCS of an image, and the linear pixel grid that stands for it.

Positions are arcsec to the West (x) and to the North (y) of an origin, North of the ICRS. The program's pixels lie
on a plane, so a WCS that bends by more than `TOLERANCE_PIXELS` within the image is refused.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.coordinates import FK4, FK5, ICRS, BaseCoordinateFrame, Galactic, SkyCoord
from astropy.io import fits
from astropy.wcs import WCS, FITSFixedWarning
from astropy.wcs.utils import wcs_to_celestial_frame

from warmlens.types import FloatArray

TOLERANCE_PIXELS = 0.05  # between the linear grid and the WCS, and between bands, anywhere on the image
DISTORTION = re.compile(r"[AB]_ORDER|CPDIS[12]|D2IMDIS[12]|DET2IM[12]")
PIXEL_ARCSEC = (1e-4, 60.0)
_AXES = ({"RA", "DEC"}, {"GLON", "GLAT"})
_INSTEAD = "set observation.fits.BAND.pixel_scale_arcsec and center_pixel"


@dataclass(frozen=True)
class SkyFrame:
    """Whole celestial WCS of an image."""

    path: Path
    wcs: WCS
    frame: BaseCoordinateFrame

    @classmethod
    def from_header(cls, path: Path, header: fits.Header) -> SkyFrame:
        """Return the WCS of the keywords that `imaging.fits.read_image` keeps.

        Raises
        ------
        ValueError
            If there is no celestial WCS of two axes, a singular one, or one with distortion.
        """
        kinds = [str(header.get(f"CTYPE{axis}", "")) for axis in (1, 2)]
        if any(DISTORTION.fullmatch(keyword) for keyword in header) or any(
            kind.rstrip()[-3:] in ("TNX", "ZPX") for kind in kinds
        ):
            raise ValueError(f"{path}: its WCS has distortion; resample the image (drizzle), or {_INSTEAD}")
        if not header.get("WCSAXES", 2) == 2:
            raise ValueError(f"{path}: its WCS has {header['WCSAXES']} axes, expected 2; {_INSTEAD}")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FITSFixedWarning)
                wcs = WCS(header)
            celestial = wcs.has_celestial
            known = not celestial or {kind.split("-")[0].strip() for kind in wcs.wcs.ctype} in _AXES
            frame = wcs_to_celestial_frame(wcs) if celestial and known else None
        except MemoryError:
            raise
        except Exception as error:  # wcslib's errors are of many classes
            raise _unusable(path, " ".join(str(error).split())[:300]) from error
        if not celestial:
            raise ValueError(f"{path}: no celestial WCS; {_INSTEAD}")
        if not known or not isinstance(frame, ICRS | FK5 | FK4 | Galactic):
            raise _unusable(path, f"axes {kinds[0]!r} and {kinds[1]!r}, expected RA and DEC, or GLON and GLAT")
        return cls(path, wcs, frame)

    @property
    def crpix(self) -> tuple[float, float]:
        """Reference pixel (column, row), from 0."""
        column, row = self.wcs.wcs.crpix - 1.0
        return float(column), float(row)

    @property
    def is_j2000(self) -> bool:
        """Whether coordinates are ICRS or FK5 of J2000: the two differ by 0.02", less than headers care for."""
        return isinstance(self.frame, ICRS) or (isinstance(self.frame, FK5) and self.frame.equinox.jyear == 2000.0)

    def radec(self, columns: FloatArray, rows: FloatArray, exact: bool = False) -> FloatArray:
        """Return right ascension and declination [2, n] [deg] of fractional pixels, from 0.

        J2000 coordinates are returned as they are, unless they are asked for in the `exact` ICRS.
        """
        try:
            world = self.wcs.all_pix2world(np.ravel(columns), np.ravel(rows), 0)
            longitude, latitude = world[self.wcs.wcs.lng], world[self.wcs.wcs.lat]
            if not self.is_j2000 or exact:
                sky = SkyCoord(longitude, latitude, unit="deg", frame=self.frame).icrs
                longitude, latitude = sky.ra.deg, sky.dec.deg
        except MemoryError:
            raise
        except Exception as error:
            raise _unusable(self.path, " ".join(str(error).split())[:300]) from error
        radec: FloatArray = np.array([longitude, latitude], dtype=np.float64)
        if not np.isfinite(radec).all():
            raise _unusable(self.path, "pixels of the image have no sky position")
        return radec

    def linear_step(self, origin: tuple[float, float], shape: tuple[int, int]) -> FloatArray:
        """Return the sky step (x West, y North) [arcsec] of a column and a row as a 2x2 matrix.

        It is the WCS' own matrix where that agrees with the whole WCS about the origin (column, row) on an image
        of `shape` (ny, nx), otherwise the best linear one: far from CRPIX, near a pole, in Galactic coordinates.

        Raises
        ------
        ValueError
            If pixels have an absurd size, or no linear step follows the WCS to 0.05 pixels.
        """
        try:
            own = self.wcs.pixel_scale_matrix[[self.wcs.wcs.lng, self.wcs.wcs.lat]] * 3600.0
        except MemoryError:
            raise
        except Exception as error:
            raise _unusable(self.path, " ".join(str(error).split())[:300]) from error
        own = np.array([[-1.0], [1.0]]) * own
        sides = np.hypot(*own)
        if not all(PIXEL_ARCSEC[0] <= side <= PIXEL_ARCSEC[1] for side in sides):
            raise ValueError(
                f"{self.path}: its WCS gives pixels of {sides[0]:g} x {sides[1]:g} arcsec; {_INSTEAD}"
            )
        columns, rows = border(shape)
        pixels = np.array([columns - origin[0], rows - origin[1]])
        centre = self.radec(np.array([origin[0]]), np.array([origin[1]]))[:, 0]
        if abs(centre[1]) > 90.0 - 1e-6:
            raise _unusable(self.path, "the origin of the positions is a pole, where no direction is North")
        sky = sky_offsets(centre, self.radec(columns, rows))
        fitted = np.linalg.lstsq(pixels.T, sky.T, rcond=None)[0].T
        for step in (own, fitted):
            bend = float(np.hypot(*(step @ pixels - sky)).max() / np.sqrt(abs(np.linalg.det(own)) or 1.0))
            if bend <= TOLERANCE_PIXELS:
                return step
        raise _unusable(
            self.path,
            f"it bends by {bend:.2g} pixels within the image, at most {TOLERANCE_PIXELS:g} are left out; "
            "resample the image to a tangential projection about the lens",
        )


def border(shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return column and row of the four corner pixels [y, x] = 00, 0x, y0, yx, then of the middles between."""
    right, top = shape[1] - 1.0, shape[0] - 1.0
    columns = np.array([0.0, right, 0.0, right, 0.5 * right, 0.5 * right, 0.0, right])
    return columns, np.array([0.0, 0.0, top, top, 0.0, top, 0.5 * top, 0.5 * top])


def sky_offsets(centre: FloatArray, radec: FloatArray) -> FloatArray:
    """Return the positions (x West, y North) [2, n] [arcsec] of directions [2, n] [deg] about a centre [2] [deg].

    On the tangent plane of the centre; a direction more than 90 degrees away is NaN.
    """
    ra, dec = np.deg2rad(radec)
    ra_0, dec_0 = np.deg2rad(centre)
    # small differences of the angles, not of products of their cosines: exact to 1e-9 arcsec
    half = np.sin(0.5 * (ra - ra_0)) ** 2
    east = np.cos(dec) * np.sin(ra - ra_0)
    north = np.sin(dec - dec_0) + 2.0 * np.sin(dec_0) * np.cos(dec) * half
    depth = np.cos(dec - dec_0) - 2.0 * np.cos(dec_0) * np.cos(dec) * half
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.array([-east, north]) / np.where(depth > 0.0, depth, np.nan)
    return np.rad2deg(plane) * 3600.0


def sexagesimal(ra_deg: float, dec_deg: float) -> str:
    """Return a position as hours, minutes, seconds and degrees, arcminutes, arcseconds."""
    sky: Any = SkyCoord(ra_deg, dec_deg, unit="deg")
    return str(sky.to_string("hmsdms", sep=":", precision=3, pad=True))


def _unusable(path: Path, reason: str) -> ValueError:
    return ValueError(f"{path}: its WCS cannot be used ({reason}); {_INSTEAD}")
