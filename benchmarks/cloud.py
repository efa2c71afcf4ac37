"""Does the observed scan look like its mocks', and where not? Faint and bright positions separately.

python benchmarks/cloud.py results/hst_full --json FILE

For a campaign with the amplitude among `scan.statistics`. Positions are faint where noise in the fitted source
makes most of the Fisher information (F < 1.5 f), bright where the source itself does (F > 4 f): what noise alone
does shows at the faint ones, substructure and misfit at the bright.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from warmlens.artifacts.file import Artifact, open_artifact
from warmlens.artifacts.names import SINGLE
from warmlens.campaign.files import stage_files
from warmlens.campaign.status import read_campaign
from warmlens.products.samples import SampleTable
from warmlens.types import FloatArray

FAINT, BRIGHT = 1.5, 4.0  # F / f below and above
QUANTILES = (0.16, 0.5, 0.84)


def numbers(artifact: Artifact, row: int | None) -> dict[str, float]:
    """Return numbers of one map, the bands added: `row` of a chunk, or None for an observed scan."""
    bands = artifact.metadata["bands"]

    def added(name: str) -> FloatArray:
        key = row if row is not None and name != "fisher_noise" else ...
        return np.sum([artifact[f"{band}/{name}"][key] for band in bands], axis=0)

    delta_r, score, fisher, noise = (added(name) for name in ("delta_r", "score", "fisher", "fisher_noise"))
    valid = artifact.array("raster/valid").astype(bool)
    informed = valid & (fisher > 0.0)
    square = np.divide(score**2, fisher, out=np.zeros_like(score), where=informed)
    faint, bright = informed & (fisher < FAINT * noise), informed & (fisher > BRIGHT * noise)
    return {
        "mean z^2": float(square[informed].mean()),
        "mean z^2, faint": float(square[faint].mean()),
        "mean z^2, bright": float(square[bright].mean()),
        "below -4 [%]": 100.0 * float(np.mean(delta_r[valid] < -4.0)),
        "below -10 [%]": 100.0 * float(np.mean(delta_r[valid] < -10.0)),
        "C(0)": float(np.sum(np.where(delta_r < -4.0, delta_r, 0.0)[valid] ** 2) / valid.sum()),
        "chi2": float(np.sum([artifact[f"{band}/chi2"][... if row is None else row] for band in bands])),
        "positions, faint": float(faint.sum()),
        "positions, bright": float(bright.sum()),
    }


def mocks(paths: list[Path], stage: str, n_mocks: int) -> Iterator[dict[str, float]]:
    """Yield numbers of every mock that did not fail; the last chunk may hold more than the campaign counts."""
    for path in paths:
        with open_artifact(path, stage) as artifact:
            table = SampleTable.read(artifact)
            for row in np.flatnonzero(table.done & (table.parameters.sample_id < n_mocks)):
                yield numbers(artifact, int(row))


def main() -> None:
    """Print the observation with samples and null mocks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("results", type=Path)
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    config = read_campaign(arguments.results)
    with open_artifact(arguments.results / SINGLE["observed_scan"], "observed_scan") as artifact:
        observed = numbers(artifact, None)
    simulated = {
        "samples": list(mocks(stage_files(config, "scans"), "scans", config.campaign.n_samples)),
        "null mocks": list(mocks(stage_files(config, "null_scans"), "null_scans", config.null_test.n_mocks)),
    }
    result = compare(observed, simulated)
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2))


def compare(
    observed: dict[str, float], simulated: dict[str, list[dict[str, float]]]
) -> dict[str, dict[str, object]]:
    """Print and return each number of the observation with its quantiles in sets of mocks, one named `samples`."""
    counts = (f"{len(rows)} {kind}" for kind, rows in simulated.items())
    table = Table("", "the observation", *counts, "samples below it")
    result: dict[str, dict[str, object]] = {}
    for name, value in observed.items():
        line = {}
        for kind, rows in simulated.items():
            low, middle, high = np.quantile([row[name] for row in rows], QUANTILES)
            line[kind] = {"low": low, "median": middle, "high": high}
        below = float(np.mean([row[name] < value for row in simulated["samples"]]))
        shown = [f"{q['median']:.4g} ({q['low']:.4g} to {q['high']:.4g})" for q in line.values()]
        table.add_row(name, f"{value:.4g}", *shown, f"{below:.1%}")
        result[name] = {"observation": value, "samples_below": below, **line}
    Console(width=140).print(table)
    return result


if __name__ == "__main__":
    main()
