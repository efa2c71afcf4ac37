from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.names import CHUNKED
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.campaign.files import stage_files
from warmlens.campaign.snakemake import remaking_command
from warmlens.config.file import parse_config
from warmlens.config.model import Config
from warmlens.products.samples import FAILED_HERE, FAILED_UPSTREAM, SampleTable
from warmlens.report.collect import failing_stages, open_of_campaign, read_report
from warmlens.report.sample import read_sample, seed_keys
from warmlens.report.smooth_fit import pull, true_parameters
from warmlens.sampling import Parameters
from warmlens.text import CITATION

ROOT = Path(__file__).parents[2]


def test_command_names_what_it_makes(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"results": "results/my lens"}))
    words = shlex.split(remaking_command(tmp_path, "figures/psf.png"))
    assert words[-2:] == ["--", "results/my lens/figures/psf.png"]
    assert words[words.index("--configfile") + 1] == "results/my lens/config.json"
    assert "--" not in shlex.split(remaking_command(tmp_path))
    with (
        pytest.raises(
            ArtifactError, match=r"abc\.h5: no such artifact; make it with: snakemake .*my lens/abc\.h5"
        ),
        open_of_campaign(tmp_path, "abc.h5", "abc"),
    ):
        pass


def _campaign(folder: Path, config: Config, n_samples: int) -> Config:
    made = config.model_copy(
        update={
            "results": str(folder),
            "campaign": config.campaign.model_copy(update={"n_samples": n_samples, "chunk_size": 2}),
        }
    )
    (folder / "config.json").write_text(made.model_dump_json())
    return made


def test_the_stage_that_failed_first_is_found(tmp_path: Path, paper_config: Config) -> None:
    config = _campaign(tmp_path, paper_config, 4)
    failed = {"halos": 0, "mocks": 3, "scans": 1}
    upstream: set[int] = set()
    for stage in CHUNKED:
        for first, path in zip((0, 2), stage_files(config, stage), strict=True):
            ids = np.arange(first, first + 2)
            table = SampleTable(Parameters(ids, np.ones(2), np.full(2, 13.0)))
            table.status[np.isin(ids, list(upstream))] = FAILED_UPSTREAM
            table.status[ids == failed.get(stage, -1)] = FAILED_HERE
            write_artifact(path, Provenance(stage, {}, span=(first, first + 2)), table.datasets(), {})
        upstream |= {failed[stage]} if stage in failed else set()
    assert failing_stages(config, [0, 1, 3]) == ["halos", "scans", "mocks"]
    stage_files(config, "mocks")[1].unlink()
    assert failing_stages(config, [0, 1, 3]) == ["halos", "scans", "unknown"]


@pytest.mark.parametrize("sample", [-1, 4])
def test_sample_that_does_not_exist(tmp_path: Path, paper_config: Config, sample: int) -> None:
    _campaign(tmp_path, paper_config, 4)
    with pytest.raises(ArtifactError, match=f"has no sample {sample}; its samples are 0 to 3"):
        read_sample(tmp_path, sample)


def test_a_campaign_on_a_grid_has_no_posterior(tmp_path: Path, paper_config: Config) -> None:
    raw = json.loads(paper_config.model_dump_json())
    prior = raw["dark_matter"]
    grid = {"m_th_kev": prior["m_th_kev"], "log10_m_halo_msun": prior["log10_m_halo_msun"], "realizations": 1}
    raw["campaign"] |= {"design": "grid", "grid": grid, "n_samples": 4}
    _campaign(tmp_path, parse_config(raw), 4)
    for read in (lambda: read_report(tmp_path), lambda: read_sample(tmp_path, 0)):
        with pytest.raises(ArtifactError, match=r"on a grid has no posterior to show; see exclusion\.json"):
            read()


def test_seed_keys_name_sample_and_band() -> None:
    bands = {"bands": ["F814W", "F555W"]}
    assert seed_keys("1131/halos/SAMPLE", 12, {}) == ("1131/halos/12",)
    assert seed_keys("1131/mocks/SAMPLE/BAND", 3, bands) == ("1131/mocks/3/F814W", "1131/mocks/3/F555W")
    assert seed_keys("", 3, bands) == ()


def test_truth_of_a_simulated_lens(paper_config: Config) -> None:
    settings: dict[str, Any] = json.loads(paper_config.model_dump_json())
    simulated, light = settings["observation"]["simulated"], settings["smooth_model"]["lens_light"]
    models = simulated["lens"]["lens_model_list"]
    truth = true_parameters(models, light, simulated)
    assert truth["lens_0.theta_E"] == simulated["lens"]["kwargs_lens"][0]["theta_E"]
    assert truth["lens_3.coeffs_4"] == simulated["lens"]["kwargs_lens"][3]["coeffs"][4]
    assert truth["quasar_1.y"] == simulated["quasar_images"][1][1]
    other = true_parameters(["SIE", *models[1:]], light, simulated)
    assert not any(name.startswith("lens_") for name in other), "parameters of another model are no truth"


def test_pull_needs_an_error_and_a_truth() -> None:
    assert pull(2.1, 0.05, 2.0) == pytest.approx(2.0)
    assert pull(2.1, None, 2.0) is pull(2.1, 0.0, 2.0) is pull(2.1, 0.05, None) is None


def test_citation_is_that_of_the_project() -> None:
    paper = yaml.safe_load((ROOT / "CITATION.cff").read_text())["preferred-citation"]
    assert (CITATION["title"], CITATION["doi"], CITATION["year"]) == (
        paper["title"],
        paper["doi"],
        str(paper["year"]),
    )
    assert [author["family-names"] for author in paper["authors"]] == ["Birrer", "Amara", "Refregier"]
    assert f"arXiv:{CITATION['arxiv']}" in {item["value"] for item in paper["identifiers"]}
