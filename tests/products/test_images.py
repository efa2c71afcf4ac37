from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.config.observation import FitsBandBlock
from warmlens.imaging.noise_correlation import neighbours
from warmlens.products.images import input_files, read_band, read_fits
from warmlens.products.observation import observation_datasets, read_observation

SHAPE = (20, 24)


def _header(**changes: Any) -> fits.Header:
    cards = {
        "BUNIT": "electron/s", "EXPTIME": 1980.0, "BKGRMS": 0.008,
        "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 172.96, "CRVAL2": -12.53,
        "CRPIX1": 11.0, "CRPIX2": 9.5,
        "CD1_1": -0.05 / 3600, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 0.05 / 3600,
    }  # fmt: skip
    return fits.Header({key: value for key, value in {**cards, **changes}.items() if value is not None})


def _write(
    folder: Path, image: np.ndarray | None = None, psf: np.ndarray | None = None, **header: Any
) -> FitsBandBlock:
    if image is None:
        image = np.arange(480.0, dtype=np.float32).reshape(SHAPE) / 100
    if psf is None:
        psf = np.zeros((5, 5))
        psf[2, 2] = 3.0
    fits.PrimaryHDU(image, _header(**header)).writeto(folder / "sci.fits", overwrite=True)
    fits.PrimaryHDU(psf).writeto(folder / "psf.fits", overwrite=True)
    return FitsBandBlock(science=str(folder / "sci.fits"), psf=str(folder / "psf.fits"))


def test_image_grid_and_noise(tmp_path: Path) -> None:
    grid, band = read_band("F814W", _write(tmp_path))
    x, y = grid.coordinates()
    assert grid.pixel_scale == pytest.approx(0.05)
    # CRPIX is the origin; columns run to the West, rows to the North
    assert x[0, 10] == pytest.approx(0.0, abs=1e-9)
    assert y[8, 0] == pytest.approx(-0.025)
    assert x[0, 11] == pytest.approx(0.05)
    np.testing.assert_allclose(band.sigma, np.hypot(0.008, np.sqrt(band.image / 1980.0)))
    assert band.mask.all()
    assert band.image[1, 2] == pytest.approx(0.26)


def test_rotated_image(tmp_path: Path) -> None:
    c, s = np.cos(0.5) * 0.05 / 3600, np.sin(0.5) * 0.05 / 3600
    grid, _ = read_band("F814W", _write(tmp_path, CD1_1=-c, CD1_2=s, CD2_1=s, CD2_2=c))
    x, y = grid.coordinates()
    # a step along the columns goes 0.05 cos(0.5) to the West and 0.05 sin(0.5) to the North
    assert x[0, 1] - x[0, 0] == pytest.approx(0.05 * np.cos(0.5))
    assert y[0, 1] - y[0, 0] == pytest.approx(0.05 * np.sin(0.5))
    assert x[1, 0] - x[0, 0] == pytest.approx(-0.05 * np.sin(0.5))


def test_extension_takes_its_exposure_from_the_primary_header(tmp_path: Path) -> None:
    """As in drizzled HST images."""
    block = _write(tmp_path).model_copy(update={"extension": 1})
    primary = fits.PrimaryHDU(header=fits.Header({"EXPTIME": 500.0}))
    image = fits.ImageHDU(np.ones(SHAPE), _header(EXPTIME=None, BUNIT="electron / s"))
    fits.HDUList([primary, image]).writeto(tmp_path / "sci.fits", overwrite=True)
    _, band = read_band("F814W", block)
    assert band.noise.exposure_s == 500.0


def test_pixel_scale_and_centre_replace_the_wcs(tmp_path: Path) -> None:
    block = _write(tmp_path, CTYPE1=None, CTYPE2=None)
    with pytest.raises(ValueError, match="no celestial WCS"):
        read_band("F814W", block)
    grid, _ = read_band("F814W", block.model_copy(update={"pixel_scale_arcsec": 0.04, "center_pixel": (3.0, 4.0)}))
    x, y = grid.coordinates()
    assert (x[4, 3], y[4, 3]) == pytest.approx((0.0, 0.0))
    assert grid.pixel_scale == pytest.approx(0.04)


def test_noise_and_weight_maps(tmp_path: Path) -> None:
    block = _write(tmp_path, EXPTIME=None, BKGRMS=None)
    sigma = np.full(SHAPE, 0.25)
    fits.PrimaryHDU(sigma).writeto(tmp_path / "sigma.fits")
    weight = np.full(SHAPE, 16.0)
    weight[0, 0] = 0.0
    fits.PrimaryHDU(weight).writeto(tmp_path / "weight.fits")
    _, with_sigma = read_band("F814W", block.model_copy(update={"sigma": str(tmp_path / "sigma.fits")}))
    _, with_weight = read_band("F814W", block.model_copy(update={"weight": str(tmp_path / "weight.fits")}))
    assert np.all(with_sigma.sigma == 0.25)
    assert not with_weight.mask[0, 0]
    np.testing.assert_allclose(with_weight.weights.ravel()[1:], 4.0)
    assert with_weight.weights[0, 0] == 0.0


