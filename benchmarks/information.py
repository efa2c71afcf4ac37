"""Where the information about the relic mass is lost: from the halos over their deflection to the scan.

python benchmarks/information.py results/paper_cold --json FILE --figure FILE.png

Every rung is a set of numbers a sample, of which the relic mass is regressed (cross-fitted, as `learned` of the
inference) and then inferred by the same acceptance: counts of subhalos by bound mass, which a perfect telescope
would give; the deflection without noise, by the power of its spatial frequencies; what is seen in the scan.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
from rich.console import Console
from rich.table import Table as Printed

from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import SINGLE
from warmlens.campaign.files import campaign_job, stage_files
from warmlens.campaign.status import read_campaign
from warmlens.config.model import Config
from warmlens.inference.calibration import leave_one_out
from warmlens.inference.information import Information, information
from warmlens.inference.learned import learned_summaries
from warmlens.inference.summary_sets import COUNTS, PAPER, RESPONSE
from warmlens.inference.table import Table
from warmlens.products.observation import read_observation
from warmlens.sampling import stream
from warmlens.stages.abc.tables import read_samples
from warmlens.types import FloatArray

mpl.use("agg")

REGION_ARCSEC = 3.0  # subhalos within are counted: the arcs and what is near them
MASS_EDGES = 10.0 ** np.arange(7.0, 11.1, 0.5)  # Msun, bound
SCALES_ARCSEC = (0.1, 0.2, 0.4, 0.8, 1.6)  # edges of the bands of wavelengths
WARM_KEV, COLD_KEV = (1.0, 1.5), (4.0, 5.0)
SAME_HALO = (13.2, 13.3)  # log10 Msun


@dataclass(frozen=True)
class Rung:
    """What one set of numbers is worth.

    Attributes
    ----------
    name
        In words.
    r_squared
        Cross-validated fraction of the variance of the relic mass that the numbers predict.
    separation
        Probability that a cold sample is predicted heavier than a warm one of the same halo mass; 0.5: not at all.
    gain
        Information and expected bound of the inference on the prediction.
    """

    name: str
    r_squared: float
    separation: float
    gain: Information


def halo_numbers(config: Config) -> Iterator[FloatArray]:
    """Subhalos above each mass of `MASS_EDGES` in the region, a chunk at a time [n, n_masses]."""
    for path in stage_files(config, "halos"):
        with open_artifact(path, "halos") as artifact:
            names = ("offsets", "m_bound", "x_arcsec", "y_arcsec")
            offsets, mass, x, y = (artifact.array(f"subhalos/{name}") for name in names)
        inside = np.hypot(x, y) < REGION_ARCSEC
        above = inside[:, None] & (mass[:, None] >= MASS_EDGES)
        running = np.concatenate([np.zeros((1, MASS_EDGES.size)), np.cumsum(above, axis=0)])
        yield np.diff(running[offsets], axis=0)


def deflection_numbers(config: Config, pixel_scale: float) -> Iterator[FloatArray]:
    """log10 of the deflection's power in bands of wavelength, and of its rms, a chunk at a time [n, n_bands + 1].

    Wavelengths fall from band to band.
    """
    for path in stage_files(config, "deflections"):
        with open_artifact(path, "deflections") as artifact:
            fields, rms = artifact.array("delta_alpha").astype(np.float64), artifact.array("rms")
        shape = fields.shape[-2:]
        window = np.outer(*(np.hanning(n) for n in shape))  # the image is not periodic
        power = (np.abs(np.fft.rfft2(fields * window)) ** 2).sum(axis=1)
        frequency = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])) / pixel_scale
        edges = 1.0 / np.array(SCALES_ARCSEC[::-1])
        bands = [(low <= frequency) & (frequency < high) for low, high in pairwise(edges)]
        yield np.log10(np.column_stack([*(power[:, band].sum(axis=1) for band in bands), rms]) + 1e-30)


def rungs(config: Config) -> dict[str, FloatArray]:
    """Numbers of every rung by name, each [n_good, ...], and the good samples' parameters under ""."""
    n = config.campaign.n_samples
    samples = read_samples(campaign_job(config, "abc"))
    good, seen = samples.good, samples.summaries
    grid = read_observation(Path(config.results) / SINGLE["observation"]).grid
    counts = np.concatenate(list(halo_numbers(config)))[:n][good]
    power = np.concatenate(list(deflection_numbers(config, grid.pixel_scale)))[:n][good]

    def side_by_side(names: tuple[str, ...]) -> FloatArray:
        return np.hstack([seen[name].samples.reshape(int(good.sum()), -1) for name in names if name in seen])

    found = {"": samples.parameters}
    for first, name in ((0, "1e7"), (2, "1e8"), (3, "3e8"), (4, "1e9")):
        found[f"halos: masses above {name}"] = counts[:, first:]
    found["deflection: rms"] = power[:, -1:]
    found['deflection: power at 0.1-0.2"'] = power[:, -2:-1]
    found["deflection: power at all scales"] = power[:, :-1]
    found["scan: C(dr), cumulative"] = side_by_side(PAPER)
    found["scan: counts, chi2"] = side_by_side(COUNTS)
    if RESPONSE[0] in seen:
        found["scan: linear response"] = side_by_side(RESPONSE)
    found["scan: everything"] = side_by_side((*PAPER, *COUNTS, *RESPONSE))
    return found


