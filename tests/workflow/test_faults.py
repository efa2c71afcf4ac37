"""Faults of a running campaign: what is started again ends with the same digests, or says what to do first."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from warmlens.artifacts.names import CHUNKED
from warmlens.campaign.status import read_campaign
from warmlens.stage_table import campaign_stages

from ..reliability import Outcome, fault
from .conftest import BIN, Project
from .damage import artifact_of, flip_arrays, swap, truncate, with_settings

ABC = "results/tiny/abc.h5"
CopyOf = Callable[[], Project]
DELETED = "the files that its messages name are deleted"


def without(project: Project, first: str) -> Project:
    """The campaign with the second chunk from a stage on, and the posterior, still to be made."""
    for stage in CHUNKED[CHUNKED.index(first) :]:
        (project.results / stage / "chunk-0000007-0000014.h5").unlink()
    (project.folder / ABC).unlink()
    return project


@contextlib.contextmanager
def running(project: Project, target: str = ABC) -> Iterator[subprocess.Popen[str]]:
    """Snakemake at work; it is killed if it is not waited for."""
    process = subprocess.Popen(
        project.command(target, cores=1),
        cwd=project.folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


def worker(project: Project, stage: str) -> psutil.Process:
    """The process of a stage, as soon as there is one."""
    deadline = time.monotonic() + 240.0
    while time.monotonic() < deadline:
        for process in psutil.process_iter(["cmdline", "cwd"]):
            words = process.info["cmdline"] or []
            if words[1:4] == [str(BIN / "warmlens"), "stage", stage] and process.info["cwd"] == str(
                project.folder
            ):
                return process
        time.sleep(0.02)
    raise AssertionError(f"no {stage} was seen running")


def resumed(project: Project) -> None:
    """What `warmlens resume` does ends well."""
    done = project.warmlens("resume", "results/tiny", "--cores", "2", "--", ABC)
    assert done.returncode == 0, done.stdout + done.stderr


@fault("Processes", "a job is killed", "SIGKILL to a stage at work")
def test_killed_job(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = without(copy_of(), "scans")
    with running(project) as process:
        worker(project, "scans").kill()
        said = process.communicate()[0]
        assert said.splitlines()[-1].startswith(
            "warmlens: scans, samples 7 to 14: ended without a message: killed"
        )
        assert process.returncode != 0
    assert "failed: scans, samples 7 to 14: ended" in project.warmlens("status", "results/tiny").stdout
    resumed(project)
    outcome.same_digests(project.digests(), finished.digests(), lost="the job in flight", after="started again")


@fault("Processes", "Snakemake is asked to end, as at a wall time", "SIGTERM to Snakemake")
def test_terminated_snakemake(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = without(copy_of(), "mocks")
    with running(project) as process:
        worker(project, "mocks")
        process.terminate()
        process.communicate()
        assert process.returncode != 0
    assert not list((project.results / ".runs").glob("*")), "a run that ended by itself leaves no record"
    resumed(project)
    outcome.same_digests(project.digests(), finished.digests(), after="started again")


@fault("Processes", "two Snakemakes are started on the same results", "in one folder, and in two that share them")
def test_two_at_once(
    copy_of: CopyOf, finished: Project, tmp_path_factory: pytest.TempPathFactory, outcome: Outcome
) -> None:
    project = without(copy_of(), "scans")
    elsewhere = Project(tmp_path_factory.mktemp("elsewhere"))
    subprocess.run(["cp", "-a", f"{project.folder}/.", str(elsewhere.folder)], check=True)
    subprocess.run(["rm", "-r", str(elsewhere.folder / "results")], check=True)
    (elsewhere.folder / "results").symlink_to(project.folder / "results")
    with running(project) as process:
        stopped = worker(project, "scans")
        stopped.suspend()
        second = project.snakemake(ABC, check=False)
        assert second.returncode != 0
        outcome.stops(second.stdout + second.stderr, "Directory cannot be locked")
        third = elsewhere.snakemake(ABC, check=False)
        assert third.returncode != 0
        outcome.stops(
            third.stdout + third.stderr, "works on these results from the folder", "wait for it, or stop it"
        )
        stopped.resume()
        process.communicate()
        assert process.returncode == 0
    outcome.same_digests(project.digests(), finished.digests(), after="the first goes on")
    elsewhere.snakemake(ABC)
    assert project.digests() == finished.digests()


@contextlib.contextmanager
def mounted(folder: Path, *words: str) -> Iterator[None]:
    """A mount on a folder, if this user may."""
    done = subprocess.run(["mount", *words, str(folder)], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"needs root that may mount: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@fault("Disk", "the disk is full while an artifact is written", "a stage writes to a tmpfs of 1 MiB")
def test_full_disk(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = without(copy_of(), "mocks")
    for stage in ("scans", "summaries"):
        for kept in (project.results / stage).glob("*"):
            kept.unlink()
    with mounted(project.results / "scans", "-t", "tmpfs", "-o", "size=1m", "tmpfs"):
        done = project.snakemake(ABC, check=False)
        assert done.returncode != 0
        outcome.stops(
            done.stdout + done.stderr,
            "the disk is full",
            "Finished artifacts are intact; make room",
            lost="that job",
        )
        assert not list((project.results / "scans").glob("*"))
    resumed(project)
    outcome.same_digests(project.digests(), finished.digests(), lost="that job", after="with room for it")


@fault("Disk", "the results are read-only", "the results folder mounted read-only")
def test_read_only_results(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = without(copy_of(), "scans")
    before = project.digests()
    with mounted(project.results, "--bind", str(project.results)):
        subprocess.run(["mount", "-o", "remount,bind,ro", str(project.results)], check=True)
        done = project.snakemake(ABC, check=False)
        assert done.returncode != 0
        outcome.stops(done.stdout + done.stderr, "Write-protected output files", "results/tiny/abc.csv")
        assert project.digests() == before
    resumed(project)
    outcome.same_digests(project.digests(), finished.digests(), after="writable again")


def run_and_delete_what_is_named(project: Project, attempts: int) -> int:
    """Start the campaign, delete the artifacts that its errors name, and so on until it ends; how often."""
    for attempt in range(attempts):
        done = project.snakemake("--forcerun", "abc", cores=2, check=False) if attempt == 0 else None
        done = done or project.snakemake(cores=2, check=False)
        if done.returncode == 0:
            return attempt
        text = done.stdout + done.stderr
        named = set(re.findall(r"^warmlens: .*?: (\S+?\.h5): .*(?:delete|run the campaign)", text, re.MULTILINE))
        assert named, text
        for name in named:
            (project.folder / name).unlink(missing_ok=True)
    raise AssertionError(f"it does not end after {attempts} starts")


@fault(
    "Artifacts", "an artifact of every stage is damaged, its time too", "a bit flipped, or cut short, then touched"
)
@pytest.mark.parametrize("damage", [flip_arrays, truncate])
def test_what_it_says_helps(
    copy_of: CopyOf, finished: Project, outcome: Outcome, damage: Callable[[Path], None]
) -> None:
    project = copy_of()
    config = read_campaign(project.results)
    for stage in campaign_stages(config)[:-1]:
        path = artifact_of(config, stage)
        damage(path)
        path.touch()
    n_deleted = run_and_delete_what_is_named(project, 20)
    assert (n_deleted > 0) == (damage is flip_arrays), "what the headers show is mended by a start"
    after = DELETED if n_deleted else ""
    outcome.same_digests(project.digests(), finished.digests(), lost="damaged files, recomputed", after=after)


@fault(
    "Artifacts", "an artifact of every stage is damaged, its time kept", "a bit flipped in each; audit is asked"
)
def test_what_audit_finds(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = copy_of()
    config = read_campaign(project.results)
    damaged = [artifact_of(config, stage) for stage in campaign_stages(config)]
    for path in damaged:
        flip_arrays(path)
    project.snakemake()  # sees nothing, and makes nothing of them
    audit = project.warmlens("audit", "results/tiny")
    assert audit.returncode == 1
    lines = audit.stdout.splitlines()
    named = {project.folder / line.partition(": ")[0] for line in lines if ": damaged: " in line}
    assert named == set(damaged)
    for path in named:
        path.unlink()
    project.snakemake()
    assert project.warmlens("audit", "results/tiny").returncode == 0
    outcome.same_digests(project.digests(), finished.digests(), lost="damaged files, recomputed", after=DELETED)


@fault("Artifacts", "an artifact of every stage is deleted", "rm, then started again")
def test_deleted(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = copy_of()
    config = read_campaign(project.results)
    for stage in campaign_stages(config):
        artifact_of(config, stage).unlink()
    project.snakemake()
    outcome.same_digests(project.digests(), finished.digests(), lost="deleted files, recomputed")


@fault("Artifacts", "two chunks of every stage are swapped", "mv, then started again")
def test_swapped(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = copy_of()
    for stage in CHUNKED:
        first, second = sorted((project.results / stage).glob("*.h5"))
        swap(first, second)
        first.touch()
        second.touch()
    project.snakemake()
    outcome.same_digests(project.digests(), finished.digests(), lost="swapped files, recomputed")


@fault("Origin", "an artifact of another seed is put in place", "halos of another seed, then started again")
def test_other_seed(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = copy_of()
    with_settings(project.results / "halos/chunk-0000000-0000007.h5", lambda settings: settings.update(seed=99))
    project.snakemake()
    outcome.same_digests(project.digests(), finished.digests(), lost="the foreign file")


@fault("Origin", ".snakemake is lost", "rm -r .snakemake, then started again", quick=True)
def test_lost_records(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = copy_of()
    subprocess.run(["rm", "-r", str(project.folder / ".snakemake")], check=True)
    assert "Nothing to be done" in project.snakemake(ABC).stderr
    outcome.same_digests(project.digests(), finished.digests())


@fault(
    "Origin",
    ".snakemake is lost, and the configuration edited",
    "abc.fraction changed, then started again",
    quick=True,
)
def test_lost_records_and_other_config(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = copy_of()
    subprocess.run(["rm", "-r", str(project.folder / ".snakemake")], check=True)
    project.configure({"abc": {"fraction": 0.5}})
    assert project.planned(ABC) == {"abc": 1}
    outcome.goes_on("the posterior is made again", "nothing")


@fault(
    "Origin",
    "records of .snakemake are emptied, and the configuration edited",
    "all files of .snakemake/metadata cut to 0 bytes, another seed; also with --rerun-triggers mtime",
    quick=True,
)
def test_emptied_records_and_another_seed(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = copy_of()
    for record in (project.folder / ".snakemake/metadata").rglob("*"):
        if record.is_file():
            record.write_bytes(b"")
    project.configure({"campaign": {"seed": 2}})
    jobs = project.planned(ABC, "--rerun-triggers", "mtime")
    assert jobs["halos"] == jobs["scans"] == 2 and jobs["null_mocks"] == jobs["abc"] == 1
    assert "smooth_model" not in jobs
    done = project.snakemake(ABC, check=False)
    assert done.returncode != 0
    last = done.stderr.splitlines()[-1]
    outcome.stops(last, "seed was 1131, is now 2", "13 finished artifacts", "nothing was changed", "--yes")
    assert project.digests() == finished.digests()
    assert (project.results / "config.json").read_text() == (finished.results / "config.json").read_text()
    assert project.planned("results/tiny/halos/chunk-0000000-0000007.h5", "--quiet", "rules") == {"halos": 1}
    assert not list((project.results / ".runs").glob("*"))


@fault("Origin", "a finished campaign is copied without times, and .snakemake is lost", "cp -r", quick=True)
def test_copied_without_times(finished: Project, tmp_path: Path, outcome: Outcome) -> None:
    subprocess.run(["cp", "-r", f"{finished.folder}/.", str(tmp_path)], check=True)
    subprocess.run(["rm", "-r", str(tmp_path / ".snakemake")], check=True)
    project = Project(tmp_path)
    (project.results / "observation.h5").touch()
    assert project.planned() == {}
    outcome.same_digests(project.digests(), finished.digests())


@fault(
    "Origin",
    "the configuration is edited between two runs",
    "abc.fraction and summaries.threshold, there and back",
)
def test_edited_config(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = copy_of()
    project.configure({"abc": {"fraction": 0.5}, "summaries": {"threshold": -3.0}})
    assert project.snakemake(ABC, check=False).returncode != 0
    assert project.digests() == finished.digests(), "nothing is discarded unasked"
    project.snakemake(ABC, yes=True)
    assert project.digests() != finished.digests()
    (project.folder / "overlay-1.yaml").unlink()
    project.snakemake(ABC, yes=True)
    outcome.same_digests(project.digests(), finished.digests())


@fault("Origin", "the clock is set back", "artifacts of tomorrow, a chunk to be made; then started again")
def test_clock_set_back(copy_of: CopyOf, finished: Project, outcome: Outcome) -> None:
    project = without(copy_of(), "scans")
    tomorrow = time.time() + 86400.0
    for path in project.results.rglob("*.h5"):
        os.utime(path, (tomorrow, tomorrow))
    resumed(project)
    assert project.digests() == finished.digests()
    assert project.planned(ABC) == {}, "what was made is taken for outdated"
    outcome.same_digests(project.digests(), finished.digests())


def test_the_limit_of_a_sample_is_a_resource(project: Project) -> None:
    target = "results/tiny/halos/chunk-0000000-0000007.h5"
    shown = project.snakemake(
        target, "--dry-run", "--printshellcmds", "--set-resources", "halos:sample_seconds=60"
    )
    assert "--sample-seconds 60 >" in " ".join((shown.stdout + shown.stderr).split())


@fault("Machine", "Snakemake is sent to another folder", "--directory of a folder without config.yaml", quick=True)
def test_another_working_folder(project: Project, outcome: Outcome) -> None:
    elsewhere = project.folder / "elsewhere"
    done = project.snakemake("--directory", str(elsewhere), "--dry-run", check=False)
    said = done.stdout + done.stderr
    assert done.returncode == 1 and "missing" not in said
    outcome.stops(said, "no config.yaml; start in the folder that holds it", "without --directory")
