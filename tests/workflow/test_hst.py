"""The overlay for a real image, made small, from FITS to posterior."""

from __future__ import annotations

import os

import numpy as np
import pytest
import yaml

from warmlens.artifacts.file import open_artifact
from warmlens.products.observation import read_observation
from warmlens.products.smooth_model import read_smooth_model

from .conftest import ROOT, Project

HST = yaml.safe_load((ROOT / "workflow/configs/hst.yaml").read_text())


def test_without_the_folder_the_message_names_the_variable(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("WARMLENS_HST_DATA", raising=False)
    project.configure(HST)
    done = project.snakemake("--dry-run", check=False)
    assert done.returncode != 0
    assert "the environment variable WARMLENS_HST_DATA is not set" in done.stdout + done.stderr


@pytest.mark.skipif("WARMLENS_HST_DATA" not in os.environ, reason="WARMLENS_HST_DATA is not set: no real image")
def test_real_image_to_posterior(project: Project) -> None:
    small = {
        "results": "results/tiny",
        "campaign": {"n_samples": 8, "chunk_size": 8},
        "halos": {"field_half_width_arcsec": 5.6},
        "smooth_model": {
            "mode": "fit",
            "source": {"n_max": 16, "clumps": {"number": 3, "n_max": 3, "threshold": 5.0, "scale_in_fwhm": 0.5}},
            "fit": {"levels": [10], "max_steps": 3, "tolerance": 1.0e-2, "psf": {"iterations": 1}},
        },
        "scan": {"shard_size": 200},
        "abc": {"fraction": 0.5},
    }
    project.configure(HST, small)
    done = project.snakemake("results/tiny/abc.h5")
    observed = read_observation(project.results / "observation.h5")
    model = read_smooth_model(project.results / "smooth_model.h5")
    with open_artifact(project.results / "smooth_model.h5", "smooth_model") as artifact:
        history, warnings = (
            artifact.metadata["history"],
            artifact.metadata["problems"] + artifact.metadata["notes"],
        )
        assert np.all(artifact.array("parameters/error") > 0)
    assert [step["name"] for step in history] == ["n_max 10", "n_max 16", "PSF 1 of 1", "clumps", "last fit"]
    fit = model.fits["F814W"]
    assert 14_000 < fit.n_pixels < 15_000  # the disc of 3.4 arcsec
    assert 1.3 < fit.chi2_red_outside_cores < 4.0  # a source of so low an order does not fit to the noise
    assert len(model.sets) == 4
    change = np.abs(fit.psf - observed.bands[0].psf)
    assert 1e-3 < change.max() < 0.05  # corrected on the quasars
    assert fit.psf.sum() == pytest.approx(1.0)
    assert any(f"F814W: chi2_red = {fit.chi2_red_outside_cores:.2f}" in line for line in warnings)
    assert "- F814W: chi2_red" in done.stdout + done.stderr
    with open_artifact(project.results / "observed_scan.h5", "observed_scan") as artifact:
        delta_r, valid = artifact.array("F814W/delta_r"), artifact.array("raster/valid")
    assert np.isfinite(delta_r).all()
    assert np.all(delta_r[~valid] == 0.0)
    assert delta_r.min() < -20.0  # misfit that a perturber takes up
    with open_artifact(project.results / "abc.h5", "abc") as artifact:
        assert artifact.metadata["n_accepted"] == 4
        assert any("chi2_red" in line for line in artifact.metadata["reasons"])