def worth(name: str, numbers: FloatArray, parameters: FloatArray, config: Config, n_rows: int) -> Rung:
    """Regress and infer the relic mass from the numbers of a rung."""
    seed = config.campaign.seed
    learned = learned_summaries(parameters, numbers, numbers[:1], stream(seed, "rungs/folds", 0))
    predicted = learned.samples[:, :1]
    block = config.dark_matter
    m, log10_mass = parameters.T
    ids = np.arange(len(m))
    table = Table(
        ids, m, log10_mass, block.m_th_kev, block.log10_m_halo_msun, (predicted,), (predicted[0],), ("rung",)
    )
    trials = leave_one_out(table, "max_rank", config.abc.fraction, n_rows, stream(seed, "rungs/trials", 0))
    gain = information(m, block.m_th_kev, trials, stream(seed, "rungs/chance", 0))
    same = (log10_mass >= SAME_HALO[0]) & (log10_mass < SAME_HALO[1])
    warm, cold = (predicted[same & (m >= low) & (m <= high), 0] for low, high in (WARM_KEV, COLD_KEV))
    return Rung(name, float(learned.r_squared[0]), float(np.mean(cold[:, None] > warm)), gain)


def draw(found: list[Rung], prior_kev: float, output: Path) -> None:
    """Information and expected bound, a line a rung."""
    import matplotlib.pyplot as plt

    from warmlens.figures.draw.style import BLUE, FULL_WIDTH_INCH, RED, house_style

    with house_style():
        figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 1.2 + 0.3 * len(found)), sharey=True)
        places = np.arange(len(found))
        for ax, colour, value, label in (
            (axes[0], RED, "gain", "information on $m_{\\rm TH}$ [nat]"),
            (axes[1], BLUE, "expected_bound", "expected bound if dark matter is cold [keV]"),
        ):
            unit = "nats" if value == "gain" else "kev"
            values, errors = (
                [getattr(rung.gain, f"{value}{kind}_{unit}") for rung in found] for kind in ("", "_error")
            )
            ax.errorbar(values, places, xerr=errors, fmt="o", ms=4, lw=1.2, color=colour)
            ax.axvline(0.0 if value == "gain" else prior_kev, color="0.6", lw=0.8, ls="--")
            ax.set_xlabel(label)
            ax.tick_params(axis="y", which="both", left=False, right=False)
        axes[0].set_yticks(places, [rung.name for rung in found])
        axes[0].set_ylim(len(found) - 0.5, -0.5)
        figure.savefig(output)
        plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path, help="folder of a finished campaign")
    parser.add_argument("--rows", type=int, default=1000, help="samples that play the observation")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    config = read_campaign(arguments.results)
    numbers = rungs(config)
    parameters = numbers.pop("")
    found = [worth(name, values, parameters, config, arguments.rows) for name, values in numbers.items()]
    printed = Printed("rung", "r^2", "cold above warm", "information [nat]", "expected bound [keV]")
    for rung in found:
        gain = rung.gain
        printed.add_row(
            rung.name,
            f"{rung.r_squared:.3f}",
            f"{rung.separation:.2f}",
            f"{gain.gain_nats:.3f} +- {gain.gain_error_nats:.3f}",
            f"{gain.expected_bound_kev:.2f} +- {gain.expected_bound_error_kev:.2f}",
        )
    Console().print(printed)
    if arguments.json:
        whole = {"command": " ".join(sys.argv), "rungs": [dataclasses.asdict(rung) for rung in found]}
        arguments.json.write_text(json.dumps(whole, indent=2) + "\n")
    if arguments.figure:
        low, high = config.dark_matter.m_th_kev
        draw(found, low + 0.0455 * (high - low), arguments.figure)


if __name__ == "__main__":
    main()
