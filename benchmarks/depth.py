"""How deep an image, or how strong its substructure, would have to be for a scan to tell the relic mass.

python benchmarks/depth.py results/paper_cold --samples 1000 --depths 1 10 100 --amplify 1 3 10 --json FILE

The mocks of a campaign are drawn anew from their deflections, as if the exposure were D times as long, and scanned
by the campaign's operator. It weighs pixels relative to one another: such an exposure makes every chi2 D times as
large, and the thresholds of the campaign are for D Delta R. Source and lens keep their freedom. `--amplify` bends
the light that many times as much, at the depth of the campaign: what halos would have to do.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import NamedTuple

from warmlens import runtime

runtime.prepare()  # before numpy: one thread, and compiled kernels of this code

import numpy as np
from edge import Maps, scan
from information import Rung, worth
from rich.console import Console
from rich.table import Table

from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import SINGLE
from warmlens.campaign.files import stage_files
from warmlens.campaign.status import read_campaign
from warmlens.fitting.smooth_model import scan_band
from warmlens.imaging.noise import NoiseModel
from warmlens.products.observation import read_observation
from warmlens.products.samples import SampleTable
from warmlens.products.smooth_model import read_smooth_model
from warmlens.sampling import stream
from warmlens.stages.mocks import noise_free_image
from warmlens.summaries.correlation import PairGeometry, correlation_function
from warmlens.summaries.cumulative import cumulative_distribution
from warmlens.summaries.response import amplitude_correlation, mean_square_significance
from warmlens.types import FloatArray

FLOOR = 1e-4  # of C(dr) and the cumulative distribution, whose logarithms are regressed


def deeper(noise: NoiseModel, depth: float) -> NoiseModel:
    """Noise of an exposure that is so many times longer."""
    if noise.background_rms is None or noise.exposure_s is None:
        raise ValueError("the noise of a longer exposure is not known where a noise map was given")
    return NoiseModel(noise.background_rms / np.sqrt(depth), noise.exposure_s * depth, noise.correlation)


class Case(NamedTuple):
    """Exposure over that of the campaign, and deflections over those of its halos."""

    depth: float
    amplify: float

    @property
    def name(self) -> str:
        """What is written of it."""
        return f"depth x {self.depth:g}, deflections x {self.amplify:g}"


def chunk_images(results: Path, path: Path, case: Case) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Parameters (relic mass, log10 halo mass) of the good samples of a chunk [n, 2], and images by band."""
    config = read_campaign(results)
    observed = read_observation(results / SINGLE["observation"])
    model = read_smooth_model(results / SINGLE["smooth_model"])
    with open_artifact(path, "deflections") as artifact:
        table = SampleTable.read(artifact)
        fields = case.amplify * artifact.array("delta_alpha").astype(np.float64)
    good = np.flatnonzero(table.done)
    ids = table.parameters.sample_id
    images = {}
    for item in observed.bands:
        band, convolution = scan_band(observed, model, item.name)
        noise = deeper(item.noise, case.depth)
        images[item.name] = np.stack(
            [
                noise.draw(
                    noise_free_image(model, observed.grid, band, convolution, fields[row]),
                    band.sigma,
                    stream(config.campaign.seed, f"depth {case.depth:g}", int(ids[row]), item.name),
                )
                for row in good
            ]
        )
    parameters = np.column_stack([table.parameters.m_th_kev, table.parameters.log10_m_halo_msun])
    return parameters[good], images


def numbers(results: Path, maps: Maps, depth: float) -> dict[str, FloatArray]:
    """Summaries of every image [n, ...]: the paper's, and those of the linear response."""
    config = read_campaign(results)
    block = config.summaries
    geometry = PairGeometry.from_raster(maps.valid, config.scan.step_arcsec, block.max_separation_arcsec)
    delta_r = depth * maps.delta_r
    thresholds = np.linspace(-40.0, block.threshold, 37)
    return {
        "C(dr), cumulative": np.log10(
            FLOOR
            + np.hstack(
                [
                    correlation_function(delta_r, geometry, block.threshold),
                    cumulative_distribution(delta_r, maps.valid, thresholds),
                ]
            )
        ),
        "linear response": np.column_stack(
            [
                mean_square_significance(maps.score, maps.fisher, maps.valid),
                amplitude_correlation(maps.score, maps.fisher, geometry),
            ]
        ),
    }


def rungs(results: Path, case: Case, n_samples: int, n_rows: int) -> list[Rung]:
    """What the summaries are worth in a case."""
    config = read_campaign(results)
    parameters: list[FloatArray] = []
    parts: dict[str, list[FloatArray]] = {}
    for path in stage_files(config, "deflections"):
        if sum(map(len, parameters)) >= n_samples:
            break
        known, images = chunk_images(results, path, case)
        parameters.append(known)
        for name, values in numbers(results, scan(results, images), case.depth).items():
            parts.setdefault(name, []).append(values)
    whole = np.concatenate(parameters)[:n_samples]
    return [
        worth(f"{case.name}: {name}", np.concatenate(values)[:n_samples], whole, config, n_rows)
        for name, values in parts.items()
    ]


def main() -> None:
    """Print a line for each depth and set of summaries."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("results", type=Path)
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--rows", type=int, default=300, help="samples that play the observation")
    parser.add_argument("--depths", type=float, nargs="+", default=[1.0, 10.0, 100.0])
    parser.add_argument("--amplify", type=float, nargs="+", default=[1.0], help="deflections, at depth 1")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    table = Table("", "r^2", "cold above warm", "information [nat]", "expected bound [keV]")
    found: list[Rung] = []
    cases = dict.fromkeys([*(Case(d, 1.0) for d in arguments.depths), *(Case(1.0, a) for a in arguments.amplify)])
    for case in cases:
        for rung in rungs(arguments.results, case, arguments.samples, arguments.rows):
            gain = rung.gain
            cells = f"{rung.r_squared:.3f}", f"{rung.separation:.2f}"
            information = f"{gain.gain_nats:.3f} +- {gain.gain_error_nats:.3f}"
            bound = f"{gain.expected_bound_kev:.2f} +- {gain.expected_bound_error_kev:.2f}"
            table.add_row(rung.name, *cells, information, bound)
            found.append(rung)
            print(rung.name, *cells, information, bound, flush=True)
    Console().print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps([dataclasses.asdict(rung) for rung in found], indent=2))


if __name__ == "__main__":
    main()
