"""The table of `warmlens systematics`: one row per variant, as CSV, JSON and figure, and printed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from warmlens.artifacts.atomic import ArtifactError, atomic_path
from warmlens.artifacts.file import Artifact, open_artifact
from warmlens.artifacts.names import SINGLE
from warmlens.campaign.files import stage_files
from warmlens.config.model import Config
from warmlens.inference.priors import HALO_MASS_PRIORS
from warmlens.products.samples import SampleTable
from warmlens.stage_table import campaign_stages
from warmlens.stages.summaries import COMBINED
from warmlens.text import Terminal
from warmlens.types import FloatArray

NAME = "systematics"
DONE, FAILED = "done", "failed"
PRIOR_GROUP = "halo-mass prior"
_MEAN_Z2 = f"{COMBINED}/mean_z2"


@dataclass(frozen=True)
class Row:
    """One campaign of the table; numbers that it does not have are None.

    The samples are shared as far as the change lets them, so that the errors of two bounds are not independent.
    """

    name: str
    group: str
    description: str
    state: str = DONE  # or FAILED
    reason: str = ""  # of the failure
    bound_kev: float | None = None  # the headline bound
    mc_error_kev: float | None = None  # its Monte-Carlo error
    prior_only_kev: float | None = None  # the bound of the prior alone
    shift_kev: float | None = None  # bound less the base's
    n_accepted: int | None = None
    n_samples: int | None = None
    n_in_common: int | None = None  # accepted samples that the base accepted too
    ess: float | None = None  # effective number of accepted samples
    verdict: str | None = None  # as in abc.json
    n_below: int | None = None  # positions of the observation's scan below the threshold, bands added
    c0: float | None = None  # C(0)
    min_delta_r: float | None = None
    mean_z2: float | None = None  # mean of z^2, if the scan has the amplitude
    null_n_below: float | None = None  # median of the campaign's own mocks without substructure
    null_mean_z2: float | None = None
    chi2_red: dict[str, float] = field(default_factory=dict)  # by band, outside the quasars' cores
    computed: tuple[str, ...] = ()  # stages that were computed for it; the others are the base's
    computed_s: float | None = None  # core seconds of these
    warnings: tuple[str, ...] = ()  # of the ABC


def read_numbers(config: Config, base: Config | None, *, bound: bool) -> dict[str, Any]:
    """Return the fields of `Row` of a finished campaign, with or without its bound; no `base` for the base."""
    return {
        **_scan_numbers(config),
        **(_bound_numbers(config, base) if bound else {}),
        **(_cost(config, base) if base is not None else {}),
    }


def read_numbers_of_failed(config: Config, base: Config) -> dict[str, Any]:
    """Return the fields of `Row` of a failed campaign: its cost, and the observation's scan if there is one."""
    scanned = all(_file(config, stage).exists() for stage in ("smooth_model", "observed_summary"))
    return {**_cost(config, base), **(_scan_numbers(config) if scanned else {})}


def prior_rows(base: Config) -> list[Row]:
    """Return the rows of the base campaign under other halo-mass priors: its own samples, weighted."""
    meta, headline, _ = _read_abc(base)
    rows = []
    for name in HALO_MASS_PRIORS:
        bound = meta["other_priors"][name]
        if bound["value_kev"] is None:
            numbers: dict[str, Any] = {"state": FAILED, "reason": "; ".join(bound["warnings"])}
        else:
            numbers = {"n_accepted": bound["k"], "n_samples": bound["n"], "n_in_common": bound["k"]}
            numbers |= {"warnings": tuple(bound["warnings"]), **_bound_fields(bound, headline)}
        rows.append(Row(name, PRIOR_GROUP, f"the base's samples weighted to the prior {name}", **numbers))
    return rows


