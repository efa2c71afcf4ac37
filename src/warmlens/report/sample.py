"""One sample of a campaign, gathered from its artifacts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Artifact
from warmlens.artifacts.names import CHUNKED, SINGLE
from warmlens.campaign.answer import check_chain
from warmlens.campaign.files import chunks, stage_files
from warmlens.config.model import CampaignBlock
from warmlens.cosmology import LensGeometry
from warmlens.figures.draw.scan import ScanRow
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.observation import Observation
from warmlens.physics import geometry
from warmlens.products.halos import read_subhalos
from warmlens.products.observation import read_observation
from warmlens.products.samples import FAILED_HERE, OK
from warmlens.products.scan_maps import by_band, raster_grid
from warmlens.report.collect import open_of_campaign, read_inferred
from warmlens.stages.summaries import COMBINED
from warmlens.types import FloatArray

SUMMARIES = {"correlation": "separation", "cumulative": "thresholds"}  # and the datasets that hold their grids
_STATUS = {OK: "done", FAILED_HERE: "failed here"}
_HALO_COUNTS = ("n_accreted", "n_friction", "n_stripped_below", "n_surviving")


@dataclass(frozen=True)
class SampleRecord:
    """One sample, and what it is compared with; what comes after the stage that it failed in is empty."""

    sample_id: int
    m_th_kev: float
    log10_m_halo_msun: float
    message: str  # why it failed; "" if it did not
    verdict: dict[str, Any]  # see `_read_verdict`
    stages: list[dict[str, Any]]  # see `_read_stage`

    observation: Observation
    fits: dict[str, tuple[FloatArray, FloatArray]]  # smooth model and sigma by band [ny, nx] [e-/s per pixel]
    lens: LensGeometry
    scan_grid: PixelGrid
    grids: dict[str, FloatArray]  # separations and thresholds of the summaries, by kind as the next two
    observed: dict[str, FloatArray]
    accepted: dict[str, FloatArray]  # 2.5, 16, 50, 84, 97.5% of the accepted samples

    scan: list[ScanRow]  # of the observation and the sample
    halo: dict[str, Any] | None = None  # see `_read_halo`
    delta_alpha: FloatArray | None = None  # [2, ny, nx] [arcsec]
    deflection_rms_arcsec: float = math.nan
    mocks: dict[str, FloatArray] = field(default_factory=dict)  # by band [ny, nx] [e-/s per pixel]
    chi2: dict[str, float] = field(default_factory=dict)  # of the smooth fit to the mock, by band
    summaries: dict[str, FloatArray] = field(default_factory=dict)


def read_sample(results: Path, sample: int) -> SampleRecord:
    """Gather sample number `sample`, from 0, of a finished campaign.

    Raises
    ------
    ArtifactError
        If there is no such sample, for a missing artifact, with the command that makes it, or a broken chain.
    """
    config = read_inferred(results)
    n = config.campaign.n_samples
    if not 0 <= sample < n:
        raise ArtifactError(f"{results}: has no sample {sample}; its samples are 0 to {n - 1}")
    check_chain(config, [results / SINGLE["abc"]])
    chunk, first = next((i, start) for i, (start, stop) in enumerate(chunks(config)) if start <= sample < stop)
    row = sample - first
    with open_of_campaign(results, SINGLE["observation"], "observation") as artifact:
        observation = read_observation(artifact.path)
    with open_of_campaign(results, SINGLE["smooth_model"], "smooth_model") as artifact:
        bands = artifact.metadata["bands"]
        fits = {band: (artifact.array(f"{band}/model"), artifact.array(f"{band}/sigma")) for band in bands}
    stages: list[dict[str, Any]] = []
    values: dict[str, Any] = {}
    for stage in CHUNKED:
        name = stage_files(config, stage)[chunk].relative_to(results).as_posix()
        with open_of_campaign(results, name, stage) as artifact:
            stages.append({"name": name, **_read_stage(artifact, row, sample, config.campaign)})
            if stages[-1]["status"] == "done":
                values |= _read_values(artifact, row)
    with open_of_campaign(results, SINGLE["observed_scan"], "observed_scan") as artifact:
        scan_grid = raster_grid(artifact)
        scan = _compare_scans(artifact, values.pop("delta_r", {}))
    with open_of_campaign(results, SINGLE["observed_summary"], "observed_summary") as artifact:
        grids = {kind: artifact.array(name) for kind, name in SUMMARIES.items()}
        observed = {kind: artifact.array(f"{COMBINED}/{kind}") for kind in SUMMARIES}
    with open_of_campaign(results, SINGLE["abc"], "abc") as artifact:
        return SampleRecord(
            sample_id=sample,
            m_th_kev=float(artifact.array("table/m_th_kev", sample)),
            log10_m_halo_msun=float(artifact.array("table/log10_m_halo_msun", sample)),
            message=artifact.strings("table/message")[sample],
            verdict=_read_verdict(artifact, sample),
            stages=stages,
            observation=observation,
            fits=fits,
            lens=geometry(config.cosmology, config.redshifts)[1],
            scan_grid=scan_grid,
            grids=grids,
            observed=observed,
            accepted={kind: artifact.array(f"predictive/{kind}/quantiles") for kind in SUMMARIES},
            scan=scan,
            **values,
        )


def _read_stage(artifact: Artifact, row: int, sample: int, campaign: CampaignBlock) -> dict[str, Any]:
    """Read the fate of a sample in a stage; the traceback is "" unless it failed in this stage."""
    status = int(artifact.array("samples/status", row))
    keys = seed_keys(artifact.text("seed_key"), sample, artifact.metadata)
    if artifact.stage == "halos" and campaign.design == "prior":  # which draws the parameters too
        keys = (f"{campaign.seed}/parameters/{sample}", *keys)
    return {
        "stage": artifact.stage,
        "digest": artifact.digest,
        "row": row,
        "status": _STATUS.get(status, "failed in an earlier stage"),
        "seed_keys": keys,
        "traceback": artifact["samples/traceback"][row].decode() if status == FAILED_HERE else "",
    }


def seed_keys(pattern: str, sample: int, metadata: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the keys of a stage's random streams for a sample, from the pattern that its artifact records."""
    if not pattern:
        return ()
    own = pattern.replace("SAMPLE", str(sample))
    return tuple(own.replace("BAND", band) for band in metadata["bands"]) if "BAND" in own else (own,)


