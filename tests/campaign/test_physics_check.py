"""What `validate` and a start say of lens, light, limits and prior, on the shipped campaign."""

from __future__ import annotations

import re
from typing import Any

import pytest

from warmlens.campaign.physics_check import checked_physics
from warmlens.campaign.preflight import check_observation
from warmlens.config.file import ConfigError, parse_config
from warmlens.config.model import Config
from warmlens.imaging.grid import PixelGrid

from ..reliability import Outcome, fault

GRID = PixelGrid.centred((160, 160), 0.05)


def changed(config: Config, **values: Any) -> Config:
    """Keys with __ for dots; numbers are places in lists."""
    raw = config.model_dump()
    for key, value in values.items():
        *path, last = (int(part) if part.isdigit() else part for part in key.split("__"))
        block = raw
        for part in path:
            if isinstance(block[part], tuple):
                block[part] = list(block[part])
            block = block[part]
        block[last] = value
    return parse_config(raw)


def problems(config: Config, grid: PixelGrid | None = GRID) -> list[str]:
    with pytest.raises(ConfigError) as error:
        checked_physics(config, grid)
    return error.value.problems


def test_the_shipped_campaign_is_sound(paper_config: Config) -> None:
    assert checked_physics(paper_config, GRID) == []


@fault("Images", "a lens or light model with a typo", "EPLL and SERSIK, and theta_E = 100 arcsec", quick=True)
def test_validate_names_wrong_models_of_fit_and_simulation(paper_config: Config, outcome: Outcome) -> None:
    wrong = changed(
        paper_config,
        smooth_model__lens__lens_model_list__0="EPLL",
        observation__simulated__lens__kwargs_lens__0__theta_E=100.0,
        observation__simulated__lens_light__lens_light_model_list__2="SERSIK",
    )
    with pytest.raises(ConfigError) as error:
        check_observation(wrong)
    outcome.stops(str(error.value), "did you mean EPL?")
    starts = [
        "smooth_model.lens.lens_model_list[0]: 'EPLL' is no lens model",
        "observation.simulated.lens.kwargs_lens[0].theta_E = 100 arcsec, but the image ends 5.62 arcsec",
        "observation.simulated.lens_light.lens_light_model_list[2]: 'SERSIK' is no light model",
    ]
    assert [line.startswith(start) for line, start in zip(error.value.problems, starts, strict=True)] == [True] * 3


def test_positions_in_pixels_lie_off_the_image(paper_config: Config) -> None:
    pixels = [[39.0, 69.0], [38.0, 93.0], [50.0, 47.0], [91.0, 87.0]]
    of_simulation = problems(changed(paper_config, observation__simulated__quasar_images=pixels))
    assert len(of_simulation) == 4
    assert of_simulation[0] == (
        "observation.simulated.quasar_images[0]: [39, 69] arcsec from the origin lies outside the image, which "
        "reaches from -3.98 to 3.98 and from -3.98 to 3.98; positions are arcsec, not pixels"
    )
    (source,) = problems(changed(paper_config, observation__simulated__source__center=[80.0, 80.0]))
    assert source.endswith("to keep it, add observation.simulated.source.center to the list `unusual`")
    kept = changed(
        paper_config,
        observation__simulated__source__center=[80.0, 80.0],
        unusual=["observation.simulated.source.center"],
    )
    assert checked_physics(kept, GRID) == []


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        (
            "lens_free__0__theta_E",
            (1.7, 2.0, 0.1),
            r"lens_0\.theta_E starts at 1\.634, .* inside its limits \(1\.7",
        ),
        ("lens_free__0__q", (0.1, 1.0, None), r"lens model 0 has no number 'q' to free; it has theta_E"),
        ("lens_free__0__e1", (-1.5, 1.5, None), r"lens_free\[0\]\.e1: limits \[-1\.5, 1\.5\], expected -0\.95"),
        ("lens_light_free__2__R_sersic", (0.005, 500.0, None), r"lens_light_free\[2\]\.R_sersic: limits"),
        ("source_beta", (0.3, 0.5, None), r"source_0\.beta starts at 0\.18, .*\(0\.3, 0\.5\)"),
        ("satellites", [(1, 2)], r"satellites: \[1, 2\]: lens model 1 has no center_x and center_y"),
    ],
)
def test_starts_and_limits_of_a_fit(paper_config: Config, key: str, value: Any, reason: str) -> None:
    (line,) = problems(changed(paper_config, **{f"smooth_model__fit__{key}": value}))
    assert line.startswith("smooth_model")
    assert re.search(reason, line), line


def test_a_lens_that_is_given_needs_no_limits(paper_config: Config) -> None:
    free = changed(paper_config, smooth_model__fit__lens_free__0__theta_E=(1.7, 2.0, 0.1))
    given = changed(free, smooth_model__mode="given", scan__marginalise_lens=False)
    assert checked_physics(given, GRID) == []


def test_the_corner_of_the_prior_without_subhalos_is_reported(paper_config: Config) -> None:
    wide = changed(paper_config, dark_matter={"m_th_kev": (0.05, 5.0), "log10_m_halo_msun": (12.0, 13.0)})
    assert checked_physics(wide, GRID) == [
        "halos: 1.6% of the prior are hosts without subhalos, lighter than twice the resolution of their trees: "
        "below 0.17 keV at 10^12 Msun"
    ]
    coarse = changed(
        paper_config,
        dark_matter={"m_th_kev": (1.0, 5.0), "log10_m_halo_msun": (10.0, 11.0)},
        halos__min_mass_msun=6e9,
    )
    (line,) = checked_physics(coarse, GRID)
    assert "8% of the prior" in line
    assert line.endswith("at any relic mass at 10^10 Msun")


def test_a_prior_wholly_without_subhalos_is_a_fault(paper_config: Config) -> None:
    light = {"m_th_kev": (0.05, 0.06), "log10_m_halo_msun": (10.0, 10.3)}
    (line,) = problems(changed(paper_config, dark_matter=light))
    assert line == (
        "halos: no host of the prior has subhalos: that takes 6.32e+13 Msun, twice the resolution of the tree; "
        "raise dark_matter, or lower halos.min_mass_msun = 1e+07"
    )
    nodes = {"m_th_kev": [0.05, 0.06, 0.3], "log10_m_halo_msun": [10.0, 10.3], "realizations": 4}
    campaign = {**paper_config.campaign.model_dump(), "design": "grid", "grid": nodes, "n_samples": 24}
    prior = {"m_th_kev": (0.05, 0.3), "log10_m_halo_msun": (10.0, 10.3)}
    (line,) = problems(changed(paper_config, campaign=campaign, dark_matter=prior))
    assert line.startswith("halos: no host of the nodes has subhalos")


def test_halos_that_cannot_be_made_are_told_before_the_first_job(paper_config: Config) -> None:
    (line,) = problems(changed(paper_config, halos__branching=(0.57, 1.2, 0.0, 0.0)))
    assert line == "halos: gamma1 of branching must be < 1, got 1.2"
    (line,) = problems(changed(paper_config, halos__z_max=0.2, unusual=["halos.z_max"]))
    assert "below z_max = 0.2" in line
