"""`warmlens run | resume | extend`, without a campaign: what is refused, and what Snakemake is called with."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.campaign import preflight
from warmlens.campaign import run as front_end
from warmlens.campaign.locks import LockedError
from warmlens.campaign.start import YES
from warmlens.campaign.status import read_campaign
from warmlens.config.model import Config
from warmlens.config.types import ConfigError

from ..reliability import Outcome, fault


@pytest.fixture
def campaign(tmp_path: Path, paper_config: Config, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Results folder of a campaign that was started and has made nothing."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "Snakefile").touch()
    results = Path("results/here")
    results.mkdir(parents=True)
    config = paper_config.model_copy(update={"results": str(results)})
    (results / "config.json").write_text(config.model_dump_json(indent=2))
    return results


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    calls: list[list[str]] = []

    def watch(command: list[str], results: Path, cores: int) -> int:
        calls.append(command[1:])
        overlays = map(Path, command[command.index("--configfile") + 1 :])
        calls.extend([path.read_text()] for path in overlays if path.exists())
        return 7

    monkeypatch.setattr(front_end, "_watch", watch)
    monkeypatch.setenv(YES, "")
    return calls


def test_snakemake_is_called_with_profile_and_overlays(campaign: Path, called: list[list[str]]) -> None:
    overlays, extra = [Path("a.yaml"), Path("b.yaml")], ["results/here/abc.h5", "--dry-run"]
    assert front_end.run(read_campaign(campaign), overlays, 3, extra) == 7
    assert called[0][:4] == ["--cores", "3", "--workflow-profile", "workflow/profiles/local"]
    assert called[0][4:6] == ["results/here/abc.h5", "--dry-run"]
    assert called[0][6:] == ["--configfile", "a.yaml", "b.yaml"]


def test_another_profile_says_how_many_cores_unless_they_are_given(
    campaign: Path, called: list[list[str]]
) -> None:
    front_end.resume(campaign, 0, ["--workflow-profile", "mine"])
    assert "--cores" not in called[0] and called[0][2:4] == ["--workflow-profile", "mine"]
    front_end.resume(campaign, 5, ["--workflow-profile", "mine"])
    assert called[2][:2] == ["--cores", "5"]
    front_end.resume(campaign, 0, [])
    assert called[4][:2] == ["--cores", str(front_end.default_cores())]


def test_resume_takes_the_configuration_of_the_last_run(campaign: Path, called: list[list[str]]) -> None:
    front_end.resume(campaign, 2, [])
    assert called[0][-2:] == ["--configfile", "results/here/config.json"]


def test_extend_raises_the_number_alone_and_leaves_the_record_to_the_start(
    campaign: Path, called: list[list[str]]
) -> None:
    recorded = (campaign / "config.json").read_text()
    front_end.extend(campaign, 5000, 2, [])
    before, given = json.loads(recorded), json.loads(called[1][0])
    assert given.pop("campaign") == before.pop("campaign") | {"n_samples": 5000}
    assert given == before
    assert [path.name for path in campaign.iterdir()] == ["config.json"]
    assert (campaign / "config.json").read_text() == recorded, "a start that has not begun changes nothing"
    with pytest.raises(ArtifactError, match="has 2483 samples already"):
        front_end.extend(campaign, 2483, 2, [])


@fault("Origin", "a campaign is extended while its images cannot be read", "their variable unset", quick=True)
def test_extend_without_the_images_changes_nothing(
    campaign: Path, called: list[list[str]], monkeypatch: pytest.MonkeyPatch, outcome: Outcome
) -> None:
    raw = json.loads((campaign / "config.json").read_text())
    bands = {
        band: {"science": "$NO_SUCH/a.fits", "psf": "$NO_SUCH/b.fits"} for band in raw["observation"]["bands"]
    }
    raw["observation"] |= {"kind": "fits", "fits": bands}
    (campaign / "config.json").write_text(json.dumps(raw))
    monkeypatch.delenv("NO_SUCH", raising=False)
    for start in (lambda: front_end.extend(campaign, 5000, 2, []), lambda: front_end.resume(campaign, 2, [])):
        with pytest.raises(ConfigError) as error:
            start()
        outcome.stops(str(error.value), "the environment variable NO_SUCH is not set")
    assert json.loads((campaign / "config.json").read_text()) == raw and not called
    assert [path.name for path in campaign.iterdir()] == ["config.json"]


@pytest.mark.parametrize(
    ("given", "yes", "handed_on"), [("", False, "ask"), ("", True, "1"), ("1", False, "1"), ("0", True, "1")]
)
def test_snakemake_is_told_whether_to_ask(
    campaign: Path,
    called: list[list[str]],
    monkeypatch: pytest.MonkeyPatch,
    given: str,
    yes: bool,
    handed_on: str,
) -> None:
    monkeypatch.setenv(YES, given)
    front_end.resume(campaign, 2, [], yes)
    assert os.environ[YES] == handed_on


def test_what_validate_says_is_printed_first(
    campaign: Path, called: list[list[str]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(preflight, "check_observation", lambda config: [f"checked for {config.results}"])
    front_end.resume(campaign, 2, [])
    assert capsys.readouterr().out.startswith("checked for results/here\n")


def test_moved_results_are_refused(campaign: Path, called: list[list[str]]) -> None:
    campaign.rename("elsewhere")
    with pytest.raises(ArtifactError, match="was started as results/here and now lies in elsewhere"):
        front_end.resume(Path("elsewhere"), 2, [])
    assert not called


def test_folders_that_are_not_right(campaign: Path, called: list[list[str]]) -> None:
    with pytest.raises(ArtifactError, match="no such file; is nowhere the results folder"):
        front_end.resume(Path("nowhere"), 2, [])
    Path("Snakefile").unlink()
    with pytest.raises(ArtifactError, match="has no Snakefile"):
        front_end.resume(campaign, 2, [])
    assert not called


def test_lock_of_unknown_owner_is_not_lifted(campaign: Path, called: list[list[str]]) -> None:
    Path(".snakemake/locks").mkdir(parents=True)
    Path(".snakemake/locks/0.output.lock").touch()
    with pytest.raises(LockedError):
        front_end.resume(campaign, 2, [])
    assert not called and Path(".snakemake/locks/0.output.lock").exists()


def test_a_lock_that_cannot_be_lifted_is_one_line(
    campaign: Path, called: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when a variable of the configuration is unset: Snakemake reads it before it lifts a lock."""
    for place in ("locks/0.output.lock", f"warmlens-runs/{socket.gethostname()}-17.json"):
        (Path(".snakemake") / place).parent.mkdir(parents=True)
        (Path(".snakemake") / place).touch()
    monkeypatch.setattr(front_end, "SNAKEMAKE", "false")
    with pytest.raises(LockedError, match="could not be lifted, as said above"):
        front_end.resume(campaign, 2, [])
    assert not called


