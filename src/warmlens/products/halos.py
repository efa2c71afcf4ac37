"""Halo realizations as datasets of their artifacts, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from warmlens.artifacts.file import Artifact, Dataset
from warmlens.halos.lens_halo import MASS_BINS, VMAX_BINS, HaloRealization, Subhalos

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
    "n_accreted": "subhalos accreted above the resolution",
    "n_friction": "of these, sunk by dynamical friction",
    "n_stripped_below": "of these, stripped below the lowest bound mass",
    "n_surviving": "of these, left in the whole halo",
    "tree_steps": "steps of the trunk",
}
_NUMBERS = {
    "f_sub": "mass fraction of all surviving subhalos",
    "z_half": "redshift of half the final mass",
}
_FUNCTIONS = {
    "cumulative_mass_function": (MASS_BINS, "dex(Msun)"),
    "cumulative_vmax_function": (VMAX_BINS, "km / s"),
}


def check_finite(halo: HaloRealization) -> None:
    """Raise `FloatingPointError` that names the first number of a halo that is not finite."""
    numbers = {
        **{name: getattr(halo.subhalos, name) for name in COLUMNS},
        **{name: getattr(halo, name) for name in (*_COUNTS, *_NUMBERS, *_FUNCTIONS)},
    }
    for name, values in numbers.items():
        if not np.isfinite(values).all():
            raise FloatingPointError(f"{name} of the halo is not finite")


def halo_datasets(realizations: Sequence[HaloRealization | None]) -> dict[str, Dataset]:
    """Return the subhalos in CSR layout and the whole-halo statistics; nothing (0 or NaN) for failed samples."""
    in_field = [r.subhalos if r else _NO_SUBHALOS for r in realizations]
    sizes = [len(item.m_bound) for item in in_field]
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    datasets = {
        "subhalos/offsets": Dataset(
            offsets, "", ("sample edge",), "subhalos of row i are offsets[i]:offsets[i + 1]"
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
        datasets[f"halo/{name}"] = Dataset(rows, "", ("sample", "bin"), "surviving subhalos above each bin value")
        datasets[f"halo/{name}_bins"] = Dataset(np.asarray(bins), unit, ("bin",), "the bin values")
    return datasets


_EMPTY = np.empty(0)


_NO_SUBHALOS = Subhalos(**{field.name: _EMPTY for field in dataclasses.fields(Subhalos)})


def read_subhalos(halos: Artifact, row: int) -> Subhalos:
    """Read the subhalos in the field of one sample."""
    start, stop = halos.array("subhalos/offsets", slice(row, row + 2))
    return Subhalos(**{name: halos.array(f"subhalos/{name}", slice(start, stop)) for name in COLUMNS})
