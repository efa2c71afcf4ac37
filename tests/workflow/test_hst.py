"""The overlay for a real image, made small, from FITS to posterior."""

from __future__ import annotations

import os

import numpy as np
import pytest
import yaml

from warmlens.artifacts import open_artifact

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
        "smooth_model": {"source": {"n_max": 14}},
        "abc": {"fraction": 0.5},
    }
    project.configure(HST, small)
    done = project.snakemake("results/tiny/abc.h5")
    with open_artifact(project.results / "smooth_model.h5", "smooth_model") as artifact:
        fit = artifact.metadata["fits"]["F814W"]
        (warning,) = artifact.metadata["warnings"]
    assert fit["n_pixels"] == 11_285
    assert 2.0 < fit["chi2_red"] < 20.0  # the published lens without potential shapelets does not fit to the noise
    assert f"F814W: chi2_red = {fit['chi2_red']:.2f}" in warning
    assert "WARNING F814W: chi2_red" in done.stdout + done.stderr
    with open_artifact(project.results / "observed_scan.h5", "observed_scan") as artifact:
        delta_r, valid = artifact.array("F814W/delta_r"), artifact.array("raster/valid")
    assert np.isfinite(delta_r).all()
    assert np.all(delta_r[~valid] == 0.0)
    assert delta_r.min() < -100.0  # misfit that a perturber takes up, as known for this image
    with open_artifact(project.results / "abc.h5", "abc") as artifact:
        assert artifact.metadata["n_accepted"] == 4
        assert any("chi2_red" in line for line in artifact.metadata["warnings"])
