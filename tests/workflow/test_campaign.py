"""The whole DAG: complete, resumable, independent of cores, interruptions and chunks."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import CHUNKED, FIGURE_GROUPS, FIGURES
from warmlens.campaign.derived import NEEDED

from ..reliability import Outcome, fault
from .conftest import BIN, N_CHUNKED_STAGES, Project

ABC = "results/tiny/abc.h5"


def test_campaign_is_complete(finished: Project) -> None:
    with open_artifact(finished.results / "abc.h5", "abc") as artifact:
        meta = artifact.metadata
        accepted = artifact.array("table/accepted")
        m_th = artifact.array("table/m_th_kev")
    assert meta["n_samples"] == 14
    assert meta["n_failed"] == 0
    assert accepted.sum() == meta["n_accepted"] == round(0.3 * 14)
    bound = meta["bounds"][meta["headline"]]
    assert bound["value_kev"] == m_th[accepted].min()  # the lowest 4.55% of 4 samples is the first of them
    assert bound["prior_only_kev"] == m_th.min()  # and the lowest 4.55% of 14 are the first of them
    table = pd.read_csv(finished.results / "abc.csv")
    assert np.array_equal(table["accepted"].to_numpy(), accepted.astype(bool))
    for figure in FIGURES:
        assert (finished.results / f"figures/{figure}.png").stat().st_size > 10_000
        assert len(pd.read_csv(finished.results / f"figures/{figure}.csv")) > 0


def test_smooth_model_fits_the_simulated_observation(finished: Project) -> None:
    with open_artifact(finished.results / "smooth_model.h5", "smooth_model") as artifact:
        for fit in artifact.metadata["fits"].values():
            assert 0.8 < fit["chi2_red"] < 2.0


def test_result_audit_and_status(finished: Project) -> None:
    shown = finished.warmlens("result", "results/tiny")
    assert shown.returncode == 0, shown.stderr
    assert "keV" in shown.stdout
    assert "the prior alone gives 1.07 keV" in shown.stdout.replace("\n", " ")
    audit = finished.warmlens("audit", "results/tiny")
    assert audit.returncode == 0, audit.stdout + audit.stderr
    status = finished.warmlens("status", "results/tiny", "--cores", "2")
    assert "2 of 2" in status.stdout
    assert "about 0 s left on 2 cores" in status.stdout


@fault("Processes", "Snakemake and all its jobs are killed", "SIGKILL to all, then `warmlens resume`", quick=True)
def test_killed_campaign_resumes_on_one_core_to_the_same_digests(
    finished: Project, copy_of: Callable[[], Project], outcome: Outcome
) -> None:
    """As a user does it, `warmlens run` and `resume`; on one core, where the finished one had two."""
    project = copy_of()
    for path in (*project.results.rglob("chunk-0000007-*.h5"), project.folder / ABC):
        path.unlink()
    before = project.digests()
    process = subprocess.Popen(
        [str(BIN / "warmlens"), "run", "--configfile", "overlay-0.yaml", "--cores", "1", "--", ABC],
        cwd=project.folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + 600.0
    while not (project.results / "halos/chunk-0000007-0000014.h5").exists():
        assert process.poll() is None, "the campaign ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.1)
    refused = project.warmlens("resume", "results/tiny", "--", ABC)
    assert refused.returncode != 0
    assert "is locked by process" in refused.stderr and "wait for it" in refused.stderr
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    done = project.digests()
    assert len(before) < len(done) < len(finished.digests())
    assert project.warmlens("audit", "results/tiny").returncode == 1
    resumed = project.warmlens("resume", "results/tiny", "--cores", "1", "--", ABC)
    assert resumed.returncode == 0, resumed.stdout + resumed.stderr
    assert "its lock is lifted" in resumed.stdout
    outcome.same_digests(project.digests(), finished.digests(), "the jobs in flight", after="resumed")
    assert not list(project.results.rglob(".*.tmp-*")), "a partial file looks like an artifact"
    again = project.warmlens("resume", "results/tiny", "--", ABC)
    assert again.returncode == 0 and "Nothing to be done" in again.stdout + again.stderr


def test_chunk_size_changes_no_number(finished: Project, copy_of: Callable[[], Project]) -> None:
    project = copy_of()
    for stage in CHUNKED:
        shutil.rmtree(project.results / stage)
    project.configure({"campaign": {"chunk_size": 20}})
    project.snakemake(ABC, cores=2)

    def rows(root: Path, stage: str, name: str) -> np.ndarray:
        parts = []
        for path in sorted((root / stage).glob("chunk-*.h5")):
            with open_artifact(path, stage) as artifact:
                parts.append(artifact.array(name))
        return np.concatenate(parts)[:14]

    for stage, name in (
        ("halos", "samples/m_th_kev"),
        ("halos", "halo/n_accreted"),
        ("halos", "halo/f_sub"),
        ("deflections", "delta_alpha"),
        ("mocks", "F814W/image"),
        ("mocks", "F555W/image"),
    ):
        small, large = rows(finished.results, stage, name), rows(project.results, stage, name)
        assert np.array_equal(small, large), (stage, name)
    masses = [_masses(root) for root in (finished.results, project.results)]
    assert np.array_equal(masses[0], masses[1][: len(masses[0])])
    for band in ("F814W", "F555W"):
        small = rows(finished.results, "scans", f"{band}/delta_r")
        large = rows(project.results, "scans", f"{band}/delta_r")
        scale = np.abs(small).max(axis=(1, 2), keepdims=True)
        assert np.max(np.abs(small - large) / scale) < 1e-9
    first, second = (pd.read_csv(p.results / "abc.csv") for p in (finished, project))
    assert np.array_equal(first["accepted"], second["accepted"])


def _masses(root: Path) -> np.ndarray:
    parts = []
    for path in sorted((root / "halos").glob("chunk-*.h5")):
        with open_artifact(path, "halos") as artifact:
            parts.append(artifact.array("subhalos/m_bound"))
    return np.concatenate(parts)


def _drawn_from(stage: str) -> list[str]:
    return [group for group, names in FIGURE_GROUPS.items() if any(stage in NEEDED[name] for name in names)]


class TestWhatIsRunAgain:
    """Jobs of a dry run after a change."""

    def test_nothing(self, finished: Project) -> None:
        assert finished.planned() == {}

    def test_more_samples(self, copy_of: Callable[[], Project]) -> None:
        project = copy_of()
        project.configure({"campaign": {"n_samples": 28}})
        jobs = project.planned(ABC)
        assert jobs == {
            "halos": 2,
            "deflections": 2,
            "mocks": 2,
            "scans": 2,
            "summaries": 2,
            "abc": 1,
        }

    def test_fewer_samples_than_the_chunk_holds(self, copy_of: Callable[[], Project]) -> None:
        project = copy_of()
        project.configure({"campaign": {"n_samples": 10}})
        assert project.planned(ABC) == {"abc": 1}

    def test_acceptance(self, copy_of: Callable[[], Project]) -> None:
        project = copy_of()
        project.configure({"abc": {"fraction": 0.5}})
        drawn = {f"figures_{group}": 1 for group in _drawn_from("abc")}
        assert drawn
        assert project.planned() == {"abc": 1, **drawn, "report": 1, "manifest": 1, "all": 1}

    def test_number_of_mocks_of_the_null_test(self, copy_of: Callable[[], Project]) -> None:
        project = copy_of()
        project.configure({"null_test": {"n_mocks": 5}})
        assert project.planned(ABC) == {"null_mocks": 1, "null_scans": 1, "null_summaries": 1, "abc": 1}
        project.configure({"null_test": {"n_mocks": 0}})
        assert project.planned(ABC) == {"abc": 1}

    def test_filter_of_the_deflections(self, copy_of: Callable[[], Project]) -> None:
        project = copy_of()
        project.configure({"deflections": {"filter_arcsec": 0.35}})
        jobs = project.planned(ABC)
        assert "halos" not in jobs
        assert jobs["deflections"] == jobs["summaries"] == 2

    def test_deleted_artifact_in_the_middle(self, copy_of: Callable[[], Project]) -> None:
        project = copy_of()
        next((project.results / "mocks").glob("*.h5")).unlink()
        jobs = project.planned()
        assert jobs["mocks"] == 1
        assert "deflections" not in jobs

    def test_every_stage_has_its_files_in_the_target(self, project: Project) -> None:
        jobs = project.planned()
        assert sum(jobs[stage] for stage in ("halos", "deflections", "mocks", "scans", "summaries")) == (
            2 * N_CHUNKED_STAGES
        )
        assert jobs["scan_operator"] == 2
        assert all(jobs[f"figures_{group}"] == 1 for group in FIGURE_GROUPS)


def test_invalid_configuration_stops_before_any_job(project: Project) -> None:
    project.configure(
        {
            "redshifts": {"source": 0.2},
            "scan": {"step_arcsec": 0.0},
            "smooth_model": {"source": {"n_max": -1}},
            "abc": {"fractoin": 0.1},
        }
    )
    done = project.snakemake(check=False)
    assert done.returncode != 0
    text = done.stdout + done.stderr
    for key in ("redshifts:", "scan.step_arcsec:", "smooth_model.source.n_max:", "abc.fractoin: unknown key"):
        assert sum(line.startswith(key) for line in text.splitlines()) == 1, text
    assert not project.results.exists()


@fault(
    "Samples",
    "samples raise an error",
    "relics lighter than 1 eV, which no tree is drawn for, in a whole campaign",
    quick=True,
)
def test_failed_samples_are_carried_to_the_table_and_left_out(
    copy_of: Callable[[], Project], outcome: Outcome
) -> None:
    """The samples of such relics fail; the others go on, all of them without subhalos: no host is heavy enough."""
    project = copy_of()
    changed = {
        "campaign": {"chunk_size": 14},
        "dark_matter": {"m_th_kev": [0.0005, 0.002], "log10_m_halo_msun": [10.0, 10.3]},
        "unusual": ["dark_matter.m_th_kev"],
    }
    project.configure({**changed, "abc": {"max_failed_fraction": 0.9}})
    project.snakemake(ABC)
    table = pd.read_csv(project.results / "abc.csv")
    failed = table["status"] > 0
    assert failed.equals(table["m_th_kev"] < 0.001)
    assert 0 < failed.sum() < 14
    assert not table.loc[failed, "accepted"].any()
    assert table.loc[failed, "distance_correlation"].isna().all()
    assert (
        table.loc[failed, "message"].str.contains("halos: ValueError: m_th_kev must be finite and >= 0.001").all()
    )
    with open_artifact(project.results / "deflections/chunk-0000000-0000014.h5", "deflections") as artifact:
        assert not artifact.array("delta_alpha")[~failed].any()
    with open_artifact(project.results / "abc.h5", "abc") as artifact:
        assert artifact.metadata["n_failed"] == failed.sum()
    assert f"{failed.sum()} of 14 samples failed" in project.warmlens("result", "results/tiny").stdout
    assert project.warmlens("report", "results/tiny").returncode == 0
    html = (project.results / "report.html").read_text()
    assert html.count('<td>halos</td><td class="wide">halos: ValueError: m_th_kev must be') == failed.sum()
    shown = project.warmlens("show", "results/tiny", str(np.flatnonzero(failed)[0]), "--output", "failed.html")
    assert shown.returncode == 0, shown.stderr
    html = (project.folder / "failed.html").read_text()
    assert "This sample failed in the stage halos." in html
    assert "Traceback (most recent call last)" in html
    project.configure({**changed, "abc": {"max_failed_fraction": 0.1}})
    done = project.snakemake(ABC, check=False)
    assert done.returncode != 0
    outcome.goes_on("the samples fail, the others go on", "those samples, counted as failed")
    outcome.stops(done.stdout + done.stderr, "more than abc.max_failed_fraction = 0.1 allows")
    last = done.stderr.splitlines()[-1]
    assert last.startswith("warmlens: abc: ") and last.endswith("; log: results/tiny/logs/abc.log")
    assert f"failed: {last.removeprefix('warmlens: ')}" in project.warmlens("status", "results/tiny").stdout


def test_audit_names_an_altered_and_a_missing_artifact(copy_of: Callable[[], Project]) -> None:
    project = copy_of()
    altered = project.results / "summaries/chunk-0000000-0000007.h5"
    missing = project.results / "mocks/chunk-0000007-0000014.h5"
    missing.unlink()
    import h5py

    with h5py.File(altered, "r+") as file:
        file["combined/counts"][0] += 1.0
    audit = project.warmlens("audit", "results/tiny")
    assert audit.returncode == 1
    assert f"{altered.relative_to(project.folder)}: altered" in audit.stdout
    assert f"{missing.relative_to(project.folder)}: missing" in audit.stdout


def test_jobs_that_read_all_chunks_get_a_list(project: Project) -> None:
    """The arguments of a job do not grow with the campaign."""
    shown = project.snakemake(ABC, "--dry-run", "--printshellcmds")
    text = " ".join((shown.stdout + shown.stderr).split())
    assert "--input summaries=@results/tiny/settings/summaries.files.json" in text
    assert text.count("--input shards=@results/tiny/settings/scan_operator.files.json") == 4
    assert "--input shards=results" not in text
