"""The whole inference on one table: bounds, likelihood ratio, calibration and checks, with errors and warnings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from warmlens.inference.acceptance import JOINT_RULES, Acceptance, accept, reduce_distances
from warmlens.inference.adjustment import adjust
from warmlens.inference.bootstrap import Counts
from warmlens.inference.bound import (
    HEADLINE,
    HEADLINE_INDEX,
    LEVEL_VALUES,
    LEVELS,
    Bound,
    TooFewError,
    lower_bounds,
    weighted_quantile,
)
from warmlens.inference.calibration import (
    MIN_KS_P,
    MIN_ROWS,
    Coverage,
    ExpectedLimit,
    LeaveOneOut,
    RankTest,
    coverage,
    coverage_by_mass,
    expected_limit,
    leave_one_out,
    rank_test,
)
from warmlens.inference.checks import CloudCheck, cloud_check
from warmlens.inference.convergence import CONVERGED, Convergence, threshold_convergence
from warmlens.inference.information import Information, information
from warmlens.inference.likelihood import RATIOS, Crossing, LikelihoodRatio, likelihood_ratio
from warmlens.inference.priors import reweightings
from warmlens.inference.table import Table
from warmlens.types import FloatArray

Streams = Callable[[str], np.random.Generator]


@dataclass(frozen=True)
class Calibration:
    """Coverage and rank tests of one version of the bound."""

    overall: dict[str, Coverage]  # coverage at every level of `LEVELS`
    by_mass: dict[str, Coverage]  # coverage of the headline in bins of the true mass
    ranks: dict[str, RankTest]  # rank tests of the parameters m_th_kev and log10_m_halo_msun
    # Whether the coverage of the headline is nominal, neither more nor less, and the ranks of m_th_kev are uniform
    exact: bool

    @property
    def passed(self) -> bool | None:
        """Whether the headline is no stronger than it claims; None if fewer than `MIN_ROWS` rows can tell."""
        covered = self.overall[HEADLINE]
        if covered.too_low:
            return False
        return True if covered.n >= MIN_ROWS else None


@dataclass(frozen=True)
class Adjusted:
    """The regression adjustment of the observation.

    Attributes
    ----------
    bounds_kev, mc_errors_kev
        At every level of `LEVELS` [keV].
    values, weights, n_components
        As in `adjustment.Adjustment`, of the parameters [k, 2].
    valid
        Whether its own calibration is exact on at least `MIN_ROWS` rows; otherwise it must not be quoted.
    """

    bounds_kev: dict[str, float]
    mc_errors_kev: dict[str, float]
    values: FloatArray
    weights: FloatArray
    n_components: int
    valid: bool


@dataclass(frozen=True)
class Analysis:
    """The results of all modules of this package for one table."""

    acceptance: Acceptance
    distances: FloatArray  # of the samples to the observation [n_kinds, n]
    bounds: dict[str, Bound]
    counts: Counts  # of the bootstrapped tables [n_bootstrap, n]
    # The headline bound under the other rules and priors, or the message of the error
    other_rules: dict[str, Bound | str]
    other_priors: dict[str, Bound | str]
    likelihood: LikelihoodRatio
    crossings: dict[str, Crossing]
    convergence: Convergence
    cloud: CloudCheck
    trials: LeaveOneOut
    calibration: Calibration
    expected: ExpectedLimit | None
    gain: Information
    # None, with the reason in `no_adjustment`, if too few samples are accepted
    adjusted: Adjusted | None
    adjusted_calibration: Calibration | None
    no_adjustment: str
    warnings: tuple[str, ...] = ()  # of the table and its calibration; `verdict` has what decides about the bound

    @property
    def n_rows(self) -> int:
        """Rows of the table that played the observation in the calibration."""
        return self.trials.rows.size


def analyse(table: Table, rule: str, fraction: float, n_bootstrap: int, n_rows: int, streams: Streams) -> Analysis:
    """Run the whole inference.

    Parameters
    ----------
    rule, fraction
        Of the acceptance.
    n_bootstrap, n_rows
        Numbers of bootstrapped tables and of rows for leave-one-out.
    streams
        A generator for each name.

    Raises
    ------
    TooFewError
        If the rule leaves too few samples for a bound.
    """
    distances = table.distances()
    accepted = accept(distances, rule, fraction, table.sample_id, streams("ties"))
    if rule == "marginal_and":  # raises TooFewError before the long computations
        lower_bounds(table, accepted, distances, streams("refusal"), n_bootstrap=2)
    convergence, counts = threshold_convergence(table, rule, fraction, n_bootstrap, streams("bootstrap"))
    bounds = lower_bounds(table, accepted, distances, streams("bounds"), counts=counts)
    likelihood = likelihood_ratio(table.m_kev, accepted.accepted, counts, table.m_range_kev)
    trials = leave_one_out(table, rule, fraction, n_rows, streams("leave_one_out"), with_adjustment=True)
    test = streams("rank_tests")
    calibration = _calibration(trials.bounds, trials.pit, trials.truth, test)
    adjusted_calibration = None
    if trials.adjusted_bounds is not None and trials.adjusted_pit is not None:
        adjusted_calibration = _calibration(trials.adjusted_bounds, trials.adjusted_pit, trials.truth, test)
    adjusted, reason = _adjusted(table, accepted, distances, convergence, adjusted_calibration, trials.rows.size)
    analysis = Analysis(
        acceptance=accepted,
        distances=distances,
        bounds=bounds,
        counts=counts,
        other_rules=_other_rules(table, rule, fraction, distances, n_bootstrap, streams),
        other_priors=_other_priors(table, accepted, distances, counts, streams),
        likelihood=likelihood,
        crossings={f"1/{round(1 / ratio)}": likelihood.falls_to(ratio) for ratio in RATIOS},
        convergence=convergence,
        cloud=cloud_check(table),
        trials=trials,
        calibration=calibration,
        expected=expected_limit(
            trials.bounds[:, HEADLINE_INDEX], trials.truth[:, 0], bounds[HEADLINE].value_kev, streams("expected")
        ),
        gain=information(table.m_kev, table.m_range_kev, trials, streams("information")),
        adjusted=adjusted,
        adjusted_calibration=adjusted_calibration,
        no_adjustment=reason,
    )
    return replace(analysis, warnings=tuple(_warnings(table, analysis)))


def _other_rules(
    table: Table, rule: str, fraction: float, distances: FloatArray, n_bootstrap: int, streams: Streams
) -> dict[str, Bound | str]:
    """Return the headline bound under every other rule: of all distances, and of each alone."""
    bounds: dict[str, Bound | str] = {}
    others = {name: (name, distances) for name in JOINT_RULES}
    others |= {kind: ("max_rank", distances[[i]]) for i, kind in enumerate(table.kinds)}
    for name, (other, cut_on) in others.items():
        if name == rule:
            continue
        rng = streams(f"rules/{name}")
        try:
            accepted = accept(cut_on, other, fraction, table.sample_id, streams("ties"))
            bounds[name] = lower_bounds(table, accepted, cut_on, rng, n_bootstrap=n_bootstrap)[HEADLINE]
        except ValueError as error:  # too few samples, or a rule that is undefined on this table
            bounds[name] = str(error)
    return bounds


def _other_priors(
    table: Table, accepted: Acceptance, distances: FloatArray, counts: Counts, streams: Streams
) -> dict[str, Bound | str]:
    """Return the headline bound under every prior, with the warnings of the re-weighting."""
    bounds: dict[str, Bound | str] = {}
    for name, prior in reweightings(table).items():
        rng = streams("priors")
        try:
            bound = lower_bounds(table, accepted, distances, rng, prior.weights, counts=counts)[HEADLINE]
        except ValueError as error:  # the samples do not cover this prior
            bounds[name] = "; ".join((*prior.warnings, str(error)))
            continue
        bounds[name] = replace(bound, warnings=prior.warnings + bound.warnings)
    return bounds


def _calibration(bounds: FloatArray, pit: FloatArray, truth: FloatArray, rng: np.random.Generator) -> Calibration:
    overall = {name: coverage(bounds[:, i], truth[:, 0], level) for i, (name, level) in enumerate(LEVELS.items())}
    ranks = {name: rank_test(pit[:, i], rng) for i, name in enumerate(("m_th_kev", "log10_m_halo_msun"))}
    exact = overall[HEADLINE].nominal_inside and ranks["m_th_kev"].ks_p > MIN_KS_P
    by_mass = coverage_by_mass(bounds[:, HEADLINE_INDEX], truth[:, 0], LEVELS[HEADLINE])
    return Calibration(overall, by_mass, ranks, exact)


def _adjusted(
    table: Table,
    accepted: Acceptance,
    distances: FloatArray,
    convergence: Convergence,
    calibration: Calibration | None,
    n_rows: int,
) -> tuple[Adjusted | None, str]:
    """Return the adjustment of the observation, or None and the reason."""
    try:
        moved = adjust(
            table.parameters,
            table.ranges,
            table.stacked(),
            np.concatenate(table.observed),
            reduce_distances(distances, accepted.rule),
            accepted.accepted,
        )
    except TooFewError as error:
        return None, str(error)
    bounds = weighted_quantile(moved.values[:, 0], moved.weights, LEVEL_VALUES)
    replicates = convergence.adjusted_replicates
    errors = np.full(len(LEVELS), np.nan) if replicates is None else replicates.std(axis=0, ddof=1)
    valid = calibration is not None and calibration.exact and n_rows >= MIN_ROWS
    bounds_kev = dict(zip(LEVELS, map(float, bounds), strict=True))
    errors_kev = dict(zip(LEVELS, map(float, errors), strict=True))
    return Adjusted(bounds_kev, errors_kev, moved.values, moved.weights, moved.n_components, valid), ""


def _warnings(table: Table, analysis: Analysis) -> list[str]:
    """List what to know of the table and its calibration beside the verdict on the bound."""
    warnings = []
    if np.ptp(table.log10_mass) == 0.0:
        warnings.append(f"all samples have the halo mass 10^{table.log10_mass[0]:g} Msun: nothing is marginalised")
    covered = analysis.calibration.overall[HEADLINE]
    if not covered.nominal_inside:
        side = "too seldom: the bound is too strong" if covered.high < covered.nominal else "too often: it is weak"
        warnings.append(
            f"coverage of the bound is {covered.fraction:.1%} [{covered.low:.1%}, {covered.high:.1%}] instead of "
            f"{covered.nominal:.1%}; the truth lies above it {side}"
        )
    for name, ranks in analysis.calibration.ranks.items():
        if ranks.ks_p <= MIN_KS_P:
            warnings.append(
                f"ranks of {name} are not uniform (KS p = {ranks.ks_p:.1g}): the posterior is miscalibrated"
            )
    if analysis.convergence.raw != CONVERGED:
        warnings.append(f"threshold convergence of the bound: {analysis.convergence.raw}")
    if analysis.acceptance.n_tied:
        warnings.append(
            f"{analysis.acceptance.n_tied} samples tie at the acceptance threshold; a seeded key decided"
        )
    return warnings
