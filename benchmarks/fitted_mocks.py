"""Is the observation's scan misfit or substructure? Mocks of a campaign are fitted from the start, as the data.

python benchmarks/fitted_mocks.py results/hst_full --samples 3 17 --null 0 1 --output results/fitted --json FILE

Run it in the folder of the workflow. Each mock plays the observation, with the PSF that the data came with: its
lens, source, PSF and clumps are fitted to it alone, with the settings of the campaign, and the scan is its own.
Beside it stands what the campaign made of the same image with the observation's smooth model.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import CONFIG, SINGLE
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.campaign import run as front_end
from warmlens.campaign.files import chunks
from warmlens.campaign.status import read_campaign
from warmlens.config.file import load_config
from warmlens.config.model import Config
from warmlens.imaging.observation import Observation
from warmlens.products.observation import observation_datasets, read_observation
from warmlens.sampling import span_name
from warmlens.summaries.response import mean_square_significance


@dataclass(frozen=True)
class Scan:
    """Fractions of the positions below -4 and -10, bands added, the lowest Delta R, and the fit's chi2_red.

    Also the mean of z^2, NaN where the amplitude is not among the statistics of the scan.
    """

    below_4: float
    below_10: float
    lowest: float
    mean_z2: float
    chi2_red: dict[str, float]


@dataclass(frozen=True)
class Mock:
    """An image that plays the observation; no relic mass for one without substructure."""

    name: str
    m_th_kev: float | None
    log10_m_halo_msun: float | None
    in_campaign: Scan
    fitted: Scan


def place(config: Config, sample: int, *, null: bool) -> tuple[Path, Path, int]:
    """Mocks and scans that hold a sample, and its row there."""
    root = Path(config.results)
    if null:
        return root / SINGLE["null_mocks"], root / SINGLE["null_scans"], sample
    for span in chunks(config):
        if span[0] <= sample < span[1]:
            name = f"chunk-{span_name(span)}.h5"
            return root / "mocks" / name, root / "scans" / name, sample - span[0]
    raise ArtifactError(f"{config.results}: has no sample {sample}")


def write_observation(config: Config, mocks: Path, row: int, output: Path) -> None:
    """Write the image of a mock as an observation: PSF, mask and noise model are those of the data."""
    observed = read_observation(Path(config.results) / SINGLE["observation"])
    bands = []
    with open_artifact(mocks) as artifact:
        for band in observed.bands:
            image = np.where(band.mask, artifact[f"{band.name}/image"][row].astype(np.float64), band.image)
            sigma = band.sigma
            if band.noise.exposure_s is not None:
                sigma = np.where(band.mask, band.noise.sigma(image), band.sigma)
            bands.append(dataclasses.replace(band, image=image, sigma=sigma))
    played = Observation(observed.kind, observed.grid, tuple(bands))
    settings = {"mocks": str(mocks), "row": row}
    write_artifact(output, Provenance("observation", settings, {"artifact": mocks}), *observation_datasets(played))


def read_scan(path: Path, row: int | None, chi2_red: dict[str, float]) -> Scan:
    """Numbers of the scan of an observation, or of one row of a chunk."""
    key = ... if row is None else row
    with open_artifact(path) as artifact:
        bands = artifact.metadata["bands"]
        valid = artifact.array("raster/valid").astype(bool)
        values = np.sum([artifact[f"{band}/delta_r"][key] for band in bands], axis=0)[valid]
        mean_z2 = float("nan")
        if f"{bands[0]}/score" in artifact.file:
            score, fisher = (
                np.sum([artifact[f"{band}/{name}"][key] for band in bands], axis=0) for name in ("score", "fisher")
            )
            mean_z2 = float(mean_square_significance(score, fisher, valid))
    below_4, below_10 = (float(np.mean(values < threshold)) for threshold in (-4.0, -10.0))
    return Scan(below_4, below_10, float(values.min()), mean_z2, chi2_red)


def fitted_chi2(results: Path) -> dict[str, float]:
    """chi2_red outside the quasars' cores, by band."""
    with open_artifact(results / SINGLE["smooth_model"], "smooth_model") as artifact:
        return {band: fit["chi2_red_outside_cores"] for band, fit in artifact.metadata["fits"].items()}


def play(config: Config, sample: int, *, null: bool, output: Path, cores: int, step: float | None) -> Mock:
    """Fit and scan one mock as the data were, on a raster of another `step` [arcsec] if one is given."""
    mocks, scans, row = place(config, sample, null=null)
    name = f"{'null' if null else 'sample'}-{sample:04d}"
    played = output / f"{name}-observation.h5"
    if not played.exists():
        write_observation(config, mocks, row, played)
    results = output / name
    change: dict[str, Any] = {
        "results": str(results),
        "observation": {"kind": "artifact", "artifact": str(played), "bands": config.observation.bands},
        "smooth_model": {"allow_poor_fit": True},  # its chi2 is what is asked
    }
    if step is not None:
        change["scan"] = {"step_arcsec": step}
    overlay = output / f"{name}.yaml"
    overlay.write_text(yaml.safe_dump(change))
    target = str(results / SINGLE["observed_scan"])
    layers = [Path(config.results) / CONFIG, overlay]
    if front_end.run(load_config(layers), layers, cores, [target, "--quiet"]):
        raise ArtifactError(f"{results}: the scan of {name} failed; see {results}/logs")
    with open_artifact(mocks) as artifact:
        kev, mass = (float(artifact[f"samples/{key}"][row]) for key in ("m_th_kev", "log10_m_halo_msun"))
    before = read_scan(scans, row, {})
    after = read_scan(results / SINGLE["observed_scan"], None, fitted_chi2(results))
    return Mock(name, None if null else kev, None if null else mass, before, after)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path, help="folder of a finished campaign")
    parser.add_argument("--samples", type=int, nargs="*", default=[])
    parser.add_argument("--null", type=int, nargs="*", default=[], help="mocks without substructure")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--step", type=float, help="of their raster [arcsec]; the campaign's unless given")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    config = read_campaign(arguments.results)
    root = arguments.results
    observed = read_scan(root / SINGLE["observed_scan"], None, fitted_chi2(root))
    found = [
        play(config, sample, null=null, output=arguments.output, cores=arguments.cores, step=arguments.step)
        for null, samples in ((True, arguments.null), (False, arguments.samples))
        for sample in samples
    ]
    printed = Table(
        "image", "keV", "log10 M", "below -4 as the campaign's mock", "fitted itself", "mean z^2", "chi2_red"
    )
    printed.add_row("the data", "", "", "", f"{observed.below_4:.1%}", f"{observed.mean_z2:.2f}", _text(observed))
    for mock in found:
        kev, mass = (f"{v:.2f}" if v else "none" for v in (mock.m_th_kev, mock.log10_m_halo_msun))
        shown = [f"{scan.below_4:.1%}" for scan in (mock.in_campaign, mock.fitted)]
        squares = f"{mock.in_campaign.mean_z2:.2f}, {mock.fitted.mean_z2:.2f}"
        printed.add_row(mock.name, kev, mass, *shown, squares, _text(mock.fitted))
    Console().print(printed)
    if arguments.json:
        whole: dict[str, Any] = {"command": " ".join(sys.argv), "observed": dataclasses.asdict(observed)}
        whole["mocks"] = [dataclasses.asdict(mock) for mock in found]
        arguments.json.write_text(json.dumps(whole, indent=2) + "\n")


def _text(scan: Scan) -> str:
    return ", ".join(f"{value:.3f}" for value in scan.chi2_red.values())


if __name__ == "__main__":
    main()