def _sky(folder: Path, width: int) -> FitsBandBlock:
    """64 x 64 pixels of sky, noise of 0.008 that is averaged over neighbours along rows."""
    noise = np.random.default_rng(1).standard_normal((64, 64 + width - 1))
    mean = np.lib.stride_tricks.sliding_window_view(noise, width, axis=1).sum(axis=-1) / np.sqrt(width)
    return _write(folder, 0.008 * mean)


def test_noise_correlation_from_blank_sky(tmp_path: Path) -> None:
    block = _sky(tmp_path, 2).model_copy(update={"blank_sky_arcsec": 0.5})
    _, band = read_band("F814W", block)
    assert band.noise.correlation is not None
    row, column, diagonal = neighbours(band.noise.correlation)
    assert row == pytest.approx(0.5, abs=0.06)
    assert column == pytest.approx(0.0, abs=0.06)
    assert diagonal == pytest.approx(0.0, abs=0.06)
    assert band.noise.background_rms == 0.008
    with pytest.raises(ValueError, match=r"F814W.blank_sky_arcsec: 2.8: \d+ unmasked pixels of blank sky"):
        read_band("F814W", block.model_copy(update={"blank_sky_arcsec": 2.8}))


def test_noise_correlation_of_the_user(tmp_path: Path) -> None:
    block = _write(tmp_path)
    _, plain = read_band("F814W", block)
    assert plain.noise.correlation is None
    path = tmp_path / "correlation.fits"
    block = block.model_copy(update={"noise_correlation": str(path)})
    assert input_files(block)["noise_correlation"] == path
    fits.PrimaryHDU(np.array([[0.0, 0.6, 0.0], [0.4, 2.0, 0.4], [0.0, 0.6, 0.0]])).writeto(path)
    _, band = read_band("F814W", block)
    assert band.noise.correlation is not None
    assert neighbours(band.noise.correlation) == pytest.approx((0.2, 0.3, 0.0))
    fits.PrimaryHDU(np.ones((3, 4))).writeto(path, overwrite=True)
    with pytest.raises(ValueError, match=r"correlation\.fits: a correlation function has equal, odd sides"):
        read_band("F814W", block)
    with pytest.raises(ValueError, match="either noise_correlation or blank_sky_arcsec"):
        FitsBandBlock.model_validate({**block.model_dump(), "blank_sky_arcsec": 1.0})


def test_correlation_survives_the_artifact(tmp_path: Path) -> None:
    block = _sky(tmp_path, 2).model_copy(update={"blank_sky_arcsec": 0.5})
    observed = read_fits({"A": block, "B": block.model_copy(update={"blank_sky_arcsec": None})})
    path = tmp_path / "observation.h5"
    write_artifact(path, Provenance("observation", {"test": 1}), *observation_datasets(observed))
    again = read_observation(path)
    np.testing.assert_array_equal(again.bands[0].noise.correlation, observed.bands[0].noise.correlation)
    assert again.bands[1].noise == observed.bands[1].noise


def test_mask(tmp_path: Path) -> None:
    image = np.ones(SHAPE)
    image[3, 4] = np.nan
    block = _write(tmp_path, image)
    with pytest.raises(ValueError, match=r"F814W: 1 unmasked pixels of the image are not finite"):
        read_band("F814W", block)
    fits.PrimaryHDU(np.isfinite(image).astype(np.int16)).writeto(tmp_path / "mask.fits")
    _, band = read_band("F814W", block.model_copy(update={"mask": str(tmp_path / "mask.fits")}))
    assert (~band.mask).sum() == 1


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        ({"BUNIT": "counts"}, "BUNIT is 'counts', expected electron/s"),
        ({"BUNIT": None}, "no BUNIT"),
        ({"EXPTIME": None}, "no keyword EXPTIME; set observation.fits.BAND.exposure_s"),
        ({"BKGRMS": None}, "no keyword BKGRMS"),
        ({"EXPTIME": -5.0}, "EXPTIME is -5.0, expected a positive number"),
        ({"CD1_1": -0.06 / 3600}, "not square"),
        ({"CD1_2": 0.02 / 3600}, "not square"),
        ({"CRPIX1": 500.0}, "outside the 24 x 20 image"),
    ],
)
def test_headers_that_do_not_fit(tmp_path: Path, header: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as error:
        read_band("F814W", _write(tmp_path, **header))
    assert "sci.fits" in str(error.value)


def test_files_that_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"band F814W.*odd"):
        read_band("F814W", _write(tmp_path, psf=np.ones((4, 4))))
    with pytest.raises(ValueError, match="3 dimensions, expected an image"):
        read_band("F814W", _write(tmp_path, np.ones((2, 20, 24))))
    block = _write(tmp_path)
    with pytest.raises(ValueError, match="has 1 extensions, extension 2 was asked for"):
        read_band("F814W", block.model_copy(update={"extension": 2}))
    with pytest.raises(ValueError, match="no such file; correct the path"):
        read_band("F814W", block.model_copy(update={"psf": str(tmp_path / "absent.fits")}))
    fits.PrimaryHDU(np.ones((3, 3))).writeto(tmp_path / "mask.fits")
    with pytest.raises(ValueError, match=r"the mask has shape \(3, 3\), the science image \(20, 24\)"):
        read_band("F814W", block.model_copy(update={"mask": str(tmp_path / "mask.fits")}))
    science = tmp_path / "sci.fits"
    science.write_bytes(science.read_bytes()[:3500])
    with pytest.raises(ValueError, match="not a readable FITS file, or truncated"):
        read_band("F814W", block)


