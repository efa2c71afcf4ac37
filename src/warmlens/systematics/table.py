"""The table of `warmlens systematics`: a row a variant, as CSV, JSON and figure, and printed."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from warmlens.artifacts.file import Artifact, ArtifactError, atomic_path, open_artifact
from warmlens.artifacts.names import SINGLE
from warmlens.campaign.files import stage_files
from warmlens.config.model import Config
from warmlens.inference.priors import HALO_MASS_PRIORS
from warmlens.products.samples import SampleTable
from warmlens.stage_table import campaign_stages
from warmlens.stages.summaries import COMBINED

NAME = "systematics"
DONE, FAILED = "done", "failed"
PRIOR_GROUP = "halo-mass prior"
_MEAN_Z2 = f"{COMBINED}/mean_z2"


@dataclass(frozen=True)
class Row:
    """One campaign of the table; what a variant does not have is None.

    Attributes
    ----------
    name, group, description
        Of the variant.
    state, reason
        `done`, or `failed` and why.
    bound_kev, mc_error_kev, prior_only_kev
        The headline bound, its Monte-Carlo error, and what the prior alone gives [keV].
    shift_kev
        Bound less the base's [keV]. The samples are shared as far as the change lets them, so that the
        errors of two campaigns are not independent.
    n_accepted, n_samples, n_in_common
        Accepted and all samples, and how many of the accepted the base accepted too.
    ess
        Effective number of accepted samples under another prior.
    quotable
        As in abc.json.
    n_below, c0, min_delta_r, mean_z2
        Of the observation's scan, bands added: positions below the threshold, C(0), lowest Delta R, and the mean
        of z^2 if the scan has the amplitude.
    null_n_below, null_mean_z2
        Their medians among the campaign's own mocks without substructure, if it has any: what smooth lens, source,
        PSF and noise of this variant do by themselves.
    chi2_red
        Of the smooth model per band, outside the quasars' cores.
    computed
        Stages that were computed for it; the others are the base's.
    computed_s
        Core seconds of these.
    warnings
        Of the ABC.
    """

    name: str
    group: str
    description: str
    state: str = DONE
    reason: str = ""
    bound_kev: float | None = None
    mc_error_kev: float | None = None
    prior_only_kev: float | None = None
    shift_kev: float | None = None
    n_accepted: int | None = None
    n_samples: int | None = None
    n_in_common: int | None = None
    ess: float | None = None
    quotable: bool | None = None
    n_below: int | None = None
    c0: float | None = None
    min_delta_r: float | None = None
    mean_z2: float | None = None
    null_n_below: float | None = None
    null_mean_z2: float | None = None
    chi2_red: dict[str, float] = field(default_factory=dict)
    computed: tuple[str, ...] = ()
    computed_s: float | None = None
    warnings: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return dataclasses.asdict(self)


def read_row(name: str, group: str, description: str, config: Config, base: Config | None, *, bound: bool) -> Row:
    """Row of a finished campaign; `base` is None for the base itself."""
    values = _scan_numbers(config)
    if bound:
        values |= _bound_numbers(config, base)
    if base is not None:
        values |= _cost(config, base)
    return Row(name, group, description, **values)


def failed_row(name: str, group: str, description: str, config: Config, base: Config, reason: str) -> Row:
    """Row of a campaign that failed, with what its scan of the observation says if it got so far."""
    values: dict[str, Any] = _cost(config, base)
    if all((Path(config.results) / SINGLE[stage]).exists() for stage in ("smooth_model", "observed_summary")):
        values |= _scan_numbers(config)
    return Row(name, group, description, FAILED, reason, **values)


def prior_rows(base: Config) -> list[Row]:
    """Rows of the base campaign under other halo-mass priors: its own samples, weighted."""
    with open_artifact(_file(base, "abc"), "abc") as artifact:
        others, own = artifact.metadata["other_priors"], _headline(artifact)
    rows = []
    for name in HALO_MASS_PRIORS:
        found = others[name]
        description = f"the base's samples weighted to the prior {name}"
        if found["value_kev"] is None:
            rows.append(Row(name, PRIOR_GROUP, description, FAILED, "; ".join(found["warnings"])))
            continue
        rows.append(
            Row(
                name,
                PRIOR_GROUP,
                description,
                bound_kev=found["value_kev"],
                mc_error_kev=found["mc_error_kev"],
                prior_only_kev=found["prior_only_kev"],
                shift_kev=found["value_kev"] - own["value_kev"],
                n_accepted=found["k"],
                n_samples=found["n"],
                n_in_common=found["k"],
                ess=found["ess"],
                warnings=tuple(found["warnings"]),
            )
        )
    return rows


def write_table(folder: Path, rows: Sequence[Row]) -> None:
    """Write the rows as CSV (a column a number) and JSON (with warnings)."""
    with atomic_path(folder / f"{NAME}.json") as temporary:
        temporary.write_text(json.dumps([row.as_dict() for row in rows], indent=2, allow_nan=False) + "\n")
    flat = []
    for row in rows:
        values = row.as_dict()
        chi2 = {f"chi2_red_{band}": value for band, value in values.pop("chi2_red").items()}
        values["computed"] = " ".join(values["computed"])
        values["warnings"] = "; ".join(values["warnings"])
        flat.append({**values, **chi2})
    with atomic_path(folder / f"{NAME}.csv") as temporary:
        pd.DataFrame(flat).convert_dtypes().to_csv(temporary, index=False)  # counts stay whole beside gaps


def print_table(rows: Sequence[Row], console: Console) -> None:
    """Print bound and scan of every variant, and why one has none."""
    columns = ("variant", "bound [keV]", "prior", "shift", "as base", "n below", "C(0)", "min dR", "z2")
    table = Table(*columns, "chi2_red", "core s", box=None)
    table.caption = "n below, z2: of the observation (median of the mocks without substructure)"
    for row in rows:
        bound = "" if row.bound_kev is None else f"{row.bound_kev:.2f} +- {row.mc_error_kev:.2f}"
        bound += " (do not quote)" if row.quotable is False else ""
        table.add_row(
            row.name,
            "failed" if row.state == FAILED else bound,
            _text(row.prior_only_kev, ".2f"),
            _text(row.shift_kev, "+.2f"),
            "" if row.n_in_common is None else f"{row.n_in_common} of {row.n_accepted}",
            _text(row.n_below, "d") + _bracketed(row.null_n_below, ".0f"),
            _text(row.c0, ".3g"),
            _text(row.min_delta_r, ".1f"),
            _text(row.mean_z2, ".2f") + _bracketed(row.null_mean_z2, ".2f"),
            " ".join(f"{value:.3f}" for value in row.chi2_red.values()),
            _text(row.computed_s, ".0f"),
        )
    wide = Console(file=console.file, highlight=False, width=max(console.width, 140))  # no cell is to be broken
    wide.print(table)
    for row in rows:
        if row.state == FAILED:
            console.print(f"{row.name} failed: {row.reason}", markup=False)


def draw_table(folder: Path, rows: Sequence[Row]) -> None:
    """Draw the bound of every variant, and beside it what its scan of the observation shows, as PNG."""
    import matplotlib as mpl

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


def _text(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _bracketed(value: float | None, form: str) -> str:
    return "" if value is None else f" ({value:{form}})"


def _file(config: Config, stage: str) -> Path:
    return Path(config.results) / SINGLE[stage]


def _headline(artifact: Artifact) -> dict[str, Any]:
    return artifact.metadata["bounds"][artifact.metadata["headline"]]


def _accepted(artifact: Artifact) -> set[int]:
    return set(artifact.array("table/sample_id")[artifact.array("table/accepted").astype(bool)].tolist())


def _bound_numbers(config: Config, base: Config | None) -> dict[str, Any]:
    with open_artifact(_file(config, "abc"), "abc") as artifact:
        meta, bound, accepted = artifact.metadata, _headline(artifact), _accepted(artifact)
    values = {
        "bound_kev": bound["value_kev"],
        "mc_error_kev": bound["mc_error_kev"],
        "prior_only_kev": bound["prior_only_kev"],
        "n_accepted": meta["n_accepted"],
        "n_samples": meta["n_samples"],
        "ess": bound["ess"],
        "quotable": meta["quotable"],
        "warnings": tuple(meta["warnings"]),
    }
    if base is not None:
        with open_artifact(_file(base, "abc"), "abc") as artifact:
            own = _headline(artifact)
            values["n_in_common"] = len(accepted & _accepted(artifact))
        values["shift_kev"] = bound["value_kev"] - own["value_kev"]
    return values


def _scan_numbers(config: Config) -> dict[str, Any]:
    with open_artifact(_file(config, "smooth_model"), "smooth_model") as artifact:
        fits = artifact.metadata["fits"]
        chi2 = {band: fits[band]["chi2_red_outside_cores"] for band in artifact.metadata["bands"]}
    with open_artifact(_file(config, "observed_scan"), "observed_scan") as artifact:
        valid = artifact.array("raster/valid")
        delta_r = np.sum([artifact.array(f"{band}/delta_r") for band in artifact.metadata["bands"]], axis=0)[valid]
    if not delta_r.size:
        raise ArtifactError(f"{_file(config, 'observed_scan')}: no position of the raster sees an unmasked pixel")
    with open_artifact(_file(config, "observed_summary"), "observed_summary") as artifact:
        c0 = float(artifact.array(f"{COMBINED}/correlation")[0])
        mean_z2 = float(artifact[_MEAN_Z2][()]) if _MEAN_Z2 in artifact.file else None
    n_below = int((delta_r < config.summaries.threshold).sum())
    observed = {"n_below": n_below, "c0": c0, "min_delta_r": float(delta_r.min()), "mean_z2": mean_z2}
    return {"chi2_red": chi2, **observed, **_null_numbers(config)}


def _null_numbers(config: Config) -> dict[str, float]:
    """Medians of the null test; none where the campaign has no null test, or did not get so far."""
    if not _file(config, "null_summaries").exists():  # the last of its stages
        return {}
    with open_artifact(_file(config, "null_scans"), "null_scans") as artifact:
        done = SampleTable.read(artifact).done
        valid = artifact.array("raster/valid")
        delta_r = np.sum([artifact.array(f"{band}/delta_r") for band in artifact.metadata["bands"]], axis=0)
    n_below = (delta_r[done][:, valid] < config.summaries.threshold).sum(axis=1)
    numbers = {"null_n_below": float(np.median(n_below))}
    with open_artifact(_file(config, "null_summaries"), "null_summaries") as artifact:
        if _MEAN_Z2 in artifact.file:
            numbers["null_mean_z2"] = float(np.median(artifact.array(_MEAN_Z2)[done]))
    return numbers


def _cost(config: Config, base: Config) -> dict[str, Any]:
    """Stages that are not the base's, and their core seconds; the observation is the base's in any case."""
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
    """Whether `path` was linked or copied from the base, which keeps size and time."""
    if not original.exists():
        return False
    mine, other = path.stat(), original.stat()
    return (mine.st_size, mine.st_mtime_ns) == (other.st_size, other.st_mtime_ns)
