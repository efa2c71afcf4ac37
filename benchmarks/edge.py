"""Why an observation lies at the edge of its mocks: what its source does to the scan, what its substructure.

python benchmarks/edge.py results/paper_cold [--draws 40] --json FILE

For a campaign on a simulated observation, whose truth is known. Images of the true source and of the fitted one,
each without substructure and with that of the truth, are scanned by the campaign's operator, with many draws of
noise. The fitted source without substructure is the null test; the true one with it is the observation once more.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import NamedTuple

from warmlens import runtime

runtime.prepare()  # before numpy: one thread, and compiled kernels of this code

import numpy as np
from rich.console import Console
from rich.table import Table

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import SINGLE
from warmlens.campaign.files import campaign_job
from warmlens.campaign.status import read_campaign
from warmlens.fitting.smooth_model import scan_band
from warmlens.products.observation import read_observation
from warmlens.products.smooth_model import read_smooth_model
from warmlens.sampling import stream
from warmlens.stages.mocks import noise_free_image
from warmlens.stages.observation import true_image
from warmlens.stages.scanner import Scanner
from warmlens.summaries.correlation import excess_residuals
from warmlens.summaries.cumulative import counts_below
from warmlens.summaries.response import mean_square_significance
from warmlens.types import BoolArray, FloatArray

KINDS = ("fitted, smooth", "fitted, substructure", "true, smooth", "true, substructure")  # source, lens
THRESHOLDS = (-10.0, -4.0)


class Maps(NamedTuple):
    """Maps of n images, all bands together [n, ny, nx], valid positions [ny, nx], chi2 of the smooth fits [n]."""

    delta_r: FloatArray
    score: FloatArray
    fisher: FloatArray
    valid: BoolArray
    chi2: FloatArray


def images(results: Path, n_draws: int) -> dict[str, FloatArray]:
    """Noisy images of every kind one after the other, by band [n_kinds n_draws, ny, nx]."""
    config = read_campaign(results)
    block = config.observation.simulated
    if config.observation.kind != "simulated" or block is None:
        raise ArtifactError(f"{results}: its observation is not simulated here, so its truth is not known")
    observed, model = (
        read_observation(results / SINGLE["observation"]),
        read_smooth_model(results / SINGLE["smooth_model"]),
    )
    with open_artifact(results / SINGLE["observation"], "observation") as artifact:
        substructure = artifact.array("truth/delta_alpha")
    found = {}
    for item in observed.bands:
        band, convolution = scan_band(observed, model, item.name)
        clean = [
            *(noise_free_image(model, observed.grid, band, convolution, f * substructure) for f in (0.0, 1.0)),
            *(true_image(item.name, block, observed.grid, f * substructure)[0] for f in (0.0, 1.0)),
        ]
        found[item.name] = np.stack(
            [
                item.noise.draw(image, item.noise.sigma(image), stream(config.campaign.seed, "edge", i, item.name))
                for image in clean
                for i in range(n_draws)  # the same noise for every kind
            ]
        )
    return found


def scan(results: Path, by_band: dict[str, FloatArray]) -> Maps:
    """Scan images with the operator of the campaign."""
    config = read_campaign(results)
    scanner = Scanner(campaign_job(config, "observed_scan"))
    none = np.empty(0, dtype=np.int64)
    scans = [scanner.scan(name, data, none) for name, data in by_band.items()]
    responses = [item.response for item in scans if item.response is not None]
    if len(responses) != len(scans):
        raise ArtifactError(f"{results}: scanned without amplitude; add it to scan.statistics")
    return Maps(
        np.sum([item.delta_r for item in scans], axis=0),
        np.sum([item.score for item in responses], axis=0),
        np.sum([item.fisher for item in responses], axis=0),
        np.logical_or.reduce([item.valid for item in scans]),
        np.sum([item.chi2 for item in scans], axis=0),
    )


def statistics(maps: Maps) -> dict[str, FloatArray]:
    """Numbers of each image by name [n]."""
    excess = excess_residuals(maps.delta_r, maps.valid)
    below = counts_below(maps.delta_r, maps.valid, np.array(THRESHOLDS))
    return {
        "C(0)": (excess**2).sum(axis=(1, 2)) / maps.valid.sum(),
        **{f"positions below {t:g}": below[:, i].astype(float) for i, t in enumerate(THRESHOLDS)},
        "mean z^2": mean_square_significance(maps.score, maps.fisher, maps.valid),
        "chi2": maps.chi2,
    }


def main() -> None:
    """Print mean and scatter of every kind, beside the observation."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("results", type=Path)
    parser.add_argument("--draws", type=int, default=40, help="of the noise, for each kind of image")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    noisy = images(arguments.results, arguments.draws)
    observed = read_observation(arguments.results / SINGLE["observation"])
    real = {band.name: band.image[None] for band in observed.bands}
    found = statistics(
        scan(arguments.results, {name: np.concatenate([noisy[name], real[name]]) for name in noisy})
    )
    table = Table("", *KINDS, "the observation")
    result = {}
    for name, values in found.items():
        by_kind = values[:-1].reshape(len(KINDS), arguments.draws)
        mean, scatter = by_kind.mean(axis=1), by_kind.std(axis=1, ddof=1)
        table.add_row(
            name, *(f"{m:.4g} +- {s:.2g}" for m, s in zip(mean, scatter, strict=True)), f"{values[-1]:.4g}"
        )
        result[name] = {
            "mean": dict(zip(KINDS, mean.tolist(), strict=True)),
            "scatter": dict(zip(KINDS, scatter.tolist(), strict=True)),
            "observation": float(values[-1]),
        }
    Console().print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
