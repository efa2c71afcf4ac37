"""Numbers and names as text, the same in the terminal and on the pages."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

_PRIORS = {
    "uniform_m": "uniform in m_TH",
    "uniform_log_m": "uniform in log m_TH",
    "uniform_inverse_m": "uniform in 1 / m_TH",
    "uniform_log_half_mode_mass": "uniform in the log of the half-mode mass",
}
_SUMMARIES = {
    "correlation": "C(dr)",
    "cumulative": "cumulative distribution of ΔR",
    "correlation_at_0": "C(dr) at dr = 0",
    "chi2": "χ² of the smooth fit",
    "counts": "counts of positions, and χ²",
    "response": "linear response",
    "mean_z2": "mean square significance of the amplitude",
    "amplitude_correlation": "correlation of the amplitude",
    "learned_m": "learned summary of m_TH",
    "learned_mass": "learned summary of M_h",
}
MEANING = {  # of the verdicts on a bound
    "measured": "the image measures this bound",
    "prior only": "the image says nothing that the prior does not say",
    "not usable": "this bound may be wrong, do not quote it",
}
# Control codes but line feed and tab, what turns the direction of text, and bytes of a file name that are no text.
_CODES = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
_NUMBER = r"(-?[\d.]+)"
_ARCSEC = ("theta_E", "center_x", "center_y", "ra_0", "dec_0", "R_sersic", "beta", "x", "y")


class Terminal(Console):
    """The terminal: texts of files, which may come from anybody, move no cursor and hide nothing on it."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"highlight": False, "soft_wrap": True, **options})

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render what is printed, with its control codes made visible."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else visible(text), style, control)


def visible(text: str) -> str:
    """Return a text with its control codes spelled out: ESC as \\x1b."""
    return _CODES.sub(lambda code: code[0].encode("unicode_escape").decode("ascii"), text)


def number(value: float | None, digits: int = 2) -> str:
    """Return a number with fixed decimals; "none" for None and NaN."""
    return "none" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def pair(value: float, error: float | None, digits: int = 2) -> str:
    """Return a value and its error, if there is one."""
    return number(value, digits) if error is None else f"{number(value, digits)} +- {number(error, digits)}"


def error_pair(value: float, error: float) -> str:
    """Return a value and its error, both with the decimals that show two digits of the error."""
    if not 0.0 < error < math.inf:
        return f"{value:.6g}"
    return pair(value, error, max(0, 1 - math.floor(math.log10(error))))


def confidence(bound: Mapping[str, Any]) -> str:
    """Return the one-sided credibility of a lower bound that is the `level` quantile of the posterior."""
    return f"{100.0 * (1.0 - bound['level']):.6g}%"


def percent(fraction: float, digits: int = 1) -> str:
    """Return a fraction in per cent."""
    return f"{100.0 * fraction:.{digits}f}%"


def crossing(fall: Mapping[str, Any]) -> str:
    """Return the relic mass at which the likelihood ratio has fallen to a value."""
    return "not within the prior" if fall["m_kev"] is None else f"{pair(fall['m_kev'], fall['mc_error_kev'])} keV"


def bound_cells(bound: Mapping[str, Any], headline: Mapping[str, Any]) -> dict[str, Any]:
    """Return a bound of abc.json [keV], that of the prior alone, its ESS, and the warnings that only it has."""
    notes = [
        warning
        for warning in bound["warnings"]
        if warning not in headline["warnings"] and not warning.startswith("indistinguish")
    ]
    if bound["value_kev"] is None:
        return {"value": "none", "prior": "", "ess": "", "notes": notes}
    return {
        "value": pair(bound["value_kev"], bound["mc_error_kev"]),
        "prior": number(bound["prior_only_kev"]),
        "ess": number(bound["ess"], 0),
        "notes": notes,
    }


def prior_name(name: str) -> str:
    """Name of another prior of abc.json, in words."""
    if limits := re.fullmatch(f"flat_{_NUMBER}_{_NUMBER}", name):
        return f"log₁₀ M_h uniform from {limits[1]} to {limits[2]}"
    if moments := re.fullmatch(f"normal_{_NUMBER}_{_NUMBER}", name):
        return f"log₁₀ M_h normal, {moments[1]} +- {moments[2]}"
    return _PRIORS.get(name, name)


def summary_name(name: str) -> str:
    """Name of a summary of abc.json, in words."""
    if count := re.fullmatch(f"positions_below_{_NUMBER}", name):
        return f"positions with ΔR below {count[1].replace('-', '−')}"
    return _SUMMARIES.get(name, name)


def parameter_unit(name: str) -> str:
    """Return the unit of a parameter of the smooth model such as lens_0.theta_E; "" for pure numbers."""
    return "arcsec" if name.rpartition(".")[2] in _ARCSEC else ""


def duration(seconds: float) -> str:
    """Return the seconds, minutes or hours, whole ones."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


CITATION = {
    "authors": "S. Birrer, A. Amara & A. Refregier",
    "year": "2017",
    "title": "Lensing substructure quantification in RXJ1131-1231: a 2 keV lower bound on dark matter thermal "
    "relic mass",
    "journal": "JCAP 05, 037",
    "doi": "10.1088/1475-7516/2017/05/037",
    "arxiv": "1702.00009",
}
