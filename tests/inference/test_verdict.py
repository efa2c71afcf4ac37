"""Every reason of a verdict, one by one, and the verdicts on simulators whose information is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from warmlens.inference.analysis import Analysis, analyse
from warmlens.inference.calibration import MIN_ROWS, coverage
from warmlens.inference.null import NullTest
from warmlens.inference.table import Table
from warmlens.inference.verdict import (
    MEASURED,
    NOT_USABLE,
    PRIOR_ONLY,
    Judgement,
    code_reasons,
    failure_reasons,
    judge_bound,
    judge_combined,
    misfit_reasons,
)

PRIOR, HALO = (1.0, 5.0), (13.0, 13.5)


def toy(n: int, noise: float, observed: float, seed: int = 1) -> Table:
    """A summary of the relic mass with some noise, and one of the halo mass."""
    rng = np.random.default_rng(seed)
    m, log10_mass = rng.uniform(*PRIOR, n), rng.uniform(*HALO, n)
    features = (m + noise * rng.standard_normal(n))[:, None], (log10_mass + rng.standard_normal(n))[:, None]
    return Table(np.arange(n), m, log10_mass, PRIOR, HALO, features, (np.array([observed]), np.array([13.25])))


def run(table: Table, fraction: float = 0.1, n_rows: int = 400) -> Analysis:
    return analyse(table, "max_rank", fraction, 200, n_rows, lambda name: np.random.default_rng([7, len(name)]))


def null(*bounds: float) -> NullTest:
    n = len(bounds)
    return NullTest(np.ones((n, 1), dtype=bool), np.array(bounds)[:, None] * np.ones(3), np.zeros((2, n)))


@pytest.fixture(scope="module")
def informed() -> tuple[Table, Analysis]:
    table = toy(1500, 0.5, 4.4)
    return table, run(table)


def judged(informed: tuple[Table, Analysis], test: NullTest | None = None, **changes: object) -> Judgement:
    table, analysis = informed
    return judge_bound(table, dataclasses.replace(analysis, **changes), test or null(*[1.1] * 40), [])


@pytest.mark.parametrize(
    ("name", "table", "verdict"),
    [
        ("informative", toy(1500, 0.5, 4.4), MEASURED),
        ("informative, few samples", toy(500, 0.5, 4.4), MEASURED),
        ("hardly informative", toy(1500, 20.0, 2.0), PRIOR_ONLY),
        ("pure noise", toy(1500, 1e4, 2.0), PRIOR_ONLY),
        ("the image of a light relic", toy(1500, 0.5, 1.2), PRIOR_ONLY),
        ("an image unlike all mocks", toy(1500, 0.5, 12.0), NOT_USABLE),
        ("a table of 80", toy(80, 0.5, 4.4), NOT_USABLE),
    ],
)
def test_verdicts_on_simulators(name: str, table: Table, verdict: str) -> None:
    judgement = judge_bound(table, run(table, 0.1 if table.n > 1000 else 0.2), None, [])
    assert judgement.verdict == verdict, (name, judgement.because)
    assert judgement.numbers()["quotable"] == (verdict == MEASURED)


def test_pure_noise_is_hardly_ever_a_measurement() -> None:
    verdicts = []
    for seed in range(8):
        table = toy(600, 1e4, 2.0, seed)
        verdicts.append(judge_bound(table, run(table, n_rows=MIN_ROWS), None, []).verdict)
    assert verdicts.count(MEASURED) == 0
    assert verdicts.count(PRIOR_ONLY) >= 7  # a calibration may fail by chance, as its p says


def test_a_measurement_says_what_it_rests_on(informed: tuple[Table, Analysis]) -> None:
    judgement = judged(informed)
    assert judgement.verdict == MEASURED
    (evidence,) = judgement.because
    assert "the bound exceeds that of the prior alone by" in evidence
    assert "Monte-Carlo errors" in evidence


def test_few_accepted_samples(informed: tuple[Table, Analysis]) -> None:
    few = dataclasses.replace(informed[1].acceptance, accepted=np.arange(informed[0].n) < 49)
    judgement = judged(informed, acceptance=few)
    assert judgement.verdict == NOT_USABLE
    assert "only 49 samples are accepted" in judgement.because[0]


def test_an_observation_outside_the_samples(informed: tuple[Table, Analysis]) -> None:
    cloud = dataclasses.replace(informed[1].cloud, outside=("OUTSIDE",))
    assert judged(informed, cloud=cloud).because == ["OUTSIDE"]


def test_summaries_that_tell_nothing(informed: tuple[Table, Analysis]) -> None:
    cloud = dataclasses.replace(informed[1].cloud, uninformative=("all alike",))
    assert judged(informed, cloud=cloud).verdict == PRIOR_ONLY


def test_the_prior_within_the_error(informed: tuple[Table, Analysis]) -> None:
    bounds = dict(informed[1].bounds)
    headline = bounds["q0455"]
    for errors, verdict in ((2.9, PRIOR_ONLY), (3.1, MEASURED), (-5.0, PRIOR_ONLY)):
        numbers = {"value_kev": 1.2 + errors * 0.1, "mc_error_kev": 0.1, "prior_only_kev": 1.2}
        bounds["q0455"] = dataclasses.replace(headline, **numbers)
        judgement = judged(informed, bounds=bounds)
        assert judgement.verdict == verdict, errors
    assert "the image prefers light relics" in judgement.because[0]


def test_mocks_without_substructure_that_reach_the_bound(informed: tuple[Table, Analysis]) -> None:
    value = informed[1].bounds["q0455"].value_kev
    assert judged(informed, null(*[value] * 2, *[1.1] * 38)).verdict == MEASURED
    judgement = judged(informed, null(*[value] * 3, *[1.1] * 37))
    assert judgement.verdict == PRIOR_ONLY
    assert judgement.because == ["null test: 8% of 40 mocks without substructure give a bound as high"]


def test_a_bound_that_is_too_strong(informed: tuple[Table, Analysis]) -> None:
    calibration = informed[1].calibration
    for n_covered, verdict in ((360, NOT_USABLE), (376, MEASURED), (400, MEASURED)):
        truth = np.where(np.arange(400) < n_covered, 3.0, 1.0)
        overall = {**calibration.overall, "q0455": coverage(np.full(400, 2.0), truth, 0.0455)}
        judgement = judged(informed, calibration=dataclasses.replace(calibration, overall=overall))
        assert judgement.verdict == verdict, n_covered
        if verdict == NOT_USABLE:
            assert "calibration failed: 90.0% of 400 truths lie above their bound" in judgement.because[0]


def test_a_measurement_needs_a_calibration_and_the_prior_does_not() -> None:
    table = toy(1500, 0.5, 4.4)
    judgement = judge_bound(table, run(table, n_rows=MIN_ROWS - 1), None, [])
    assert (judgement.verdict, judgement.because) == (NOT_USABLE, ["calibrated on 299 rows only (fewer than 300)"])
    noise = toy(1500, 1e4, 2.0)
    judgement = judge_bound(noise, run(noise, n_rows=MIN_ROWS - 1), None, [])
    assert judgement.verdict == PRIOR_ONLY
    assert "calibrated on 299 rows only (fewer than 300)" in judgement.warnings


def test_a_bound_that_falls_with_the_threshold(informed: tuple[Table, Analysis]) -> None:
    convergence, bound = informed[1].convergence, informed[1].bounds["q0455"].value_kev
    for shift, verdict in ((-0.5, NOT_USABLE), (-0.2, MEASURED), (0.5, MEASURED)):
        steps = tuple(
            dataclasses.replace(step, raw_kev=bound + shift * (step.fraction < 0.1), raw_error_kev=0.1)
            for step in convergence.steps
        )
        judgement = judged(informed, convergence=dataclasses.replace(convergence, steps=steps))
        assert judgement.verdict == verdict, shift
        if verdict == NOT_USABLE:
            assert "the bound falls to" in judgement.because[0]


def test_failures_that_cluster_are_told_from_faults_of_samples() -> None:
    rng = np.random.default_rng(3)
    m = rng.uniform(0.05, 5.0, 2483)
    parameters = {"m_th_kev": m, "log10_m_halo_msun": rng.uniform(12.0, 13.0, 2483)}
    (single,) = failure_reasons(parameters, np.isin(np.arange(2483), [5, 700, 1400, 2000]))
    assert (single.verdict, single.text) == (MEASURED, "4 of 2483 samples failed and are left out")
    light = m < 0.11  # as many as a case of the old halo model: 30 of 2,483
    _, clustered = failure_reasons(parameters, light)
    assert clustered.verdict == NOT_USABLE
    assert f"the {light.sum()} of 2483 samples that failed cluster: their m_th_kev is 0.05" in clustered.text
    assert failure_reasons(parameters, np.zeros(2483, dtype=bool)) == []


def test_samples_of_several_versions_of_the_code() -> None:
    same = {stage: {"a"} for stage in ("halos", "mocks", "summaries", "observed_summary", "null_summaries")}
    assert code_reasons(same, ()) == []
    assert code_reasons({**same, "halos": {"older"}}, ()) == [], "what follows was made of these alike"
    for stage, name in (("summaries", "summaries"), ("observed_summary", "summaries"), ("halos", "halos")):
        (reason,) = code_reasons({**same, stage: {"a", "b"}}, ())
        assert reason.verdict == NOT_USABLE
        assert reason.text.startswith(f"{name} were made by 2 versions of the code")
    (dirty,) = code_reasons(same, ("scans",))
    assert (dirty.verdict, dirty.text) == (MEASURED, "made by code with changes that were not committed: scans")


def test_misfit_of_the_lens() -> None:
    problem, note = misfit_reasons(["chi2_red is 3"], ["bright arcs"])
    assert (problem.verdict, note.verdict) == (NOT_USABLE, MEASURED)


def test_several_lenses() -> None:
    lenses = {"results/a": PRIOR_ONLY, "results/b": MEASURED}
    assert judge_combined(2.0, 0.1, 1.18, lenses).verdict == MEASURED
    assert judge_combined(1.3, 0.1, 1.18, lenses).verdict == PRIOR_ONLY
    judgement = judge_combined(2.0, 0.1, 1.18, {**lenses, "results/c": NOT_USABLE})
    assert judgement.verdict == NOT_USABLE
    assert "results/c is not usable; see `warmlens result results/c`" in judgement.because
