"""Stage `deflections`: the filtered deflection of every halo realization of a chunk, on the image's pixels."""

from __future__ import annotations

import logging
from itertools import pairwise
from pathlib import Path

import numpy as np

from warmlens.artifacts.file import Dataset, Provenance, open_artifact, write_artifact
from warmlens.config.model import HalosBlock
from warmlens.lensing.high_pass import effective_sigma_pixels
from warmlens.lensing.substructure import filtered_deflection
from warmlens.physics import check_field, geometry, halo_generator, smooth_host
from warmlens.products.halos import read_subhalos
from warmlens.products.observation import read_observation
from warmlens.products.samples import SampleTable
from warmlens.products.time_limit import SAMPLE_SECONDS
from warmlens.stages.settings import DeflectionsSettings

log = logging.getLogger(__name__)


def run(
    settings: DeflectionsSettings,
    halos: Path,
    observation: Path,
    output: Path,
    sample_seconds: float = SAMPLE_SECONDS,
) -> None:
    """Write Delta alpha of each sample, its rms and maximum, and the subhaloes that made it."""
    grid = read_observation(observation).grid
    block = settings.deflections
    sigma_arcsec = grid.pixel_scale * effective_sigma_pixels(block.filter_arcsec, grid.pixel_scale, block.filter)
    if block.filter != "gaussian":
        log.info("%s filter: as wide as a Gaussian of %.3f arcsec", block.filter, sigma_arcsec)
    _, lens = geometry(settings.cosmology, settings.redshifts)
    with open_artifact(halos, "halos") as artifact:
        provenance = Provenance(
            "deflections",
            settings.as_dict(),
            {"halos": halos, "observation": observation},
            span=artifact.span,
        )
        halos_block = HalosBlock.model_validate(artifact.settings["halos"])
        check_field(halos_block.field_half_width_arcsec, grid, block.filter_arcsec)
        generator = (
            halo_generator(settings.cosmology, settings.redshifts, halos_block) if block.smooth_host else None
        )
        f_sub = artifact.array("halo/f_sub")
        table = SampleTable.read(artifact)
        delta_alpha = np.full((len(table), 2, *grid.shape), np.nan, dtype=np.float32)
        statistics = np.full((len(table), 2), np.nan)
        offsets = artifact.array("subhalos/offsets")
        mass = artifact.array("subhalos/m_bound")

        def deflect(row: int) -> None:
            subhalos = read_subhalos(artifact, row)
            log10_m_halo = float(table.parameters.log10_m_halo_msun[row])
            host = smooth_host(generator, log10_m_halo, float(f_sub[row])) if generator else None
            field = filtered_deflection(subhalos, grid, lens, block.filter_arcsec, block.filter, host)
            if not np.isfinite(field).all():
                raise FloatingPointError(f"the deflection of {len(subhalos.m_bound)} subhaloes is not finite")
            size = np.hypot(*field)
            delta_alpha[row] = field
            statistics[row] = np.sqrt(np.mean(size**2)), size.max()

        table.for_each(deflect, "deflections", sample_seconds)
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
    write_artifact(output, provenance, datasets, {"filter_sigma_arcsec": sigma_arcsec})
