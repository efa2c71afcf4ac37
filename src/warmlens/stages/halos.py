"""Stage `halos`: draw the halo realization of every sample of a chunk."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warmlens.artifacts import Dataset, Provenance, write_artifact
from warmlens.campaign import Parameters, Span, draw_parameters, grid_parameters, stream
from warmlens.config import CosmologyBlock, HalosBlock, RedshiftBlock
from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.halos.merger_tree import BRANCHING
from warmlens.halos.population import (
    MASS_BINS,
    VMAX_BINS,
    HaloGenerator,
    HaloModel,
    HaloRealization,
    Subhalos,
)
from warmlens.stages.samples import SampleTable
from warmlens.stages.settings import GridNodes, HalosSettings
from warmlens.stages.time_limit import SAMPLE_SECONDS

# unit and description of each subhalo column
COLUMNS = {
    "m_bound": ("Msun", "bound mass at the lens redshift"),
    "m_acc": ("Msun", "mass at accretion"),
    "z_acc": ("", "redshift of accretion"),
    "concentration": ("", "concentration at accretion"),
    "r_max_kpc": ("kpc", "radius of the maximum circular velocity"),
    "v_max_kms": ("km / s", "maximum circular velocity"),
    "r_s_kpc": ("kpc", "scale radius"),
    "rho_s": ("Msun / kpc3", "scale density"),
    "r_t_kpc": ("kpc", "truncation radius"),
    "x_arcsec": ("arcsec", "position, to the West"),
    "y_arcsec": ("arcsec", "position, to the North"),
}
_COUNTS = {
    "n_accreted": "subhaloes accreted above the resolution",
    "n_friction": "of these, sunk by dynamical friction",
    "n_stripped_below": "of these, stripped below the lowest bound mass",
    "n_surviving": "of these, left in the whole halo",
    "tree_steps": "steps of the trunk",
}
_NUMBERS = {
    "f_sub": "mass fraction of all surviving subhaloes",
    "z_half": "redshift of half the final mass",
}
_FUNCTIONS = {
    "cumulative_mass_function": (MASS_BINS, "dex(Msun)"),
    "cumulative_vmax_function": (VMAX_BINS, "km / s"),
}
_PRESETS = {"paper": ("paper", "nfw_host"), "calibrated": ("jvdb16", "nfw_infall")}


def geometry(cosmology: CosmologyBlock, redshifts: RedshiftBlock) -> tuple[Cosmology, LensGeometry]:
    """Cosmology and lens geometry of the configuration."""
    background = Cosmology(**cosmology.model_dump())
    return background, LensGeometry.from_redshifts(background, redshifts.lens, redshifts.source)


def halo_generator(cosmology: CosmologyBlock, redshifts: RedshiftBlock, halos: HalosBlock) -> HaloGenerator:
    """Generator of halo realizations with the physics of the configuration."""
    return HaloGenerator(*geometry(cosmology, redshifts), halo_model(halos))


def halo_model(halos: HalosBlock) -> HaloModel:
    """Physics of the configuration, the preset resolved."""
    tau_dyn, positions = _PRESETS.get(halos.preset, (halos.tau_dyn, halos.positions))
    physics = halos.model_dump(exclude={"preset", "field_half_width_arcsec", "tau_dyn", "positions", "branching"})
    branching = BRANCHING[halos.branching] if isinstance(halos.branching, str) else halos.branching
    return HaloModel(tau_dyn=tau_dyn, positions=positions, branching=branching, **physics)  # type: ignore[arg-type]


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


def _check_finite(halo: HaloRealization) -> None:
    numbers = {
        **{name: getattr(halo.subhalos, name) for name in COLUMNS},
        **{name: getattr(halo, name) for name in (*_COUNTS, *_NUMBERS, *_FUNCTIONS)},
    }
    for name, values in numbers.items():
        if not np.isfinite(values).all():
            raise FloatingPointError(f"{name} of the halo is not finite")


def _datasets(realizations: Sequence[HaloRealization | None]) -> dict[str, Dataset]:
    """Subhaloes in CSR layout and the whole-halo statistics; nothing (0 or NaN) for failed samples."""
    in_field = [r.subhalos if r else _NO_SUBHALOS for r in realizations]
    sizes = [len(item.m_bound) for item in in_field]
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    datasets = {
        "subhalos/offsets": Dataset(
            offsets, "", ("sample edge",), "subhaloes of row i are offsets[i]:offsets[i + 1]"
        )
    }
    for name, (unit, description) in COLUMNS.items():
        column = np.concatenate([getattr(item, name) for item in in_field])
        datasets[f"subhalos/{name}"] = Dataset(column, unit, ("subhalo",), description)
    for name, description in _COUNTS.items():
        counts = np.array([getattr(r, name) if r else 0 for r in realizations], dtype=np.int64)
        datasets[f"halo/{name}"] = Dataset(counts, "", ("sample",), description)
    for name, description in _NUMBERS.items():
        values = np.array([getattr(r, name) if r else np.nan for r in realizations])
        datasets[f"halo/{name}"] = Dataset(values, "", ("sample",), description)
    for name, (bins, unit) in _FUNCTIONS.items():
        rows = np.array([getattr(r, name) if r else np.full(len(bins), np.nan) for r in realizations])
        datasets[f"halo/{name}"] = Dataset(rows, "", ("sample", "bin"), "surviving subhaloes above each bin value")
        datasets[f"halo/{name}_bins"] = Dataset(np.asarray(bins), unit, ("bin",), "the bin values")
    return datasets


_EMPTY = np.empty(0)
_NO_SUBHALOS = Subhalos(**{field.name: _EMPTY for field in dataclasses.fields(Subhalos)})
