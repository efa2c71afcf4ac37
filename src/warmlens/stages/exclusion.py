"""Stage `exclusion`: which halo masses of a grid campaign the accepted samples leave standing."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Dataset
from warmlens.inference.acceptance import Acceptance, accept
from warmlens.inference.calibration import CONFIDENCE, clopper_pearson
from warmlens.inference.checks import cloud_check
from warmlens.inference.exclusion import LEVEL, MAX_RATIO, Exclusion, exclusion
from warmlens.inference.summary_sets import kinds_of, learned_points, points
from warmlens.inference.table import Table
from warmlens.inference.verdict import MEASURED, NOT_USABLE, PRIOR_ONLY, Reason, judge, table_reasons
from warmlens.products.answer import NODE_COLUMNS
from warmlens.sampling import stream
from warmlens.stage_table import ExclusionSettings
from warmlens.stages.abc.numbers import to_json_types
from warmlens.stages.abc.tables import Samples, read_samples, write_answer
from warmlens.stages.job import Job
from warmlens.types import FloatArray

log = logging.getLogger(__name__)


def run(job: Job[ExclusionSettings]) -> None:
    """Write the counts on the nodes, what they exclude, and the table of samples."""
    settings, block = job.settings, job.settings.abc
    samples = read_samples(job)
    table = _headline_table(settings, samples)
    distances = table.distances()
    rng = stream(settings.seed, "exclusion/ties", 0)
    try:
        acceptance = accept(distances, block.acceptance, block.fraction, table.sample_id, rng)
        counts = exclusion(
            table.m_kev,
            table.log10_mass,
            acceptance.accepted,
            np.array(settings.nodes.m_th_kev),
            np.array(settings.nodes.log10_m_halo_msun),
        )
    except ValueError as error:
        raise ArtifactError(f"the grid excludes nothing: {error}") from error
    cloud = cloud_check(table)
    reasons = [
        *table_reasons(table.n, acceptance.k),
        *(Reason(NOT_USABLE, text) for text in cloud.outside),
        *samples.reasons,
        *(Reason(PRIOR_ONLY, text) for text in cloud.uninformative),
        *(Reason(MEASURED, text) for text in counts.warnings),
    ]
    if not any(halo.excluded for halo in counts.halo_masses):
        reasons.append(Reason(PRIOR_ONLY, statement(counts)))
    if acceptance.n_tied:
        reasons.append(Reason(MEASURED, f"{acceptance.n_tied} samples share the distance at the cut"))
    judgement = judge(reasons, statement(counts))
    log.warning("the exclusion is %s: %s", judgement.verdict, "; ".join(judgement.because))
    for warning in judgement.warnings:
        log.warning(warning)
    last = counts.excluded_up_to
    metadata = to_json_types(
        {
            **judgement.numbers(),
            "n_samples": len(samples.table),
            "n_failed": int((~samples.good).sum()),
            "summaries": block.summaries,
            "distance": block.distance,
            "acceptance": acceptance.rule,
            "fraction": acceptance.fraction,
            "n_accepted": acceptance.k,
            "n_ties": acceptance.n_tied,
            "implied_quantile": acceptance.implied_quantile,
            "level": LEVEL,
            "max_ratio": MAX_RATIO,
            "confidence": CONFIDENCE,
            "prior": "uniform on the nodes",
            "halo_masses": [
                {**dataclasses.asdict(halo), "excluded_at": halo.excluded_at} for halo in counts.halo_masses
            ],
            "excluded_up_to_log10_m_halo_msun": None if last is None else last.log10_m_halo_msun,
            "statement": statement(counts),
            "nearest_neighbour_percentile": cloud.percentile,
            "warnings": judgement.warnings,
        }
    )
    datasets = _node_datasets(counts, settings) | _table_datasets(samples, distances, acceptance, table.kinds)
    write_answer(job, datasets, metadata, NODE_COLUMNS)


def statement(counts: Exclusion) -> str:
    """Return what may be said about the halo mass, counting errors included."""
    last = counts.excluded_up_to
    if last is not None:
        return (
            f"halo masses up to 10^{last.log10_m_halo_msun:g} Msun are excluded at "
            f"{100 * (1.0 - last.cumulative_interval[1]):.1f}%, all of them together"
        )
    excluded = [halo for halo in counts.halo_masses if halo.excluded]
    if not excluded:
        return f"no halo mass is excluded at {100 * (1 - LEVEL):.2f}%"
    names = ", ".join(f"10^{halo.log10_m_halo_msun:g} Msun at {100 * halo.excluded_at:.1f}%" for halo in excluded)
    return f"halo mass excluded: {names}"


def _headline_table(settings: ExclusionSettings, samples: Samples) -> Table:
    """Return the good samples as points whose squared distance is the one that the settings ask for."""
    block = settings.abc
    try:
        kinds = points(samples.summaries, samples.grids, block.distance)
        if block.summaries == "learned":
            rng = stream(settings.seed, "exclusion/learned", 0)
            kinds = learned_points(samples.parameters, samples.summaries, rng)[0]
    except ValueError as error:
        raise ArtifactError(f"the table of samples cannot be used: {error}") from error
    return samples.points(settings, {kind: kinds[kind] for kind in kinds_of(block.summaries, kinds)})


def _probability(counts: Exclusion) -> FloatArray:
    """Return the posterior probability of each node [halo mass, relic mass]; 0 for one without samples."""
    rate = counts.n_accepted / np.maximum(counts.n_samples, 1)
    return rate / rate.sum()


def _rate_intervals(counts: Exclusion) -> FloatArray:
    """Return the Clopper-Pearson interval of the fraction accepted at each node [halo mass, relic mass, edge]."""
    pairs = zip(counts.n_accepted.ravel().tolist(), counts.n_samples.ravel().tolist(), strict=True)
    return np.array([clopper_pearson(k, n) if n else (0.0, 1.0) for k, n in pairs]).reshape(
        *counts.n_samples.shape, 2
    )


_OF_HALO_MASS = {  # attribute, description
    "n_samples": ("n_samples", "samples with summaries"),
    "n_accepted": ("n_accepted", "of these, accepted"),
    "rate": ("rate", "fraction accepted"),
    "rate_interval": ("rate_interval", "Clopper-Pearson"),
    "probability": ("probability", "posterior, relic mass marginalised"),
    "probability_interval": ("probability_interval", "its counting error"),
    "cumulative": ("cumulative", "posterior of this and all lower ones"),
    "cumulative_interval": ("cumulative_interval", "its counting error"),
    "likelihood_ratio": ("ratio", "likelihood over the best halo mass's"),
    "likelihood_ratio_interval": ("ratio_interval", "its counting error"),
    "excluded": ("excluded", "1 where the intervals support it"),
}


def _node_datasets(counts: Exclusion, settings: ExclusionSettings) -> dict[str, Dataset]:
    halo, relic = ("halo mass",), ("relic mass",)
    grid = (*halo, *relic)
    masses = np.array([mass.log10_m_halo_msun for mass in counts.halo_masses])
    intervals = _rate_intervals(counts)
    datasets = {
        "nodes/m_th_kev": Dataset(np.array(settings.nodes.m_th_kev), "keV", relic, "thermal relic mass"),
        "nodes/log10_m_halo_msun": Dataset(masses, "dex(Msun)", halo, "log10 of M200c of the host halo"),
        "nodes/n_samples": Dataset(counts.n_samples, "", grid, "samples with summaries"),
        "nodes/n_accepted": Dataset(counts.n_accepted, "", grid, "of these, accepted"),
        "nodes/rate_interval": Dataset(intervals, "", (*grid, "edge"), "Clopper-Pearson interval of the fraction"),
        "nodes/probability": Dataset(_probability(counts), "", grid, "posterior, uniform prior on the nodes"),
    }
    for name, (attribute, description) in _OF_HALO_MASS.items():
        values = np.array([getattr(mass, attribute) for mass in counts.halo_masses])
        datasets[f"halo_mass/{name}"] = Dataset(values, "", (*halo, "edge")[: values.ndim], description)
    return datasets


def _table_datasets(
    samples: Samples, distances: FloatArray, acceptance: Acceptance, kinds: Sequence[str]
) -> dict[str, Dataset]:
    """Return all samples as datasets; NaN and not accepted where one failed."""
    table, good, axes = samples.table, samples.good, ("sample",)

    def spread(values: FloatArray) -> FloatArray:
        column = np.full(len(table), np.nan)
        column[good] = values
        return column

    columns = {
        "sample_id": ("", "number of the sample"),
        "m_th_kev": ("keV", "thermal relic mass"),
        "log10_m_halo_msun": ("dex(Msun)", "log10 of M200c of the host halo"),
        "status": ("", "0 done, otherwise failed"),
    }
    result = {
        f"table/{name}": Dataset(table[name].to_numpy(), unit, axes, description)
        for name, (unit, description) in columns.items()
    }
    accepted = np.zeros(len(table), dtype=bool)
    accepted[good] = acceptance.accepted
    result["table/message"] = Dataset(table["message"].tolist(), "", axes, "why the sample failed")
    result["table/accepted"] = Dataset(accepted, "", axes, "1 for accepted samples")
    result["table/max_rank"] = Dataset(
        spread(acceptance.max_rank.astype(np.float64)), "", axes, "larger rank of the distances"
    )
    for kind, values in zip(kinds, distances, strict=True):
        result[f"table/distance_{kind}"] = Dataset(spread(values), "", axes, f"distance in {kind}")
    return result
