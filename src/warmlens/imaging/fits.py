"""Read images from FITS files, which may be damaged, huge or malicious."""

from __future__ import annotations

import gzip
import math
import os
import re
import warnings
from pathlib import Path
from typing import IO

import numpy as np
from astropy.io import fits

from warmlens.imaging.sky import DISTORTION
from warmlens.types import FloatArray

_BLOCK = 2880  # bytes; headers and data fill whole blocks
_MAX_HEADER_BLOCKS = 1000
_MAX_UNIT_BYTES = 2**29
_MAX_AXES, _MAX_COLUMNS = 9, 999
_GZIP = b"\x1f\x8b"
# Cards that declare sizes: in any spelling, and in the only one that is accepted.
_STRUCTURE = re.compile(rb"\s*(HIERARCH\s+)?(BITPIX|NAXIS\d*|PCOUNT|GCOUNT|TFIELDS)\b", re.IGNORECASE)
_STRUCTURE_CARD = re.compile(rb"(BITPIX|NAXIS\d{0,3}|PCOUNT|GCOUNT|TFIELDS) *= +(-?\d{1,18}) *(/.*)?", re.DOTALL)
_BITPIX = (8, 16, 32, 64, -32, -64)
# Only these keywords are kept: units, noise, and all that the WCS of an image of two axes can have. Cards of more
# axes, which a parser makes room for, and of projections with more parameters than there are, are left out.
_KEPT = re.compile(
    r"BUNIT|EXPTIME|BKGRMS|RADEC?SYS|EQUINOX|EPOCH|WCSAXES|LONPOLE|LATPOLE"
    r"|(CTYPE|CUNIT|CRVAL|CRPIX|CDELT|CROTA)[12]|(CD|PC)[12]_[12]|PC00[12]00[12]|P[VS][12]_[1-3]?\d"
)


class _UnsuitableError(ValueError):
    """A file that is readable but does not hold the image that is needed."""


def read_image(path: Path, extension: int, max_side: int) -> tuple[FloatArray, fits.Header]:
    """Read the image [y, x] of one extension, at most `max_side` pixels on a side, and the header keywords in use.

    Raises
    ------
    ValueError
        With the file, its content, what was expected and what to do.
    """
    if not os.path.exists(path):  # noqa: PTH110 (a path that the system refuses is no file either)
        raise ValueError(f"{path}: no such file; correct the path under observation.fits")
    if not path.is_file():
        raise ValueError(f"{path}: not a file; correct the path under observation.fits")
    try:
        _check_structure(path, extension, max_side)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", message="File may have been truncated")
            # read as a table, a compressed image is refused: the size that its tiles inflate to is not declared
            with fits.open(path, memmap=False, disable_image_compression=True) as hdus:
                hdu = hdus[extension]
                if not isinstance(hdu, fits.PrimaryHDU | fits.ImageHDU):
                    raise _not_an_image(extension, "a table (a compressed image must be unpacked, with funpack)")
                return np.array(hdu.data, dtype=np.float64), _kept_header(hdu.header, hdus[0].header)
    except _UnsuitableError as error:
        raise ValueError(f"{path}: {error}") from None
    except MemoryError:
        raise
    except Exception as error:  # astropy raises errors of many classes
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise ValueError(f"{path}: not a readable FITS file, or truncated ({reason})") from error


def _check_structure(path: Path, extension: int, max_side: int) -> None:
    """Check the sizes in all headers up to that extension: astropy loops over them and allocates them."""
    with path.open("rb") as packed:
        start = packed.read(6)
        packed.seek(0)
        if start != b"SIMPLE" and start[:2] != _GZIP:
            raise ValueError("it begins with neither SIMPLE nor a gzip header")
        handle: IO[bytes] = gzip.GzipFile(fileobj=packed) if start[:2] == _GZIP else packed  # type: ignore[assignment]
        for number in range(extension + 1):
            shape, n_bytes = _read_unit(handle)
            if shape is None:
                raise _UnsuitableError(
                    f"has {number} extensions, extension {extension} was asked for; "
                    "set observation.fits.BAND.extension"
                )
            handle.seek(-(-n_bytes // _BLOCK) * _BLOCK, 1)
    assert shape is not None
    if not shape or min(shape) < 1:
        raise _not_an_image(extension, "no data")
    if len(shape) != 2:
        raise _not_an_image(extension, f"{len(shape)} dimensions")
    if max(shape) > max_side:
        raise _UnsuitableError(
            f"{shape[0]} x {shape[1]} pixels, at most {max_side} on a side are read; cut out the lens"
        )


def _read_unit(handle: IO[bytes]) -> tuple[tuple[int, ...] | None, int]:
    """Read one header; return axes (x first; None at the end of the file) and bytes of its data."""
    sizes: dict[str, int] = {}
    for number in range(_MAX_HEADER_BLOCKS):
        block = handle.read(_BLOCK)
        if not block and not number:
            return None, 0
        for card in (block[i : i + 80] for i in range(0, len(block), 80)):
            if card.rstrip() == b"END":
                return _axes_and_bytes(sizes)
            if _STRUCTURE.match(card):
                keyword_and_size = _STRUCTURE_CARD.fullmatch(card)
                if keyword_and_size is None:
                    raise ValueError(f"bad card {card[:40]!r}")
                sizes.setdefault(keyword_and_size[1].decode(), int(keyword_and_size[2]))
        if len(block) < _BLOCK:
            raise ValueError("a header without an end")
    raise ValueError(f"a header of more than {_MAX_HEADER_BLOCKS} blocks")


def _axes_and_bytes(sizes: dict[str, int]) -> tuple[tuple[int, ...], int]:
    n_axes = sizes.get("NAXIS", -1)
    if not (0 <= n_axes <= _MAX_AXES and 0 <= sizes.get("TFIELDS", 0) <= _MAX_COLUMNS):
        raise ValueError(f"NAXIS {n_axes}, TFIELDS {sizes.get('TFIELDS', 0)}")
    axes = tuple(sizes.get(f"NAXIS{i}", -1) for i in range(1, n_axes + 1))
    groups, extra, bits = sizes.get("GCOUNT", 1), sizes.get("PCOUNT", 0), sizes.get("BITPIX")
    if min(*axes, groups, extra) < 0 or bits not in _BITPIX:
        raise ValueError(f"BITPIX {bits}, axes {axes}, PCOUNT {extra}, GCOUNT {groups}")
    n_bytes = abs(bits) // 8 * groups * (extra + math.prod(axes)) if axes else 0
    if n_bytes > _MAX_UNIT_BYTES:
        raise ValueError(f"{n_bytes} bytes declared, at most {_MAX_UNIT_BYTES} are read; cut out the lens")
    return axes, n_bytes


def _not_an_image(extension: int, content: str) -> _UnsuitableError:
    return _UnsuitableError(
        f"extension {extension} holds {content}, expected an image [y, x]; for the science image set "
        "observation.fits.BAND.extension, write any other image to a file's first extension"
    )


def _kept_header(header: fits.Header, primary: fits.Header) -> fits.Header:
    kept = fits.Header()
    for keyword in header:
        if _KEPT.fullmatch(keyword) or DISTORTION.fullmatch(keyword):
            kept[keyword] = header[keyword]
    if "EXPTIME" not in kept and "EXPTIME" in primary:  # as in drizzled HST images
        kept["EXPTIME"] = primary["EXPTIME"]
    return kept