def write_table(folder: Path, rows: Sequence[Row]) -> None:
    """Write the rows as CSV (one column per number) and JSON (with lists)."""
    records = [asdict(row) for row in rows]
    with atomic_path(folder / f"{NAME}.json") as temporary:
        temporary.write_text(json.dumps(records, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    for record in records:
        record["computed"] = " ".join(record["computed"])
        record["warnings"] = "; ".join(record["warnings"])
        record |= {f"chi2_red_{band}": value for band, value in record.pop("chi2_red").items()}
    with atomic_path(folder / f"{NAME}.csv") as temporary:
        pd.DataFrame(records).convert_dtypes().to_csv(temporary, index=False)  # counts stay whole beside gaps


def print_table(rows: Sequence[Row], console: Console) -> None:
    """Print bound and scan of every variant, and why one has none."""
    columns = ("variant", "bound [keV]", "verdict", "prior", "shift", "as base", "n below", "C(0)", "min dR", "z2")
    caption = "n below, z2: of the observation (median of the mocks without substructure)"
    table = Table(*columns, "chi2_red", "core s", box=None, caption=caption)
    for row in rows:
        bound = "" if row.bound_kev is None else f"{row.bound_kev:.2f} +- {row.mc_error_kev:.2f}"
        table.add_row(
            row.name,
            "failed" if row.state == FAILED else bound,
            row.verdict or "",
            _text("{:.2f}", row.prior_only_kev),
            _text("{:+.2f}", row.shift_kev),
            "" if row.n_in_common is None else f"{row.n_in_common} of {row.n_accepted}",
            _text("{}", row.n_below) + _text(" ({:.0f})", row.null_n_below),
            _text("{:.3g}", row.c0),
            _text("{:.1f}", row.min_delta_r),
            _text("{:.2f}", row.mean_z2) + _text(" ({:.2f})", row.null_mean_z2),
            " ".join(f"{value:.3f}" for value in row.chi2_red.values()),
            _text("{:.0f}", row.computed_s),
        )
    # so that no cell is broken
    wide = Terminal(file=console.file, markup=False, soft_wrap=False, width=max(console.width, 150))
    wide.print(table)
    for row in rows:
        if row.state == FAILED:
            console.print(f"{row.name} failed: {row.reason}", markup=False)


def draw_table(folder: Path, rows: Sequence[Row]) -> None:
    """Draw the bound of every variant and its scan of the observation, as PNG."""
    import matplotlib as mpl  # takes a second to import; a failed base campaign is reported without it

    mpl.use("agg")
    import matplotlib.pyplot as plt

    from warmlens.figures.draw.style import FULL_WIDTH_INCH, house_style
    from warmlens.figures.draw.systematics import draw_bounds, draw_scans

    with house_style():
        height = 0.9 + 0.24 * (len(rows) + len({row.group for row in rows}))
        figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, height), sharey=True, width_ratios=(3.0, 2.0))
        draw_bounds(axes[0], rows)
        draw_scans(axes[1], rows)
        with atomic_path(folder / f"{NAME}.png") as temporary:
            figure.savefig(temporary, format="png")
        plt.close(figure)


def _text(form: str, value: float | None) -> str:
    return "" if value is None else form.format(value)


def _file(config: Config, stage: str) -> Path:
    return Path(config.results) / SINGLE[stage]


def _read_abc(config: Config) -> tuple[dict[str, Any], dict[str, Any], set[int]]:
    """Return the metadata of the ABC, its headline bound, and the numbers of the accepted samples."""
    with open_artifact(_file(config, "abc"), "abc") as artifact:
        meta, accepted = artifact.metadata, artifact.array("table/accepted").astype(bool)
        return meta, meta["bounds"][meta["headline"]], set(artifact.array("table/sample_id")[accepted].tolist())


