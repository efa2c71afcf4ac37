"""Figures of the plane of Delta R and R_sens, in which positions of scans are points."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from warmlens.artifacts.file import Artifact, ArtifactError, open_artifact
from warmlens.figures.draw.scan import draw_scan_plane
from warmlens.figures.inputs import Inputs
from warmlens.figures.recipe import all_of, needed, panel_table
from warmlens.figures.samples import relic_name
from warmlens.products.scan_maps import by_band
from warmlens.types import FloatArray

_MARK_SIZE = 14.0  # of a point in the legend [points^2]
_LONG_NAME = 24  # characters of a legend entry beyond which two fit beside one another

Points = tuple[FloatArray, FloatArray]  # Delta R and R_sens of positions, each [n]


@dataclass(frozen=True)
class PlaneFigure:
    """Positions of several scans by name."""

    scans: Mapping[str, Points]

    def table(self) -> pd.DataFrame:
        """A row a position and scan."""
        frames = {
            name: pd.DataFrame({"delta_r": delta, "r_sens": sens}) for name, (delta, sens) in self.scans.items()
        }
        return panel_table(frames).rename(columns={"panel": "scan"})


def read_scan_plane(inputs: Inputs) -> PlaneFigure:
    """The observation's scan, per band and of all together."""
    with open_artifact(needed(inputs, "observed_scan"), "observed_scan") as artifact:
        valid = artifact.array("raster/valid")
        delta, r_sens = by_band(artifact, "delta_r"), by_band(artifact, "r_sens")
    return PlaneFigure({name: (delta[name][valid], r_sens[name][valid]) for name in delta})


def read_lens_planes(inputs: Inputs) -> PlaneFigure:
    """Fig. 6: observations scanned with different numbers of shapelets of the lens potential."""
    return _compare(inputs, _lens_name)


def read_source_planes(inputs: Inputs) -> PlaneFigure:
    """Fig. 7: observations scanned with different descriptions of the source."""
    return _compare(inputs, _source_name)


def draw_plane_figure(data: PlaneFigure) -> Figure:
    """The plane, Delta R above, R_sens to the right."""
    figure, axes = plt.subplots(
        2, 2, figsize=(5.4, 5.0), width_ratios=(3.2, 1.0), height_ratios=(1.0, 3.2), sharex="col", sharey="row"
    )
    axes[0, 1].remove()
    draw_scan_plane(axes[1, 0], axes[0, 0], axes[1, 1], dict(data.scans))
    handles, names = axes[1, 0].get_legend_handles_labels()
    n_columns = 3 if max(map(len, names)) < _LONG_NAME else 2
    legend = figure.legend(handles, names, loc="outside lower center", ncols=n_columns)
    for handle in legend.legend_handles:
        if isinstance(handle, PathCollection):
            handle.set_sizes([_MARK_SIZE])  # the points themselves may be tiny
            handle.set_alpha(1.0)
    return figure


def _compare(inputs: Inputs, name_of: Callable[[Artifact, Artifact], str]) -> PlaneFigure:
    """Scan of every campaign's observation, all bands together; of a single campaign also mocks with R_sens."""
    numbers = sorted({int(key.partition("/")[0]) for key in inputs})
    names, points = [], []
    for number in numbers:
        with (
            open_artifact(needed(inputs, f"{number}/smooth_model"), "smooth_model") as model,
            open_artifact(needed(inputs, f"{number}/observed_scan"), "observed_scan") as scan,
        ):
            names.append(name_of(model, scan))
            valid = scan.array("raster/valid")
            points.append((_combined(scan, "delta_r")[valid], _combined(scan, "r_sens")[valid]))
    if len(set(names)) < len(names):  # alike in what the figure compares
        folders = [inputs[f"{number}/observed_scan"].parent.name for number in numbers]
        names = [f"{name} ({folder})" for name, folder in zip(names, folders, strict=True)]
    mocks = {key.removeprefix("0/"): path for key, path in inputs.items() if key.startswith("0/scans/")}
    if mocks:
        return PlaneFigure({f"observation, {names[0]}": points[0], **_mock_points(mocks)})
    return PlaneFigure(dict(zip(names, points, strict=True)))


def _mock_points(inputs: Inputs) -> dict[str, Points]:
    """Points of the mocks that `scan.residual_samples` names."""
    found: dict[str, Points] = {}
    for path in all_of(inputs, "scans"):
        with open_artifact(path, "scans") as artifact:
            if "residuals/sample_id" not in artifact.file:
                continue
            valid = artifact.array("raster/valid")
            sample_id = artifact.array("samples/sample_id")
            m_th, log10_m_halo = (artifact.array(f"samples/{name}") for name in ("m_th_kev", "log10_m_halo_msun"))
            for place, sample in enumerate(artifact.array("residuals/sample_id")):
                row = int(np.flatnonzero(sample_id == sample)[0])
                name = rf"mock {sample}: {relic_name(m_th[row])}, $10^{{{log10_m_halo[row]:.2f}}}$ M$_\odot$"
                found[name] = (
                    _combined(artifact, "delta_r", row)[valid],
                    _combined(artifact, "r_sens", place)[valid],
                )
    if not found:
        raise ArtifactError(
            "the scans hold R_sens of no mock: the samples of scan.residual_samples have all failed; name others"
        )
    return found


def _combined(artifact: Artifact, name: str, row: int | None = None) -> FloatArray:
    """Map of all bands together [ny, nx]."""
    return list(by_band(artifact, name, row).values())[-1]


def _lens_name(model: Artifact, _: Artifact) -> str:
    pairs = zip(model.metadata["lens_models"], model.metadata["kwargs_lens"], strict=True)
    number = sum(len(kwargs["coeffs"]) for name, kwargs in pairs if name == "SHAPELETS_CART")
    return f"{number} lens shapelets"


def _source_name(model: Artifact, scan: Artifact) -> str:
    first, *clumps = model.metadata["sets"]
    nested = scan.settings["scan"]["nested"]
    parts = [rf"$n_{{\rm max}} = {first['n_max']}$"]
    parts += [rf"nested $n_{{\rm max}} = {nested['n_max']}$"] if nested is not None else []
    parts += [f"{len(clumps)} clumps"] if clumps else []
    return " + ".join(parts)
