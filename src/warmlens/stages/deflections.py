"""Stage `deflections`: the filtered deflection of every halo realization of a chunk, on the image's pixels."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from warmlens.artifacts import Artifact, Dataset, Provenance, open_artifact, write_artifact
from warmlens.halos.population import Subhalos
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.substructure import filtered_deflection, required_half_width
from warmlens.stages.halos import COLUMNS, geometry
from warmlens.stages.products import read_observation
from warmlens.stages.samples import SampleTable
from warmlens.stages.settings import DeflectionsSettings


def run(settings: DeflectionsSettings, halos: Path, observation: Path, output: Path) -> None:
    """Write Delta alpha of each sample, its rms and maximum, and the subhaloes that made it."""
    grid = read_observation(observation).grid
    _, lens = geometry(settings.cosmology, settings.redshifts)
    with open_artifact(halos, "halos") as artifact:
        provenance = Provenance(
            "deflections",
            settings.as_dict(),
            {"halos": halos, "observation": observation},
            span=artifact.span,
        )
        check_field(
            artifact.settings["halos"]["field_half_width_arcsec"], grid, settings.deflections.filter_arcsec
        )
        table = SampleTable.read(artifact)
        delta_alpha = np.full((len(table), 2, *grid.shape), np.nan, dtype=np.float32)
        statistics = np.full((len(table), 2), np.nan)
        offsets = artifact.array("subhalos/offsets")
        mass = artifact.array("subhalos/m_bound")

        def deflect(row: int) -> None:
            subhalos = read_subhalos(artifact, row)
            field = filtered_deflection(subhalos, grid, lens, settings.deflections.filter_arcsec)
            if not np.isfinite(field).all():
                raise FloatingPointError(f"the deflection of {len(subhalos.m_bound)} subhaloes is not finite")
            size = np.hypot(*field)
            delta_alpha[row] = field
            statistics[row] = np.sqrt(np.mean(size**2)), size.max()

        table.for_each(deflect, "deflections")
    sample = ("sample",)
    totals = np.array([mass[start:stop].sum() for start, stop in pairwise(offsets)])
    datasets = {
        **table.datasets(),
        "delta_alpha": Dataset(
            delta_alpha, "arcsec", ("sample", "component", "y", "x"), "high-pass filtered deflection (x, y)"
        ),
        "rms": Dataset(statistics[:, 0], "arcsec", sample, "root mean square of |Delta alpha| over the image"),
        "max": Dataset(statistics[:, 1], "arcsec", sample, "largest |Delta alpha| in the image"),
        "n_subhalos": Dataset(np.diff(offsets), "", sample, "subhaloes in the field"),
        "m_subhalos": Dataset(totals, "Msun", sample, "their bound mass"),
    }
    write_artifact(output, provenance, datasets, {})


def read_subhalos(halos: Artifact, row: int) -> Subhalos:
    """Subhaloes in the field of one sample."""
    start, stop = halos["subhalos/offsets"][row : row + 2]
    return Subhalos(**{name: halos[f"subhalos/{name}"][start:stop] for name in COLUMNS})


def check_field(half_width_arcsec: float, grid: PixelGrid, filter_arcsec: float) -> None:
    """Refuse a field of subhaloes that does not reach three filter widths beyond the image."""
    needed = required_half_width(grid, filter_arcsec)
    if half_width_arcsec < needed:
        raise ValueError(
            f"halos.field_half_width_arcsec = {half_width_arcsec:g} is too small: the image and three widths of "
            f"the filter (deflections.filter_arcsec = {filter_arcsec:g}) reach {needed:.2f}; "
            "raise it to at least that"
        )
