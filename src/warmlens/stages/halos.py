"""Stage `halos`: draw the halo realization of every sample of a chunk."""

from __future__ import annotations

from pathlib import Path

from warmlens.artifacts.file import Provenance, write_artifact
from warmlens.halos.lens_halo import (
    HaloRealization,
)
from warmlens.physics import halo_generator
from warmlens.products.halos import _check_finite, _datasets
from warmlens.products.samples import SampleTable
from warmlens.products.time_limit import SAMPLE_SECONDS
from warmlens.sampling import Parameters, Span, draw_parameters, grid_parameters, stream
from warmlens.stages.settings import GridNodes, HalosSettings


def parameters_of(settings: HalosSettings, span: Span) -> Parameters:
    """Parameters of the samples of a span: nodes of the grid, or draws from the prior."""
    chosen = settings.dark_matter
    if isinstance(chosen, GridNodes):
        return grid_parameters(span, chosen.m_th_kev, chosen.log10_m_halo_msun)
    return draw_parameters(settings.seed, span, chosen.m_th_kev, chosen.log10_m_halo_msun)


def run(settings: HalosSettings, span: Span, output: Path, sample_seconds: float = SAMPLE_SECONDS) -> None:
    """Draw and write the realizations of samples start..stop-1."""
    provenance = Provenance("halos", settings.as_dict(), seed_key=f"{settings.seed}/halos/SAMPLE", span=span)
    table = SampleTable(parameters_of(settings, span))
    generator = halo_generator(settings.cosmology, settings.redshifts, settings.halos)
    realizations: list[HaloRealization | None] = [None] * len(table)

    def draw(row: int) -> None:
        p = table.parameters
        rng = stream(settings.seed, "halos", int(p.sample_id[row]))
        halo = generator.draw(
            float(p.m_th_kev[row]),
            10.0 ** float(p.log10_m_halo_msun[row]),
            settings.halos.field_half_width_arcsec,
            rng,
        )
        _check_finite(halo)
        realizations[row] = halo

    table.for_each(draw, "halos", sample_seconds)
    write_artifact(output, provenance, {**table.datasets(), **_datasets(realizations)}, {})
