"""What a wrong PSF of the arcs does to residuals and scan: smooth mocks with another PSF than the fit believes in.

python benchmarks/psf_error.py results/hst_full [--towards-given 0.25 0.5 1] [--broaden 0.02 0.05] [--draws 20]

The lensed source is convolved with another kernel than that of the smooth model, the quasars and the light of the
lens are not: as if the arcs, of another colour and elsewhere on the detector, had a PSF of their own. `towards
given` goes from the PSF as the fit corrected it (0) back to that of the file (1); `broaden` convolves with a
Gaussian that widens the core by this fraction. Beside it stands the observation.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from warmlens import runtime

runtime.prepare()  # before numpy: one thread, and compiled kernels of this code

import numpy as np  # noqa: E402
from edge import scan, statistics  # noqa: E402
from residuals import regions  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from scipy import fft, ndimage  # noqa: E402

from warmlens.artifacts import open_artifact  # noqa: E402
from warmlens.campaign import stream  # noqa: E402
from warmlens.fitting.linear import solve  # noqa: E402
from warmlens.imaging.mock import lensed_image  # noqa: E402
from warmlens.imaging.observation import Observation  # noqa: E402
from warmlens.imaging.psf import Convolution, fwhm  # noqa: E402
from warmlens.layout import SINGLE  # noqa: E402
from warmlens.stages.products import (  # noqa: E402
    SmoothModel,
    read_linear_model,
    read_observation,
    read_smooth_model,
    scan_band,
)
from warmlens.status import read_campaign  # noqa: E402
from warmlens.types import FloatArray  # noqa: E402


def broadened(psf: FloatArray, pixel_scale: float, fraction: float) -> FloatArray:
    """The PSF convolved with a Gaussian that widens a Gaussian core of the same FWHM by this fraction."""
    sigma = (
        fwhm(psf, pixel_scale) / pixel_scale / np.sqrt(8.0 * np.log(2.0)) * np.sqrt((1.0 + fraction) ** 2 - 1.0)
    )
    return np.real(fft.ifft2(ndimage.fourier_gaussian(fft.fft2(psf), sigma)))


def kernels(
    fitted: FloatArray, given: FloatArray, pixel_scale: float, arguments: argparse.Namespace
) -> dict[str, FloatArray]:
    """PSF of the arcs by name."""
    towards = {f"{f:g} towards given": fitted + f * (given - fitted) for f in arguments.towards_given}
    broad = {f"broadened by {f:.0%}": broadened(fitted, pixel_scale, f) for f in arguments.broaden}
    return {"as fitted": fitted} | towards | broad


def images(
    observed: Observation, model: SmoothModel, name: str, psfs: dict[str, FloatArray], n_draws: int, seed: int
) -> FloatArray:
    """Noisy images of smooth mocks of a band, kernel by kernel [n_kernels n_draws, ny, nx]."""
    fit = model.fits[name]
    noise = next(band.noise for band in observed.bands if band.name == name)
    found = []
    for psf in psfs.values():
        seen = Convolution(psf, observed.grid.shape)
        arcs = lensed_image(model.sets, fit.source_coefficients, model.rays.source_x, model.rays.source_y, seen)
        clean = arcs + fit.fixed_image
        found += [  # the same noise for every kernel
            noise.draw(clean, noise.sigma(clean), stream(seed, "psf error", i, name)) for i in range(n_draws)
        ]
    return np.stack(found)


def main() -> None:
    """Print mean and scatter for every kernel, beside the observation."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("results", type=Path)
    parser.add_argument("--towards-given", type=float, nargs="*", default=[0.25, 0.5, 1.0])
    parser.add_argument("--broaden", type=float, nargs="*", default=[0.02, 0.05])
    parser.add_argument("--draws", type=int, default=20, help="of the noise, for each kernel")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    results: Path = arguments.results
    seed = read_campaign(results).campaign.seed
    observed = read_observation(results / SINGLE["observation"])
    model = read_smooth_model(results / SINGLE["smooth_model"])
    noisy, chi2 = {}, {}
    for item in observed.bands:
        band = scan_band(observed, model, item.name)[0]
        psfs = kernels(band.psf, item.psf, observed.grid.pixel_scale, arguments)
        mocks = images(observed, model, item.name, psfs, arguments.draws, seed)
        noisy[item.name] = np.concatenate([mocks, item.image[None]])
        with open_artifact(results / SINGLE["scan_design"], "scan_design") as design:
            linear = read_linear_model(design, item.name)
        whitened = (band.weights * noisy[item.name]).reshape(len(noisy[item.name]), -1).T
        squares = solve(linear, np.ascontiguousarray(whitened)).residual ** 2
        for name, pixels in regions(observed, model, item).items():
            chi2[f"{item.name}, {name}"] = squares[pixels.ravel()].mean(axis=0)
    found = {**statistics(scan(results, noisy)), **chi2}
    table, written = Table("", *psfs, "the observation"), {}
    for name, values in found.items():
        by_kernel = values[:-1].reshape(len(psfs), arguments.draws)
        mean, scatter = by_kernel.mean(axis=1), by_kernel.std(axis=1, ddof=1)
        shown = [f"{m:.4g} +- {s:.2g}" for m, s in zip(mean, scatter, strict=True)]
        table.add_row(name, *shown, f"{values[-1]:.4g}")
        written[name] = {
            "mean": dict(zip(psfs, mean.tolist(), strict=True)),
            "scatter": dict(zip(psfs, scatter.tolist(), strict=True)),
            "observation": float(values[-1]),
        }
    Console(width=160).print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(written, indent=2))


if __name__ == "__main__":
    main()
