"""Choices and coefficients of the subhalo physics."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal, get_args

from warmlens.halos.dark_matter import TransferFunction
from warmlens.halos.merger_tree import BRANCHING, Branching
from warmlens.halos.stripping import DynamicalTime

Positions = Literal["nfw_host", "nfw_infall", "orbit_infall"]
Concentration = Literal["paper", "duffy08"]

MIN_MASS_MSUN = 1.0e3  # the tables of the variance and of formation histories reach no deeper

_CHOICES: dict[str, tuple[str, ...]] = {
    "tau_dyn": get_args(DynamicalTime),
    "positions": get_args(Positions),
    "transfer_function": get_args(TransferFunction),
    "concentration": get_args(Concentration),
}
_SET_BY_DUFFY08 = (
    "concentration_amplitude",
    "concentration_mass_slope",
    "concentration_redshift_slope",
    "concentration_pivot_msun",
)
# The home of the ranges is `config.HalosBlock`, where a user meets them. This short form guards models that are
# built in Python; tests/halos/test_model.py keeps the two in step. Numbers that are not named here are > 0.
_MAY_BE_ZERO = ("stripping_amplitude", "friction_amplitude", "concentration_scatter_dex")
_ANY_SIGN = (
    "concentration_mass_slope",
    "concentration_redshift_slope",
    "friction_mass_slope",
    "friction_circularity_slope",
)


@dataclass(frozen=True)
class HaloModel:
    """Choices and coefficients of the subhalo physics; the defaults are those of Birrer et al. 2017.

    Attributes
    ----------
    tau_dyn
        Dynamical time of tidal stripping, see `warmlens.halos.stripping.loss_per_efold`.
    positions
        "nfw_host": subhalos follow the NFW profile of the host at the lens. "nfw_infall": that of the host when
        each was accreted. "orbit_infall": each is at a random time of the orbit that it had in the host at its
        accretion, with the circularity of its dynamical friction.
    transfer_function
        Free-streaming break of thermal relics, see `warmlens.halos.dark_matter.ThermalRelic`.
    branching
        (G0, gamma1, gamma2, gamma3) of the branching rate, see `warmlens.halos.merger_tree.BRANCHING`.
    barrier_factor, sharp_k_a
        Factor of the collapse threshold and k_s R of the sharp-k filter (Benson et al. 2013).
    stripping_amplitude, stripping_slope
        A_ts and zeta of tidal stripping.
    min_mass_msun
        Floor of the tree's resolution, and smallest bound mass of a subhalo [Msun].
    friction_amplitude, friction_mass_slope, friction_circularity_slope
        A_df, b_df and c_df of dynamical friction.
    concentration
        Relation of cold halos. "paper": the power law with the next four coefficients. "duffy08": that of
        Duffy et al. 2008; the next four must keep their defaults.
    concentration_amplitude, concentration_mass_slope, concentration_redshift_slope, concentration_pivot_msun
        A_c, B_c, C_c and pivot mass [Msun] of "paper".
    concentration_min
        Smallest concentration of either relation.
    concentration_scatter_dex
        Log-normal scatter of the subhalos' concentrations [dex].
    formation_mass_cap_msun
        Heaviest cold halo [Msun] to which a warm halo is mapped for its concentration.
    z_max
        Redshift at which the tree ends.
    """

    tau_dyn: DynamicalTime = "paper"
    positions: Positions = "nfw_host"
    transfer_function: TransferFunction = "viel05"
    branching: Branching = BRANCHING["pch08"]
    barrier_factor: float = 1.197
    sharp_k_a: float = 2.5
    stripping_amplitude: float = 1.54
    stripping_slope: float = 0.07
    min_mass_msun: float = 1.0e7
    friction_amplitude: float = 0.216
    friction_mass_slope: float = 1.3
    friction_circularity_slope: float = 1.9
    concentration: Concentration = "paper"
    concentration_amplitude: float = 5.22
    concentration_mass_slope: float = -0.072
    concentration_redshift_slope: float = -0.42
    concentration_pivot_msun: float = 2.0e12
    concentration_min: float = 1.5
    concentration_scatter_dex: float = 0.0
    formation_mass_cap_msun: float = 1.0e16
    z_max: float = 20.0

    def __post_init__(self) -> None:
        for name, allowed in _CHOICES.items():
            if getattr(self, name) not in allowed:
                names = ", ".join(f'"{choice}"' for choice in allowed)
                raise ValueError(f"{name} must be one of {names}, got {getattr(self, name)!r}")
        if len(self.branching) != 4 or not all(map(math.isfinite, self.branching)):
            raise ValueError(f"branching must be four finite numbers, got {self.branching!r}")
        if not self.branching[1] < 1.0:
            raise ValueError(f"gamma1 of branching must be < 1, got {self.branching[1]!r}")
        for field in dataclasses.fields(self):
            if not isinstance(field.default, float):
                continue
            name, value = field.name, getattr(self, field.name)
            if self.concentration == "duffy08" and name in _SET_BY_DUFFY08 and value != field.default:
                raise ValueError(
                    f'{name} is set by concentration = "duffy08" and must keep its default '
                    f"{field.default!r}, got {value!r}"
                )
            self._check_range(name, value)

    def _check_range(self, name: str, value: float) -> None:
        if name == "min_mass_msun":
            in_range, needed = value >= MIN_MASS_MSUN, f" and >= {MIN_MASS_MSUN:g}"
        elif name in _ANY_SIGN:
            in_range, needed = True, ""
        elif name in _MAY_BE_ZERO:
            in_range, needed = value >= 0.0, " and >= 0"
        else:
            in_range, needed = value > 0.0, " and > 0"
        if not (in_range and math.isfinite(value)):
            raise ValueError(f"{name} must be finite{needed}, got {value!r}")
