"""docs/own_lens.md on its simulated lens: other pixels, redshifts and bands, a rolled detector, no satellite."""

from __future__ import annotations

import json
import os
import runpy
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from astropy.io import fits

from warmlens.artifacts.file import open_artifact
from warmlens.campaign.preflight import check_observation
from warmlens.config.file import load_config
from warmlens.config.smooth_model import SmoothModelBlock
from warmlens.products.observation import read_observation
from warmlens.stage_table import ObservationSettings, SmoothModelSettings, stage_settings

from ..shared import run_stage

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
OVERLAY = ROOT / "docs/examples/own_lens.yaml"
TINY: dict[str, Any] = {
    "campaign": {"n_samples": 8, "chunk_size": 8},
    "halos": {"min_mass_msun": 1.0e8},
    "smooth_model": {"fit": {"levels": [8]}},
    "scan": {"step_arcsec": 0.25, "nested": {"n_max": 2}},
    "null_test": {"n_mocks": 0},
    "abc": {"fraction": 0.5, "bootstrap": 100},
}
SIMULATOR = runpy.run_path(str(ROOT / "docs/examples/simulate_lens.py"))


@dataclass(frozen=True)
class Lens:
    """Files of the lens, and the campaign that ran on them."""

    files: Path
    results: Path
    said: str


@pytest.fixture(scope="module")
def lens(tmp_path_factory: pytest.TempPathFactory) -> Lens:
    """From the files to a bound, as a user runs it; the lens is fitted."""
    folder = tmp_path_factory.mktemp("own_lens")
    files = folder / "data"
    SIMULATOR["write"](files)
    for name in ("Snakefile", "workflow", "config.yaml"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "tiny.yaml").write_text(yaml.safe_dump(TINY))
    done = subprocess.run(
        [str(BIN / "snakemake"), "results/own_lens/abc.h5", "--cores", "2",
         "--workflow-profile", "workflow/profiles/local", "--configfile", str(OVERLAY), "tiny.yaml"],
        cwd=folder, capture_output=True, text=True, check=False,
        env={**os.environ, "NO_COLOR": "1", "OWN_LENS": str(files)},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return Lens(files, folder / "results/own_lens", done.stdout + done.stderr)


def parameters(lens: Lens) -> dict[str, tuple[float, float]]:
    """Fitted value and error by name."""
    with open_artifact(lens.results / "smooth_model.h5", "smooth_model") as artifact:
        names = [entry["name"] for entry in artifact.metadata["parameters"]]
        pairs = zip(artifact.array("parameters/value"), artifact.array("parameters/error"), strict=True)
        return dict(zip(names, pairs, strict=True))


def truth(name: str) -> float:
    component, key = name.split(".")
    kind, number = component.split("_")
    if kind == "quasar":
        return float(SIMULATOR["quasar_images"]()["xy".index(key)][int(number)])
    return SIMULATOR["LENS" if kind == "lens" else "LIGHT"][int(number)][key]


def test_campaign_reaches_a_bound(lens: Lens) -> None:
    numbers = json.loads((lens.results / "abc.json").read_text())
    assert numbers["n_samples"] == 8
    assert numbers["n_failed"] == 0
    assert 1.0 < numbers["bounds"]["q0455"]["value_kev"] < 5.0
    assert numbers["verdict"] == "not usable"  # of 8 samples, and it says so


def test_fit_finds_the_lens(lens: Lens) -> None:
    with open_artifact(lens.results / "smooth_model.h5", "smooth_model") as artifact:
        assert artifact.metadata["problems"] == artifact.metadata["notes"] == []
        assert artifact.metadata["fits"]["F140W"]["chi2_red"] == pytest.approx(1.0, abs=0.06)  # 3 of its sigma
    fitted = {name: values for name, values in parameters(lens).items() if not name.startswith("source")}
    pull = {name: (value - truth(name)) / error for name, (value, error) in fitted.items()}
    assert len(pull) == 22
    assert max(map(abs, pull.values())) < 3.5, pull
    assert np.sqrt(np.mean(np.square(list(pull.values())))) < 1.5
    assert fitted["lens_0.theta_E"][1] < 0.003  # the errors are not so wide that anything is within them
    assert fitted["quasar_0.x"][1] < 0.003


def quasars_are_bright(path: Path) -> bool:
    """Whether the true quasar images, positions on the sky, fall on the brightest pixels about them."""
    observed = read_observation(path)
    x, y, _ = SIMULATOR["quasar_images"]()
    columns, rows = (np.rint(c).astype(int) for c in observed.grid.to_pixel(x, y))
    image = observed.bands[0].image
    return all(
        image[r, c] > 0.85 * image[r - 3 : r + 4, c - 3 : c + 4].max() for r, c in zip(rows, columns, strict=True)
    )


ROLLED, MIRRORED = {"CD1_2": -1.0, "CD2_1": -1.0}, {"CD1_1": -1.0, "CD2_1": -1.0}


@pytest.mark.parametrize("signs", [{}, ROLLED, MIRRORED], ids=["right", "rolled the other way", "mirrored"])
def test_wrong_orientation_is_seen(
    lens: Lens, signs: dict[str, float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The true lens fits the image as it lies, and no wrong twin of it."""
    for path in lens.files.glob("*.fits"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    with fits.open(tmp_path / "sci.fits", mode="update") as hdus:
        for key, sign in signs.items():
            hdus[0].header[key] *= sign
    monkeypatch.setenv("OWN_LENS", str(tmp_path))
    config = load_config([ROOT / "config.yaml", OVERLAY])
    assert any("FAR" in line for line in check_observation(config)) == bool(signs)
    settings = stage_settings(config, "observation")
    assert isinstance(settings, ObservationSettings)
    observed, model = tmp_path / "observation.h5", tmp_path / "smooth_model.h5"
    run_stage("observation", settings, observed)
    assert quasars_are_bright(observed) != bool(signs)
    true_lens = {"lens_model_list": SIMULATOR["LENS_MODELS"], "kwargs_lens": SIMULATOR["LENS"]}
    light = [{key: value for key, value in SIMULATOR["LIGHT"][0].items() if key != "amp"}]
    block = {**config.smooth_model.model_dump(), "mode": "given", "lens": true_lens}
    block["lens_light"]["kwargs_lens_light"] = light
    block["quasar_images"] = np.column_stack(SIMULATOR["quasar_images"]()[:2]).tolist()
    given = SmoothModelSettings(smooth_model=SmoothModelBlock.model_validate(block))
    if signs:
        with pytest.raises(ValueError, match=r"chi2_red = \d"):
            run_stage("smooth_model", given, model, observation=observed)
    else:
        run_stage("smooth_model", given, model, observation=observed)
