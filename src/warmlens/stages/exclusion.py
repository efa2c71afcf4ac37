"""Stage `exclusion`: which halo masses of a grid campaign the accepted samples leave standing."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from warmlens import __version__
from warmlens.artifacts.chain import check_chains
from warmlens.artifacts.file import ArtifactError, Dataset, Provenance, atomic_path, write_artifact
from warmlens.inference.acceptance import Acceptance, accept
from warmlens.inference.calibration import CONFIDENCE, clopper_pearson
from warmlens.inference.checks import cloud_check
from warmlens.inference.exclusion import LEVEL, MAX_RATIO, Exclusion, exclusion
from warmlens.inference.summary_sets import Summary, kinds_of, learned_points, points
from warmlens.inference.table import Table
from warmlens.sampling import stream
from warmlens.stages.abc.numbers import plain
from warmlens.stages.abc.tables import read_summaries, usable_table
from warmlens.stages.settings import ExclusionSettings
from warmlens.types import BoolArray, FloatArray

log = logging.getLogger(__name__)


def run(
    settings: ExclusionSettings,
    summaries: Sequence[Path],
    observed_summary: Path,
    smooth_model: Path,
    output: Path,
    table_csv: Path,
    numbers_json: Path,
) -> None:
    """Write the counts on the nodes, what they exclude, and the table of samples."""
    inputs = {"observed_summary": observed_summary, "smooth_model": smooth_model}
    inputs |= {f"summaries/{path.stem}": path for path in summaries}
    provenance = Provenance("exclusion", settings.as_dict(), inputs, seed_key=f"{settings.seed}/exclusion")
    check_chains(inputs.values(), settings.upstream)
    table, good, upstream_warnings = usable_table(
        summaries, smooth_model, settings.n_samples, settings.abc.max_failed_fraction
    )
    samples = _samples(settings, table[good], *read_summaries(summaries, observed_summary, None, good))
    distances = samples.distances()
    block = settings.abc
    rng = stream(settings.seed, "exclusion/ties", 0)
    try:
        acceptance = accept(distances, block.acceptance, block.fraction, samples.sample_id, rng)
        found = exclusion(
            samples.m_kev,
            samples.log10_mass,
            acceptance.accepted,
            np.array(settings.nodes.m_th_kev),
            np.array(settings.nodes.log10_m_halo_msun),
        )
    except ValueError as error:
        raise ArtifactError(f"the grid excludes nothing: {error}") from error
    cloud = cloud_check(samples)
    warnings = [*cloud.warnings, *found.warnings, *upstream_warnings]
    if acceptance.n_tied:
        warnings.append(f"{acceptance.n_tied} samples share the distance at the cut")
    for warning in warnings:
        log.warning(warning)
    metadata = plain(
        {
            "n_samples": len(table),
            "n_failed": int((~good).sum()),
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
                {**dataclasses.asdict(item), "excluded_at": item.excluded_at} for item in found.halo_masses
            ],
            "excluded_up_to_log10_m_halo_msun": (
                None if found.excluded_up_to is None else found.excluded_up_to.log10_m_halo_msun
            ),
            "statement": statement(found),
            "nearest_neighbour_percentile": cloud.percentile,
            "warnings": warnings,
        }
    )
    nodes = _nodes(found, settings)
    arrays = {
        **_node_datasets(found, settings),
        **_table_datasets(table, good, distances, acceptance, samples.kinds),
    }
    digest = write_artifact(output, provenance, arrays, metadata)
    with atomic_path(table_csv) as temporary:
        nodes.to_csv(temporary, index=False)
    with atomic_path(numbers_json) as temporary:
        whole = {"package_version": __version__, "artifact": output.name, "artifact_digest": digest, **metadata}
        whole["nodes"] = nodes.to_dict(orient="records")
        temporary.write_text(json.dumps(whole, indent=2, allow_nan=False) + "\n")


def statement(found: Exclusion) -> str:
    """What may be said about the halo mass, counting errors included."""
    last = found.excluded_up_to
    if last is None:
        single = [item for item in found.halo_masses if item.excluded]
        if not single:
            return f"no halo mass is excluded at {100 * (1 - LEVEL):.2f}%"
        names = ", ".join(
            f"10^{item.log10_m_halo_msun:g} Msun at {100 * item.excluded_at:.1f}%" for item in single
        )
        return f"halo mass excluded: {names}"
    return (
        f"halo masses up to 10^{last.log10_m_halo_msun:g} Msun are excluded at "
        f"{100 * (1.0 - last.cumulative_interval[1]):.1f}%, all of them together"
    )


def _samples(
    settings: ExclusionSettings,
    table: pd.DataFrame,
    summaries: Mapping[str, Summary],
    grids: Mapping[str, FloatArray],
) -> Table:
    """The good samples as points whose squared distance is the one that the settings ask for."""
    block = settings.abc
    try:
        known = points(summaries, grids, block.distance)
        if block.summaries == "learned":
            parameters = table[["m_th_kev", "log10_m_halo_msun"]].to_numpy()
            rng = stream(settings.seed, "exclusion/learned", 0)
            known = learned_points(parameters, summaries, rng)[0]
        kinds = kinds_of(block.summaries, known)
        return Table(
            table["sample_id"].to_numpy(),
            table["m_th_kev"].to_numpy(),
            table["log10_m_halo_msun"].to_numpy(),
            settings.dark_matter.m_th_kev,
            settings.dark_matter.log10_m_halo_msun,
            tuple(known[kind].samples for kind in kinds),
            tuple(known[kind].observed for kind in kinds),
            kinds,
        )
    except ValueError as error:
        raise ArtifactError(f"the table of samples cannot be used: {error}") from error


def _nodes(found: Exclusion, settings: ExclusionSettings) -> pd.DataFrame:
    """One row a node, halo mass by halo mass."""
    relic, halo = np.meshgrid(settings.nodes.m_th_kev, settings.nodes.log10_m_halo_msun)
    intervals = _rate_intervals(found)
    return pd.DataFrame(
        {
            "m_th_kev": relic.ravel(),
            "log10_m_halo_msun": halo.ravel(),
            "n_samples": found.n_samples.ravel(),
            "n_accepted": found.n_accepted.ravel(),
            "rate_low": intervals[..., 0].ravel(),
            "rate_high": intervals[..., 1].ravel(),
            "probability": _probability(found).ravel(),
        }
    )


def _probability(found: Exclusion) -> FloatArray:
    """Posterior probability of each node [halo mass, relic mass]; a node without samples left has none."""
    rate = found.n_accepted / np.maximum(found.n_samples, 1)
    return rate / rate.sum()


def _rate_intervals(found: Exclusion) -> FloatArray:
    """Clopper-Pearson interval of the fraction accepted at each node [halo mass, relic mass, edge]."""
    pairs = zip(found.n_accepted.ravel().tolist(), found.n_samples.ravel().tolist(), strict=True)
    return np.array([clopper_pearson(k, n) if n else (0.0, 1.0) for k, n in pairs]).reshape(
        *found.n_samples.shape, 2
    )


def _node_datasets(found: Exclusion, settings: ExclusionSettings) -> dict[str, Dataset]:
    masses, grid = ("halo mass",), ("halo mass", "relic mass")
    items = found.halo_masses

    def column(name: str) -> Any:
        return np.array([getattr(item, name) for item in items])

    return {
        "nodes/m_th_kev": Dataset(np.array(settings.nodes.m_th_kev), "keV", ("relic mass",), "thermal relic mass"),
        "nodes/log10_m_halo_msun": Dataset(
            column("log10_m_halo_msun"), "dex(Msun)", masses, "log10 of M200c of the host halo"
        ),
        "nodes/n_samples": Dataset(found.n_samples, "", grid, "samples with summaries"),
        "nodes/n_accepted": Dataset(found.n_accepted, "", grid, "of these, accepted"),
        "nodes/rate_interval": Dataset(
            _rate_intervals(found), "", (*grid, "edge"), "Clopper-Pearson interval of the fraction accepted"
        ),
        "nodes/probability": Dataset(_probability(found), "", grid, "posterior, uniform prior on the nodes"),
        "halo_mass/n_samples": Dataset(column("n_samples"), "", masses, "samples with summaries"),
        "halo_mass/n_accepted": Dataset(column("n_accepted"), "", masses, "of these, accepted"),
        "halo_mass/rate": Dataset(column("rate"), "", masses, "fraction accepted"),
        "halo_mass/rate_interval": Dataset(column("rate_interval"), "", (*masses, "edge"), "Clopper-Pearson"),
        "halo_mass/probability": Dataset(column("probability"), "", masses, "posterior, relic mass marginalised"),
        "halo_mass/probability_interval": Dataset(
            column("probability_interval"), "", (*masses, "edge"), "its counting error"
        ),
        "halo_mass/cumulative": Dataset(column("cumulative"), "", masses, "posterior of this and all lower ones"),
        "halo_mass/cumulative_interval": Dataset(
            column("cumulative_interval"), "", (*masses, "edge"), "its counting error"
        ),
        "halo_mass/likelihood_ratio": Dataset(column("ratio"), "", masses, "likelihood over the best halo mass's"),
        "halo_mass/likelihood_ratio_interval": Dataset(
            column("ratio_interval"), "", (*masses, "edge"), "its counting error"
        ),
        "halo_mass/excluded": Dataset(column("excluded"), "", masses, "1 where the intervals support it"),
    }


def _table_datasets(
    table: pd.DataFrame, good: BoolArray, distances: FloatArray, acceptance: Acceptance, kinds: Sequence[str]
) -> dict[str, Dataset]:
    """All samples; NaN and not accepted where one failed."""

    def spread(values: FloatArray) -> FloatArray:
        column = np.full(len(table), np.nan)
        column[good] = values
        return column

    axes = ("sample",)
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
