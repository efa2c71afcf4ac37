"""FITS files that somebody made to be read by mistake: always a `ConfigError` that names the file."""

from __future__ import annotations

import gzip
import os
import re
import resource
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from warmlens.config.file import ConfigError, expand_path
from warmlens.config.observation import FitsBandBlock
from warmlens.products.images import read_band

SHAPE = (20, 24)
CARDS = {
    "BUNIT": "electron/s", "EXPTIME": 1980.0, "BKGRMS": 0.008,
    "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 172.96, "CRVAL2": -12.53, "CRPIX1": 11.0, "CRPIX2": 9.5,
    "CD1_1": -0.05 / 3600, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 0.05 / 3600,
}  # fmt: skip


@pytest.fixture(autouse=True)
def bounded_memory() -> Iterator[None]:
    """A small file must not ask for more than 2 GiB beyond what the tests have taken already."""
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (taken + 2**31, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, limits)


def _psf(n: int = 5) -> np.ndarray:
    psf = np.zeros((n, n))
    psf[n // 2, n // 2] = 3.0
    return psf


@pytest.fixture
def block(tmp_path: Path) -> FitsBandBlock:
    fits.PrimaryHDU(np.ones(SHAPE), fits.Header(CARDS)).writeto(tmp_path / "sci.fits")
    fits.PrimaryHDU(_psf()).writeto(tmp_path / "psf.fits")
    return FitsBandBlock(science=str(tmp_path / "sci.fits"), psf=str(tmp_path / "psf.fits"))


def _refused(block: FitsBandBlock, reason: str, file: str | None = None) -> None:
    with pytest.raises(ConfigError, match=reason) as error:
        read_band("F814W", block)
    assert (file or block.science) in str(error.value) or "F814W" in str(error.value)
    assert len(str(error.value)) < 1000


def test_a_sound_image_is_read(block: FitsBandBlock) -> None:
    grid, band = read_band("F814W", block)
    assert grid.shape == SHAPE
    assert band.psf[2, 2] == 1.0


def _card(keyword: str, value: str) -> bytes:
    return f"{keyword:8s}= {value:>20s}".ljust(80).encode("latin-1")


def _raw(path: str, cards: list[bytes], data: bytes = b"") -> None:
    header = b"".join([*cards, b"END".ljust(80)])
    Path(path).write_bytes(header.ljust(-(-len(header) // 2880) * 2880) + data.ljust(-(-len(data) // 2880) * 2880))


_IMAGE = [
    _card(*card)
    for card in (("SIMPLE", "T"), ("BITPIX", "-64"), ("NAXIS", "2"), ("NAXIS1", "24"), ("NAXIS2", "20"))
]
_PIXELS = np.ones(480, dtype=">f8").tobytes()
_UNREADABLE = "not a readable FITS file, or truncated"


def _with(*changes: tuple[str, str]) -> list[bytes]:
    changed = dict(changes)
    kept = [card for card in _IMAGE if card[:8].decode().strip() not in changed]
    return [*kept[: len(_IMAGE)], *(_card(keyword, value) for keyword, value in changes)]


HEADERS: list[tuple[list[bytes], str]] = [
    (_with(("NAXIS1", "999999999"), ("NAXIS2", "999999999")), _UNREADABLE),
    (_with(("NAXIS1", "9" * 18), ("NAXIS2", "9" * 18)), _UNREADABLE),
    (_with(("NAXIS1", "-24")), _UNREADABLE),
    (_with(("NAXIS1", "0")), "holds no data"),
    (_with(("NAXIS1", "'24'")), _UNREADABLE),
    (_with(("NAXIS", "999")), _UNREADABLE),
    (_with(("NAXIS", "-1")), _UNREADABLE),
    (_with(("NAXIS", "999999999999")), _UNREADABLE),
    (_with(("NAXIS", "0")), "holds no data|not a readable"),
    (_with(("BITPIX", "7")), _UNREADABLE),
    (_with(("BITPIX", "-640000000")), _UNREADABLE),
    (_with(("BITPIX", "many")), _UNREADABLE),
    (_with(("SIMPLE", "F")), _UNREADABLE),
    (_with(("GROUPS", "T"), ("PCOUNT", "1000000000"), ("GCOUNT", "1000000000"), ("NAXIS1", "0")), "FITS|expected"),
    ([_card("SIMPLE", "T")], _UNREADABLE),
    ([*_IMAGE, b"\xff\xfe\x00\x01".ljust(80, b"\x80")], _UNREADABLE + "|no BUNIT"),
    ([*_IMAGE, _card("BUNIT", "'\xe9lectron'")], _UNREADABLE + "|BUNIT is"),
    ([*_IMAGE, _card("BZERO", "huge")], _UNREADABLE + "|no BUNIT"),
    ([*_IMAGE, _card("EXTEND", "T"), _card("BLANK", "'x'")], _UNREADABLE + "|no BUNIT"),
]


@pytest.mark.parametrize(("cards", "reason"), HEADERS, ids=range(len(HEADERS)))
def test_absurd_structures(block: FitsBandBlock, cards: list[bytes], reason: str) -> None:
    _raw(block.science, cards, _PIXELS)
    _refused(block, reason)
    _raw(block.psf, cards, _PIXELS)  # as the PSF, where no unit is asked for
    with pytest.raises(ConfigError):
        read_band("F814W", block)


@pytest.mark.parametrize(
    ("cards", "reason"),
    [
        ({"BSCALE": -1.0}, None),
        ({"BSCALE": 1e308, "BZERO": 1e308}, "not finite"),
        ({"BSCALE": np.inf}, _UNREADABLE),
        ({"EXPTIME": 0.0}, "EXPTIME is 0.0, expected a positive number"),
        ({"EXPTIME": "1980"}, "EXPTIME is '1980', expected a positive number"),
        ({"EXPTIME": True}, "EXPTIME is True, expected a positive number"),
        ({"BKGRMS": -1.0}, "BKGRMS is -1.0"),
        ({"BKGRMS": 1e200}, "BKGRMS is 1e[+]200, expected a positive number below 1e[+]30"),
        ({"BUNIT": 5}, "BUNIT is 5"),
        ({"CD1_1": 0.0, "CD2_2": 0.0}, "WCS"),
        ({"CD1_1": "nan"}, "WCS|not square"),
        ({"CD1_1": 1e-320, "CD2_2": 1e-320}, "WCS|not square"),
        ({"CD1_1": 1e300, "CD2_2": 1e300}, "WCS|not square"),
        ({"CRPIX1": 1e300}, "outside the 24 x 20 image"),
        ({"CTYPE1": "RA---XXX", "CTYPE2": "DEC--XXX"}, "WCS"),
        ({"CTYPE2": "RA---TAN"}, "WCS"),
        ({"WCSAXES": 999}, "its WCS has 999 axes, expected 2"),
        ({"A_ORDER": 2, "A_2_0": 1e-5}, "its WCS has distortion"),
        ({"CPDIS1": "LOOKUP"}, "its WCS has distortion"),
        ({"CRPIX999": 5.0, "PV2_99": 1e300}, None),
    ],
    ids=str,
)
def test_absurd_cards(block: FitsBandBlock, cards: dict[str, Any], reason: str | None) -> None:
    header = b"".join(
        _card(key, f"'{value}'" if isinstance(value, str) else "T" if value is True else str(value).upper())[:80]
        for key, value in {**CARDS, **cards}.items()
    )
    _raw(block.science, [*_IMAGE, header], _PIXELS)
    if reason is None:
        read_band("F814W", block)
    else:
        _refused(block, reason)


PSFS: list[tuple[Callable[[], np.ndarray], str | None]] = [
    (lambda: np.zeros((5, 5)), "its sum must be positive"),
    (lambda: -_psf(), "its sum must be positive"),
    (lambda: np.full((5, 5), np.nan), "25 of 25 pixels are not finite"),
    (lambda: np.full((5, 5), np.inf), "25 of 25 pixels are not finite"),
    (lambda: np.full((5, 5), 1e308), "its sum must be positive and finite"),
    (lambda: np.where(_psf() > 0, 1.0, -0.0416), "nearly cancel"),
    (lambda: np.ones((4, 4)), "size must be odd"),
    (lambda: np.ones((5, 7)), "must be a square"),
    (lambda: np.ones(5), "1 dimensions, expected an image"),
    (lambda: np.eye(5)[:, ::-1] * np.arange(5.0), "recentre the PSF"),
    (lambda: _psf(63), None),  # larger than the image
]


@pytest.mark.parametrize(("make", "reason"), PSFS, ids=range(len(PSFS)))
def test_point_spread_functions(block: FitsBandBlock, make: Callable[[], np.ndarray], reason: str | None) -> None:
    fits.PrimaryHDU(make()).writeto(block.psf, overwrite=True)
    if reason is None:
        assert read_band("F814W", block)[1].psf.sum() == 1.0
        return
    with pytest.raises(ConfigError, match=reason):
        read_band("F814W", block)


def test_images_and_maps(block: FitsBandBlock, tmp_path: Path) -> None:
    header = fits.Header(CARDS)
    for image, reason in (
        (np.full(SHAPE, np.nan), "480 unmasked pixels of the image are not finite"),
        (np.ones((2, 3, 4)), "3 dimensions"),
        (np.ones((1, 5000), dtype=np.int16), "5000 x 1 pixels, at most 4096 on a side"),
    ):
        fits.PrimaryHDU(image, header).writeto(block.science, overwrite=True)
        _refused(block, reason)
    fits.PrimaryHDU(np.ones(SHAPE), header).writeto(block.science, overwrite=True)
    for value, key, reason in (
        (0.0, "mask", "the mask leaves no pixel"),
        (np.nan, "mask", "pixels that are not finite"),
        (0.0, "weight", "the mask leaves no pixel"),
        (np.inf, "weight", "noise of 480 unmasked pixels is not positive"),
        (-1.0, "sigma", "noise of 480 unmasked pixels is not positive"),
        (np.nan, "sigma", "noise of 480 unmasked pixels is not positive"),
    ):
        path = tmp_path / "map.fits"
        fits.PrimaryHDU(np.full(SHAPE, value)).writeto(path, overwrite=True)
        with pytest.raises(ConfigError, match=reason):
            read_band("F814W", block.model_copy(update={key: str(path)}))


def test_extensions(block: FitsBandBlock) -> None:
    table = fits.BinTableHDU.from_columns([fits.Column("x", "D", array=np.ones(3))])
    packed = fits.CompImageHDU(np.ones(SHAPE), fits.Header(CARDS))
    fits.HDUList([fits.PrimaryHDU(), table, packed]).writeto(block.science, overwrite=True)
    for extension, reason in (
        (0, "holds no data"),
        (1, "holds a table"),
        (2, "with funpack"),
        (3, "has 3 extensions"),
    ):
        _refused(block.model_copy(update={"extension": extension}), reason)


def test_gzip(block: FitsBandBlock) -> None:
    content = Path(block.science).read_bytes()
    Path(block.science).write_bytes(gzip.compress(content))
    assert read_band("F814W", block)[0].shape == SHAPE
    Path(block.science).write_bytes(gzip.compress(content)[:-30])
    _refused(block, "not a readable FITS file, or truncated")
    Path(block.science).write_bytes(b"\x1f\x8b" + b"\0" * 100)
    _refused(block, "not a readable FITS file, or truncated")


def test_bombs(block: FitsBandBlock) -> None:
    """Headers and data that are declared huge, or do not end, in small files."""
    endless = b"COMMENT ".ljust(80) * 2**14
    with gzip.open(block.science, "wb", compresslevel=1) as packed:
        packed.write(b"".join(_IMAGE))
        for _ in range(2**6):
            packed.write(endless)
    _refused(block, "a header of more than 1000 blocks")
    with Path(block.science).open("wb") as sparse:
        sparse.write(b"".join(_IMAGE))
        sparse.truncate(2**40)
    _refused(block, "a header of more than 1000 blocks")
    declared = _with(("BITPIX", "8"), ("NAXIS1", "100000"), ("NAXIS2", "100000"))
    _raw(block.science, declared, _PIXELS)
    with Path(block.science).open("r+b") as sparse:
        sparse.truncate(2**40)
    _refused(block, "10000000000 bytes declared, at most 536870912 are read")
    _raw(block.science, [_card("SIMPLE", "T"), _card("BITPIX", "8"), _card("NAXIS", "0")])
    with Path(block.science).open("ab") as file:  # an extension before the one that is read
        file.write(
            Path(block.psf)
            .read_bytes()
            .replace(b"SIMPLE  =                    T", b"XTENSION= 'BINTABLE'          ")
        )
    _refused(block.model_copy(update={"extension": 2}), "extension 2 was asked for|not a readable")


def test_what_is_no_fits_file(block: FitsBandBlock, tmp_path: Path) -> None:
    science = Path(block.science)
    for content in (b"", b"S", b"PK\x03\x04", b"BZh9", b"\xfd7zXZ\0", b"\x89HDF\r\n\x1a\n", os.urandom(5000)):
        science.write_bytes(content)
        _refused(block, "not a readable FITS file")
    content = Path(block.psf).read_bytes()
    for length in (6, 80, 2879, 2880):
        science.write_bytes(content[:length])
        _refused(block, _UNREADABLE)
    science.unlink()
    os.mkfifo(science)  # reading it would wait for ever
    _refused(block, "not a file")
    science.unlink()
    science.mkdir()
    _refused(block, "not a file")
    for name in ("absent.fits", "x" * 300, "http://localhost/x.fits"):
        _refused(block.model_copy(update={"science": name}), "no such file|not readable", name.partition("//")[0])
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    _refused(block.model_copy(update={"science": str(tmp_path / "loop")}), "loop", "loop")


def test_symbolic_links_are_followed(block: FitsBandBlock, tmp_path: Path) -> None:
    (tmp_path / "link.fits").symlink_to(block.science)
    assert read_band("F814W", block.model_copy(update={"science": str(tmp_path / "link.fits")}))[0].shape == SHAPE


def test_paths(block: FitsBandBlock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    odd = tmp_path / "a b'c\"d;$(touch x)*?"
    odd.mkdir()
    Path(block.science).rename(odd / "sci ence.fits")
    monkeypatch.setenv("DATA", str(odd))
    assert read_band("F814W", block.model_copy(update={"science": "$DATA/sci ence.fits"}))[0].shape == SHAPE
    escaped = str(odd).replace("$", "$$")
    assert expand_path(f"{escaped}/x") == odd / "x"
    for text, reason in (
        ("$(touch x)/sci.fits", "write $NAME"),
        ("${DATA/sci.fits", "write $NAME"),
        ("$ABSENT_VARIABLE/sci.fits", "ABSENT_VARIABLE is not set"),
        ("~nobody_of_that_name/sci.fits", "home directory"),
        ("a\0b", "cannot be printed"),
        ("a\nb", "cannot be printed"),
        ("a{b}", "holds braces"),
        ("", "an empty path"),
    ):
        with pytest.raises(ConfigError, match=re.escape(reason)):
            expand_path(text)
