"""What kind of misfit makes the residuals of an observation: smooth mocks in which one thing is not as fitted.

python benchmarks/misfit.py results/hst_full [--draws 20] --json FILE

Mocks of the smooth model, scanned and fitted by the campaign's operator as the observation is, in which

- the PSF of the arcs is another than the fit's, as if their colour or place on the detector mattered: that of the
  file, or broader, in all directions or in one, or with every pixel of it wrong; the quasars keep theirs;
- the source has spots, bright and dark, too small for its basis, on its brightest parts;
- pixels are wrong by a fraction of the light of the arcs, each by its own, as interpolation of an undersampled
  image may do;
- the lens has a multipole of its own angular structure;
- the substructure of samples of the campaign bends the light, as it is and many times as much.

Each kind leaves its own mark: how badly the bright arc is fitted, whether images of one source point miss the same
light (`counterparts` of residuals.py), and how the scan takes it. The observation is listed with them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator
from pathlib import Path

from warmlens import runtime

runtime.prepare()  # before numpy: one thread, and compiled kernels of this code

import numpy as np
from edge import scan, statistics
from lenstronomy.LensModel.lens_model import LensModel
from residuals import BRIGHT_ARC, counterparts, numbers, regions
from rich.console import Console
from rich.table import Table
from scipy import fft, ndimage

from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import SINGLE
from warmlens.campaign.files import stage_files
from warmlens.campaign.status import read_campaign
from warmlens.fitting.smooth_model import SmoothModel, scan_band
from warmlens.imaging.mock import lensed_image
from warmlens.imaging.observation import Band, Observation
from warmlens.imaging.psf import Convolution, fwhm
from warmlens.imaging.shapelets import surface_brightness
from warmlens.products.observation import read_observation
from warmlens.products.scan_operator import read_linear_model
from warmlens.products.smooth_model import read_smooth_model
from warmlens.sampling import stream
from warmlens.stages.mocks import noise_free_image
from warmlens.types import FloatArray

BROADER, PSF_PIXELS = 0.1, 0.1  # FWHM of the PSF, each of its pixels
SPOT_SIGMA, N_SPOTS = 0.015, 200  # arcsec in the source plane
CONTRASTS = (0.3, 1.0)  # of a spot, to the source where it is
PIXEL_ERRORS = (0.01, 0.03)  # of the light of the arcs
MULTIPOLES = ((3, 0.01), (4, 0.01), (4, 0.03))  # order, strength in units of the Einstein radius
AMPLIFY = (1.0, 3.0, 10.0)
N_FIELDS = 10  # realizations of what is random in a kind


def broader(psf: FloatArray, pixel_scale: float, along: tuple[float, float]) -> FloatArray:
    """The PSF convolved with a Gaussian that widens a core of its FWHM by these fractions along y and x."""
    core = fwhm(psf, pixel_scale) / pixel_scale / np.sqrt(8.0 * np.log(2.0))
    sigma = core * np.sqrt((1.0 + np.array(along)) ** 2 - 1.0)
    return np.real(fft.ifft2(ndimage.fourier_gaussian(fft.fft2(psf), sigma)))


def spots(model: SmoothModel, name: str, convolution: Convolution, rng: np.random.Generator) -> FloatArray:
    """Image [ny, nx] of spots of contrast 1, of both signs, where the image of the source is bright."""
    x, y = model.rays.source_x, model.rays.source_y
    light = surface_brightness(model.sets, model.fits[name].source_coefficients, x, y).mean(axis=1)
    chance = np.clip(light, 0.0, None)
    light_of_spots = np.zeros_like(x)
    for pixel in rng.choice(len(light), N_SPOTS, p=chance / chance.sum()):
        distance2 = (x - x[pixel].mean()) ** 2 + (y - y[pixel].mean()) ** 2
        light_of_spots += rng.choice([-1.0, 1.0]) * light[pixel] * np.exp(-0.5 * distance2 / SPOT_SIGMA**2)
    return convolution.forward(light_of_spots.mean(axis=1).reshape(convolution.shape))


def multipole(model: SmoothModel, observed: Observation, order: int, strength: float, angle: float) -> FloatArray:
    """Deflection [2, ny, nx] of a multipole about the first lens model; strength in Einstein radii."""
    main = model.kwargs_lens[0]
    x, y = observed.grid.coordinates()
    parameters = {
        "m": order,
        "a_m": strength * main["theta_E"],
        "phi_m": angle,
        "center_x": main["center_x"],
        "center_y": main["center_y"],
        "r_E": main["theta_E"],
    }
    return np.stack(LensModel(["MULTIPOLE"]).alpha(x, y, [parameters]))


def images_by_kind(
    results: Path, observed: Observation, model: SmoothModel, data: Band
) -> dict[str, list[FloatArray]]:
    """Noise-free images of a band by kind of misfit; draws of a kind take them in turn."""
    band, convolution = scan_band(observed, model, data.name)
    fit, seed = model.fits[data.name], read_campaign(results).campaign.seed

    def arcs(kernel: FloatArray) -> FloatArray:
        x, y = model.rays.source_x, model.rays.source_y
        return lensed_image(model.sets, fit.source_coefficients, x, y, Convolution(kernel, observed.grid.shape))

    light, scale = arcs(band.psf), observed.grid.pixel_scale
    smooth = light + fit.fixed_image
    images = {
        "as fitted": [smooth],
        "PSF of the file": [arcs(data.psf) + fit.fixed_image],
        f"PSF {BROADER:.0%} broader": [arcs(broader(band.psf, scale, (BROADER, BROADER))) + fit.fixed_image],
        f"PSF {BROADER:.0%} broader along x": [arcs(broader(band.psf, scale, (0.0, BROADER))) + fit.fixed_image],
    }
    wrong_psfs = [
        band.psf * (1.0 + PSF_PIXELS * stream(seed, "PSF pixels", i, data.name).normal(size=band.psf.shape))
        for i in range(N_FIELDS)
    ]
    images[f"PSF pixels wrong by {PSF_PIXELS:.0%}"] = [arcs(p / p.sum()) + fit.fixed_image for p in wrong_psfs]
    fine = [spots(model, data.name, convolution, stream(seed, "spots", i)) for i in range(N_FIELDS)]
    for contrast in CONTRASTS:
        images[f"spots of {contrast:.0%}"] = [smooth + contrast * image for image in fine]
    for part in PIXEL_ERRORS:
        errors = [stream(seed, "pixel errors", i, data.name).normal(size=light.shape) for i in range(N_FIELDS)]
        images[f"pixels wrong by {part:.0%}"] = [smooth + part * light * error for error in errors]

    def bent(fields: Iterable[FloatArray]) -> list[FloatArray]:
        return [noise_free_image(model, observed.grid, band, convolution, field) for field in fields]

    for order, strength in MULTIPOLES:
        turned = np.arange(N_FIELDS) / N_FIELDS * 2.0 * np.pi / order
        images[f"multipole {order} of {strength:.0%}"] = bent(
            multipole(model, observed, order, strength, float(angle)) for angle in turned
        )
    with open_artifact(stage_files(read_campaign(results), "deflections")[0], "deflections") as artifact:
        fields = artifact["delta_alpha"][:N_FIELDS].astype(np.float64)
    for factor in AMPLIFY:
        images[f"substructure x {factor:g}"] = bent(factor * fields)
    return images


def noisy_images(images: dict[str, list[FloatArray]], data: Band, n_draws: int, seed: int) -> Iterator[FloatArray]:
    """Draw every kind with the same noise."""
    for clean in images.values():
        for i in range(n_draws):
            image = clean[i % len(clean)]
            yield data.noise.draw(image, data.noise.sigma(image), stream(seed, "misfit", i, data.name))


def main() -> None:
    """Print the observation, and mean and scatter for every kind."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("results", type=Path)
    parser.add_argument("--draws", type=int, default=20, help="of the noise, for each kind")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    results: Path = arguments.results
    seed = read_campaign(results).campaign.seed
    observed = read_observation(results / SINGLE["observation"])
    model = read_smooth_model(results / SINGLE["smooth_model"])
    images: dict[str, FloatArray] = {}
    marks: dict[str, FloatArray] = {}
    names: list[str] = []
    for band in observed.bands:
        clean = images_by_kind(results, observed, model, band)
        names = list(clean)
        images[band.name] = np.stack([*noisy_images(clean, band, arguments.draws, seed), band.image])
        with open_artifact(results / SINGLE["scan_design"], "scan_design") as design:
            linear = read_linear_model(design, band.name)
        pixels = regions(observed, model, band)
        pairs = counterparts(observed, model, pixels[BRIGHT_ARC])
        weights = scan_band(observed, model, band.name)[0].weights
        lines = list(numbers(images[band.name], weights, linear, pixels, pairs))
        marks |= {f"{band.name}, {key}": np.array([line[key] for line in lines]) for key in lines[0]}
    columns = {**statistics(scan(results, images)), **marks}
    shown: dict[str, list[str]] = {"the observation": [f"{values[-1]:.3g}" for values in columns.values()]}
    written = {}
    for name, values in columns.items():
        by_kind = values[:-1].reshape(len(names), arguments.draws)
        mean, scatter = by_kind.mean(axis=1), by_kind.std(axis=1, ddof=1)
        for kind, m, s in zip(names, mean, scatter, strict=True):
            shown.setdefault(kind, []).append(f"{m:.3g} +- {s:.2g}")
        written[name] = {
            "observation": float(values[-1]),
            "mean": dict(zip(names, mean.tolist(), strict=True)),
            "scatter": dict(zip(names, scatter.tolist(), strict=True)),
        }
    table = Table("", *columns)
    for kind, cells in shown.items():
        table.add_row(kind, *cells)
    Console(width=260).print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(written, indent=2))


if __name__ == "__main__":
    main()
