"""Figure scan_plane and Figs. 6 and 7: positions of scans in the plane of Delta R and R_sens."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import cycle

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Artifact, open_artifact
from warmlens.figures.inputs import Inputs, chunk_paths, input_path, open_input
from warmlens.figures.recipe import panel_table
from warmlens.figures.samples import relic_name
from warmlens.products.scan_maps import by_band

Scans = dict[str, pd.DataFrame]  # delta_r and r_sens of positions, one row each, by name of the scan

_MARK_SIZE = 14.0  # of a point in the legend [points^2]
_LONG_NAME = 24  # characters of a legend entry beyond which only two fit in a line
_BINS = 60
_LINEAR = 1.0  # of the asinh scale of Delta R: below, noise alone decides

tabulate = partial(panel_table, column="scan")


def read_bands(inputs: Inputs) -> Scans:
    """Return the observation's scan, per band and of all together."""
    with open_input(inputs, "observed_scan") as artifact:
        valid = artifact.array("raster/valid")
        delta_r, r_sens = by_band(artifact, "delta_r"), by_band(artifact, "r_sens")
    return {
        band: pd.DataFrame({"delta_r": delta_r[band][valid], "r_sens": r_sens[band][valid]}) for band in delta_r
    }


def read_lenses(inputs: Inputs) -> Scans:
    """Return the scans of Fig. 6: observations with different numbers of shapelets of the lens potential."""
    return _compare(inputs, _lens_name)


def read_sources(inputs: Inputs) -> Scans:
    """Return the scans of Fig. 7: observations with different descriptions of the source."""
    return _compare(inputs, _source_name)


def _compare(inputs: Inputs, name_of: Callable[[Artifact, Artifact], str]) -> Scans:
    """Return the scan of every campaign's observation; of a single campaign also the mocks with R_sens."""
    numbers = sorted({int(key.partition("/")[0]) for key in inputs})
    names, positions = [], []
    for number in numbers:
        with (
            open_artifact(input_path(inputs, f"{number}/smooth_model"), "smooth_model") as model,
            open_artifact(input_path(inputs, f"{number}/observed_scan"), "observed_scan") as scan,
        ):
            names.append(name_of(model, scan))
            positions.append(_all_bands(scan))
    if len(set(names)) < len(names):  # alike in what the figure compares
        folders = [inputs[f"{number}/observed_scan"].parent.name for number in numbers]
        names = [f"{name} ({folder})" for name, folder in zip(names, folders, strict=True)]
    mocks = {key.removeprefix("0/"): path for key, path in inputs.items() if key.startswith("0/scans/")}
    if mocks:
        return {f"observation, {names[0]}": positions[0], **_read_mocks(mocks)}
    return dict(zip(names, positions, strict=True))


def _read_mocks(inputs: Inputs) -> Scans:
    """Return the scans of the mocks that `scan.residual_samples` names."""
    scans: Scans = {}
    for path in chunk_paths(inputs, "scans"):
        with open_artifact(path, "scans") as artifact:
            if "residuals/sample_id" not in artifact.file:
                continue
            sample_id = artifact.array("samples/sample_id")
            m_th, log10_m_halo = (artifact.array(f"samples/{name}") for name in ("m_th_kev", "log10_m_halo_msun"))
            for place, sample in enumerate(artifact.array("residuals/sample_id")):
                row = int(np.flatnonzero(sample_id == sample)[0])
                name = rf"mock {sample}: {relic_name(m_th[row])}, $10^{{{log10_m_halo[row]:.2f}}}$ M$_\odot$"
                scans[name] = _all_bands(artifact, row, place)
    if not scans:
        raise ArtifactError(
            "the scans hold R_sens of no mock: the samples of scan.residual_samples have all failed; name others"
        )
    return scans


