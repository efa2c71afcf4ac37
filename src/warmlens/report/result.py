"""`warmlens result`: the bound of a finished campaign, and what is reported with it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import FIGURES, NUMBERS, REPORT, SINGLE, TABLE
from warmlens.campaign.answer import open_answer
from warmlens.text import MEANING, Terminal, bound_cells, confidence, crossing, pair


def print_result(results: Path) -> None:
    """Print warnings, bound, its companions, calibration, and where posterior and figures are."""
    path = results / SINGLE["abc"]
    with open_answer(results) as artifact:
        meta = artifact.metadata
    with open_artifact(results / SINGLE["smooth_model"], "smooth_model") as artifact:
        fits, bands = artifact.metadata["fits"], artifact.metadata["bands"]
    console = Terminal()
    print_verdict(console, meta)
    bound = meta["bounds"][meta["headline"]]
    if meta["summaries"] != "paper":
        console.print(f"by the {meta['summaries']} summaries, not the paper's, whose bound is below:")
    console.print(
        f"[bold]m_TH > {pair(bound['value_kev'], bound['mc_error_kev'])} keV[/] "
        f"({confidence(bound)} one-sided, {meta['n_accepted']} of {meta['n_samples']} samples "
        f"accepted); the prior alone gives {bound['prior_only_kev']:.2f} keV"
    )
    chi2 = ", ".join(f"chi2_red = {fits[band]['chi2_red']:.3f} in {band}" for band in bands)
    for line in [
        *companions(meta),
        "instead of this rule and prior:",
        *others(meta),
        f"smooth model: {chi2}",
        f"posterior:    {path} and {results / TABLE}",
        f"all numbers:  {results / NUMBERS}",
        f"figures:      {results / 'figures'}/ ({', '.join(FIGURES)}).png",
    ]:
        console.print(line, markup=False)
    if (results / REPORT).exists():
        console.print(f"report:       {results / REPORT}, all of this on one page", markup=False)


def print_verdict(console: Console, meta: Mapping[str, Any]) -> None:
    """Print the verdict with its reasons, and one line per warning."""
    colour = {"measured": "green", "prior only": "yellow", "not usable": "red"}[meta["verdict"]]
    console.print(f"[bold {colour}]{meta['verdict'].upper()}[/] {MEANING[meta['verdict']]}")
    for reason in meta["reasons"]:
        console.print(f"  - {escape(reason)}")
    for warning in meta["warnings"]:
        console.print(f"[bold]warning[/] {escape(warning)}")


def companions(meta: Mapping[str, Any]) -> list[str]:
    """Return the lines that are printed with the headline, from the metadata of the stage `abc`."""
    name, headline = meta["headline"], meta["bounds"][meta["headline"]]
    lines = []
    for level, bound in meta["bounds"].items():
        if level != name:
            cells = bound_cells(bound, headline)
            value, prior = f"{cells['value']} keV ({confidence(bound)})", cells["prior"]
            lines.append(f"{level + ':':13} > {value}, the prior alone {prior} keV")
    top = meta["likelihood_ratio"]["normalised_at_kev"]
    for ratio, fall in meta["likelihood_ratio"]["falls_to"].items():
        note = f" ({'; '.join(fall['warnings'])})" if fall["m_kev"] is not None and fall["warnings"] else ""
        lines.append(f"likelihood:   falls to {ratio} of its value at {top:g} keV: {crossing(fall)}{note}")
    adjusted = meta["regression_adjustment"]
    if adjusted["valid"]:
        value = pair(adjusted["bounds_kev"][name], adjusted["mc_errors_kev"][name])
        lines.append(f"adjusted:     > {value} keV by local-linear regression ({adjusted['reason']})")
    else:
        lines.append(f"adjusted:     not valid: {adjusted['reason']}")
    covered = meta["calibration"]["coverage"][name]
    lines.append(
        f"coverage:     {covered['fraction']:.1%} [{covered['low']:.1%}, {covered['high']:.1%}] of "
        f"{covered['n']} truths lie above their bound, nominal {covered['nominal']:.1%}"
    )
    if expected := meta["expected_limit"]:
        low, median, high = expected["quantiles_kev"][1:4]
        lines.append(
            f"expected:     {median:.2f} keV (68%: {low:.2f} to {high:.2f}) for cold dark matter; the bound is "
            f"above {expected['observed_percentile']:.0f}% of these"
        )
    ranks = ", ".join(f"{rank['rank']:.0%} in {key}" for key, rank in meta["observation_among_samples"].items())
    return [
        *lines,
        f"threshold:    {meta['threshold_convergence']['raw']}",
        nearest_line(meta),
        f"observation:  samples below it: {ranks}",
        *null_lines(meta),
        *information_lines(meta),
    ]


def nearest_line(meta: Mapping[str, Any]) -> str:
    """Say how far the samples are from the observation, compared with how far they are from each other."""
    near = ", ".join(f"{value:.0f}% ({kind})" for kind, value in meta["nearest_neighbour_percentile"].items())
    return f"nearest:      the nearest sample is farther than those of {near} of the samples"


def null_lines(meta: Mapping[str, Any]) -> list[str]:
    """Return the bounds from mocks without substructure, and the place of the observation among them."""
    test = meta["null_test"]
    if test is None:
        return ["null test:    none"]
    bound = test["bound_kev"]
    expected = test["expected_limit_kev"]
    cold = "" if expected is None else f", cold dark matter {expected:.2f} keV"
    near = test["nearest_neighbour_percentile"].items()
    far = ", ".join(f"{value['median']:.0f}% ({kind})" for kind, value in near)
    ranks = test["observation_among_mocks"].items()
    places = ", ".join(f"{rank['rank']:.0%} in {name} (p = {rank['p_value']:.2g})" for name, rank in ranks)
    return [
        f"null test:    > {bound['median']:.2f} keV (68%: {bound['low']:.2f} to {bound['high']:.2f}) from "
        f"{test['n_mocks']} mocks without substructure; the prior alone {test['prior_only_kev']:.2f} keV{cold}",
        f"              {test['fraction_reaching_bound']:.0%} of them give a bound as high as the observation's; "
        f"their nearest sample is farther than those of {far} of the samples",
        f"              of them below the observation: {places}",
    ]


def information_lines(meta: Mapping[str, Any]) -> list[str]:
    """Return the information of each set of summaries, and the bound to expect of one and of eight lenses."""
    gain = meta["information"]
    lines = [f"information:  {pair(gain['gain_nats'], gain['gain_error_nats'], 3)} nat over the prior, on average"]
    for name, entry in meta["summary_sets"].items():
        if "refused" in entry:
            lines.append(f"summaries {name}: none: {entry['refused']}")
            continue
        gain, bound = entry["gain"], entry["bound"]
        lines.append(
            f"summaries {name}: {pair(gain['gain_nats'], gain['gain_error_nats'], 3)} nat, "
            f"bound {pair(bound['value_kev'], bound['mc_error_kev'])} keV"
        )
    return lines + [
        f"forecast:     {pair(case['median_kev'], case['median_error_kev'])} keV expected of "
        f"{case['n_lenses']} such lens{'es' if case['n_lenses'] > 1 else ''}"
        for case in meta["forecast"]
        if case["n_lenses"] in (1, 8) and case["noise_factor"] == 1.0
    ]


def others(meta: Mapping[str, Any]) -> list[str]:
    """Return one line per other rule and prior; warnings that the headline has too are not repeated."""
    lines = []
    headline = meta["bounds"][meta["headline"]]
    for group, word in (("other_rules", "rule"), ("other_priors", "prior")):
        for name, bound in meta[group].items():
            cells = bound_cells(bound, headline)
            numbers = f"> {cells['value']} keV, the prior alone {cells['prior']} keV, ESS {cells['ess']}"
            lines.append("; ".join([f"{word} {name}: {numbers if cells['ess'] else 'none'}", *cells["notes"]]))
    return lines
