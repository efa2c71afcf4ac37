"""Lens and light models that lenstronomy would refuse minutes later, or answer with nonsense."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from warmlens.imaging.grid import PixelGrid
from warmlens.lensing import model_check
from warmlens.lensing.model_check import Components, model_problems

X, Y = PixelGrid.centred((40, 40), 0.2).coordinates()  # to 3.9 arcsec, corners 5.5
EPL = {"theta_E": 1.2, "gamma": 2.0, "e1": 0.1, "e2": 0.0, "center_x": 0.0, "center_y": 0.0}
SERSIC = {"R_sersic": 0.6, "n_sersic": 2.0, "center_x": 0.0, "center_y": 0.0}


def problems(name: str, kwargs: dict[str, Any], kind: Any = "lens", unusual: tuple[str, ...] = ()) -> list[str]:
    key = "smooth_model.lens" if kind == "lens" else "smooth_model.lens_light"
    return model_problems(Components(kind, key, [name], [kwargs]), X, Y, unusual)


def without(kwargs: dict[str, Any], *names: str, **more: Any) -> dict[str, Any]:
    return {key: value for key, value in (kwargs | more).items() if key not in names}


KWARGS = "smooth_model.lens.kwargs_lens[0]"
WRONG: list[tuple[str, dict[str, Any], list[str]]] = [
    ("EPLL", EPL, ["lens_model_list[0]: 'EPLL' is no lens model of lenstronomy; did you mean EPL?"]),
    ("sie", EPL, ["'sie' is no lens model of lenstronomy; did you mean SIE?"]),
    ("MyLens", EPL, ["'MyLens' is no lens model of lenstronomy; its documentation lists them"]),
    ("EPL", without(EPL, "center_y"), [f"{KWARGS}.center_y: missing; EPL has theta_E, gamma, e1, e2, center_x"]),
    ("EPL", without(EPL, "theta_E", "e2"), [f"{KWARGS}.theta_E: missing", f"{KWARGS}.e2: missing"]),
    ("SHEAR", {"gamma1": 0.1, "gamma2": 0.0, "ra_0": 0.0}, [f"{KWARGS}.dec_0: missing"]),
    ("EPL", without(EPL, "e1", "e2", q=0.7, phi=0.3), [
        "q: EPL has no such parameter; give e1, e2 = (1 - q)/(1 + q) [cos 2 phi, sin 2 phi], here 0.1456, 0.09964",
        "phi: EPL has no such parameter; give e1, e2", "e1: missing", "e2: missing",
    ]),
    ("EPL", without(EPL, "theta_E", theta_e=1.2), [
        "theta_e: EPL has no such parameter; did you mean theta_E?", "theta_E: missing",
    ]),
    ("SIE", EPL, [f"{KWARGS}.gamma: SIE has no such parameter; it has theta_E, e1, e2, center_x, center_y"]),
    ("EPL", EPL | {"e1": 0.8, "e2": -0.8}, [f"{KWARGS}: |e| = 1.131 of e1 and e2, expected below 1"]),
    ("EPL", EPL | {"gamma": 3.2}, [f"{KWARGS}.gamma = 3.2, expected above 1 and below 3"]),
    ("SIS", {"theta_E": -0.2, "center_x": 0.0, "center_y": 0.0}, [f"{KWARGS}.theta_E = -0.2, expected 0 or more"]),
    ("EPL", EPL | {"theta_E": [1.0, 2.0]}, ["lenstronomy refuses these parameters of EPL (TypeError: "]),
    ("SYNTHESIS", {}, ["SYNTHESIS cannot be made from numbers alone"]),
]  # fmt: skip


@pytest.mark.parametrize(("name", "kwargs", "expected"), WRONG)
def test_wrong_lenses(name: str, kwargs: dict[str, Any], expected: list[str]) -> None:
    found = problems(name, kwargs, unusual=("smooth_model.lens.kwargs_lens",))  # no answer helps
    assert len(found) == len(expected)
    for line, words in zip(found, expected, strict=True):
        assert words in line
        assert "\n" not in line
        assert line.startswith("smooth_model.lens.")


def test_a_model_without_its_library_names_it() -> None:
    pytest.importorskip("lenstronomy")
    try:
        import fastell4py  # noqa: F401
    except ImportError:
        (line,) = problems("PEMD", EPL)
        assert line == (
            "smooth_model.lens.lens_model_list[0]: PEMD needs another library (module fastell4py not installed); "
            "install it, or use EPL, the same profile"
        )


@pytest.mark.parametrize(
    ("name", "kwargs", "expected"),
    [
        ("EPL", EPL | {"theta_E": 100.0}, ".theta_E = 100 arcsec, but the image ends 5.52 arcsec from there"),
        ("EPL", EPL | {"theta_E": 1200.0}, ".theta_E = 1200, expected 0 to 100 arcsec; did you mean 1.2 (mas)"),
        ("EPL", EPL | {"center_x": 74.0}, ": the first lens is centred on [74, 0] arcsec, outside the image"),
        ("SHEAR", {"gamma1": 8.4, "gamma2": -0.5}, ".gamma1 = 8.4, expected -0.6 to 0.6; did you mean 0.084"),
    ],
)
def test_unusual_numbers_of_a_lens_are_asked_about(name: str, kwargs: dict[str, Any], expected: str) -> None:
    (line,) = problems(name, kwargs)
    assert line.startswith(KWARGS + expected)
    assert line.endswith("; to keep it, add smooth_model.lens.kwargs_lens to the list `unusual`")
    assert problems(name, kwargs, unusual=("smooth_model.lens.kwargs_lens",)) == []


@pytest.mark.parametrize(
    ("name", "kwargs", "expected"),
    [
        ("SERSICC", SERSIC, "'SERSICC' is no light model of lenstronomy; did you mean SERSIC?"),
        ("SERSIC", SERSIC | {"e1": 0.1}, "e1: SERSIC has no such parameter; it has R_sersic, n_sersic, center_x"),
        ("SERSIC", without(SERSIC, "n_sersic"), "n_sersic: missing"),
        ("SERSIC", SERSIC | {"R_sersic": 0.0}, "R_sersic = 0, expected above 0"),
        (
            "SERSIC",
            SERSIC | {"R_sersic": 600.0},
            "R_sersic = 600, expected 0.001 to 100 arcsec; did you mean 0.6 (mas)",
        ),
        ("SERSIC_ELLIPSE", SERSIC | {"e1": 1.0, "e2": 0.0}, "|e| = 1 of e1 and e2, expected below 1"),
        (
            "INTERPOL",
            {"image": 1.0, "phi_G": 0.0, "scale": 1.0},
            "lenstronomy refuses these parameters of INTERPOL",
        ),
    ],
)
def test_wrong_lights(name: str, kwargs: dict[str, Any], expected: str) -> None:
    (line,) = problems(name, kwargs, "light")
    assert expected in line
    assert line.startswith("smooth_model.lens_light.")


SOUND: list[tuple[Any, str, dict[str, Any]]] = [
    ("lens", "EPL", without(EPL, "center_x", "center_y")),  # lenstronomy's own default is 0
    ("lens", "EPL_Q_PHI", without(EPL, "e1", "e2", q=0.7, phi=0.3)),
    ("lens", "SIE", without(EPL, "gamma")),
    ("lens", "SHEAR", {"gamma1": 0.3, "gamma2": -0.2}),
    ("lens", "SHEAR_GAMMA_PSI", {"gamma_ext": 0.1, "psi_ext": 0.4}),
    ("lens", "CONVERGENCE", {"kappa": -0.1}),
    ("lens", "NFW", {"Rs": 8.0, "alpha_Rs": 1.0, "center_x": 0.1, "center_y": 0.1}),  # on a pixel's centre
    ("lens", "PJAFFE", {"sigma0": 1.0, "Ra": 0.1, "Rs": 1.0, "center_x": 0.0, "center_y": 0.0}),
    ("lens", "SHAPELETS_CART", {"beta": 1.6, "coeffs": [0.01, 0.0, 0.0], "center_x": 0.0, "center_y": 0.0}),
    ("lens", "MULTIPOLE", {"m": 4, "a_m": 0.02, "phi_m": 0.1, "center_x": 0.0, "center_y": 0.0, "r_E": 1.0}),
    ("light", "SERSIC", SERSIC | {"amp": 3.0}),
    ("light", "SERSIC_ELLIPSE", SERSIC | {"e1": 0.3, "e2": 0.4}),
    ("light", "GAUSSIAN", {"sigma": 0.4}),
    ("light", "UNIFORM", {}),
    ("light", "CHAMELEON", {"w_c": 0.1, "w_t": 0.5, "e1": 0.0, "e2": 0.0, "center_x": 0.0, "center_y": 0.0}),
]


@pytest.mark.parametrize(("kind", "name", "kwargs"), SOUND)
def test_sound_models_pass(kind: Any, name: str, kwargs: dict[str, Any]) -> None:
    assert problems(name, kwargs, kind) == []


def test_a_group_halo_outside_the_image_may_be_larger_than_it() -> None:
    group = {"theta_E": 9.0, "center_x": 25.0, "center_y": -6.0}
    lens = Components("lens", "smooth_model.lens", ["EPL", "SIS"], [EPL, group])
    assert model_problems(lens, X, Y, ()) == []


def test_a_deflection_that_is_not_finite_is_found_in_any_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where only a part of the pixels is evaluated: those about the centre are never left out."""
    from lenstronomy.LensModel.Profiles.sis import SIS

    def singular(self: Any, x: Any, y: Any, theta_E: float, center_x: float = 0.0, center_y: float = 0.0) -> Any:
        r = np.hypot(x - center_x, y - center_y)
        return theta_E * (x - center_x) / r, theta_E * (y - center_y) / r

    monkeypatch.setattr(SIS, "derivatives", singular)
    monkeypatch.setattr(model_check, "MAX_PIXELS", 100)
    centre = {"center_x": float(X[7, 5]), "center_y": float(Y[7, 5])}
    (line,) = problems("SIS", {"theta_E": 1.0, **centre})
    assert line.startswith(
        f"{KWARGS}: the deflection of SIS is not finite at 1 pixels, such as that at [-2.9, -2.5]"
    )
    assert problems("SIS", {"theta_E": 1.0, "center_x": 0.02, "center_y": 0.0}) == []
