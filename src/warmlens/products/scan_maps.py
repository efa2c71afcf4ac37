"""Maps of a scan read back for figures, of the bands and of all together."""

from __future__ import annotations

import numpy as np

from warmlens.artifacts.file import Artifact
from warmlens.imaging.grid import PixelGrid
from warmlens.scan.response import LinearResponse
from warmlens.types import FloatArray


def by_band(artifact: Artifact, name: str, row: int | None = None) -> dict[str, FloatArray]:
    """Map `name` [ny, nx] of each band and, of several bands, their sum; `row` is that of the sample, if any."""
    bands = artifact.metadata["bands"]
    maps = {band: _read(artifact, f"{band}/{name}", row) for band in bands}
    return {**maps, " + ".join(bands): np.sum(list(maps.values()), axis=0)} if len(bands) > 1 else maps


def read_response(artifact: Artifact, row: int | None = None) -> LinearResponse | None:
    """Read score and Fisher information of all bands together; None if the statistics lack the amplitude."""
    bands = artifact.metadata["bands"]
    if f"{bands[0]}/score" not in artifact.file:
        return None
    score, fisher = (
        np.sum([_read(artifact, f"{band}/{name}", row) for band in bands], axis=0) for name in ("score", "fisher")
    )
    noise = np.sum([artifact.array(f"{band}/fisher_noise") for band in bands], axis=0)
    return LinearResponse(score, fisher, noise)


def read_sensitivity(artifact: Artifact, response: LinearResponse | None) -> tuple[FloatArray, str]:
    """Read the smallest mass that would be seen, or the error of the amplitude, and its label; NaN: not known."""
    if "sensitivity/min_mass" in artifact.file:
        delta_r = artifact.settings["scan"]["sensitivity"]["delta_r"]
        return artifact.array("sensitivity/min_mass"), rf"$M(\Delta R = {-delta_r:g})$ [M$_\odot$]"
    if response is None:
        return np.empty((0, 0)), ""
    theta_e_mas = 1e3 * artifact.settings["scan"]["perturber"]["theta_e_arcsec"]
    return theta_e_mas * response.error, r"error of $\hat\epsilon\,\theta_{\rm E}$ [mas]"


def raster_grid(artifact: Artifact) -> PixelGrid:
    """Return the positions of a scan as the pixels of a map."""
    x, y = artifact.array("raster/x"), artifact.array("raster/y")
    ny, nx = x.shape
    step = float(artifact.settings["scan"]["step_arcsec"])
    return PixelGrid(ny, nx, step, float(x[0, 0]), float(y[0, 0]))


def _read(artifact: Artifact, name: str, row: int | None) -> FloatArray:
    return artifact.array(name, ... if row is None else row)
