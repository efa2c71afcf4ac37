"""Stage `deflections`: the filtered deflection of every halo realization of a chunk, on the image's pixels."""

from __future__ import annotations

import logging
from itertools import pairwise

import numpy as np

from warmlens.artifacts.file import Dataset
from warmlens.config.model import HalosBlock
from warmlens.lensing.high_pass import effective_sigma_pixels
from warmlens.lensing.substructure import filtered_deflection
from warmlens.physics import check_field, geometry, halo_generator, smooth_host
from warmlens.products.halos import read_subhalos
from warmlens.products.observation import read_observation
from warmlens.products.samples import SampleTable
from warmlens.stage_table import DeflectionsSettings
from warmlens.stages.job import Job

log = logging.getLogger(__name__)


def run(job: Job[DeflectionsSettings]) -> None:
    """Write Delta alpha of each sample, its rms and maximum, and number and mass of the subhalos that made it."""
    settings, block = job.settings, job.settings.deflections
    grid = read_observation(job.path("observation")).grid
    sigma_arcsec = grid.pixel_scale * effective_sigma_pixels(block.filter_arcsec, grid.pixel_scale, block.filter)
    if block.filter != "gaussian":
        log.info("%s filter: as wide as a Gaussian of %.3f arcsec", block.filter, sigma_arcsec)
    _, lens = geometry(settings.cosmology, settings.redshifts)
    with job.open("halos") as halos:
        physics = HalosBlock.model_validate(halos.settings["halos"])
        check_field(physics.field_half_width_arcsec, grid, block.filter_arcsec)
        generator = halo_generator(settings.cosmology, settings.redshifts, physics) if block.smooth_host else None
        f_sub, mass = halos.array("halo/f_sub"), halos.array("subhalos/m_bound")
        offsets = halos.array("subhalos/offsets")
        table, span = SampleTable.read(halos), halos.span
        delta_alpha = np.full((len(table), 2, *grid.shape), np.nan, dtype=np.float32)
        statistics = np.full((len(table), 2), np.nan)

        def deflect(row: int) -> None:
            subhalos = read_subhalos(halos, row)
            log10_m_halo = float(table.parameters.log10_m_halo_msun[row])
            host = smooth_host(generator, log10_m_halo, float(f_sub[row])) if generator else None
            delta = filtered_deflection(subhalos, grid, lens, block.filter_arcsec, block.filter, host)
            if not np.isfinite(delta).all():
                raise FloatingPointError(f"the deflection of {len(subhalos.m_bound)} subhalos is not finite")
            size = np.hypot(*delta)
            delta_alpha[row] = delta
            statistics[row] = np.sqrt(np.mean(size**2)), size.max()

        table.for_each(deflect, "deflections", job.sample_seconds)
    sample = ("sample",)
    totals = np.array([mass[start:stop].sum() for start, stop in pairwise(offsets)])
    datasets = {
        **table.datasets(),
        "delta_alpha": Dataset(
            delta_alpha, "arcsec", ("sample", "component", "y", "x"), "high-pass filtered deflection (x, y)"
        ),
        "rms": Dataset(statistics[:, 0], "arcsec", sample, "root mean square of |Delta alpha| over the image"),
        "max": Dataset(statistics[:, 1], "arcsec", sample, "largest |Delta alpha| in the image"),
        "n_subhalos": Dataset(np.diff(offsets), "", sample, "subhalos in the field"),
        "m_subhalos": Dataset(totals, "Msun", sample, "their bound mass"),
    }
    job.write(datasets, {"filter_sigma_arcsec": sigma_arcsec}, span)
