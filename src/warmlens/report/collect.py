"""What the report of a campaign shows, gathered from its artifacts as plain values."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Artifact, open_artifact
from warmlens.artifacts.names import CHUNKED, CONFIG, EXCLUSION_NUMBERS, SINGLE
from warmlens.campaign.answer import other_settings
from warmlens.campaign.files import chunks, stage_files
from warmlens.campaign.snakemake import recorded_results, remaking_command
from warmlens.campaign.status import read_campaign
from warmlens.config.digest import settings_digest
from warmlens.config.model import Config
from warmlens.inference.bound import LEVELS
from warmlens.inference.calibration import MASS_BINS_KEV
from warmlens.products.samples import FAILED_HERE, OK
from warmlens.report.smooth_fit import read_smooth_fit
from warmlens.stage_table import stage_digests

_PARAMETERS = ("sample_id", "m_th_kev", "log10_m_halo_msun")
_ACCEPTED = (*_PARAMETERS, "distance_correlation", "distance_cumulative", "max_rank")


def read_inferred(results: Path) -> Config:
    """Read the configuration of a campaign that has a posterior.

    Raises
    ------
    ArtifactError
        For a campaign on a grid.
    """
    config = read_campaign(results)
    if config.campaign.design == "grid":
        raise ArtifactError(f"{results}: a campaign on a grid has no posterior to show; see {EXCLUSION_NUMBERS}")
    return config


@contextmanager
def open_of_campaign(results: Path, name: str, stage: str) -> Iterator[Artifact]:
    """Open the artifact `name` under a results folder.

    Raises
    ------
    ArtifactError
        If it is missing or was made with other settings than the campaign now has; with the command that makes it.
    """
    path = results / name
    if not path.exists():
        raise ArtifactError(f"{path}: no such artifact; make it with: {remaking_command(results, name)}")
    with open_artifact(path, stage) as artifact:
        config = read_campaign(results)
        if settings_digest(artifact.settings) != stage_digests(config)[stage]:
            raise other_settings(config, artifact)
        yield artifact


def read_report(results: Path) -> dict[str, Any]:
    """Gather the values of the template report.html.j2 from a finished campaign; see `read_smooth_fit` for `fit`.

    `meta` are the metadata of the stage `abc`, which abc.json holds too; `truth` is None unless the observation is
    simulated; `accepted` and `failed` are one dict per sample, in the order of their numbers.

    Raises
    ------
    ArtifactError
        For a missing artifact, with the command that makes it; for a campaign on a grid.
    """
    config = read_inferred(results)
    with open_of_campaign(results, SINGLE["observation"], "observation") as artifact:
        truth = artifact.metadata.get("truth")
        simulated = artifact.settings["observation"].get("simulated")
    with open_of_campaign(results, SINGLE["smooth_model"], "smooth_model") as artifact:
        fit = read_smooth_fit(artifact, simulated)
    with open_of_campaign(results, SINGLE["abc"], "abc") as artifact:
        _put_in_order(artifact.metadata)
        return {
            "results": results,
            "config": config,
            "meta": artifact.metadata,
            "created": artifact.text("created_utc"),
            "truth": truth,
            "fit": fit,
            "accepted": _read_rows(artifact, artifact.array("table/accepted").astype(bool), _ACCEPTED),
            "failed": _read_failed(artifact, config),
            "reproduction": _reproduction(results, config),
        }


def _put_in_order(meta: dict[str, Any]) -> None:
    """Sort levels and mass ranges of the metadata, whose order canonical JSON does not keep."""
    calibration = meta["calibration"]
    for block, key, names in (
        (meta, "bounds", LEVELS),
        (calibration, "coverage", LEVELS),
        (calibration, "coverage_by_true_mass", MASS_BINS_KEV),
    ):
        block[key] = {name: block[key][name] for name in names}


def _read_rows(artifact: Artifact, rows: np.ndarray, columns: Sequence[str]) -> list[dict[str, Any]]:
    values = [artifact.array(f"table/{name}")[rows].tolist() for name in columns]
    return [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)]


def _read_failed(artifact: Artifact, config: Config) -> list[dict[str, Any]]:
    """Read the samples without summaries: parameters, the stage that each failed in, and why."""
    failed = artifact.array("table/status") != OK
    samples = _read_rows(artifact, failed, _PARAMETERS)
    messages = [text for text, here in zip(artifact.strings("table/message"), failed, strict=True) if here]
    stages = failing_stages(config, [sample["sample_id"] for sample in samples])
    return [
        {**sample, "stage": stage, "message": message}
        for sample, stage, message in zip(samples, stages, messages, strict=True)
    ]


def failing_stages(config: Config, samples: Sequence[int]) -> list[str]:
    """Return the stage that each sample failed in; "unknown" if the chunk that records it is missing."""
    stage_of = dict.fromkeys(samples, "unknown")
    spans = {span for span in chunks(config) if any(span[0] <= sample < span[1] for sample in samples)}
    for stage in CHUNKED:
        for span, path in zip(chunks(config), stage_files(config, stage), strict=True):
            if span in spans and path.exists():
                with open_artifact(path, stage) as artifact:
                    here = artifact.array("samples/status") == FAILED_HERE
                    failed = artifact.array("samples/sample_id")[here]
                stage_of |= {int(sample): stage for sample in failed if int(sample) in stage_of}
    return [stage_of[sample] for sample in samples]


def _reproduction(results: Path, config: Config) -> dict[str, Any]:
    """Return what makes the same numbers again, and the configuration as YAML with the digest of its JSON."""
    recorded = json.loads((results / CONFIG).read_text(encoding="utf-8"))
    return {
        "command": remaking_command(results),
        "results": str(recorded_results(results)),
        "seed": config.campaign.seed,
        "config_yaml": yaml.safe_dump(recorded, sort_keys=False, allow_unicode=True, width=100),
        "config_digest": settings_digest(recorded),
    }
