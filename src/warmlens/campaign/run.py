"""`warmlens run | resume | extend`: Snakemake with the flags that a campaign needs, and the time that is left."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from warmlens.artifacts.atomic import ArtifactError, atomic_path
from warmlens.artifacts.names import CONFIG, EXTENDED
from warmlens.campaign import locks
from warmlens.campaign.locks import LockedError
from warmlens.campaign.snakemake import SNAKEMAKE, arguments, recorded_results
from warmlens.campaign.start import ASK, YES
from warmlens.campaign.status import campaign_status, progress_line, read_campaign
from warmlens.config.file import ConfigError, parse_config
from warmlens.config.model import Config

_REPORT_SECONDS = 15.0
_POLL_SECONDS = 0.2


def run(config: Config, overlays: Sequence[Path], cores: int, extra: Sequence[str], yes: bool = False) -> int:
    """Run Snakemake on config.yaml and overlays in this folder; return its exit code.

    Parameters
    ----------
    config
        What they say, for checks and for the progress.
    overlays
        Configuration files, later ones win.
    cores
        Jobs at a time; 0: all cores of this machine, or what a profile among `extra` says.
    extra
        Targets and flags, which go to Snakemake as they are.
    yes
        Whether finished artifacts that do not fit are discarded without asking.

    Raises
    ------
    ArtifactError
        If this is not the folder of the workflow.
    ConfigError
        If the images cannot be used.
    LockedError
        If another Snakemake is at work here, or may be.
    """
    folder, results = Path(), Path(config.results)
    if not (folder / "Snakefile").is_file():
        raise ArtifactError(f"{folder.resolve()}: has no Snakefile; run this in the folder of warmlens")
    lift_abandoned_lock(folder, overlays)
    from warmlens.campaign.preflight import check_observation  # what reads images takes a second to load

    for line in check_observation(config):
        print(line, flush=True)
    bring_back_from_the_future(results)
    own_profile = any(word.startswith("--workflow-profile") for word in extra)
    size = None if own_profile and not cores else cores or default_cores()
    # Snakemake asks, once it knows what it would make
    os.environ[YES] = "1" if yes else os.environ.get(YES) or ASK
    return _watch([SNAKEMAKE, *arguments(size, overlays, extra)], results, cores or default_cores())


def resume(results: Path, cores: int, extra: Sequence[str], yes: bool = False) -> int:
    """Go on with a campaign as it was last started; return Snakemake's exit code."""
    config = parse_config(_read_own(results))
    return run(config, [results / CONFIG], cores, extra, yes)


def extend(results: Path, n_samples: int, cores: int, extra: Sequence[str], yes: bool = False) -> int:
    """Raise the number of samples of a campaign and go on with it; return Snakemake's exit code.

    The campaign has the new number as soon as it has started.

    Raises
    ------
    ArtifactError
        If it has as many already.
    """
    path = results / CONFIG
    raw = _read_own(results)
    present = raw["campaign"]["n_samples"]
    if n_samples <= present:
        raise ArtifactError(f"{path}: the campaign has {present} samples already; extend takes the new total")
    raw["campaign"]["n_samples"] = n_samples
    config = parse_config(raw)
    overlay = results / EXTENDED
    with atomic_path(overlay) as temporary:
        temporary.write_text(json.dumps(raw, indent=2), encoding="utf-8")
    try:
        return run(config, [overlay], cores, extra, yes)
    finally:
        overlay.unlink(missing_ok=True)


def lift_abandoned_lock(folder: Path, overlays: Sequence[Path]) -> None:
    """Lift the lock that a killed Snakemake left in its working folder.

    Raises
    ------
    LockedError
        If it is not certain that its owner is gone.
    """
    if locks.is_locked(folder):
        locks.check_abandoned(folder)
        command = [SNAKEMAKE, *arguments(1, overlays), "--unlock", "--quiet"]
        if subprocess.run(command, cwd=folder, check=False).returncode:
            raise LockedError(f"{folder.resolve()}: the lock of a killed run could not be lifted, as said above")
        print("the last run was killed; its lock is lifted, what it had finished is kept", flush=True)
    locks.forget_gone(folder)


def bring_back_from_the_future(results: Path) -> None:
    """Give files that are newer than now, as after a clock was set back, the present time.

    Snakemake would take everything that is computed now from such a file for outdated, and fail.
    """
    now = time.time()
    future = [path for path in results.rglob("*") if path.is_file() and path.stat().st_mtime > now]
    for path in future:
        os.utime(path, (now, now))
    if future:
        print(f"{len(future)} files in {results} had times in the future (a clock set back?), now the present one")


def default_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def _read_own(results: Path) -> dict[str, Any]:
    """Return the configuration of the campaign in `results`, which must lie where its configuration says.

    In a folder that was moved Snakemake would start from nothing at the old place.
    """
    read_campaign(results)
    recorded = recorded_results(results)
    if recorded.resolve() != results.resolve():
        raise ArtifactError(
            f"{results / CONFIG}: the campaign was started as {recorded} and now lies in {results}; move it back, "
            "start from the folder that it was started from, or change `results` in that file"
        )
    raw: dict[str, Any] = json.loads((results / CONFIG).read_text(encoding="utf-8"))
    return raw


def _watch(command: Sequence[str], results: Path, cores: int) -> int:
    """Run a command, print the progress of the campaign now and then, and hand signals on."""

    def stop(number: int, _: FrameType | None) -> None:
        process.send_signal(number)
        say("no more jobs are started, those that run are finished first")

    def interrupted(*_: object) -> None:
        say("the jobs that run are stopped, finished artifacts are kept")

    def say(what_happens: str) -> None:
        print(f"stopping: {what_happens}; `warmlens resume {results}` goes on from there", flush=True)

    with subprocess.Popen(command) as process:  # whatever happens here, Snakemake is waited for
        handlers: dict[int, Callable[..., None]] = {signal.SIGTERM: stop, signal.SIGHUP: stop}
        # Ctrl-C reaches Snakemake and its jobs from the terminal; Snakemake waits for their end, and so does this.
        handlers[signal.SIGINT] = interrupted
        before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
        try:
            _print_progress(process, results, cores)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
    return process.returncode


def _print_progress(process: subprocess.Popen[bytes], results: Path, cores: int) -> None:
    """Until a process ends, print the progress of the campaign whenever it has changed."""
    printed, last = "", time.monotonic()
    while process.poll() is None:
        time.sleep(_POLL_SECONDS)
        if time.monotonic() - last > _REPORT_SECONDS and (results / CONFIG).is_file():
            try:
                line = progress_line(campaign_status(read_campaign(results)), cores)
            except (ArtifactError, ConfigError) as error:  # ends nothing: the run itself may mend it
                line = f"the progress is not known: {error}"
            if line != printed:
                print(line, flush=True)
            printed, last = line, time.monotonic()
