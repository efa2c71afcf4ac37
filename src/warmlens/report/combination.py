"""`warmlens combine`: the bound from several campaigns, one a lens."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from warmlens.artifacts.file import ArtifactError, atomic_path, open_artifact
from warmlens.artifacts.names import SINGLE
from warmlens.inference.bound import HEADLINE, LEVELS
from warmlens.inference.combine import Combined, combine
from warmlens.inference.likelihood import RATIOS, LikelihoodRatio


def combine_results(results: Sequence[Path], output: Path | None) -> dict[str, Any]:
    """Multiply the likelihood ratios of finished campaigns; print the bound, and write its numbers if asked to.

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
        with open_artifact(folder / SINGLE["abc"], "abc") as artifact:
            observed = artifact.inputs["observed_summary"]["digest"]
            if observed in seen:
                raise ArtifactError(
                    f"{folder} and {seen[observed]} are of the same observation, which would count twice"
                )
            seen[observed] = folder
            lenses.append(_read(artifact))
            warnings += [f"{folder}: {text}" for text in artifact.metadata["warnings"]]
    try:
        found = combine(lenses)
    except ValueError as error:
        raise ArtifactError(str(error)) from error
    numbers = _numbers(found, [str(folder) for folder in results], warnings)
    _print(numbers)
    if output is not None:
        with atomic_path(output) as temporary:
            temporary.write_text(json.dumps(numbers, indent=2, allow_nan=False) + "\n")
    return numbers


def _read(artifact: Any) -> LikelihoodRatio:
    return LikelihoodRatio(
        artifact.array("likelihood/m_kev"),
        artifact.array("likelihood/ratio"),
        artifact.array("likelihood/replicates"),
        float(artifact.metadata["likelihood_ratio"]["bandwidth_kev"]),
        int(artifact.metadata["n_accepted"]),
    )


def _numbers(found: Combined, names: list[str], warnings: list[str]) -> dict[str, Any]:
    return {
        "lenses": names,
        "headline": HEADLINE,
        "bounds": {
            name: {
                "level": level,
                "value_kev": found.bounds_kev[name],
                "mc_error_kev": found.mc_errors_kev[name],
                "prior_only_kev": found.prior_only_kev[name],
            }
            for name, level in LEVELS.items()
        },
        "likelihood_ratio": {
            "m_kev": found.m_kev.tolist(),
            "ratio": found.ratio.tolist(),
            "falls_to": {f"1/{round(1 / ratio)}": found.falls_to(ratio) for ratio in RATIOS},
        },
        "warnings": warnings,
    }


def _print(numbers: dict[str, Any]) -> None:
    console = Console(highlight=False, soft_wrap=True)
    for warning in numbers["warnings"]:
        console.print(f"[bold red]WARNING[/] {escape(warning)}")
    bound = numbers["bounds"][numbers["headline"]]
    grid = numbers["likelihood_ratio"]["m_kev"]
    console.print(
        f"[bold]m_TH > {bound['value_kev']:.2f} +- {bound['mc_error_kev']:.2f} keV[/] "
        f"({100 * (1 - bound['level']):.2f}% one-sided) from {len(numbers['lenses'])} lenses, uniform prior from "
        f"{grid[0]:g} to {grid[-1]:g} keV; the prior alone "
        f"gives {bound['prior_only_kev']:.2f} keV"
    )
    for name, value in numbers["likelihood_ratio"]["falls_to"].items():
        where = "not within the prior" if value is None else f"{value:.2f} keV"
        console.print(f"the product of the likelihoods falls to {name}: {where}")