def _all_bands(scan: Artifact, row: int | None = None, place: int | None = None) -> pd.DataFrame:
    """Return the valid positions of all bands; a sample has its Delta R in `row`, and its R_sens in `place`."""
    valid = scan.array("raster/valid")
    maps = {"delta_r": by_band(scan, "delta_r", row), "r_sens": by_band(scan, "r_sens", place)}
    return pd.DataFrame({name: list(bands.values())[-1][valid] for name, bands in maps.items()})


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


def draw(scans: Scans) -> Figure:
    """Draw the plane, the distribution of Delta R above it, and that of R_sens to the right."""
    figure, axes = plt.subplots(
        2, 2, figsize=(5.4, 5.0), width_ratios=(3.2, 1.0), height_ratios=(1.0, 3.2), sharex="col", sharey="row"
    )
    axes[0, 1].remove()
    draw_scan_plane(axes[1, 0], axes[0, 0], axes[1, 1], scans)
    handles, names = axes[1, 0].get_legend_handles_labels()
    n_columns = 3 if max(map(len, names)) < _LONG_NAME else 2
    legend = figure.legend(handles, names, loc="outside lower center", ncols=n_columns)
    for handle in legend.legend_handles:
        if isinstance(handle, PathCollection):
            handle.set_sizes([_MARK_SIZE])  # the points themselves may be tiny
            handle.set_alpha(1.0)
    return figure


def draw_scan_plane(plane: Axes, top: Axes, right: Axes, scans: Scans) -> None:
    """Draw positions in the plane of Delta R and R_sens, and both marginal distributions, one colour per scan.

    The legend is left to the figure: there is no place in the plane that no position can take.

    Reference: Birrer+2017, Figs 6 and 7.
    """
    every = pd.concat(scans.values())
    lit = every["r_sens"][every["r_sens"] > 0.0]
    low, high = max(float(lit.min()), 1e-4 * float(lit.max())), 1.3 * float(lit.max())
    reach = 1.1 * float(every["delta_r"].abs().max())
    plane.set_xscale("asinh", linear_width=_LINEAR)
    plane.set_yscale("log")
    scale = plane.xaxis.get_transform()
    span = float(scale.transform(np.array([reach]))[0])
    edges = scale.inverted().transform(np.linspace(-span, span, _BINS + 1)).tolist()
    sens_edges = np.geomspace(low, high, _BINS + 1).tolist()
    colours = cycle(mpl.rcParams["axes.prop_cycle"].by_key()["color"])
    for (name, scan), colour in zip(scans.items(), colours, strict=False):
        delta, sens = scan["delta_r"].to_numpy(), scan["r_sens"].to_numpy()
        size = float(np.clip(4000.0 / delta.size, 0.5, 6.0))
        plane.scatter(delta, sens, s=size, c=colour, alpha=0.5, lw=0, label=name, rasterized=True)
        top.hist(delta, edges, histtype="step", color=colour, lw=1.2)
        right.hist(sens, sens_edges, histtype="step", color=colour, lw=1.2, orientation="horizontal")
    line = np.geomspace(low, high, 100)
    plane.plot(line, line, color="black", lw=0.8, ls=":", label=r"$\Delta R = R_{\rm sens}$")
    plane.plot(-line, line, color="black", lw=0.8, ls="--", label=r"$\Delta R = -R_{\rm sens}$")
    plane.set_xlim(-reach, reach)
    plane.set_ylim(low, high)
    plane.set_xlabel(r"$\Delta R = R_{\rm pert} - R_{\rm smooth}$")
    plane.set_ylabel(r"$R_{\rm sens}$")
    ticks = [value for value in (-100.0, -10.0, -1.0, 0.0, 1.0, 10.0, 100.0) if abs(value) <= reach]
    plane.set_xticks(ticks, [f"{value:g}".replace("-", "\u2212") for value in ticks])
    for ax in (top, right):
        ax.tick_params(labelbottom=ax is right, labelleft=ax is top)
    top.set_yscale("log")
    right.set_xscale("log")
    top.set_ylabel("positions")
    right.set_xlabel("positions")
    top.yaxis.set_minor_formatter(NullFormatter())
    right.xaxis.set_minor_formatter(NullFormatter())
