"""`warmlens combine`: the bound from several campaigns, one per lens."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from warmlens.artifacts.file import Artifact, ArtifactError, atomic_path
from warmlens.campaign.answer import open_answer
from warmlens.inference.bound import HEADLINE, LEVELS
from warmlens.inference.combine import combine
from warmlens.inference.likelihood import RATIOS, LikelihoodRatio
from warmlens.report.result import print_warnings
from warmlens.text import confidence, pair


def combine_results(results: Sequence[Path], output: Path | None) -> dict[str, Any]:
    """Multiply the likelihood ratios of finished campaigns; print the bound, and write its numbers to `output`.

    Raises
    ------
    ArtifactError
        For fewer than two campaigns, or two of the same observation.
    """
    if len(results) < 2:
        raise ArtifactError("combine needs the results folders of at least two campaigns, each of another lens")
    lenses: list[LikelihoodRatio] = []
    warnings: list[str] = []
    seen: dict[str, Path] = {}
    for folder in results:
        with open_answer(folder) as artifact:
            observed = artifact.inputs["observed_summary"]["digest"]
            if observed in seen:
                raise ArtifactError(
                    f"{folder} and {seen[observed]} are of the same observation, which would count twice"
                )
            seen[observed] = folder
            lenses.append(_read_ratio(artifact))
            warnings += [f"{folder}: {text}" for text in artifact.metadata["warnings"]]
    try:
        combined = combine(lenses)
    except ValueError as error:
        raise ArtifactError(str(error)) from error
    numbers = {
        "lenses": [str(folder) for folder in results],
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
            temporary.write_text(json.dumps(numbers, indent=2, allow_nan=False) + "\n")
    return numbers


def _read_ratio(artifact: Artifact) -> LikelihoodRatio:
    return LikelihoodRatio(
        artifact.array("likelihood/m_kev"),
        artifact.array("likelihood/ratio"),
        artifact.array("likelihood/replicates"),
        float(artifact.metadata["likelihood_ratio"]["bandwidth_kev"]),
        int(artifact.metadata["n_accepted"]),
    )


def _print(numbers: dict[str, Any]) -> None:
    console = Console(highlight=False, soft_wrap=True)
    print_warnings(console, numbers["warnings"])
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
