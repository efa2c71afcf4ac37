"""What `warmlens validate` and the start of a campaign find in the images before anything runs."""

from __future__ import annotations

import re
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from scipy import ndimage

from warmlens.campaign.image_page import describe_images, describe_orientation, draw_images
from warmlens.campaign.preflight import check_observation, read_images, simulate_images
from warmlens.config.file import ConfigError, load_config
from warmlens.config.model import Config
from warmlens.fitting.lens_fit import fit_lens
from warmlens.fitting.smooth_model import finished_model
from warmlens.imaging.grid import PixelGrid
from warmlens.products.images import read_fits
from warmlens.types import FloatArray

from ..reliability import Outcome, fault

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated lens of docs/own_lens.md as FITS files."""
    path = tmp_path_factory.mktemp("lens")
    runpy.run_path(str(ROOT / "docs/examples/simulate_lens.py"))["write"](path)
    return path


@pytest.fixture
def config(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Config:
    monkeypatch.setenv("OWN_LENS", str(folder))
    return load_config([ROOT / "config.yaml", ROOT / "docs/examples/own_lens.yaml"])


def changed(config: Config, block: str, **values: Any) -> Config:
    return config.model_copy(update={block: getattr(config, block).model_copy(update=values)})


@pytest.fixture
def with_map(config: Config, folder: Path, tmp_path: Path) -> Callable[..., Config]:
    """The configuration with one file of the lens changed, or added, by a function of the image and its noise."""

    def change(key: str, make: Callable[[FloatArray, FloatArray], FloatArray], **block: Any) -> Config:
        image, noise = (fits.getdata(folder / f"{name}.fits").astype(np.float64) for name in ("sci", "noise"))
        path = tmp_path / f"{key}.fits"
        header = fits.getheader(folder / "sci.fits") if key == "science" else None
        fits.PrimaryHDU(make(image, noise), header).writeto(path, overwrite=True)
        return with_band(config, **{key: str(path), **block})

    return change


def with_band(config: Config, **values: Any) -> Config:
    assert config.observation.fits is not None
    block = config.observation.fits["F140W"].model_copy(update=values)
    return changed(config, "observation", fits={"F140W": block})


def page(config: Config) -> str:
    return "\n".join(describe_images(read_images(config)))


def test_a_sound_lens_has_no_notes_and_its_page_has_all_numbers(config: Config) -> None:
    assert check_observation(config) == []
    text = page(config)
    for words in (
        "74 x 74 pixels of 0.0800 arcsec (5.92 x 5.92 arcsec)",
        "north 35.0 degrees clockwise from up, east to its left",
        "[38.3, 34.6] pixel, from 0   14:06:24.000 -44:18:00.000",
        "[   0,    0]  x  -0.922, y  -4.025 arcsec   14:06:24.086 -44:18:04.025",
        "5476 of 5476 (100.0%)",
        "0.97 of their sigma",
        "S/N 129, pixel [28, 21]",
        "25 x 25 pixels, sum 1 (normalised to 1), core at [+0.00, +0.00] pixels from the middle",
        "FWHM 0.201 arcsec (2.51 pixels)",
        "0: [-0.065, -1.382] arcsec, pixel [27.7, 20.9], 0.023 arcsec from the brightest pixel",
        "EPL: theta_E 1.2, gamma 2",
        "4.00 x 4.00 arcsec about [0.00, 0.00], step 0.1: 1600 positions",
    ):
        assert words in text
    assert "FAR" not in text


def test_positions_to_the_east_are_far_from_the_light(config: Config) -> None:
    mirrored = [(-x, y) for x, y in config.smooth_model.quasar_images]
    wrong = changed(config, "smooth_model", quasar_images=mirrored)
    assert sum("FAR" in note for note in check_observation(wrong)) >= 3
    assert page(wrong).count("FAR") >= 3


def test_the_page_has_the_correlation_of_the_noise(config: Config) -> None:
    """The simulated lens has independent pixels: next to no correlation."""
    text = page(with_band(config, blank_sky_arcsec=2.0))
    numbers = re.search(
        r"(\S+) along rows, (\S+) along columns, (\S+) diagonal \(\d+ pixels beyond 2 arcsec\)", text
    )
    assert numbers is not None, text
    assert max(abs(float(number)) for number in numbers.groups()) < 0.1


def test_every_problem_is_a_line(config: Config) -> None:
    wrong = changed(config, "smooth_model", quasar_images=[(0.0, 1.2), (10.0, 3.0)])
    wrong = changed(wrong, "halos", field_half_width_arcsec=3.0)
    with pytest.raises(ConfigError) as error:
        check_observation(wrong)
    field, outside = error.value.problems
    assert outside.startswith("smooth_model.quasar_images[1]: [10, 3] arcsec")
    assert "outside the image" in outside
    assert field.startswith("halos.field_half_width_arcsec = 3 is too small")


def test_a_missing_file_is_named(config: Config) -> None:
    with pytest.raises(ConfigError, match=r"absent\.fits: no such file"):
        check_observation(with_band(config, psf="absent.fits"))


def test_a_simulated_observation_has_its_field_and_its_window_checked(paper_config: Config) -> None:
    assert check_observation(paper_config) == []
    with pytest.raises(ConfigError, match="too small"):
        check_observation(changed(paper_config, "halos", field_half_width_arcsec=3.0))
    with pytest.raises(ConfigError, match=r"scan\.window_arcsec: 9 x 9 arcsec"):
        check_observation(changed(paper_config, "scan", window_arcsec=(9.0, 9.0)))


def test_a_simulated_observation_has_a_page(paper_config: Config) -> None:
    observation = paper_config.observation
    assert observation.simulated is not None
    small = observation.simulated.model_copy(update={"shape": (100, 100), "psf_pixels": 25, "supersampling": 1})
    config = changed(paper_config, "observation", simulated=small)
    assert "band" not in page(config)  # nothing is simulated to check it
    text = "\n".join(describe_images(simulate_images(config)))
    assert "band F814W" in text and "band F555W" in text
    assert "exposure 1980 s, background 0.0082 e-/s per pixel" in text


def test_an_observation_of_another_campaign_must_exist(config: Config) -> None:
    taken = changed(config, "observation", kind="artifact", artifact="absent.h5")
    with pytest.raises(ConfigError, match=r"absent\.h5: no such file"):
        check_observation(taken)


def test_a_mirrored_image_is_said_to_be_one() -> None:
    mirrored = PixelGrid(10, 10, 0.1, 0.0, 0.0, ((-1.0, 0.0), (0.0, 1.0)))
    assert describe_orientation(mirrored) == "north 0.0 degrees clockwise from up, east to its right (mirrored)"


@fault(
    "Images",
    "the noise map is another quantity",
    "the variance, the weight or counts in place of sigma",
    quick=True,
)
@pytest.mark.parametrize(
    ("key", "make", "reason"),
    [
        ("sigma", lambda image, noise: noise**2, r"it seems to be the variance \(sigma\^2\); give its root"),
        ("sigma", lambda image, noise: noise**-2, "it seems to be an inverse variance; give it as `weight`"),
        ("sigma", lambda image, noise: 2400.0 * noise, "is it in other units than the image"),
        ("sigma", lambda image, noise: noise / 20.0, "sigma is too small; .* is it in other units than the image"),
        ("weight", lambda image, noise: noise, "it seems to be the noise; give it as `sigma`"),
        ("weight", lambda image, noise: noise**2, r"it seems to be the variance \(sigma\^2\)"),
    ],
)
def test_a_noise_map_of_another_quantity_is_refused(
    with_map: Callable[..., Config], key: str, make: Any, reason: str, outcome: Outcome
) -> None:
    config = with_map(key, make, **({"sigma": None} if key == "weight" else {}))
    with pytest.raises(ConfigError, match=reason) as error:
        check_observation(config)
    outcome.stops(str(error.value), "times their sigma")
    poor = changed(config, "smooth_model", allow_poor_fit=True)
    assert sum("times their sigma" in note for note in check_observation(poor)) == 1


@fault(
    "Images", "the exposure time is not that of the image", "EXPTIME 1 in an image of rates; counts", quick=True
)
@pytest.mark.parametrize(
    ("scale", "exposure", "reason"),
    [
        (1.0, 1.0, r"is the exposure time of 1 s right \(1 in the header of an image of rates\?\)"),
        (1.0, 20.0, "brightest quarter of the pixels scatters by .* is the exposure time of 20 s too short"),
        (2400.0, 2400.0, "is the image in electrons instead of electrons per second"),
    ],
)
def test_a_wrong_exposure_is_seen_in_the_sky(
    with_map: Callable[..., Config], scale: float, exposure: float, reason: str, outcome: Outcome
) -> None:
    """Poisson noise of a wrong exposure time is no noise that the image has."""
    config = with_map(
        "science", lambda image, noise: scale * image, sigma=None, exposure_s=exposure, background_rms=0.01
    )
    with pytest.raises(ConfigError, match=reason) as error:
        check_observation(config)
    outcome.stops(str(error.value), "sigma")


def test_a_noise_that_is_a_little_off_is_a_note(with_map: Callable[..., Config]) -> None:
    assert check_observation(with_map("sigma", lambda image, noise: 1.15 * noise)) == []
    (note,) = check_observation(with_map("sigma", lambda image, noise: 1.6 * noise))
    assert "is sigma too large?" in note
    (note,) = check_observation(with_map("sigma", lambda image, noise: 0.6 * noise))
    assert "is sigma too small, or is there no blank sky" in note
    config = with_map("science", lambda image, noise: image, sigma=None, exposure_s=100.0, background_rms=0.01)
    assert any("is the exposure time of 100 s too short" in note for note in check_observation(config))


def _ring(image: FloatArray) -> FloatArray:
    y, x = np.indices(image.shape)
    return np.hypot(x - 38.3, y - 34.6) < 25.0


@fault("Images", "the mask is inverted", "1 where pixels are bad; a data-quality array", quick=True)
@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda image, noise: 1.0 - _ring(image), "where the arcs are, .*: is the mask inverted"),
        (lambda image, noise: (np.random.default_rng(1).random(image.shape) < 0.07) * 1.0, "is the mask inverted"),
        (
            lambda image, noise: np.where(
                np.random.default_rng(1).random(image.shape) < 0.07, 2.0 ** (image > 0.1).cumsum(1).clip(0, 9), 0
            ),
            "the mask has values like 0, 1, 2, 4: is it a data-quality array",
        ),
    ],
    ids=["inverted", "bad pixels", "flags"],
)
def test_an_inverted_mask_is_asked_for(
    with_map: Callable[..., Config], make: Any, reason: str, outcome: Outcome
) -> None:
    with pytest.raises(ConfigError, match=reason) as error:
        check_observation(with_map("mask", make))
    assert "FAR" not in str(error.value)  # the WCS is not to blame
    outcome.stops(str(error.value), "1 marks pixels that are used")


@pytest.mark.parametrize(
    "make",
    [
        lambda image, noise: _ring(image) * 255.0,
        lambda image, noise: image > 0.3,  # the arcs alone, thin
        lambda image, noise: np.indices(image.shape)[0] < 37,  # half of the image
        lambda image, noise: ndimage.gaussian_filter(_ring(image) * 1.0, 2.0),
    ],
    ids=["255", "arcs", "half", "soft"],
)
def test_a_sound_mask_is_not_asked_for(with_map: Callable[..., Config], make: Any) -> None:
    config = with_map("mask", lambda image, noise: np.asarray(make(image, noise), dtype=np.float64))
    assert not any("mask" in note for note in check_observation(config))


def test_a_masked_quasar_image_is_not_far_from_its_light(with_map: Callable[..., Config]) -> None:
    def mask(image: FloatArray, noise: FloatArray) -> FloatArray:
        y, x = np.indices(image.shape)
        return (np.hypot(x - 27.7, y - 20.9) > 5.0) * 1.0

    config = with_map("mask", mask)
    assert check_observation(config) == []
    assert "pixel [27.7, 20.9], masked" in page(config)


def _shifted(psf: FloatArray, row: float, column: float) -> FloatArray:
    return ndimage.shift(psf, (row, column), order=3)


@fault("Images", "the PSF is off its middle pixel", "shifted by half a pixel and by one", quick=True)
@pytest.mark.parametrize("shift", [(1.0, 0.0), (0.0, -1.0), (0.5, 0.0), (0.5, 0.5), (-0.5, 0.5)])
def test_a_psf_off_its_middle_is_refused(
    folder: Path, with_map: Callable[..., Config], shift: tuple[float, float], outcome: Outcome
) -> None:
    psf = fits.getdata(folder / "psf.fits").astype(np.float64)
    with pytest.raises(ConfigError, match="recentre the PSF") as error:
        check_observation(with_map("psf", lambda image, noise: _shifted(psf, *shift)))
    undo = f"[y, x] = [{-shift[0]:.2f}, {-shift[1]:.2f}]".replace("-0.00", "0.00")
    outcome.stops(str(error.value).replace("-0.00", "0.00"), "recentre the PSF", undo)


def test_a_psf_a_little_off_or_with_a_pedestal_is_a_note(folder: Path, with_map: Callable[..., Config]) -> None:
    psf = fits.getdata(folder / "psf.fits").astype(np.float64)
    (note,) = check_observation(with_map("psf", lambda image, noise: 7.0 * _shifted(psf, 0.2, 0.0)))
    assert re.search(r"\[\+0\.00, \+0\.(15|20)\] pixels off its middle: fitted positions are off by 1\d mas", note)
    (note,) = check_observation(with_map("psf", lambda image, noise: psf + 0.02 * psf.max()))
    assert re.search(r"\d+% of the PSF's light is in a level like that of its rim: is a background left", note)


def test_pixels_without_data_are_notes(with_map: Callable[..., Config]) -> None:
    def damage(image: FloatArray, noise: FloatArray) -> FloatArray:
        image[:8, :8] = 0.0
        image[40, 40] = -1.0
        return image

    deep, constant = check_observation(with_map("science", damage))
    assert deep == "F140W: 1 used pixels lie more than 10 sigma below the sky; mask them if they are dead"
    assert "36 used pixels equal their neighbours exactly; mask them if they hold no data" in constant


@fault(
    "Images",
    "the window of the scan is larger than the image",
    "scan.window_arcsec wider; off to a side",
    quick=True,
)
@pytest.mark.parametrize(
    ("window", "center"), [((9.0, 9.0), (0.0, 0.0)), ((8.3, 4.0), (0.0, 0.0)), ((4.0, 4.0), (3.0, 0.0))]
)
def test_a_window_that_leaves_the_image_is_refused(
    config: Config, window: tuple[float, float], center: tuple[float, float], outcome: Outcome
) -> None:
    with pytest.raises(ConfigError) as error:
        check_observation(changed(config, "scan", window_arcsec=window, center=center))
    outcome.stops(str(error.value), "of its positions outside the image", "from x = -4.33 to 3.92")


def test_a_corner_of_the_window_beyond_a_rolled_image_is_a_note(config: Config) -> None:
    (note,) = check_observation(changed(config, "scan", window_arcsec=(4.6, 4.6)))
    assert re.search(r"scan\.window_arcsec: \d\.\d% of its positions lie outside the image", note)
    assert check_observation(changed(config, "scan", window_arcsec=None)) == []


@fault(
    "Images",
    "pixels to be ignored have a huge noise",
    "sigma 10^8, infinite, 10^4 times; a weight of 10^-20",
    quick=True,
)
@pytest.mark.parametrize("value", [1e8, np.inf, 100.0, -20.0])
def test_ignored_pixels_do_not_lower_chi2_red(
    with_map: Callable[..., Config], value: float, outcome: Outcome
) -> None:
    """A wrong shear passes no gate because of pixels that count for nothing: chi2_red is that of a mask."""

    def noise_map(image: FloatArray, noise: FloatArray) -> FloatArray:
        sigma = np.where(_ring(image), noise, max(value, 0.0))
        return np.where(_ring(image), noise**-2, 10.0**value) if value < 0.0 else sigma

    key = {"weight": {"sigma": None}, "sigma": {}}["weight" if value < 0.0 else "sigma"]
    huge = with_map("weight" if value < 0.0 else "sigma", noise_map, **key)
    masked = with_map("mask", lambda image, noise: _ring(image) * 1.0)
    (note,) = check_observation(huge)
    assert re.search(r"\d+ pixels are masked by the (sigma|weight) map", note)
    chi2_red = [_chi2_red_of_a_wrong_shear(config) for config in (huge, masked)]
    assert chi2_red[0] == pytest.approx(chi2_red[1], rel=1e-6)
    assert chi2_red[0] > 1.5
    outcome.goes_on("they count as masked, and validate tells their number", "nothing")


def _chi2_red_of_a_wrong_shear(config: Config) -> float:
    block = config.smooth_model.model_copy(update={"mode": "given"})
    light = config.smooth_model.lens_light
    truth = runpy.run_path(str(ROOT / "docs/examples/simulate_lens.py"))
    kwargs = [truth["LENS"][0], {"gamma1": 0.05, "gamma2": 0.03}]
    shapes = [{name: value for name, value in truth["LIGHT"][0].items() if name != "amp"}]
    source = block.source.model_copy(update={"n_max": 6, "supersampling": 1})
    block = block.model_copy(
        update={
            "lens": block.lens.model_copy(update={"kwargs_lens": kwargs}),
            "lens_light": light.model_copy(update={"kwargs_lens_light": shapes}),
            "source": source,
        }
    )
    assert config.observation.fits is not None
    model = finished_model(fit_lens(block, read_fits(config.observation.fits)))
    return model.fits["F140W"].chi2_red_outside_cores


def test_the_figure_of_validate_has_all_that_is_believed(
    with_map: Callable[..., Config], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = []
    monkeypatch.setattr("warmlens.figures.recipe.plt.close", figures.append)
    config = with_map("mask", lambda image, noise: _ring(image) * 1.0)
    draw_images(read_images(config), tmp_path / "view.png")
    assert (tmp_path / "view.png").stat().st_size > 10_000
    assert (tmp_path / "view.csv").read_text().startswith("band,x_arcsec,y_arcsec,image_e_per_s")
    ax = figures[0].axes[0]
    assert [text.get_text() for text in ax.get_legend().get_texts()] == [
        "critical curves, start of the fit", "window of the scan", "quasar images", "origin of positions"
    ]  # fmt: skip
    texts = [text.get_text() for text in ax.texts]
    assert {"N", "E", "0", "3", "2 arcsec"} <= set(texts)
    assert any(text.startswith("F140W: ") and text.endswith("of the pixels used") for text in texts)
    assert ax.get_xlabel() == "$x$, to the West [arcsec]"
