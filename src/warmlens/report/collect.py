"""What the report of a campaign says, gathered from its artifacts as plain values."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from warmlens.artifacts.file import Artifact, open_artifact
from warmlens.artifacts.names import (
    CHUNKED,
    CONFIG,
    FIGURES,
    SINGLE,
)
from warmlens.campaign.files import chunks, stage_files
from warmlens.campaign.snakemake import recorded_results, remaking_command
from warmlens.config.digest import settings_digest
from warmlens.config.model import Config
from warmlens.inference.bound import LEVELS
from warmlens.inference.calibration import MASS_BINS_KEV
from warmlens.products.samples import FAILED_HERE, OK
from warmlens.report.campaign_files import open_of_campaign, read_inferred
from warmlens.report.smooth_fit import SmoothFit, read_smooth_fit


@dataclass(frozen=True)
class AcceptedSample:
    """One accepted sample: parameters, distances from the observation, and the rank that it was accepted by."""

    sample_id: int
    m_th_kev: float
    log10_m_halo_msun: float
    distance_correlation: float
    distance_cumulative: float
    max_rank: float
    weight: float


@dataclass(frozen=True)
class FailedSample:
    """One sample without summaries: parameters, the stage it failed in, and why."""

    sample_id: int
    m_th_kev: float
    log10_m_halo_msun: float
    stage: str
    message: str


@dataclass(frozen=True)
class FigureFile:
    """One figure of the campaign: where it should lie, its caption, and the command that makes it."""

    name: str
    path: Path
    caption: str
    command: str


@dataclass(frozen=True)
class Truth:
    """Dark matter of a simulated observation; infinite m_th_kev is cold dark matter."""

    m_th_kev: float
    log10_m_halo_msun: float


@dataclass(frozen=True)
class Reproduction:
    """What makes the same numbers again.

    Attributes
    ----------
    command, results
        For a checkout of the code, and the results folder that it writes to.
    seed
        Of the campaign.
    config_yaml, config_digest
        The whole configuration, and the SHA-256 of its canonical JSON.
    """

    command: str
    results: str
    seed: int
    config_yaml: str
    config_digest: str


@dataclass(frozen=True)
class Campaign:
    """A finished campaign.

    Attributes
    ----------
    results, config
        Its folder and configuration.
    meta, created
        Metadata of the stage `abc`, which are the numbers of abc.json, and when it was run.
    truth
        Of a simulated observation.
    fit
        The smooth model.
    accepted, failed
        Samples, in the order of their numbers.
    figures
        In the order of `layout.FIGURES`.
    reproduction
        How to make the same again.
    """

    results: Path
    config: Config
    meta: dict[str, Any]
    created: str
    truth: Truth | None
    fit: SmoothFit
    accepted: tuple[AcceptedSample, ...]
    failed: tuple[FailedSample, ...]
    figures: tuple[FigureFile, ...]
    reproduction: Reproduction

    @property
    def headline(self) -> dict[str, Any]:
        """The bound that is quoted."""
        return self.meta["bounds"][self.meta["headline"]]


def read_report(results: Path, captions: Mapping[str, str]) -> Campaign:
    """Gather what the report of a finished campaign says.

    Parameters
    ----------
    results
        Results folder.
    captions
        Of the figures, by name.

    Raises
    ------
    ArtifactError
        Naming an artifact that is missing, and the command that makes it; for a campaign on a grid.
    """
    config = read_inferred(results)
    with open_of_campaign(results, SINGLE["observation"], "observation") as artifact:
        observation = artifact.metadata
        simulated = artifact.settings["observation"].get("simulated")
    with open_of_campaign(results, SINGLE["smooth_model"], "smooth_model") as artifact:
        fit = read_smooth_fit(artifact, simulated)
    with open_of_campaign(results, SINGLE["abc"], "abc") as artifact:
        meta = _ordered(artifact.metadata)
        created = artifact.text("created_utc")
        accepted, failed = _accepted(artifact), _failed(artifact, config)
    return Campaign(
        results=results,
        config=config,
        meta=meta,
        created=created,
        truth=_truth(observation.get("truth")),
        fit=fit,
        accepted=accepted,
        failed=failed,
        figures=tuple(
            FigureFile(
                name,
                results / f"figures/{name}.png",
                captions[name],
                remaking_command(results, f"figures/{name}.png"),
            )
            for name in FIGURES
        ),
        reproduction=_reproduction(results, config),
    )


def _ordered(meta: dict[str, Any]) -> dict[str, Any]:
    """The metadata with levels and ranges of mass in their order, which canonical JSON does not keep."""
    calibration = meta["calibration"]
    by_mass = calibration["coverage_by_true_mass"]
    calibration = {
        **calibration,
        "coverage": {name: calibration["coverage"][name] for name in LEVELS},
        "coverage_by_true_mass": {name: by_mass[name] for name in MASS_BINS_KEV},
    }
    return {**meta, "bounds": {name: meta["bounds"][name] for name in LEVELS}, "calibration": calibration}


def _truth(stored: Mapping[str, Any] | None) -> Truth | None:
    return None if stored is None else Truth(float(stored["m_th_kev"]), float(stored["log10_m_halo_msun"]))


def _accepted(artifact: Artifact) -> tuple[AcceptedSample, ...]:
    rows = np.flatnonzero(artifact.array("table/accepted"))
    names = list(AcceptedSample.__dataclass_fields__)
    columns = [artifact.array(f"table/{name}")[rows] for name in names]
    return tuple(AcceptedSample(int(sample), *map(float, rest)) for sample, *rest in zip(*columns, strict=True))


def _failed(artifact: Artifact, config: Config) -> tuple[FailedSample, ...]:
    rows = np.flatnonzero(artifact.array("table/status") != OK)
    if not rows.size:
        return ()
    ids = artifact.array("table/sample_id")
    masses, halos = artifact.array("table/m_th_kev"), artifact.array("table/log10_m_halo_msun")
    messages = artifact.strings("table/message")
    stages = failing_stages(config, [int(ids[row]) for row in rows])
    return tuple(
        FailedSample(int(ids[row]), float(masses[row]), float(halos[row]), stage, messages[row])
        for row, stage in zip(rows, stages, strict=True)
    )


def failing_stages(config: Config, samples: Sequence[int]) -> list[str]:
    """The stage that each sample failed in; "unknown" if the chunk that would tell is no longer there."""
    found = dict.fromkeys(samples, "unknown")
    spans = {span for span in chunks(config) if any(span[0] <= sample < span[1] for sample in samples)}
    for stage in CHUNKED:
        for span, path in zip(chunks(config), stage_files(config, stage), strict=True):
            if span in spans and path.exists():
                with open_artifact(path, stage) as artifact:
                    here = artifact.array("samples/status") == FAILED_HERE
                    failed = artifact.array("samples/sample_id")[here]
                found |= {int(sample): stage for sample in failed if int(sample) in found}
    return [found[sample] for sample in samples]


def _reproduction(results: Path, config: Config) -> Reproduction:
    recorded = json.loads((results / CONFIG).read_text())
    return Reproduction(
        command=remaking_command(results),
        results=str(recorded_results(results)),
        seed=config.campaign.seed,
        config_yaml=yaml.safe_dump(recorded, sort_keys=False, allow_unicode=True, width=100),
        config_digest=settings_digest(recorded),
    )
