"""Fig. 8: cumulative mass and v_max functions of subhalos at z = 0, from a configuration."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from warmlens.config.model import Config
from warmlens.figures.draw.halo_functions import draw_cumulative_functions
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.halos.dark_matter import ThermalRelic, dark_matter
from warmlens.halos.population import MASS_BINS, VMAX_BINS, HaloPopulation
from warmlens.halos.suppression import lovell14, lovell20
from warmlens.physics import geometry, halo_model
from warmlens.sampling import stream
from warmlens.types import FloatArray

log = logging.getLogger(__name__)

MODELS_KEV = (1.0, 2.0, 3.3, 5.0, 10.0, math.inf)
HOST_LOG10, REDSHIFT, N_REALIZATIONS = 12.5, 0.0, 5  # Birrer+2017, appendix B
_FITS = {"Lovell+14": lovell14, "Lovell 20": lovell20}


def read(config: Config) -> dict[str, pd.DataFrame]:
    """Return the functions "mass" and "v_max": N above each value, one row per model and value.

    Columns are the mean of the realizations, each of them, and published suppressions times the mean of CDM.
    """
    cosmology, _ = geometry(config.cosmology, config.redshifts)
    population = HaloPopulation(cosmology, REDSHIFT, halo_model(config.halos))
    mass_counts: dict[str, FloatArray] = {}
    vmax_counts: dict[str, FloatArray] = {}
    half_mode: dict[str, float] = {}
    for number, m_th in enumerate(MODELS_KEV):
        model = dark_matter(m_th, cosmology, config.halos.transfer_function)
        name = f"{m_th:g} keV" if isinstance(model, ThermalRelic) else "CDM"
        halos = []
        for realization in range(N_REALIZATIONS):
            rng = stream(config.campaign.seed, "figure_8", N_REALIZATIONS * number + realization)
            halos.append(population.draw(model, 10.0**HOST_LOG10, rng))
        mass_counts[name] = np.array([halo.cumulative_mass_function for halo in halos])
        vmax_counts[name] = np.array([halo.cumulative_vmax_function for halo in halos])
        if isinstance(model, ThermalRelic):
            half_mode[name] = model.half_mode_mass_msun
        log.info("%s: %.0f subhalos", name, np.mean([halo.n_surviving for halo in halos]))
    cold = mass_counts["CDM"].mean(axis=0)
    resolved = math.log10(config.halos.min_mass_msun) <= MASS_BINS
    mass, v_max = [], []
    for name, counts in mass_counts.items():
        rows = _tabulate_counts("m_bound_msun", 10.0 ** MASS_BINS[resolved], name, counts[:, resolved])
        if name in half_mode:
            for label, fit in _FITS.items():
                rows[f"n_above_{label}"] = suppress(cold, fit, half_mode[name])[resolved]
        mass.append(rows)
        v_max.append(_tabulate_counts("v_max_kms", VMAX_BINS, name, vmax_counts[name]))
    return {"mass": pd.concat(mass), "v_max": pd.concat(v_max)}


def draw(functions: dict[str, pd.DataFrame]) -> Figure:
    """Draw the mass function and the v_max function."""
    figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 3.4))
    for ax, panel, column, symbol, unit in (
        (axes[0], "mass", "m_bound_msun", r"$m_{\rm bound}$", r"[M$_\odot$]"),
        (axes[1], "v_max", "v_max_kms", r"$v_{\rm max}$", r"[km s$^{-1}$]"),
    ):
        models = {str(name): rows for name, rows in functions[panel].groupby("model", sort=False)}
        grid = next(iter(models.values()))[column].to_numpy()
        counts = {name: rows.filter(like="realization").to_numpy().T for name, rows in models.items()}
        references = {
            fit: {name: rows[f"n_above_{fit}"].to_numpy() for name, rows in models.items() if name != "CDM"}
            for fit in _FITS
            if f"n_above_{fit}" in functions[panel]
        }
        draw_cumulative_functions(ax, grid, counts, references, f"{symbol} {unit}")
        ax.set_ylabel(f"subhalos above {symbol}")
        ax.set_ylim(bottom=0.2)
    axes[1].set_xlim(left=3.0)
    return figure


def suppress(cold: FloatArray, fit: Callable[[FloatArray, float], FloatArray], m_hm: float) -> FloatArray:
    """Return cumulative counts of cold halos [n], at `MASS_BINS`, with a published suppression of each bin."""
    per_bin = cold - np.append(cold[1:], 0.0)
    middle = 10.0 ** (MASS_BINS + 0.5 * (MASS_BINS[1] - MASS_BINS[0]))
    return np.cumsum((per_bin * fit(middle, m_hm))[::-1])[::-1]


def _tabulate_counts(column: str, values: FloatArray, model: str, counts: FloatArray) -> pd.DataFrame:
    """Return counts of subhalos above each value [n], of each realization [n_realization, n] and their mean."""
    numbered = {f"n_above_realization_{number}": row for number, row in enumerate(counts, start=1)}
    return pd.DataFrame({column: values, "model": model, "n_above_mean": counts.mean(axis=0), **numbered})
