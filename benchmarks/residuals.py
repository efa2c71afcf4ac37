"""Where the smooth model fits the observation worse than mocks, and whether the source does it: residuals.

python benchmarks/residuals.py results/hst_full --json FILE

chi2 per pixel by region: arcs are divided by their brightness in noise deviations of a pixel, away from the
quasar images; cores are those of the quasar images and of the lens. Every image is fitted with all the freedom
that the scan gives source and lens.

Residuals of two pixels of the bright arc that see the same point of the source in different images of it: light of
the source that the basis cannot follow is missing in both, so that their mean product is positive, as large as the
chi2 that it makes where the PSF resolves it. An error of PSF or lens is not shared by the images of one point.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
from collections.abc import Iterator
from pathlib import Path

from warmlens import runtime

runtime.prepare()  # before numpy: one thread, and compiled kernels of this code

import numpy as np
from cloud import compare
from scipy import sparse, spatial

from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import SINGLE
from warmlens.campaign.files import stage_files
from warmlens.campaign.status import read_campaign
from warmlens.fitting.linear import LinearModel, solve
from warmlens.fitting.smooth_model import SmoothModel, scan_band
from warmlens.imaging.observation import Band, Observation
from warmlens.products.observation import read_observation
from warmlens.products.samples import SampleTable
from warmlens.products.scan_operator import read_linear_model
from warmlens.products.smooth_model import read_smooth_model
from warmlens.types import BoolArray, FloatArray

QUASAR_CORE, QUASAR_HALO, LENS_CORE = 0.25, 0.8, 0.3  # arcsec
BRIGHTNESS = (-np.inf, 1.0, 3.0, 10.0, 20.0, 40.0, np.inf)  # edges, in noise deviations
BRIGHT_ARC = "arc above 10 sigma"
SAME_POINT = (0.02, 0.04)  # arcsec in the source plane, at most
OTHER_IMAGE = 0.5  # arcsec on the sky, at least


def regions(observed: Observation, model: SmoothModel, band: Band) -> dict[str, BoolArray]:
    """Pixels of each region [ny, nx] that has any, without those that the fit leaves out."""
    fit = model.fits[band.name]
    x, y = observed.grid.coordinates()
    to_quasar = np.min([np.hypot(x - x_i, y - y_i) for x_i, y_i in model.quasars], axis=0)
    used = scan_band(observed, model, band.name)[0].mask
    brightness = (fit.model - fit.fixed_image) / band.sigma
    away = used & (to_quasar > QUASAR_HALO)
    by_region = {
        f"arc at {low:g} to {high:g} sigma": away & (brightness > low) & (brightness <= high)
        for low, high in itertools.pairwise(BRIGHTNESS)
    }
    by_region[BRIGHT_ARC] = away & (brightness > 10.0)
    if not by_region[BRIGHT_ARC].any():
        raise SystemExit(f"{band.name}: no arc exceeds 10 noise deviations of a pixel: nothing to compare")
    by_region["cores of quasar images"] = used & (to_quasar < QUASAR_CORE)
    by_region["core of the lens"] = used & (np.hypot(x, y) < LENS_CORE)
    return {name: pixels for name, pixels in by_region.items() if pixels.any()}


def counterparts(observed: Observation, model: SmoothModel, pixels: BoolArray) -> dict[str, sparse.csr_array]:
    """Pairs of these pixels that see one point of the source in two images, by how near: 1 / number of pairs."""
    index = np.flatnonzero(pixels)
    sky = np.stack(observed.grid.coordinates(), axis=-1).reshape(-1, 2)[index]
    source = np.stack([model.rays.source_x.mean(axis=1), model.rays.source_y.mean(axis=1)], axis=-1)[index]
    near = spatial.cKDTree(source).query_pairs(max(SAME_POINT), output_type="ndarray")
    near = near[np.linalg.norm(sky[near[:, 0]] - sky[near[:, 1]], axis=1) > OTHER_IMAGE]
    apart = np.linalg.norm(source[near[:, 0]] - source[near[:, 1]], axis=1)
    pairs = {}
    for low, high in itertools.pairwise((0.0, *SAME_POINT)):
        i, j = index[near[(apart >= low) & (apart < high)]].T
        weights = sparse.coo_array((np.full(len(i), 1.0 / len(i)), (i, j)), shape=(pixels.size, pixels.size))
        pairs[f'counterparts, {low:g} to {high:g}" ({len(i)} pairs)'] = weights.tocsr()
    return pairs


def numbers(
    images: FloatArray,
    weights: FloatArray,
    model: LinearModel,
    pixels: dict[str, BoolArray],
    pairs: dict[str, sparse.csr_array],
) -> Iterator[dict[str, float]]:
    """Yield the mean squared residual per region and mean product per kind of pairs of each image [n, ny, nx]."""
    whitened = (weights * images).reshape(len(images), -1).T
    for residual in solve(model, np.ascontiguousarray(whitened)).residual.T:
        chi2 = {name: float((residual[region.ravel()] ** 2).mean()) for name, region in pixels.items()}
        yield chi2 | {name: float(residual @ (pair @ residual)) for name, pair in pairs.items()}


def mocks(paths: list[Path], stage: str, n_mocks: int, band: str) -> Iterator[FloatArray]:
    """Yield images of the mocks of each chunk that did not fail [n, ny, nx]."""
    for path in paths:
        with open_artifact(path, stage) as artifact:
            table = SampleTable.read(artifact)
            rows = np.flatnonzero(table.done & (table.parameters.sample_id < n_mocks))
            yield artifact.array(f"{band}/image")[rows].astype(np.float64)


def main() -> None:
    """Print the observation with samples and null mocks, band by band."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("results", type=Path)
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    results: Path = arguments.results
    config = read_campaign(results)
    observed, model = (
        read_observation(results / SINGLE["observation"]),
        read_smooth_model(results / SINGLE["smooth_model"]),
    )
    written = {}
    for band in observed.bands:
        weights, pixels = scan_band(observed, model, band.name)[0].weights, regions(observed, model, band)
        with open_artifact(results / SINGLE["scan_design"], "scan_design") as design:
            linear = read_linear_model(design, band.name)
        fit = functools.partial(
            numbers,
            weights=weights,
            model=linear,
            pixels=pixels,
            pairs=counterparts(observed, model, pixels[BRIGHT_ARC]),
        )
        print(f"{band.name}: chi2 per pixel; pixels: {', '.join(f'{k} {v.sum()}' for k, v in pixels.items())}")
        simulated = {
            name: [
                line
                for images in mocks(stage_files(config, stage), stage, n_mocks, band.name)
                for line in fit(images)
            ]
            for name, stage, n_mocks in (
                ("samples", "mocks", config.campaign.n_samples),
                ("null mocks", "null_mocks", config.null_test.n_mocks),
            )
        }
        (values,) = fit(band.image[None])
        written[band.name] = compare(values, simulated)
    if arguments.json:
        arguments.json.write_text(json.dumps(written, indent=2))


if __name__ == "__main__":
    main()
