"""`warmlens combine`: the bound from several campaigns, one per lens."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warmlens.artifacts.atomic import ArtifactError, atomic_path
from warmlens.artifacts.file import Artifact, open_artifact
from warmlens.artifacts.names import SINGLE
from warmlens.campaign.answer import open_answer
from warmlens.inference.bound import HEADLINE, LEVELS
from warmlens.inference.combine import combine
from warmlens.inference.likelihood import RATIOS, LikelihoodRatio
from warmlens.inference.verdict import Verdict, judge_combined
from warmlens.products.observation import read_observation
from warmlens.report.result import print_verdict
from warmlens.text import Terminal, confidence, pair
from warmlens.types import FloatArray

_DISTINCT = 0.5  # fraction of the pixels: an image with fewer different values is one of whole counts


def combine_results(results: Sequence[Path], output: Path | None) -> dict[str, Any]:
    """Multiply the likelihood ratios of finished campaigns; print the bound, and write its numbers to `output`.

    Raises
    ------
    ArtifactError
        For fewer than two campaigns, or two of the same observation, whatever was made of it.
    """
    if len(results) < 2:
        raise ArtifactError("combine needs the results folders of at least two campaigns, each of another lens")
    lenses: list[LikelihoodRatio] = []
    warnings: list[str] = []
    verdicts: dict[str, Verdict] = {}
    for folder in results:
        with open_answer(folder) as artifact:
            lenses.append(_read_ratio(artifact))
            verdicts[str(folder)] = artifact.metadata["verdict"]
            warnings += [f"{folder}: {text}" for text in artifact.metadata["warnings"]]
    check_different([_Observed.read(folder) for folder in results])
    try:
        combined = combine(lenses)
    except ValueError as error:
        raise ArtifactError(str(error)) from error
    value, error_kev, prior = (
        numbers[HEADLINE] for numbers in (combined.bounds_kev, combined.mc_errors_kev, combined.prior_only_kev)
    )
    numbers = {
        **judge_combined(value, error_kev, prior, verdicts).numbers(),
        "lenses": verdicts,
        "headline": HEADLINE,
        "bounds": {
            name: {
                "level": level,
                "value_kev": combined.bounds_kev[name],
                "mc_error_kev": combined.mc_errors_kev[name],
                "prior_only_kev": combined.prior_only_kev[name],
            }
            for name, level in LEVELS.items()
        },
        "likelihood_ratio": {
            "m_kev": combined.m_kev.tolist(),
            "ratio": combined.ratio.tolist(),
            "falls_to": {f"1/{round(1 / ratio)}": combined.falls_to(ratio) for ratio in RATIOS},
        },
        "warnings": warnings,
    }
    _print(numbers)
    if output is not None:
        with atomic_path(output) as temporary:
            temporary.write_text(json.dumps(numbers, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return numbers


@dataclass(frozen=True)
class _Observed:
    """What tells an observation from others: the unmasked pixel values of each band, and a simulated lens."""

    folder: Path
    values: dict[str, FloatArray]
    simulated: dict[str, Any] | None

    @classmethod
    def read(cls, folder: Path) -> _Observed:
        with open_artifact(folder / SINGLE["observation"], "observation") as artifact:
            simulated = artifact.settings["observation"].get("simulated")
        observed = read_observation(folder / SINGLE["observation"])
        values = {band.name: band.image[band.mask] for band in observed.bands}
        lens = None if simulated is None else {key: simulated[key] for key in simulated if key != "bands"}
        return cls(folder, values, lens)


def check_different(observed: Sequence[_Observed]) -> None:
    """Refuse two campaigns of one observation, which would count twice.

    Masks, windows, cutouts, bands, noise, models and summaries may differ: what counts is the image.
    """
    for first, second in itertools.combinations(observed, 2):
        bands = itertools.product(first.values.values(), second.values.values())
        if any(map(_same_image, *zip(*bands, strict=True))) or (
            first.simulated is not None and first.simulated == second.simulated
        ):
            raise ArtifactError(
                f"{first.folder} and {second.folder} are of the same observation, which would count twice; "
                "combine takes one campaign per lens, with all bands in it"
            )


def _same_image(first: FloatArray, second: FloatArray) -> bool:
    """Return whether most unmasked pixels of two images [n] have exactly the same values, in any order."""
    one, other = np.unique(first), np.unique(second)
    if one.size < _DISTINCT * first.size or other.size < _DISTINCT * second.size:
        return np.array_equal(first, second)  # whole counts: images of any two lenses share most values
    return np.intersect1d(one, other).size > 0.5 * min(one.size, other.size)


def _read_ratio(artifact: Artifact) -> LikelihoodRatio:
    return LikelihoodRatio(
        artifact.array("likelihood/m_kev"),
        artifact.array("likelihood/ratio"),
        artifact.array("likelihood/replicates"),
        float(artifact.metadata["likelihood_ratio"]["bandwidth_kev"]),
        int(artifact.metadata["n_accepted"]),
    )


def _print(numbers: dict[str, Any]) -> None:
    console = Terminal()
    print_verdict(console, numbers)
    bound = numbers["bounds"][numbers["headline"]]
    grid = numbers["likelihood_ratio"]["m_kev"]
    console.print(
        f"[bold]m_TH > {pair(bound['value_kev'], bound['mc_error_kev'])} keV[/] "
        f"({confidence(bound)} one-sided) from {len(numbers['lenses'])} lenses, uniform prior from "
        f"{grid[0]:g} to {grid[-1]:g} keV; the prior alone gives {bound['prior_only_kev']:.2f} keV"
    )
    for name, value in numbers["likelihood_ratio"]["falls_to"].items():
        where = "not within the prior" if value is None else f"{value:.2f} keV"
        console.print(f"the product of the likelihoods falls to {name}: {where}")