def test_bands_must_share_their_pixels(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    blocks = {"A": _write(tmp_path), "B": _write(tmp_path / "b", CRPIX1=11.5)}
    with pytest.raises(ValueError, match="band B lies on other pixels than band A"):
        read_fits(blocks)
    assert len(read_fits({"A": blocks["A"], "B": blocks["A"]}).bands) == 2


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("sigma", 1e8, None),
        ("sigma", np.inf, None),
        ("sigma", 1e4 * 0.25, None),
        ("weight", 1e-20, None),
        ("weight", np.nan, None),
        ("sigma", 0.0, "noise of 100 unmasked pixels is not positive"),
        ("sigma", np.nan, "noise of 100 unmasked pixels is not positive"),
        ("weight", np.inf, "noise of 100 unmasked pixels is not positive"),
        ("sigma", 20.0 * 0.25, r"noise of 96 used pixels .* is more than 10 times that of the quiet ones \(0\.25"),
        ("sigma", 1e-4, "noise of 100 used pixels .* is less than a thirtieth of that of the quiet ones"),
    ],
)
def test_pixels_that_a_noise_map_ignores(tmp_path: Path, key: str, value: float, reason: str | None) -> None:
    """They are masked; what may be either is refused."""
    block = _write(tmp_path, np.arange(9600.0).reshape(80, 120) / 2000)
    values = np.full((80, 120), 0.25 if key == "sigma" else 16.0)
    values[:1, :100] = value
    fits.PrimaryHDU(values).writeto(tmp_path / "map.fits")
    block = block.model_copy(update={key: str(tmp_path / "map.fits")})
    if value == 20.0 * 0.25:  # 1% may be edges of a mosaic, 6% are refused
        read_band("F814W", block)
        values[:5] = value
        fits.PrimaryHDU(values).writeto(tmp_path / "map.fits", overwrite=True)
        reason = r"noise of 600 used pixels \(6\.2%\) is more than 10 times that of the quiet ones \(0\.25"
    if reason is None:
        assert np.count_nonzero(~read_band("F814W", block)[1].mask) == 100
    else:
        with pytest.raises(ValueError, match=reason):
            read_band("F814W", block)


@pytest.mark.skipif("WARMLENS_HST_DATA" not in os.environ, reason="WARMLENS_HST_DATA is not set: no real image")
def test_real_image() -> None:
    folder = os.environ["WARMLENS_HST_DATA"]
    block = FitsBandBlock(science=f"{folder}/sci.fits", psf=f"{folder}/psf.fits", mask=f"{folder}/arc_mask.fits")
    grid, band = read_band("F814W", block)
    assert grid.shape == (160, 160)
    assert band.mask.sum() == 11_285
    # the mass centre lies at (4.420", 3.932") of a frame in which pixel i is at 0.05" (i + 1)
    assert grid.origin_x == pytest.approx(0.05 - 4.420, abs=1e-3)
    assert grid.origin_y == pytest.approx(0.05 - 3.932, abs=1e-3)
    # quasar B is the brightest: its peak lies where it was published
    row, column = np.unravel_index(np.argmax(band.image), grid.shape)
    x, y = grid.coordinates()
    assert np.hypot(x[row, column] + 2.076, y[row, column] - 0.662) < 0.05


@pytest.mark.skipif("WARMLENS_HST_DATA" not in os.environ, reason="WARMLENS_HST_DATA is not set: no real image")
def test_noise_of_the_real_image_is_correlated() -> None:
    """Drizzled: neighbours alike along rows and columns, less across, hardly two pixels apart."""
    folder = os.environ["WARMLENS_HST_DATA"]
    block = FitsBandBlock(science=f"{folder}/sci.fits", psf=f"{folder}/psf.fits", blank_sky_arcsec=4.8)
    _, band = read_band("F814W", block)
    correlation = band.noise.correlation
    assert correlation is not None
    row, column, diagonal = neighbours(correlation)
    assert 0.2 < row < 0.35
    assert 0.2 < column < 0.35
    assert 0.05 < diagonal < 0.15
    assert abs(correlation[0]).max() < 0.1
    assert abs(correlation[:, 0]).max() < 0.1