def _bound_fields(bound: Mapping[str, Any], of_base: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the fields of a bound, and its shift from the bound of the base, if there is one."""
    shift = None if of_base is None else bound["value_kev"] - of_base["value_kev"]
    fields = {name: bound[name] for name in ("mc_error_kev", "prior_only_kev", "ess")}
    return {**fields, "bound_kev": bound["value_kev"], "shift_kev": shift}


def _bound_numbers(config: Config, base: Config | None) -> dict[str, Any]:
    meta, bound, accepted = _read_abc(config)
    numbers = {name: meta[name] for name in ("n_accepted", "n_samples", "verdict")}
    numbers["warnings"] = (*meta["reasons"], *meta["warnings"])
    if base is None:
        return {**_bound_fields(bound, None), **numbers}
    _, of_base, accepted_by_base = _read_abc(base)
    return {**_bound_fields(bound, of_base), **numbers, "n_in_common": len(accepted & accepted_by_base)}


def _scan_numbers(config: Config) -> dict[str, Any]:
    with open_artifact(_file(config, "smooth_model"), "smooth_model") as artifact:
        fits = artifact.metadata["fits"]
        chi2 = {band: fits[band]["chi2_red_outside_cores"] for band in artifact.metadata["bands"]}
    with open_artifact(_file(config, "observed_scan"), "observed_scan") as artifact:
        delta_r = _valid_delta_r(artifact)
    if not delta_r.size:
        raise ArtifactError(f"{_file(config, 'observed_scan')}: no position of the raster sees an unmasked pixel")
    with open_artifact(_file(config, "observed_summary"), "observed_summary") as artifact:
        c0 = float(artifact.array(f"{COMBINED}/correlation")[0])
        mean_z2 = float(artifact[_MEAN_Z2][()]) if _MEAN_Z2 in artifact.file else None
    n_below = int((delta_r < config.summaries.threshold).sum())
    observed = {"n_below": n_below, "c0": c0, "min_delta_r": float(delta_r.min()), "mean_z2": mean_z2}
    return {"chi2_red": chi2, **observed, **_null_numbers(config)}


def _valid_delta_r(artifact: Artifact) -> FloatArray:
    """Return Delta R of all bands together at the valid positions [..., n_valid]."""
    delta_r = np.sum([artifact.array(f"{band}/delta_r") for band in artifact.metadata["bands"]], axis=0)
    return delta_r[..., artifact.array("raster/valid")]


def _null_numbers(config: Config) -> dict[str, float]:
    """Return the medians of the null test; none where the campaign has no null test, or did not get so far."""
    if not _file(config, "null_summaries").exists():  # the last of its stages
        return {}
    with open_artifact(_file(config, "null_scans"), "null_scans") as artifact:
        done = SampleTable.read(artifact).done
        n_below = (_valid_delta_r(artifact)[done] < config.summaries.threshold).sum(axis=1)
    numbers = {"null_n_below": float(np.median(n_below))}
    with open_artifact(_file(config, "null_summaries"), "null_summaries") as artifact:
        if _MEAN_Z2 in artifact.file:
            numbers["null_mean_z2"] = float(np.median(artifact.array(_MEAN_Z2)[done]))
    return numbers


def _cost(config: Config, base: Config) -> dict[str, Any]:
    """Return the stages that are not the base's, and their core seconds; the observation always is the base's."""
    root = Path(base.results)
    stages, seconds = [], 0.0
    for stage in campaign_stages(config)[1:]:
        for path in stage_files(config, stage):
            if path.exists() and not _shared(path, root / path.relative_to(config.results)):
                with open_artifact(path, stage) as artifact:
                    seconds += artifact.wall_seconds
                stages.append(stage)
    return {"computed": tuple(dict.fromkeys(stages)), "computed_s": seconds}


def _shared(path: Path, original: Path) -> bool:
    """Return whether `path` was linked or copied from the base, which keeps size and time."""
    if not original.exists():
        return False
    mine, other = path.stat(), original.stat()
    return (mine.st_size, mine.st_mtime_ns) == (other.st_size, other.st_mtime_ns)
