"""What came out of a finished campaign, in words."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import (
    FIGURES,
    NUMBERS,
    REPORT,
    SINGLE,
    TABLE,
)
from warmlens.text import confidence, crossing, own_notes, pair


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
    if meta["summaries"] != "paper":
        console.print(f"by the {meta['summaries']} summaries, not the paper's, whose bound is below:")
    if not meta["quotable"]:
        console.print("[bold red]NOT TO BE QUOTED[/], see the warnings:")
    console.print(
        f"[bold]m_TH > {pair(bound['value_kev'], bound['mc_error_kev'])} keV[/] "
        f"({confidence(bound)} one-sided, {meta['n_accepted']} of {meta['n_samples']} samples "
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
    if (results / REPORT).exists():
        console.print(f"report:       {results / REPORT}, all of this on one page")


def companions(meta: Mapping[str, Any]) -> list[str]:
    """What stands beside the headline, a line each."""
    lines = []
    for name, bound in meta["bounds"].items():
        if name != meta["headline"]:
            lines.append(
                f"{name + ':':13} > {pair(bound['value_kev'], bound['mc_error_kev'])} keV "
                f"({confidence(bound)}), the prior alone {bound['prior_only_kev']:.2f} keV"
            )
    for name, found in meta["likelihood_ratio"]["falls_to"].items():
        note = f" ({'; '.join(found['warnings'])})" if found["m_kev"] is not None and found["warnings"] else ""
        top = meta["likelihood_ratio"]["normalised_at_kev"]
        lines.append(f"likelihood:   falls to {name} of its value at {top:g} keV: {crossing(found)}{note}")
    adjusted = meta["regression_adjustment"]
    if adjusted["valid"]:
        name = meta["headline"]
        value = pair(adjusted["bounds_kev"][name], adjusted["mc_errors_kev"][name])
        lines.append(f"adjusted:     > {value} keV by local-linear regression ({adjusted['reason']})")
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
    places = meta["observation_among_samples"].items()
    lines.append(
        "observation:  samples below it: " + ", ".join(f"{rank['rank']:.0%} in {name}" for name, rank in places)
    )
    lines += null_lines(meta)
    gain = meta["information"]
    lines.append(
        f"information:  {gain['gain_nats']:.3f} +- {gain['gain_error_nats']:.3f} nat over the prior, on average"
    )
    for name, entry in meta["summary_sets"].items():
        if "refused" in entry:
            lines.append(f"summaries {name}: none: {entry['refused']}")
            continue
        gain, bound = entry["gain"], entry["bound"]
        lines.append(
            f"summaries {name}: {gain['gain_nats']:.3f} +- {gain['gain_error_nats']:.3f} nat, "
            f"bound {pair(bound['value_kev'], bound['mc_error_kev'])} keV"
        )
    lines += [
        f"forecast:     {pair(case['median_kev'], case['median_error_kev'])} keV expected of "
        f"{case['n_lenses']} such lens{'es' if case['n_lenses'] > 1 else ''}"
        for case in meta["forecast"]
        if case["n_lenses"] in (1, 8) and case["noise_factor"] == 1.0
    ]
    return lines


def null_lines(meta: Mapping[str, Any]) -> list[str]:
    """What mocks without substructure lead to, and where the observation lies among them."""
    test = meta["null_test"]
    if test is None:
        return ["null test:    none"]
    bound = test["bound_kev"]
    expected = test["expected_limit_kev"]
    cold = "" if expected is None else f", cold dark matter {expected:.2f} keV"
    places = test["observation_among_mocks"].items()
    far = ", ".join(
        f"{value['median']:.0f}% ({kind})" for kind, value in test["nearest_neighbour_percentile"].items()
    )
    return [
        f"null test:    > {bound['median']:.2f} keV (68%: {bound['low']:.2f} to {bound['high']:.2f}) from "
        f"{test['n_mocks']} mocks without substructure; the prior alone {test['prior_only_kev']:.2f} keV{cold}",
        f"              {test['fraction_reaching_bound']:.0%} of them give a bound as high as the observation's; "
        f"their nearest sample is farther than those of {far} of the samples",
        "              of them below the observation: "
        + ", ".join(f"{rank['rank']:.0%} in {name} (p = {rank['p_value']:.2g})" for name, rank in places),
    ]


def others(meta: Mapping[str, Any]) -> list[str]:
    """The headline under other rules and priors, a line each.

    Warnings that the headline has too are not repeated.
    """
    lines = []
    headline = meta["bounds"][meta["headline"]]
    for group, word in (("other_rules", "rule"), ("other_priors", "prior")):
        for name, bound in meta[group].items():
            note = "".join(f"; {text}" for text in own_notes(bound, headline))
            if bound["value_kev"] is None:
                lines.append(f"{word} {name}: none{note}")
            else:
                lines.append(
                    f"{word} {name}: > {pair(bound['value_kev'], bound['mc_error_kev'])} keV, "
                    f"the prior alone {bound['prior_only_kev']:.2f} keV, ESS {bound['ess']:.0f}{note}"
                )
    return lines
