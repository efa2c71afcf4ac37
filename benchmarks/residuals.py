"""Where does the smooth model fit the observation worse than mocks: chi2 a pixel of the scan's fit, by region.

python benchmarks/residuals.py results/hst_full --json FILE

Arcs are told apart by their brightness in noise deviations of a pixel, away from the quasar images; cores are
those of the quasar images and of the lens. Every image is fitted with all the freedom that the scan gives source
and lens.
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

import numpy as np  # noqa: E402
from cloud import compare  # noqa: E402

from warmlens.artifacts import open_artifact  # noqa: E402
from warmlens.fitting.linear import LinearModel, solve  # noqa: E402
from warmlens.imaging.observation import Band, Observation  # noqa: E402
from warmlens.layout import SINGLE, stage_files  # noqa: E402
from warmlens.stages.products import (  # noqa: E402
    SmoothModel,
    read_linear_model,
    read_observation,
    read_smooth_model,
    scan_band,
)
from warmlens.stages.samples import SampleTable  # noqa: E402
from warmlens.status import read_campaign  # noqa: E402
from warmlens.types import BoolArray, FloatArray  # noqa: E402

QUASAR_CORE, QUASAR_HALO, LENS_CORE = 0.25, 0.8, 0.3  # arcsec
BRIGHTNESS = (-np.inf, 1.0, 3.0, 10.0, np.inf)  # edges, in noise deviations


def regions(observed: Observation, model: SmoothModel, item: Band) -> dict[str, BoolArray]:
    """Pixels of each region [ny, nx], those that the fit leaves out not among them."""
    fit = model.fits[item.name]
    x, y = observed.grid.coordinates()
    to_quasar = np.min([np.hypot(x - x_i, y - y_i) for x_i, y_i in model.quasars], axis=0)
    used = scan_band(observed, model, item.name)[0].mask
    brightness = (fit.model - fit.fixed_image) / item.sigma
    found = {
        f"arc at {low:g} to {high:g} sigma": used
        & (to_quasar > QUASAR_HALO)
        & (brightness > low)
        & (brightness <= high)
        for low, high in itertools.pairwise(BRIGHTNESS)
    }
    found["cores of quasar images"] = used & (to_quasar < QUASAR_CORE)
    found["core of the lens"] = used & (np.hypot(x, y) < LENS_CORE)
    return found


def chi2_by_region(
    images: FloatArray, weights: FloatArray, model: LinearModel, pixels: dict[str, BoolArray]
) -> Iterator[dict[str, float]]:
    """Mean squared residual of each region, of each image [n, ny, nx]."""
    whitened = (weights * images).reshape(len(images), -1).T
    squares = solve(model, np.ascontiguousarray(whitened)).residual ** 2
    for square in squares.T:
        yield {name: float(square[region.ravel()].mean()) for name, region in pixels.items()}


def mocks(paths: list[Path], stage: str, n_mocks: int, band: str) -> Iterator[FloatArray]:
    """Images of the mocks of each chunk that did not fail [n, ny, nx]."""
    for path in paths:
        with open_artifact(path, stage) as artifact:
            table = SampleTable.read(artifact)
            rows = np.flatnonzero(table.done & (table.parameters.sample_id < n_mocks))
            yield artifact.array(f"{band}/image")[rows].astype(np.float64)


def main() -> None:
    """Print the observation beside samples and null mocks, band by band."""
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
    for item in observed.bands:
        weights, pixels = scan_band(observed, model, item.name)[0].weights, regions(observed, model, item)
        with open_artifact(results / SINGLE["scan_design"], "scan_design") as design:
            linear = read_linear_model(design, item.name)

        fit = functools.partial(chi2_by_region, weights=weights, model=linear, pixels=pixels)
        print(f"{item.name}: chi2 a pixel; pixels: {', '.join(f'{k} {v.sum()}' for k, v in pixels.items())}")
        clouds = {
            name: [
                line
                for images in mocks(stage_files(config, stage), stage, n_mocks, item.name)
                for line in fit(images)
            ]
            for name, stage, n_mocks in (
                ("samples", "mocks", config.campaign.n_samples),
                ("null mocks", "null_mocks", config.null_test.n_mocks),
            )
        }
        (values,) = fit(item.image[None])
        written[item.name] = compare(values, clouds)
    if arguments.json:
        arguments.json.write_text(json.dumps(written, indent=2))


if __name__ == "__main__":
    main()
