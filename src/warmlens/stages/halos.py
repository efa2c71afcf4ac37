"""Stage `halos`: draw the halo realization of every sample of a chunk."""

from __future__ import annotations

from warmlens.halos.lens_halo import HaloRealization
from warmlens.physics import halo_generator
from warmlens.products.halos import check_finite, halo_datasets
from warmlens.products.samples import SampleTable
from warmlens.sampling import Parameters, Span, draw_parameters, grid_parameters, stream
from warmlens.stage_table import GridNodes, HalosSettings
from warmlens.stages.job import Job


def run(job: Job[HalosSettings]) -> None:
    """Draw and write the realizations of samples start..stop-1."""
    settings, span = job.settings, job.span
    assert span is not None  # make_job checks it
    table = SampleTable(parameters_of(settings, span))
    generator = halo_generator(settings.cosmology, settings.redshifts, settings.halos)
    realizations: list[HaloRealization | None] = [None] * len(table)

    def draw(row: int) -> None:
        sample = table.parameters
        rng = stream(settings.seed, "halos", int(sample.sample_id[row]))
        m_halo_msun = 10.0 ** float(sample.log10_m_halo_msun[row])
        field = settings.halos.field_half_width_arcsec
        halo = generator.draw(float(sample.m_th_kev[row]), m_halo_msun, field, rng)
        check_finite(halo)
        realizations[row] = halo

    table.for_each(draw, "halos", job.sample_seconds)
    datasets = {**table.datasets(), **halo_datasets(realizations)}
    job.write(datasets, {}, seed_key=f"{settings.seed}/halos/SAMPLE")


def parameters_of(settings: HalosSettings, span: Span) -> Parameters:
    """Return the parameters of the samples of a span: nodes of the grid, or draws from the prior."""
    chosen = settings.dark_matter
    if isinstance(chosen, GridNodes):
        return grid_parameters(span, chosen.m_th_kev, chosen.log10_m_halo_msun)
    return draw_parameters(settings.seed, span, chosen.m_th_kev, chosen.log10_m_halo_msun)
