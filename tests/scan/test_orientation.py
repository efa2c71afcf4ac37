"""The scan is the same on every detector: all arrays are turned or mirrored, and the sky stays as it was."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from astropy.io import fits

from warmlens.artifacts.file import open_artifact
from warmlens.campaign.files import resolve_window
from warmlens.config.file import merge, parse_config
from warmlens.config.yaml import read_yaml
from warmlens.fitting.lens_fit import usable_pixels
from warmlens.fitting.linear import build_linear_model
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.rays import SmoothRays
from warmlens.physics import scan_raster
from warmlens.scan import nested
from warmlens.scan.apply import delta_r_and_response
from warmlens.scan.nested import NestedShapelets
from warmlens.scan.perturber import Perturber
from warmlens.scan.raster import Raster
from warmlens.stage_table import stage_settings
from warmlens.stages.observation import true_image

from ..reliability import fault
from ..shared import run_stage
from .conftest import Band

ROOT = Path(__file__).parents[2]
TURNED = {
    "as it is": lambda image: image,
    "columns mirrored": lambda image: image[..., :, ::-1],
    "rows mirrored": lambda image: image[..., ::-1, :],
    "by 90 degrees": lambda image: np.rot90(image, 1, axes=(-2, -1)),
    "by 180 degrees": lambda image: np.rot90(image, 2, axes=(-2, -1)),
    "by 270 degrees": lambda image: np.rot90(image, 3, axes=(-2, -1)),
    "transposed": lambda image: np.swapaxes(image, -2, -1),
}
TOLERANCE = 1e-8  # of the largest Delta R, score or Fisher information: rounding, amplified by the weak priors
SHAPE, SCALE = (28, 24), 0.05


def turned_grid(grid, turn):
    """The grid whose pixels lie on the sky where those of `grid` do, in the order of the turned image."""
    x, y = (turn(values) for values in grid.coordinates())
    steps = [[values[0, 1] - values[0, 0], values[1, 0] - values[0, 0]] for values in (x, y)]
    axes = tuple(tuple(float(round(step / grid.pixel_scale)) for step in row) for row in steps)
    return PixelGrid(*x.shape, grid.pixel_scale, float(x[0, 0]), float(y[0, 0]), axes)


def band_of(turn, factor):
    """An arc near a mask, an asymmetric PSF and uneven weights, and two images, on a turned detector."""
    original = PixelGrid.centred(SHAPE, SCALE, 0.01, -0.02)
    grid = turned_grid(original, turn)
    theta_x, theta_y = grid.subpixel_coordinates(factor)
    radius = np.hypot(theta_x - 0.013, theta_y + 0.017)
    bend = 0.5 / radius + 0.05 * (theta_x - theta_y)
    rays = SmoothRays(theta_x, theta_y, theta_x - bend * (theta_x - 0.013), theta_y - bend * (theta_y + 0.017))
    sets = (ShapeletSet(5, 0.12, 0.06, 0.03),)
    rng = np.random.default_rng(3)
    psf = hst_like_psf(814.0, SCALE, 21) * rng.uniform(0.7, 1.3, (21, 21))
    weights = rng.uniform(60.0, 100.0, SHAPE)
    weights[0:8, 0:9] = 0.0
    images = rng.normal(0.0, 0.02, (2, *SHAPE)) + 0.3 * np.exp(-np.hypot(*original.coordinates()) / 0.3)
    psf, weights, images = turn(psf), np.ascontiguousarray(turn(weights)), turn(images)
    convolution = Convolution(psf, grid.shape)
    fixed = np.stack([point_source(psf, grid, 0.4, 0.1).ravel(), np.ones(grid.ny * grid.nx)], axis=1)
    model = build_linear_model(pixel_basis(sets, rays.source_x, rays.source_y), fixed, convolution, weights, 1e-8)
    return Band(model, sets, rays, Perturber(0.01, 0.1), convolution, weights, grid), images


def scanned(turn, factor):
    """Every number of the scan of two images by position, on a turned detector."""
    band, images = band_of(turn, factor)
    shard = band.shard(POSITIONS, NESTED, response=True)
    delta, response = delta_r_and_response(shard, band, *band.fit(images))
    return {
        "delta_r": delta,
        "score": response.score,
        "fisher": response.fisher,
        "noise": response.noise,
        "points": shard.points,
        "valid": np.diff(shard.pixel_offsets) > 0,
    }


def difference(first, second, name):
    return np.abs(first[name] * 1.0 - second[name]).max() / np.abs(first[name]).max()


def around(center, step):
    return Raster(4 * step, 3 * step, step, center).coordinates()


POSITIONS = np.concatenate(
    [
        around((0.41, 0.305), 0.05),  # on pixel centres: the centre of a perturber, and 4 pixels to its edge
        around((-0.215, 0.38), 0.05),  # on corners of pixels, which are centres of the cells of the mesh
        around((-0.24, -0.47), 0.05),  # on borders, beside the mask
        around((0.307, 0.003), 0.4),  # anywhere, and beyond the image
    ]
)
NESTED = NestedShapelets(3, 1e-5, (1e-3, 1.0))


@pytest.mark.parametrize(("factor", "names"), [(1, TURNED), (2, ["columns mirrored", "by 270 degrees"])])
def test_delta_r_and_response_are_the_same_on_every_detector(factor, names):
    expected = scanned(TURNED["as it is"], factor)
    assert 0 < np.count_nonzero(~expected["valid"]) < 20
    for name in names:
        result = scanned(TURNED[name], factor)
        assert max(difference(expected, result, key) for key in result) < TOLERANCE, name


def test_one_fixed_diagonal_does_not_pass(monkeypatch):
    def one_diagonal(source, row, column):
        (a, b), (c, d) = source[row, column : column + 2], source[row + 1, column : column + 2]
        return nested._triangle(a, b, c) + nested._triangle(d, b, c)

    monkeypatch.setattr(nested, "_source_area", one_diagonal)
    monkeypatch.setattr(nested, "_source_points", nested._source_points.py_func)
    expected, mirrored = (scanned(TURNED[name], 1) for name in ("as it is", "columns mirrored"))
    for key in ("points", "delta_r", "score"):
        assert difference(expected, mirrored, key) > 1e4 * TOLERANCE, key
    turned = scanned(TURNED["transposed"], 1)
    assert difference(expected, turned, "delta_r") < TOLERANCE  # its diagonal stays where it was


def test_a_window_around_the_mask_has_as_many_positions_on_every_detector():
    """33 and 39 pixels of 0.05" hold 16.5 and 19.5 steps of 0.1"."""
    grid = PixelGrid.centred((44, 50), 0.05, 0.013, -0.4)
    mask = np.zeros(grid.shape, dtype=bool)
    mask[4:43, 7:40] = True
    windows = {Raster.around(turn(mask), turned_grid(grid, turn), 0.1) for turn in TURNED.values()}
    assert len(windows) == 1
    assert windows.pop().width == 1.65


def test_the_disc_of_the_fit_holds_the_same_pixels_on_every_detector():
    """20 pixels of 0.05" from the lens lie on the edge of a disc of 1"; so do 12 and 16."""
    grid = PixelGrid(60, 64, 0.05, -1.55, -1.45)
    layer = {"smooth_model": {"disc_arcsec": 1.0, "lens_core_mask_arcsec": 0.25}}
    block = parse_config(merge(read_yaml(ROOT / "config.yaml"), layer)).smooth_model
    expected = usable_pixels(block, grid)
    for turn in TURNED.values():
        np.testing.assert_array_equal(usable_pixels(block, turned_grid(grid, turn)), turn(expected))


def write_fits(folder, turn, grid, images):
    """Write a band with the WCS of its grid, and return its block of the configuration."""
    (xx, xy), (yx, yy) = grid.axes
    header = fits.Header({"BUNIT": "electron/s", "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN"})
    header.update({"CRVAL1": 173.0, "CRVAL2": -12.5})
    steps = {"CD1_1": -xx, "CD1_2": -xy, "CD2_1": yx, "CD2_2": yy}  # right ascension grows to the East
    column, row = grid.to_pixel(np.array(0.0), np.array(0.0))
    for key, value in {**steps, "CRPIX1": column + 1.0, "CRPIX2": row + 1.0}.items():
        header[key] = float(value) * (grid.pixel_scale / 3600.0 if key in steps else 1.0)
    folder.mkdir()
    for name, image in images.items():
        fits.writeto(folder / f"{name}.fits", np.ascontiguousarray(turn(image)) * 1.0, header)
    return {name: str(folder / f"{name}.fits") for name in images}


def observed_scan(folder, name):
    """Run the stages from FITS files on a detector turned by `name` to the scan of the observation."""
    layer = yaml.safe_load((ROOT / "workflow/configs/ci.yaml").read_text())
    layer["scan"] |= {"step_arcsec": 0.6, "window_arcsec": None, "statistics": ["delta_r", "amplitude"]}
    layer["smooth_model"]["source"] = {"n_max": 5, "clumps": None}
    layer["observation"]["simulated"] |= {"shape": [84, 80], "psf_pixels": 21}
    layer |= {"observation": layer["observation"] | {"bands": ["F814W"]}}
    block = parse_config(merge(read_yaml(ROOT / "config.yaml"), layer)).observation.simulated
    original = PixelGrid.centred(block.shape, block.pixel_scale_arcsec)
    clean, psf = true_image("F814W", block, original, np.zeros((2, *original.shape)))
    rng = np.random.default_rng(5)
    psf *= rng.uniform(0.9, 1.1, psf.shape)
    sigma = np.sqrt(0.01**2 + clean / 1980.0)
    mask = np.zeros(original.shape)
    mask[3:81, 2:77] = 1.0  # 3.9" and 3.75": 6.5 and 6.25 steps
    images = {
        "science": clean + sigma * rng.standard_normal(clean.shape),
        "psf": psf,
        "sigma": sigma,
        "mask": mask,
    }
    turn = TURNED[name]
    files = write_fits(folder, turn, turned_grid(original, turn), images)
    layer["observation"] |= {"kind": "fits", "fits": {"F814W": files}}
    config = resolve_window(parse_config(merge(read_yaml(ROOT / "config.yaml"), layer)))
    paths = {stage: folder / f"{stage}.h5" for stage in ("observation", "smooth_model", "scan_design")}
    image = {key: paths[key] for key in ("observation", "smooth_model")}
    n_positions = scan_raster(config.scan).n_positions

    def run(stage, output, span=None, **inputs):
        run_stage(stage, stage_settings(config, stage), output, span, **inputs)

    run("observation", paths["observation"])
    run("smooth_model", paths["smooth_model"], observation=paths["observation"])
    run("scan_design", paths["scan_design"], **image)
    shard = folder / "shard.h5"
    run("scan_operator", shard, (0, n_positions), design=paths["scan_design"], **image)
    run("observed_scan", folder / "scan.h5", design=paths["scan_design"], shards=[shard], **image)
    with open_artifact(folder / "scan.h5", "observed_scan") as scan:
        names = ("raster/x", "raster/y", "raster/valid", "F814W/delta_r", "F814W/score", "F814W/fisher")
        return {name: scan.array(name) * 1.0 for name in names}


@fault(
    "Images",
    "the detector is mirrored or turned",
    "image, noise, PSF, mask and WCS alike, in FITS files",
    quick=True,
)
def test_from_fits_files_to_the_scan_of_the_observation(tmp_path, outcome):
    expected = observed_scan(tmp_path / "0", "as it is")
    assert np.abs(expected["F814W/delta_r"]).max() > 1.0
    for name in ("columns mirrored", "by 90 degrees"):
        result = observed_scan(tmp_path / name, name)
        for key, values in expected.items():
            np.testing.assert_allclose(result[key], values, rtol=0, atol=1e-7 * np.abs(values).max(), err_msg=name)
    outcome.goes_on("the same scan at the same sky positions, to rounding", "nothing")