def _watching(child: str, patience: float = 15.0) -> str:
    """A program that watches a child as `warmlens run` watches Snakemake; its exit code is the child's."""
    return (
        "import sys; from pathlib import Path; from warmlens.campaign import run as front_end; "
        f"front_end._REPORT_SECONDS = {patience}; "
        f"sys.exit(front_end._watch([sys.executable, '-c', {child!r}], Path('results/here'), 1))"
    )


def test_sigterm_is_handed_on_and_the_exit_code_comes_back(tmp_path: Path) -> None:
    child = (
        "import signal, sys, time; signal.signal(15, lambda *_: sys.exit(5)); "
        "print('up', flush=True); time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", _watching(child)], stdout=subprocess.PIPE, text=True, cwd=tmp_path
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "up\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=30) == 5
        assert "stopping: no more jobs are started" in process.stdout.read()


def test_interrupt_is_waited_for_and_says_how_to_go_on(tmp_path: Path) -> None:
    """Ctrl-C goes to the whole group of processes: Snakemake ends its jobs, and the front end outlives it."""
    child = (
        "import signal, sys, time; signal.signal(2, lambda *_: (time.sleep(1), sys.exit(6))); "
        "print('up', flush=True); time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", _watching(child)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "up\n"
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(timeout=30) == 6
        assert "`warmlens resume results/here` goes on" in process.stdout.read()


def test_progress_is_printed_when_it_changes_and_a_damaged_artifact_ends_nothing(campaign: Path) -> None:
    (campaign / "observation.h5").write_bytes(b"no HDF5")
    done = subprocess.run(
        [sys.executable, "-c", _watching("import time, sys; time.sleep(4); sys.exit(3)", patience=0.1)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 3, done.stderr
    said = done.stdout.splitlines()
    assert (
        len(said) == 1
        and "progress is not known: results/here/observation.h5: not a readable HDF5 file" in said[0]
    )


def test_times_in_the_future_are_brought_back(campaign: Path, called: list[list[str]]) -> None:
    future, past = campaign / "halos.h5", campaign / "mocks.h5"
    for path, seconds in ((future, 86400.0), (past, -86400.0)):
        path.touch()
        os.utime(path, (time.time() + seconds,) * 2)
    before = past.stat().st_mtime
    front_end.resume(campaign, 2, [])
    assert called and future.stat().st_mtime <= time.time() and past.stat().st_mtime == before
