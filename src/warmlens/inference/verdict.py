"""The verdict on a bound: whether the image measured it, and every reason, in one place.

A bound is `measured` if nothing speaks against it. It is `prior only` if it is right but says nothing that the
prior does not say. It is `not usable` if it may be wrong.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import scipy  # scipy.stats takes 1 s to import; scipy loads it on first use

from warmlens.inference.analysis import Analysis
from warmlens.inference.bound import HEADLINE, MIN_FOR_BOUND, Bound, count_warning, prior_warning
from warmlens.inference.calibration import MIN_ROWS, Coverage
from warmlens.inference.null import NullTest
from warmlens.inference.table import Table
from warmlens.types import BoolArray, FloatArray

Verdict = Literal["measured", "prior only", "not usable"]
MEASURED: Verdict = "measured"
PRIOR_ONLY: Verdict = "prior only"
NOT_USABLE: Verdict = "not usable"
VERDICTS = (MEASURED, PRIOR_ONLY, NOT_USABLE)  # from the best to the worst

MIN_TABLE = 100
MAX_REACHING = 0.05  # fraction of mocks without substructure that may give a bound as high
MAX_FALL = 3.0  # Monte-Carlo errors by which the bound may fall when fewer samples are accepted
CLUSTER_P = 1e-3  # KS probability that the failed samples are drawn like the others
MIN_FAILED = 3  # failures that can cluster

_SHOWN = 3  # stages by name
# What the same code has to make: mocks are compared with each other, with the observation and with the null test
COMPARED = {
    "halos": ("halos",),
    "deflections": ("deflections",),
    "mocks": ("mocks", "null_mocks"),
    "scans": ("scans", "observed_scan", "null_scans"),
    "summaries": ("summaries", "observed_summary", "null_summaries"),
}


@dataclass(frozen=True)
class Reason:
    """A fact, and the best verdict that it leaves: `measured` for a mere warning."""

    verdict: Verdict
    text: str


@dataclass(frozen=True)
class Judgement:
    """The verdict on an answer, from all reasons; `evidence` is the reason for `measured`."""

    reasons: tuple[Reason, ...]
    evidence: str

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of all reasons."""
        return max((reason.verdict for reason in self.reasons), key=VERDICTS.index, default=MEASURED)

    @property
    def because(self) -> list[str]:
        """Reasons for the verdict, the most serious first."""
        against = [reason for reason in self.reasons if reason.verdict != MEASURED]
        against.sort(key=lambda reason: -VERDICTS.index(reason.verdict))
        return [reason.text for reason in against] or [self.evidence]

    @property
    def warnings(self) -> list[str]:
        """What to know beside the reasons."""
        return [reason.text for reason in self.reasons if reason.verdict == MEASURED]

    def numbers(self) -> dict[str, Any]:
        """Return what every file and page says of the verdict."""
        return {"verdict": self.verdict, "reasons": self.because, "quotable": self.verdict == MEASURED}


def judge(reasons: Iterable[Reason], evidence: str, calibration: Sequence[Reason] = ()) -> Judgement:
    """Return the verdict from all reasons.

    `calibration` has what a measurement needs and a statement about the prior alone does not: it counts only if
    nothing else speaks against the bound.
    """
    given = list(reasons)
    if any(reason.verdict != MEASURED for reason in given):
        calibration = [Reason(MEASURED, reason.text) for reason in calibration]
    return Judgement((*given, *calibration), evidence)


def judge_bound(table: Table, analysis: Analysis, null: NullTest | None, others: Iterable[Reason]) -> Judgement:
    """Judge the headline bound of a campaign; `others` are reasons that the table does not know."""
    bound = analysis.bounds[HEADLINE]
    reasons = [
        *table_reasons(table.n, analysis.acceptance.k),
        *(Reason(NOT_USABLE, text) for text in analysis.cloud.outside),
        *_coverage_reasons(analysis.calibration.overall[HEADLINE]),
        *_convergence_reasons(analysis),
        *excess_reasons(bound.value_kev, bound.mc_error_kev, bound.prior_only_kev),
        *(Reason(PRIOR_ONLY, text) for text in analysis.cloud.uninformative),
        *_null_reasons(null, bound),
    ]
    known = {reason.text for reason in reasons}
    texts = dict.fromkeys([*bound.warnings, *analysis.warnings])
    reasons += [Reason(MEASURED, text) for text in texts if text not in known]
    reasons += others
    covered = analysis.calibration.overall[HEADLINE]
    evidence = excess(bound.value_kev, bound.mc_error_kev, bound.prior_only_kev)
    evidence += f"; {covered.fraction:.1%} of {covered.n} truths lie above theirs"
    return judge(reasons, evidence, _untested(covered))


def judge_combined(value: float, error: float, prior_only: float, lenses: Mapping[str, Verdict]) -> Judgement:
    """Judge the bound from several lenses [keV], each of which has its own verdict."""
    unusable = [name for name, verdict in lenses.items() if verdict == NOT_USABLE]
    reasons = [Reason(NOT_USABLE, f"{name} is not usable; see `warmlens result {name}`") for name in unusable]
    return judge([*reasons, *excess_reasons(value, error, prior_only)], excess(value, error, prior_only))


def excess(value: float, error: float, prior_only: float) -> str:
    """Say by how much a bound exceeds that of the prior alone [keV]."""
    above = value - prior_only
    errors = f", {above / error:.1f} Monte-Carlo errors" if error > 0.0 else ""
    return f"the bound exceeds that of the prior alone by {above:.2f} keV{errors}"


