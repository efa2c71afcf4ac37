"""PSF: convolution against a direct sum, adjoint, point sources, the HST-like model."""

import os

import numpy as np
import pytest
from astropy.io import fits
from scipy import signal

from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import Convolution, core_offset, fwhm, hst_like_psf, point_source, validate_psf


@pytest.fixture
def rng():
    return np.random.default_rng(11)


@pytest.mark.parametrize("kernel_size", [1, 7, 31, 61])
@pytest.mark.parametrize("shape", [(20, 24), (31, 17)])
def test_forward_is_the_direct_sum(rng, kernel_size, shape):
    """Also for a kernel larger than the image, where the FFT could wrap around."""
    psf, images = rng.normal(size=(kernel_size, kernel_size)), rng.normal(size=(3, *shape))
    middle = kernel_size // 2
    convolved = Convolution(psf, shape).forward(images)
    for image, result in zip(images, convolved, strict=True):
        full = signal.convolve2d(image, psf, mode="full")
        expected = full[middle : middle + shape[0], middle : middle + shape[1]]
        np.testing.assert_allclose(result, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kernel_size", [9, 51])
def test_adjoint(rng, kernel_size):
    """<a, P b> = <P^T a, b>, and P^T differs from P for a PSF without symmetry."""
    convolution = Convolution(rng.normal(size=(kernel_size, kernel_size)), (22, 25))
    a, b = rng.normal(size=(2, 22, 25))
    assert np.sum(a * convolution.forward(b)) == pytest.approx(np.sum(convolution.adjoint(a) * b), rel=1e-12)
    assert abs(np.sum(a * convolution.forward(b)) - np.sum(convolution.forward(a) * b)) > 0.1


def test_convolution_of_many_images_in_blocks(rng):
    convolution = Convolution(hst_like_psf(814.0, 0.05, 21), (120, 120))
    images = rng.normal(size=(2, 20, 120, 120))
    np.testing.assert_allclose(
        convolution.forward(images)[1, 7], convolution.forward(images[1, 7]), rtol=0, atol=1e-14
    )


def test_convolution_refuses_other_shapes():
    with pytest.raises(ValueError, match="odd"):
        Convolution(np.ones((4, 4)), (8, 8))
    with pytest.raises(ValueError, match="8, 8"):
        Convolution(np.ones((3, 3)), (8, 8)).forward(np.ones((8, 9)))


def good_psf():
    return hst_like_psf(814.0, 0.05, 11)


def off_centre():
    return np.roll(good_psf(), 3, axis=1)


@pytest.mark.parametrize(
    ("psf", "message"),
    [
        (np.ones(9), "square"),
        (np.ones((5, 7)), "square"),
        (np.ones((6, 6)), "odd"),
        (np.where(good_psf() == good_psf().max(), np.nan, good_psf()), "1 of 121"),
        (-good_psf(), "positive"),
        (off_centre(), "middle"),
    ],
)
def test_bad_psf_is_named(psf, message):
    with pytest.raises(ValueError, match=rf"F814W.*{message}"):
        validate_psf(psf, "F814W")


def test_psf_is_normalised():
    np.testing.assert_allclose(validate_psf(7.0 * good_psf(), "F814W"), good_psf(), rtol=1e-14)


def test_hst_psf_widths():
    """F814W at 0.05": 5 pixels above half the peak (diameter 0.126") as the ACS image has; blue: less."""
    red, blue = hst_like_psf(814.0, 0.05, 161), hst_like_psf(555.0, 0.05, 161)
    assert np.count_nonzero(red > 0.5 * red.max()) == 5
    assert red.max() == pytest.approx(0.1216, rel=0.06)  # peak of the empirical ACS PSF
    assert 0.09 < fwhm(blue, 0.05) < fwhm(red, 0.05) < 0.126
    assert red.sum() == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(red, red.T, atol=1e-15)
    np.testing.assert_allclose(red, red[::-1, ::-1], atol=1e-12)


def test_airy_rings():
    """Without blur and obscuration, one wavelength: first zero at 1.22 lambda / D, width 1.03 lambda / D."""
    scale = 0.004
    psf = hst_like_psf(800.0, scale, 101, diameter_m=2.4, obscuration=0.0, blur_arcsec=0.0, relative_bandwidth=0.0)
    lambda_over_d = np.degrees(800e-9 / 2.4) * 3600.0
    profile = psf[50, 50:]
    assert np.argmin(profile[:30]) * scale == pytest.approx(1.2197 * lambda_over_d, abs=scale)
    assert fwhm(psf, scale) == pytest.approx(1.029 * lambda_over_d, rel=0.01)


def test_fwhm_of_a_gaussian():
    y, x = np.mgrid[-15:16, -15:16]
    psf = np.exp(-0.5 * (x**2 + y**2) / 1.4**2)
    assert fwhm(psf, 0.05) == pytest.approx(0.05 * 1.4 * 2.0 * np.sqrt(2.0 * np.log(2.0)), rel=5e-3)


@pytest.mark.parametrize("parameters", [{"n_pix": 20}, {"obscuration": 1.0}, {"blur_arcsec": -0.1}])
def test_impossible_telescopes_are_refused(parameters):
    arguments = {"wavelength_nm": 814.0, "pixel_scale_arcsec": 0.05, "n_pix": 21} | parameters
    with pytest.raises(ValueError, match=next(iter(parameters))):
        hst_like_psf(**arguments)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.5, -0.5), (0.23, 0.41), (-0.37, 0.08)])