def _read_values(artifact: Artifact, row: int) -> dict[str, Any]:
    """Read the fields of `SampleRecord` that a stage made, and `delta_r` of its scan."""
    bands = artifact.metadata.get("bands", ())
    match artifact.stage:
        case "halos":
            return {"halo": _read_halo(artifact, row)}
        case "deflections":
            rms = float(artifact.array("rms", row))
            return {"delta_alpha": _read_floats(artifact, "delta_alpha", row), "deflection_rms_arcsec": rms}
        case "mocks":
            return {"mocks": {band: _read_floats(artifact, f"{band}/image", row) for band in bands}}
        case "scans":
            chi2 = {band: float(artifact.array(f"{band}/chi2", row)) for band in bands}
            return {"chi2": chi2, "delta_r": by_band(artifact, "delta_r", row)}
        case _:
            return {"summaries": {kind: artifact.array(f"{COMBINED}/{kind}", row) for kind in SUMMARIES}}


def _read_floats(artifact: Artifact, name: str, row: int) -> FloatArray:
    return artifact.array(name, row).astype(np.float64)


def _read_halo(artifact: Artifact, row: int) -> dict[str, Any]:
    """Read the subhalos in the field, and numbers and mass function of the whole halo."""
    return {
        **{name: int(artifact.array(f"halo/{name}", row)) for name in _HALO_COUNTS},
        **{name: float(artifact.array(f"halo/{name}", row)) for name in ("f_sub", "z_half")},
        "subhalos": read_subhalos(artifact, row),
        "mass_bins": artifact.array("halo/cumulative_mass_function_bins"),
        "mass_function": _read_floats(artifact, "halo/cumulative_mass_function", row),
        "min_mass_msun": float(artifact.settings["halos"]["min_mass_msun"]),
    }


def _compare_scans(observed: Artifact, delta_r: Mapping[str, FloatArray]) -> list[ScanRow]:
    """Return Delta R of observation and sample by band, NaN outside the valid positions; [] without a sample's."""
    valid = observed.array("raster/valid")
    seen, r_sens = by_band(observed, "delta_r"), by_band(observed, "r_sens")

    def blank(values: FloatArray) -> FloatArray:
        return np.where(valid, values, np.nan)

    return [ScanRow(band, [blank(seen[band]), blank(delta_r[band])], blank(r_sens[band])) for band in delta_r]


def _read_verdict(artifact: Artifact, sample: int) -> dict[str, Any]:
    """Read the distances of a sample and their ranks, 1 for the nearest; a failed sample has no ranks."""
    accepted, max_rank = artifact.array("table/accepted"), artifact.array("table/max_rank")
    distances = {kind: artifact.array(f"table/distance_{kind}") for kind in SUMMARIES}
    failed = not np.isfinite(max_rank[sample])
    return {
        "accepted": bool(accepted[sample]),
        "distances": {kind: float(column[sample]) for kind, column in distances.items()},
        "ranks": {} if failed else {kind: 1 + int((d < d[sample]).sum()) for kind, d in distances.items()},
        "max_rank": float(max_rank[sample]),
        "n_ranked": int(np.isfinite(max_rank).sum()),
        "n_accepted": int(accepted.sum()),
    }
