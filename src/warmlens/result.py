"""What came out of a finished campaign, in words."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from warmlens.artifacts import open_artifact
from warmlens.layout import FIGURES, NUMBERS, SINGLE, TABLE


def print_result(results: Path) -> None:
    """Print warnings, bound, its companions, calibration, and where posterior and figures are."""
    path = results / SINGLE["abc"]
    with open_artifact(path, "abc") as artifact:
        meta = artifact.metadata
    with open_artifact(results / SINGLE["smooth_model"], "smooth_model") as artifact:
        chi2 = {band: artifact.metadata["fits"][band]["chi2_red"] for band in artifact.metadata["bands"]}
    console = Console(highlight=False, soft_wrap=True)
    for warning in meta["warnings"]:
        console.print(f"[bold red]WARNING[/] {escape(warning)}")
    bound = meta["bounds"][meta["headline"]]
    if not meta["quotable"]:
        console.print("[bold red]NOT TO BE QUOTED[/], see the warnings:")
    console.print(
        f"[bold]m_TH > {_pair(bound['value_kev'], bound['mc_error_kev'])} keV[/] "
        f"({100 * (1 - bound['level']):.2f}% one-sided, {meta['n_accepted']} of {meta['n_samples']} samples "
        f"accepted); the prior alone gives {bound['prior_only_kev']:.2f} keV"
    )
    for line in [*companions(meta), "instead of this rule and prior:", *others(meta)]:
        console.print(line, markup=False)
    console.print(
        "smooth model: " + ", ".join(f"chi2_red = {value:.3f} in {band}" for band, value in chi2.items())
    )
    console.print(f"posterior:    {path} and {results / TABLE}")
    console.print(f"all numbers:  {results / NUMBERS}")
    console.print(f"figures:      {results / 'figures'}/ ({', '.join(FIGURES)}).png")


def companions(meta: Mapping[str, Any]) -> list[str]:
    """What stands beside the headline, a line each."""
    lines = []
    for name, bound in meta["bounds"].items():
        if name != meta["headline"]:
            lines.append(
                f"{name + ':':13} > {_pair(bound['value_kev'], bound['mc_error_kev'])} keV "
                f"({100 * (1 - bound['level']):.2f}%), the prior alone {bound['prior_only_kev']:.2f} keV"
            )
    for name, found in meta["likelihood_ratio"]["falls_to"].items():
        value = (
            "not within the prior"
            if found["m_kev"] is None
            else f"{_pair(found['m_kev'], found['mc_error_kev'])} keV"
        )
        note = f" ({'; '.join(found['warnings'])})" if found["m_kev"] is not None and found["warnings"] else ""
        top = meta["likelihood_ratio"]["normalised_at_kev"]
        lines.append(f"likelihood:   falls to {name} of its value at {top:g} keV: {value}{note}")
    adjusted = meta["regression_adjustment"]
    if adjusted["valid"]:
        name = meta["headline"]
        pair = _pair(adjusted["bounds_kev"][name], adjusted["mc_errors_kev"][name])
        lines.append(f"adjusted:     > {pair} keV by local-linear regression ({adjusted['reason']})")
    else:
        lines.append(f"adjusted:     not valid: {adjusted['reason']}")
    covered = meta["calibration"]["coverage"][meta["headline"]]
    lines.append(
        f"coverage:     {covered['fraction']:.1%} [{covered['low']:.1%}, {covered['high']:.1%}] of "
        f"{covered['n']} truths lie above their bound, nominal {covered['nominal']:.1%}"
    )
    expected = meta["expected_limit"]
    if expected is not None:
        low, median, high = expected["quantiles_kev"][1:4]
        lines.append(
            f"expected:     {median:.2f} keV (68%: {low:.2f} to {high:.2f}) for cold dark matter; the bound is "
            f"above {expected['observed_percentile']:.0f}% of these"
        )
    lines.append(f"threshold:    {meta['threshold_convergence']['raw']}")
    near = ", ".join(f"{value:.0f}% ({kind})" for kind, value in meta["nearest_neighbour_percentile"].items())
    lines.append(f"in the cloud: the nearest sample is farther than those of {near} of the samples")
    gain = meta["information"]
    lines.append(
        f"information:  {gain['gain_nats']:.3f} +- {gain['gain_error_nats']:.3f} nat over the prior, on average"
    )
    sets = {name: entry for name, entry in meta["summary_sets"].items() if isinstance(entry, dict)}
    for name, entry in sets.items():
        gain, bound = entry["gain"], entry["bound"]
        lines.append(
            f"summaries {name}: {gain['gain_nats']:.3f} +- {gain['gain_error_nats']:.3f} nat, "
            f"bound {_pair(bound['value_kev'], bound['mc_error_kev'])} keV"
        )
    lines += [
        f"forecast:     {_pair(case['median_kev'], case['median_error_kev'])} keV expected of "
        f"{case['n_lenses']} such lens{'es' if case['n_lenses'] > 1 else ''}"
        for case in meta["forecast"]
        if case["n_lenses"] in (1, 8) and case["noise_factor"] == 1.0
    ]
    return lines


def others(meta: Mapping[str, Any]) -> list[str]:
    """The headline under other rules and priors, a line each.

    Warnings that the headline has too are not repeated.
    """
    lines = []
    own = set(meta["bounds"][meta["headline"]]["warnings"])
    for group, word in (("other_rules", "rule"), ("other_priors", "prior")):
        for name, bound in meta[group].items():
            notes = [
                text for text in bound["warnings"] if text not in own and not text.startswith("indistinguish")
            ]
            note = f"; {'; '.join(notes)}" if notes else ""
            if bound["value_kev"] is None:
                lines.append(f"{word} {name}: none{note}")
            else:
                pair = _pair(bound["value_kev"], bound["mc_error_kev"])
                lines.append(
                    f"{word} {name}: > {pair} keV, the prior alone {bound['prior_only_kev']:.2f} keV, "
                    f"ESS {bound['ess']:.0f}{note}"
                )
    return lines


def _pair(value: float, error: float | None) -> str:
    return f"{value:.2f}" if error is None else f"{value:.2f} +- {error:.2f}"