def test_point_source_flux_and_centroid(offset):
    grid = PixelGrid.centred((80, 90), 0.05)
    column, row = 44.0 + offset[0], 40.0 + offset[1]
    x, y = grid.to_sky(np.float64(column), np.float64(row))
    image = point_source(hst_like_psf(814.0, 0.05, 41), grid, float(x), float(y))
    rows, columns = np.mgrid[:80, :90]
    assert image.sum() == pytest.approx(1.0, abs=1e-3)
    assert (image * columns).sum() / image.sum() == pytest.approx(column, abs=1e-3)
    assert (image * rows).sum() / image.sum() == pytest.approx(row, abs=1e-3)


def test_point_source_shape_against_a_finer_psf():
    """A shift by a quarter of a pixel against binning a finer PSF off its centre, to 2% of the peak."""
    fine = hst_like_psf(814.0, 0.025, 121)
    grid = PixelGrid.centred((41, 41), 0.05)
    shifted = point_source(hst_like_psf(814.0, 0.05, 41), grid, 0.0125, 0.0125)
    binned = fine[19:101, 19:101].reshape(41, 2, 41, 2).sum(axis=(1, 3))  # fine centre at 20.25, 20.25
    error = np.abs(shifted / shifted[5:-5, 5:-5].sum() - binned / binned[5:-5, 5:-5].sum())
    assert error[5:-5, 5:-5].max() < 0.02 * binned.max()


def test_point_source_at_and_beyond_the_edge():
    psf, grid = hst_like_psf(814.0, 0.05, 21), PixelGrid.centred((30, 30), 0.05)
    edge_x = float(grid.to_sky(np.float64(0.0), np.float64(15.0))[0])
    half = 0.5 * (1.0 + psf[:, 10].sum())  # the central column stays
    assert point_source(psf, grid, edge_x, 0.0).sum() == pytest.approx(half, abs=1e-3)
    np.testing.assert_array_equal(point_source(psf, grid, 100.0, 0.0), 0.0)
    with pytest.raises(ValueError, match="finite"):
        point_source(psf, grid, np.nan, 0.0)


def test_point_source_on_a_rotated_grid():
    """The PSF belongs to the pixels, not to the sky: on a rotated grid only the position turns."""
    psf = np.zeros((5, 5))
    psf[2, 2], psf[2, 3] = 0.7, 0.3
    grid = PixelGrid(21, 21, 0.1, 1.0, -1.0, ((0.0, -1.0), (1.0, 0.0)))
    x, y = grid.to_sky(np.float64(8.0), np.float64(12.0))
    image = point_source(psf, grid, float(x), float(y))
    assert image[12, 8] == pytest.approx(0.7, abs=1e-6)
    assert image[12, 9] == pytest.approx(0.3, abs=1e-6)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.2), (-0.5, 0.5), (1.0, 0.0)])
def test_the_core_is_located_whatever_the_wings(shift: tuple[float, float]) -> None:
    """To 0.06 pixels, with a one-sided wing of a tenth of the light."""
    rows, columns = np.mgrid[-12:13, -12:13].astype(float)
    wing = np.exp(-0.5 * ((columns - 7.0) ** 2 + (rows - 5.0) ** 2) / 2.0**2)
    for width in (0.9, 2.0):
        core = np.exp(-0.5 * ((columns - shift[0]) ** 2 + (rows - shift[1]) ** 2) / width**2)
        psf = core / core.sum() + 0.1 * wing / wing.sum()
        assert core_offset(psf) == pytest.approx(shift, abs=0.06)


@pytest.mark.skipif("WARMLENS_HST_DATA" not in os.environ, reason="WARMLENS_HST_DATA is not set: no real image")
def test_the_core_of_a_real_psf_is_in_the_middle() -> None:
    """Though all of its light has a centroid 0.84 pixels off."""
    psf = fits.getdata(f"{os.environ['WARMLENS_HST_DATA']}/psf.fits").astype(float)
    assert np.hypot(*core_offset(psf)) < 0.05
    columns = np.arange(psf.shape[1]) - psf.shape[1] // 2
    assert abs((psf * columns).sum() / psf.sum()) > 0.5