def table_reasons(n: int, k: int) -> list[Reason]:
    """Judge the numbers of samples: `k` of `n` are accepted."""
    reasons = []
    if n < MIN_TABLE:
        reasons.append(Reason(NOT_USABLE, f"the table has {n} samples only (fewer than {MIN_TABLE})"))
    if text := count_warning(k):
        reasons.append(Reason(NOT_USABLE, text))
    return reasons


def excess_reasons(value: float, error: float, prior_only: float) -> list[Reason]:
    """Judge how far a bound lies above that of the prior alone [keV]."""
    text = prior_warning(value, error, prior_only)
    return [Reason(PRIOR_ONLY, text)] if text else []


def _null_reasons(null: NullTest | None, bound: Bound) -> list[Reason]:
    if null is None:
        return [Reason(MEASURED, "there is no null test (null_test.n_mocks)")]
    reaching = null.fraction_reaching(bound.value_kev)
    if reaching <= MAX_REACHING:
        return []
    n = len(null.bounds)
    return [
        Reason(PRIOR_ONLY, f"null test: {reaching:.0%} of {n} mocks without substructure give a bound as high")
    ]


def _coverage_reasons(covered: Coverage) -> list[Reason]:
    """Refuse a bound that lies above the truth too often; one that is too weak is only a warning."""
    if not covered.too_low:
        return []
    return [
        Reason(
            NOT_USABLE,
            f"calibration failed: {covered.fraction:.1%} of {covered.n} truths lie above their bound instead of "
            f"{covered.nominal:.1%}: the bound is too strong",
        )
    ]


def _untested(covered: Coverage) -> list[Reason]:
    if covered.n >= MIN_ROWS:
        return []
    return [Reason(NOT_USABLE, f"calibrated on {covered.n} rows only (fewer than {MIN_ROWS})")]


def _convergence_reasons(analysis: Analysis) -> list[Reason]:
    """Refuse a bound that falls as fewer samples are accepted: it then rests on the unlike ones.

    A bound that rises is safe: the accepted fraction is still too large to see all that the image says.
    """
    fraction, bound = analysis.acceptance.fraction, analysis.bounds[HEADLINE]
    fewer = [step for step in analysis.convergence.steps if step.fraction < fraction and step.k >= MIN_FOR_BOUND]
    for step in fewer:
        if bound.value_kev - step.raw_kev > MAX_FALL * step.raw_error_kev:
            return [
                Reason(
                    NOT_USABLE,
                    f"the bound falls to {step.raw_kev:.2f} +- {step.raw_error_kev:.2f} keV if the fraction "
                    f"{step.fraction:.2g} is accepted instead of {fraction:.2g}; lower abc.fraction",
                )
            ]
    return []


def failure_reasons(parameters: Mapping[str, FloatArray], failed: BoolArray) -> list[Reason]:
    """Tell failures that cluster in parameter space from faults of single samples.

    Parameters
    ----------
    parameters
        Of all samples by name [n].
    failed
        True for the failed ones [n].
    """
    n_failed = int(failed.sum())
    if not n_failed:
        return []
    reasons = [Reason(MEASURED, f"{n_failed} of {len(failed)} samples failed and are left out")]
    if n_failed < MIN_FAILED or n_failed == len(failed):
        return reasons
    for name, values in parameters.items():
        p_value = float(scipy.stats.ks_2samp(values[failed], values[~failed]).pvalue)
        if p_value < CLUSTER_P:
            low, high = values[failed].min(), values[failed].max()
            text = (
                f"the {n_failed} of {len(failed)} samples that failed cluster: their {name} is {low:.4g} to "
                f"{high:.4g} (KS p = {p_value:.1g}), so that the others are not drawn from the prior; narrow "
                f"dark_matter.{name} to where samples can be made, or mend what fails"
            )
            reasons.append(Reason(NOT_USABLE, text))
    return reasons


def code_reasons(codes: Mapping[str, Collection[str]], uncommitted: Collection[str]) -> list[Reason]:
    """Refuse samples that were made by several versions of the code, warn of code that no commit holds.

    Parameters
    ----------
    codes
        Versions of the code that made the artifacts of each stage.
    uncommitted
        Stages with artifacts of code that had changes that were not committed.
    """
    reasons = []
    for name, stages in COMPARED.items():
        versions = {version for stage in stages for version in codes.get(stage, ())}
        if len(versions) > 1:
            text = (
                f"{name} were made by {len(versions)} versions of the code ({', '.join(stages)}): "
                "samples and observation were not treated alike; delete the artifacts of these stages and run the "
                "campaign again"
            )
            reasons.append(Reason(NOT_USABLE, text))
    if uncommitted:
        named = ", ".join(sorted(uncommitted)) if len(uncommitted) <= _SHOWN else f"{len(uncommitted)} stages"
        reasons.append(Reason(MEASURED, f"made by code with changes that were not committed: {named}"))
    return reasons


def misfit_reasons(problems: Iterable[str], notes: Iterable[str]) -> list[Reason]:
    """Refuse a bound from a smooth model with problems that `allow_poor_fit` let pass, and warn of its notes."""
    return [*(Reason(NOT_USABLE, text) for text in problems), *(Reason(MEASURED, text) for text in notes)]
