from __future__ import annotations

import dataclasses
import math

import pytest

from warmlens.config.model import HalosBlock
from warmlens.halos.merger_tree import BRANCHING
from warmlens.halos.model import HaloModel


def test_defaults_are_those_of_the_paper():
    model = HaloModel()
    assert (model.tau_dyn, model.positions, model.transfer_function) == ("paper", "nfw_host", "viel05")
    assert model.branching == BRANCHING["pch08"] == (0.57, 0.38, -0.01, 0.0)
    assert (model.concentration, model.concentration_scatter_dex) == ("paper", 0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tau_dyn": "other"}, 'tau_dyn must be one of "paper", "jvdb16", got'),
        ({"positions": "orbit"}, 'positions must be one of "nfw_host", "nfw_infall", "orbit_infall", got'),
        ({"transfer_function": "x"}, 'transfer_function must be one of "viel05", "bode01", "vogel23", got'),
        ({"concentration": "duffy"}, 'concentration must be one of "paper", "duffy08", got'),
        ({"branching": (0.57, 0.38, -0.01)}, "branching must be four finite numbers, got"),
        ({"branching": (0.57, math.nan, 0.0, 0.0)}, "branching must be four finite numbers, got"),
        ({"min_mass_msun": 0.0}, r"min_mass_msun must be finite and >= 1000, got 0\.0"),
        ({"min_mass_msun": 999.0}, r"min_mass_msun must be finite and >= 1000, got 999\.0"),
        ({"min_mass_msun": math.nan}, "min_mass_msun must be finite and >= 1000, got nan"),
        ({"stripping_amplitude": -1.0}, "stripping_amplitude must be finite and >= 0"),
        ({"concentration_scatter_dex": -0.1}, "concentration_scatter_dex must be finite and >= 0"),
        ({"friction_mass_slope": math.inf}, "friction_mass_slope must be finite, got inf"),
        ({"sharp_k_a": math.nan}, "sharp_k_a must be finite and > 0"),
        ({"z_max": math.inf}, "z_max must be finite and > 0"),
    ],
)
def test_impossible_models_are_errors(change, message):
    with pytest.raises(ValueError, match=message):
        HaloModel(**change)


def test_a_named_relation_leaves_no_room_for_coefficients():
    HaloModel(concentration="duffy08", concentration_min=2.0)
    with pytest.raises(ValueError, match='concentration_amplitude is set by concentration = "duffy08"'):
        HaloModel(concentration="duffy08", concentration_amplitude=6.0)


def refuses(build):
    try:
        build()
    except ValueError:
        return True
    return False


NUMBERS = [field.name for field in dataclasses.fields(HaloModel) if isinstance(field.default, float)]


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", [-1.0, 0.0, 1e-300, math.inf, -math.inf, math.nan])
def test_a_model_refuses_what_the_configuration_refuses(name, value, paper_config):
    halos = paper_config.halos.model_dump()
    in_configuration = refuses(lambda: HalosBlock(**(halos | {name: value})))
    in_model = refuses(lambda: HaloModel(**{name: value}))
    assert in_model == (
        in_configuration or name == "min_mass_msun"
    )  # 1e-300 Msun is below the floor of the tables
