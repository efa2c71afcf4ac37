"""One sample of a campaign, gathered from its artifacts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warmlens.artifacts.file import Artifact, ArtifactError
from warmlens.artifacts.names import CHUNKED, SINGLE
from warmlens.campaign.files import chunks, stage_files
from warmlens.config.model import Config, CosmologyBlock, RedshiftBlock
from warmlens.cosmology import LensGeometry
from warmlens.figures.draw.scan import ScanRow
from warmlens.halos.lens_halo import Subhalos
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.observation import Observation
from warmlens.physics import geometry
from warmlens.products.halos import read_subhalos
from warmlens.products.observation import read_observation
from warmlens.products.samples import FAILED_HERE, OK
from warmlens.products.scan_maps import by_band, raster_grid
from warmlens.report.campaign_files import open_of_campaign, read_inferred
from warmlens.stages.summaries import COMBINED
from warmlens.types import FloatArray

SUMMARIES = {"correlation": "separation", "cumulative": "thresholds"}


@dataclass(frozen=True)
class StageRecord:
    """What a stage did for the sample.

    Attributes
    ----------
    stage, name, digest
        The stage, its artifact under the results folder, and the SHA-256 of its content.
    row
        Of the sample in the artifact.
    status
        done, failed here, or failed in an earlier stage.
    seed_keys
        Keys of the random streams it drew from, seed first; none where nothing is drawn.
    traceback
        Where it failed, if it did.
    """

    stage: str
    name: str
    digest: str
    row: int
    status: str
    seed_keys: tuple[str, ...]
    traceback: str


@dataclass(frozen=True)
class HaloFacts:
    """Substructure of the sample; see the artifact of the stage `halos` for what the numbers mean."""

    subhalos: Subhalos
    counts: dict[str, int]
    f_sub: float
    z_half: float
    mass_bins: FloatArray
    mass_function: FloatArray
    min_mass_msun: float


@dataclass(frozen=True)
class Verdict:
    """What the inference made of the sample: distances and ranks are NaN if it failed."""

    accepted: bool
    weight: float
    distance_correlation: float
    distance_cumulative: float
    ranks: dict[str, int]
    max_rank: float
    n_ranked: int
    n_accepted: int


@dataclass(frozen=True)
class ImageFit:
    """Smooth model of a band and its noise, infinite where masked, both [ny, nx] [e-/s per pixel]."""

    model: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class SampleRecord:
    """One sample, with what it is compared to.

    Attributes
    ----------
    sample_id, m_th_kev, log10_m_halo_msun
        Its number and parameters.
    message
        Why it failed; "" if it did not.
    stages
        One record a chunked stage.
    halo, delta_alpha, deflection_rms_arcsec, mocks, chi2, scan, summaries
        What the stages made; None or empty from the stage on that failed. Deflections [2, ny, nx] [arcsec], mock
        images by band [e-/s per pixel], chi2 of the smooth fit by band, Delta R of observation and sample.
    verdict
        Of the inference.
    observation, fits, lens
        The observation, its smooth model by band, and the geometry of the lens.
    scan_grid, grids, observed, accepted
        Positions of the scan; grids of the summaries, those of the observation, and the 2.5, 16, 50, 84 and
        97.5% of the accepted samples, by kind.
    """

    sample_id: int
    m_th_kev: float
    log10_m_halo_msun: float
    message: str
    stages: tuple[StageRecord, ...]
    halo: HaloFacts | None
    delta_alpha: FloatArray | None
    deflection_rms_arcsec: float
    mocks: dict[str, FloatArray]
    chi2: dict[str, float]
    scan: tuple[ScanRow, ...]
    summaries: dict[str, FloatArray]
    verdict: Verdict
    observation: Observation
    fits: dict[str, ImageFit]
    lens: LensGeometry
    scan_grid: PixelGrid
    grids: dict[str, FloatArray]
    observed: dict[str, FloatArray]
    accepted: dict[str, FloatArray]


def read_sample(results: Path, sample: int) -> SampleRecord:
    """Gather one sample of a finished campaign.

    Parameters
    ----------
    results
        Results folder.
    sample
        Number of the sample, from 0.

    Raises
    ------
    ArtifactError
        If there is no such sample, or an artifact is missing; with the command that makes it.
    """
    config = read_inferred(results)
    n = config.campaign.n_samples
    if not 0 <= sample < n:
        raise ArtifactError(f"{results}: has no sample {sample}; its samples are 0 to {n - 1}")
    place, span = next((i, span) for i, span in enumerate(chunks(config)) if span[0] <= sample < span[1])
    reader = _Reader(results, config, place, sample - span[0], sample)
    with open_of_campaign(results, SINGLE["observation"], "observation") as artifact:
        observation = read_observation(artifact.path)
    with open_of_campaign(results, SINGLE["smooth_model"], "smooth_model") as artifact:
        fits = {
            band: ImageFit(artifact.array(f"{band}/model"), artifact.array(f"{band}/sigma"))
            for band in artifact.metadata["bands"]
        }
    stages = tuple(reader.stage_record(stage) for stage in CHUNKED)
    done = {record.stage: record.status == "done" for record in stages}
    with open_of_campaign(results, SINGLE["observed_scan"], "observed_scan") as artifact:
        scan_grid, valid = raster_grid(artifact), artifact.array("raster/valid")
        seen, r_sens = by_band(artifact, "delta_r"), by_band(artifact, "r_sens")
    with open_of_campaign(results, SINGLE["observed_summary"], "observed_summary") as artifact:
        grids = {kind: artifact.array(name) for kind, name in SUMMARIES.items()}
        observed = {kind: artifact.array(f"{COMBINED}/{kind}") for kind in SUMMARIES}
    with open_of_campaign(results, SINGLE["abc"], "abc") as artifact:
        verdict, message = _verdict(artifact, sample), artifact.strings("table/message")[sample]
        accepted = {kind: artifact.array(f"predictive/{kind}/quantiles") for kind in SUMMARIES}
    maps = reader.scan() if done["scans"] else {}
    m_th_kev, log10_m_halo_msun = reader.parameters()
    delta_alpha, rms = reader.deflection() if done["deflections"] else (None, np.nan)
    return SampleRecord(
        sample_id=sample,
        m_th_kev=m_th_kev,
        log10_m_halo_msun=log10_m_halo_msun,
        message=message,
        stages=stages,
        halo=reader.halo() if done["halos"] else None,
        delta_alpha=delta_alpha,
        deflection_rms_arcsec=rms,
        mocks=reader.mocks() if done["mocks"] else {},
        chi2=reader.chi2() if done["scans"] else {},
        scan=tuple(
            ScanRow(
                name,
                [np.where(valid, item, np.nan) for item in (seen[name], maps[name])],
                np.where(valid, sens, np.nan),
            )
            for name, sens in (r_sens.items() if maps else ())
        ),
        summaries=reader.summaries() if done["summaries"] else {},
        verdict=verdict,
        observation=observation,
        fits=fits,
        lens=reader.lens(),
        scan_grid=scan_grid,
        grids=grids,
        observed=observed,
        accepted=accepted,
    )


@dataclass(frozen=True)
class _Reader:
    """Reads the row of one sample from the artifacts of its chunk."""

    results: Path
    config: Config
    place: int
    row: int
    sample: int

    def _open(self, stage: str) -> Any:
        name = stage_files(self.config, stage)[self.place].relative_to(self.results).as_posix()
        return open_of_campaign(self.results, name, stage)

    def stage_record(self, stage: str) -> StageRecord:
        with self._open(stage) as artifact:
            status = int(artifact.array("samples/status", self.row))
            words = {OK: "done", FAILED_HERE: "failed here"}
            keys = seed_keys(artifact.text("seed_key"), self.sample, artifact.metadata)
            campaign = self.config.campaign
            if stage == "halos" and campaign.design == "prior":  # which draws the parameters too
                keys = (f"{campaign.seed}/parameters/{self.sample}", *keys)
            return StageRecord(
                stage,
                artifact.path.relative_to(self.results).as_posix(),
                artifact.digest,
                self.row,
                words.get(status, "failed in an earlier stage"),
                keys,
                artifact["samples/traceback"][self.row].decode() if status == FAILED_HERE else "",
            )

    def parameters(self) -> tuple[float, float]:
        with self._open("halos") as artifact:
            names = ("m_th_kev", "log10_m_halo_msun")
            m_th_kev, log10_m_halo_msun = (float(artifact.array(f"samples/{name}", self.row)) for name in names)
        return m_th_kev, log10_m_halo_msun

    def lens(self) -> LensGeometry:
        with self._open("halos") as artifact:
            settings = artifact.settings
        return geometry(
            CosmologyBlock.model_validate(settings["cosmology"]),
            RedshiftBlock.model_validate(settings["redshifts"]),
        )[1]

    def halo(self) -> HaloFacts:
        with self._open("halos") as artifact:
            counts = ("n_accreted", "n_friction", "n_stripped_below", "n_surviving")
            return HaloFacts(
                read_subhalos(artifact, self.row),
                {name: int(artifact.array(f"halo/{name}", self.row)) for name in counts},
                float(artifact.array("halo/f_sub", self.row)),
                float(artifact.array("halo/z_half", self.row)),
                artifact.array("halo/cumulative_mass_function_bins"),
                artifact.array("halo/cumulative_mass_function", self.row).astype(np.float64),
                float(artifact.settings["halos"]["min_mass_msun"]),
            )

    def deflection(self) -> tuple[FloatArray, float]:
        with self._open("deflections") as artifact:
            return artifact.array("delta_alpha", self.row).astype(np.float64), float(
                artifact.array("rms", self.row)
            )

    def mocks(self) -> dict[str, FloatArray]:
        with self._open("mocks") as artifact:
            return {
                band: artifact.array(f"{band}/image", self.row).astype(np.float64)
                for band in artifact.metadata["bands"]
            }

    def scan(self) -> dict[str, FloatArray]:
        with self._open("scans") as artifact:
            return by_band(artifact, "delta_r", self.row)

    def chi2(self) -> dict[str, float]:
        with self._open("scans") as artifact:
            return {band: float(artifact.array(f"{band}/chi2", self.row)) for band in artifact.metadata["bands"]}

    def summaries(self) -> dict[str, FloatArray]:
        with self._open("summaries") as artifact:
            return {kind: artifact.array(f"{COMBINED}/{kind}", self.row) for kind in SUMMARIES}


def seed_keys(pattern: str, sample: int, metadata: Mapping[str, Any]) -> tuple[str, ...]:
    """Keys of a stage's random streams for one sample, from the pattern that its artifact records."""
    if not pattern:
        return ()
    own = pattern.replace("SAMPLE", str(sample))
    return tuple(own.replace("BAND", band) for band in metadata["bands"]) if "BAND" in own else (own,)


def _verdict(artifact: Artifact, sample: int) -> Verdict:
    """Distances of a sample and their ranks among the samples that did not fail, 1 for the nearest."""
    table = {name: artifact.array(f"table/{name}") for name in _VERDICT}
    distances = {kind: table[f"distance_{kind}"] for kind in SUMMARIES}
    failed = not np.isfinite(table["max_rank"][sample])
    ranks = {} if failed else {kind: 1 + int((all_ < all_[sample]).sum()) for kind, all_ in distances.items()}
    return Verdict(
        accepted=bool(table["accepted"][sample]),
        weight=float(table["weight"][sample]),
        distance_correlation=float(distances["correlation"][sample]),
        distance_cumulative=float(distances["cumulative"][sample]),
        ranks=ranks,
        max_rank=float(table["max_rank"][sample]),
        n_ranked=int(np.isfinite(table["max_rank"]).sum()),
        n_accepted=int(table["accepted"].sum()),
    )


_VERDICT = ("accepted", "weight", "distance_correlation", "distance_cumulative", "max_rank")
