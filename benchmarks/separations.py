"""Which separations and which band carry what a scan says of the relic mass.

python benchmarks/separations.py results/paper_cold --figure FILE.png [--json FILE]

Rank correlation of every bin of the correlation functions with the relic mass over all samples of a campaign; what
both owe to the halo mass is taken out (partial, in ranks).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib as mpl
import numpy as np
from scipy.stats import rankdata

from warmlens.artifacts.file import open_artifact
from warmlens.campaign.files import stage_files
from warmlens.campaign.status import read_campaign
from warmlens.figures.draw.style import house_style
from warmlens.products.samples import OK
from warmlens.types import FloatArray

mpl.use("agg")

STATISTICS = {"correlation": r"$C(\mathrm{d}r)$", "amplitude_correlation": "of the amplitude"}
NAMES = ("samples/m_th_kev", "samples/log10_m_halo_msun", "samples/status")


def partial_rank_correlation(numbers: FloatArray, of_interest: FloatArray, other: FloatArray) -> FloatArray:
    """Correlation of ranks of each column [n, k] with `of_interest` [n], `other` [n] taken out of both, [k]."""
    ranks = rankdata(np.column_stack([numbers, of_interest]), axis=0)
    regressors = np.column_stack([rankdata(other), np.ones(len(other))])
    left = ranks - regressors @ np.linalg.lstsq(regressors, ranks, rcond=None)[0]
    left /= np.linalg.norm(left, axis=0)
    return left[:, :-1].T @ left[:, -1]


def correlations(results: Path) -> tuple[FloatArray, dict[str, dict[str, FloatArray]], int]:
    """Separations [n_dr] [arcsec], partial correlations [n_dr] by statistic and band, number of samples."""
    config = read_campaign(results)
    files = stage_files(config, "summaries")
    with open_artifact(files[0], "summaries") as artifact:
        separation = artifact.array("separation")
        bands = [*artifact.metadata["bands"], "combined"]
    wanted = {(kind, band): f"{band}/{kind}" for kind in STATISTICS for band in bands}
    read: dict[str, list[FloatArray]] = {name: [] for name in (*NAMES, *wanted.values())}
    for path in files:
        with open_artifact(path, "summaries") as artifact:
            for name, parts in read.items():
                parts.append(artifact.array(name))
    columns = {name: np.concatenate(parts)[: config.campaign.n_samples] for name, parts in read.items()}
    m_th, log10_mass, status = (columns[name] for name in NAMES)
    good = status == OK
    found: dict[str, dict[str, FloatArray]] = {kind: {} for kind in STATISTICS}
    for (kind, band), name in wanted.items():
        found[kind][band] = partial_rank_correlation(columns[name][good], m_th[good], log10_mass[good])
    return separation, found, int(good.sum())


def draw(separation: FloatArray, found: dict[str, dict[str, FloatArray]], n: int, output: Path) -> None:
    """A panel for each correlation function, a line for each band."""
    import matplotlib.pyplot as plt

    with house_style():
        figure, axes = plt.subplots(1, len(found), figsize=(7.2, 2.9), sharey=True, layout="constrained")
        for ax, (kind, by_band) in zip(axes, found.items(), strict=True):
            ax.axhspan(-2.0 / np.sqrt(n), 2.0 / np.sqrt(n), color="0.9", label=r"no correlation, $2\sigma$")
            for band, values in by_band.items():
                ax.plot(separation, values, label=band, color="k" if band == "combined" else None)
            ax.set(xlabel=r"$\mathrm{d}r$ [arcsec]", title=STATISTICS[kind])
        axes[0].set_ylabel(r"rank correlation with $m_\mathrm{TH}$ at fixed $M_\mathrm{h}$")
        axes[-1].legend(fontsize="small")
        figure.savefig(output)
        plt.close(figure)


def main() -> None:
    """Print the strongest bins, and write the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("results", type=Path)
    parser.add_argument("--figure", type=Path, required=True, help="picture to write")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    separation, found, n = correlations(arguments.results)
    print(f"{n} samples, error of a correlation {1.0 / np.sqrt(n):.3f}")
    for kind, by_band in found.items():
        for band, values in by_band.items():
            best = int(np.argmax(np.abs(values)))
            strongest = f"strongest {values[best]:+.3f} at {separation[best]:.2f} arcsec"
            print(f"{kind}, {band}: {values[0]:+.3f} at 0, {strongest}")
    draw(separation, found, n, arguments.figure)
    if arguments.json:
        numbers = {kind: {band: v.tolist() for band, v in by_band.items()} for kind, by_band in found.items()}
        arguments.json.write_text(json.dumps({"separation_arcsec": separation.tolist(), **numbers}, indent=2))


if __name__ == "__main__":
    main()
