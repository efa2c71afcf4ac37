"""Positions on the sky are those of astropy's whole WCS, or the image is refused."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS, FITSFixedWarning

from warmlens.config.observation import FitsBandBlock
from warmlens.imaging.sky import border, sexagesimal, sky_offsets
from warmlens.products.images import read_all, read_files

from ..reliability import Outcome, fault

SHAPE = (60, 70)
STEP = 0.08 / 3600.0
ROLLED = {"CD1_1": -0.8 * STEP, "CD1_2": 0.6 * STEP, "CD2_1": 0.6 * STEP, "CD2_2": 0.8 * STEP}
CARDS: dict[str, Any] = {
    "BUNIT": "electron/s", "EXPTIME": 1980.0, "BKGRMS": 0.008,
    "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 211.6, "CRVAL2": -44.3, "CRPIX1": 31.4, "CRPIX2": 25.7,
    **ROLLED,
}  # fmt: skip
NO_CD = dict.fromkeys(ROLLED)
SIDES = {"CDELT1": -STEP, "CDELT2": STEP}
PC = {"PC1_1": 0.8, "PC1_2": -0.6, "PC2_1": 0.6, "PC2_2": 0.8}
MAS = 1.0e-3 / 3600.0


def band(folder: Path, name: str = "a", extension: int = 0, **changes: Any) -> FitsBandBlock:
    cards = {key: value for key, value in {**CARDS, **changes}.items() if value is not None}
    image = np.random.default_rng(1).normal(0.0, 0.008, SHAPE)
    kind = fits.ImageHDU if extension else fits.PrimaryHDU
    units = [fits.PrimaryHDU()] * extension + [kind(image, fits.Header(cards))]
    fits.HDUList(units).writeto(folder / f"{name}.fits", overwrite=True)
    psf = np.zeros((5, 5))
    psf[2, 2] = 1.0
    fits.PrimaryHDU(psf).writeto(folder / "psf.fits", overwrite=True)
    return FitsBandBlock(science=str(folder / f"{name}.fits"), psf=str(folder / "psf.fits"), extension=extension)


SWAPPED = {
    "CTYPE1": "DEC--TAN", "CTYPE2": "RA---TAN", "CRVAL1": -44.3, "CRVAL2": 211.6,
    "CD1_1": ROLLED["CD2_1"], "CD1_2": ROLLED["CD2_2"], "CD2_1": ROLLED["CD1_1"], "CD2_2": ROLLED["CD1_2"],
}  # fmt: skip


@pytest.mark.parametrize(
    "changes",
    [
        {},
        SWAPPED,
        {**NO_CD, **SIDES, **PC},
        {**NO_CD, **SIDES, "CROTA2": 25.0},
        {**NO_CD, **SIDES, **{key.replace("PC", "PC00").replace("_", "00"): value for key, value in PC.items()}},
        {"CTYPE1": "RA---SIN", "CTYPE2": "DEC--SIN"},
        {"CTYPE1": "RA---CAR", "CTYPE2": "DEC--CAR"},
        {"CTYPE1": "GLON-TAN", "CTYPE2": "GLAT-TAN", "CRVAL1": 316.0, "CRVAL2": 16.0},
        {"LONPOLE": 90.0},
        {"PV1_3": 90.0},
        {"EQUINOX": 1950.0},
        {"CTYPE1": "RA---TPV", "CTYPE2": "DEC--TPV", "PV1_1": 1.0, "PV2_1": 1.0},
        {"CRVAL2": 90.0 - 10.0 / 3600.0},
        {"CRVAL2": 90.0 - 1.0 / 3600.0},  # the pole lies in the image
        {"CRPIX1": 4000.0, "CRPIX2": -3000.0, "CRVAL2": -80.0},
        {"CD1_1": 0.8 * STEP, "CD2_1": -0.6 * STEP},
    ],
    ids=lambda changes: " ".join(f"{key}={value}" for key, value in changes.items())[:40] or "plain",
)
def test_positions_are_those_of_astropy(tmp_path: Path, changes: dict[str, Any]) -> None:
    far = "CRPIX1" in changes
    block = band(tmp_path, **changes)
    read = read_files("A", block.model_copy(update={"center_pixel": (30.0, 25.0)}) if far else block)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)  # of PC001001
        wcs = WCS(fits.getheader(block.science))
    columns, rows = border(SHAPE)
    there = wcs.pixel_to_world(columns, rows).icrs
    east, north = wcs.pixel_to_world(*read.origin).icrs.spherical_offsets_to(there)
    x, y = read.grid.to_sky(columns, rows)
    np.testing.assert_allclose(x, -east.arcsec, atol=1e-5)
    np.testing.assert_allclose(y, north.arcsec, atol=1e-5)


@fault(
    "Images",
    "the WCS is none that square pixels have",
    "distortion, pole, ecliptic axes, no projection",
    quick=True,
)
@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"A_ORDER": 2, "A_2_0": 1e-4}, "its WCS has distortion"),
        ({"CTYPE1": "RA---TNX", "CTYPE2": "DEC--TNX"}, "its WCS has distortion"),
        ({"CTYPE1": "RA---TPV", "CTYPE2": "DEC--TPV", "PV1_1": 1.0, "PV2_1": 1.0, "PV1_4": 300.0}, "it bends by"),
        ({"CTYPE1": "ELON-TAN", "CTYPE2": "ELAT-TAN"}, "expected RA and DEC, or GLON and GLAT"),
        ({"CTYPE1": "DEC--TAN"}, "WCS"),
        ({"CTYPE1": "DEC--TAN", "CTYPE2": "RA---TAN"}, "its WCS cannot be used"),
        ({"CRVAL2": 90.0}, "a pole, where no direction is North"),
        ({"RADESYS": "GAPPT"}, "its WCS cannot be used"),
        ({"CD1_1": -0.81 * STEP}, "not square"),
    ],
)
def test_a_wcs_that_bends_or_is_none_is_refused(
    tmp_path: Path, changes: dict[str, Any], reason: str, outcome: Outcome
) -> None:
    with pytest.raises(ValueError, match=reason) as error:
        read_files("A", band(tmp_path, **changes))
    outcome.stops(str(error.value), "WCS" if "WCS" in str(error.value) else "not square", "a.fits")


def test_pixels_that_are_square_within_the_tolerance_are_made_square(tmp_path: Path) -> None:
    """WFI J2033-4723 as published has pixels of 0.05005 by 0.05 arcsec: 0.03 pixels at the corners."""
    read = read_files("A", band(tmp_path, **{key: value * 1.001 for key, value in ROLLED.items() if "_1" in key}))
    assert read.grid.pixel_scale == pytest.approx(0.08004, rel=1e-6)
    axes = np.array(read.grid.axes)
    np.testing.assert_allclose(axes.T @ axes, np.eye(2), atol=1e-12)


@fault(
    "Images",
    "a band lies elsewhere on the sky",
    'CRVAL off by 8 mas, 0.2" and a degree; turned; mirrored',
    quick=True,
)
@pytest.mark.parametrize(
    ("changes", "offset"),
    [
        ({"CRVAL2": -44.3 + 8.0 * MAS}, r"0\.1 pixels \(0\.008 arcsec; .* West, \+0\.008 North on average\)"),
        ({"CRVAL1": 211.6 + 8.0 * MAS}, r"0\.0716 pixels \(0\.00573 arcsec; -0\.00573 West"),
        ({"CRVAL2": -44.3 + 200.0 * MAS}, r"2\.5 pixels \(0\.2 arcsec"),
        ({"CRVAL1": 212.6}, r"3\.22e\+04 pixels"),
        ({"CRVAL1": 31.6, "CRVAL2": 44.3}, "pixels"),
        ({"CRPIX1": 31.7}, r"0\.3 pixels \(0\.024 arcsec"),
        (
            {"CD1_1": -0.8016 * STEP, "CD1_2": 0.5979 * STEP, "CD2_1": 0.5979 * STEP, "CD2_2": 0.8016 * STEP},
            "pixels",
        ),
        ({"CD1_1": 0.8 * STEP, "CD2_1": -0.6 * STEP}, "pixels"),
    ],
)
def test_a_band_elsewhere_on_the_sky_is_refused(
    tmp_path: Path, changes: dict[str, Any], offset: str, outcome: Outcome
) -> None:
    with pytest.raises(ValueError, match=offset) as error:
        read_all({"A": band(tmp_path), "B": band(tmp_path, "b", **changes)})
    outcome.stops(str(error.value), "lies on other pixels than band A", "align the images")


@pytest.mark.parametrize(
    "changes",
    [
        {"CRPIX1": 31.4 + 1e-9},
        {"CRPIX1": 31.4 - 0.01, "CRVAL2": -44.3 + 1.0 * MAS},
        {"extension": 1},
        {"RADESYS": "FK5", "EQUINOX": 2000.0},
        SWAPPED,
        {**NO_CD, **SIDES, **PC},
    ],
    ids=["rounding", "a mas", "extension", "FK5", "axes swapped", "PC"],
)
def test_a_band_on_the_same_pixels_of_the_sky_is_accepted(tmp_path: Path, changes: dict[str, Any]) -> None:
    """Whatever its header looks like."""
    first, second = read_all({"A": band(tmp_path), "B": band(tmp_path, "b", **changes)})
    assert second.grid.shape == first.grid.shape


def test_another_reference_pixel_of_the_same_sky_is_accepted(tmp_path: Path) -> None:
    here = WCS(fits.Header(CARDS)).pixel_to_world(10.0, 20.0)
    other = {"CRPIX1": 11.0, "CRPIX2": 21.0, "CRVAL1": here.ra.deg, "CRVAL2": here.dec.deg}
    blocks = {"A": band(tmp_path), "B": band(tmp_path, "b", **other)}
    assert len(read_all(blocks)) == 2
    blocks["B"] = blocks["B"].model_copy(update={"center_pixel": (10.0, 20.0)})
    with pytest.raises(ValueError, match=r"the origin is pixel \[10\.00, 20\.00\] against \[30\.40, 24\.70\]"):
        read_all(blocks)


def test_a_band_without_a_wcs_is_compared_by_its_grid(tmp_path: Path) -> None:
    north_up = {"CD1_1": -STEP, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": STEP}
    instead = {"pixel_scale_arcsec": 0.08, "center_pixel": (30.4, 24.7)}
    plain = band(tmp_path, "b", CTYPE1=None, CTYPE2=None).model_copy(update=instead)
    assert len(read_all({"A": band(tmp_path, **north_up), "B": plain})) == 2
    with pytest.raises(ValueError, match="lies on other pixels"):
        read_all({"A": band(tmp_path), "B": plain})
    other = plain.model_copy(update={"pixel_scale_arcsec": 0.081})
    with pytest.raises(ValueError, match="lies on other pixels"):
        read_all({"A": band(tmp_path, **north_up), "B": other})


def test_offsets_are_on_the_tangent_plane() -> None:
    centre = np.array([359.9999, 89.5])
    radec = np.array([[0.0001], [89.5]])
    east, north = 0.0002 * np.cos(np.deg2rad(89.5)) * 3600.0, 0.0
    np.testing.assert_allclose(sky_offsets(centre, radec)[:, 0], [-east, north], atol=1e-7)
    assert np.isnan(sky_offsets(centre, np.array([[180.0], [-10.0]]))).all()
    assert sexagesimal(211.6, -44.3) == "14:06:24.000 -44:18:00.000"
