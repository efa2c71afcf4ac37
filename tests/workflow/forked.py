"""A program of the environment in a process that has Snakemake imported: two thirds of the time of a dry run.

The process is forked from one that has done nothing but import, and is like any other otherwise: it has a folder,
arguments and an environment of its own, and an exit code.
"""

from __future__ import annotations

import atexit
import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload(["snakemake.cli", "snakemake.report"])


def run(command: Sequence[str], folder: Path, environment: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    """Run a Python script, as `subprocess.run` does with its output captured.

    Parameters
    ----------
    command
        Path of the script, and its arguments.
    folder
        Working folder.
    environment
        All its variables.
    """
    with tempfile.TemporaryDirectory() as scratch:
        outputs = Path(scratch) / "stdout", Path(scratch) / "stderr"
        task = {"COMMAND": list(command), "FOLDER": folder, "ENVIRONMENT": dict(environment), "OUTPUTS": outputs}
        # this file by its path: it has no name that another process could import it by
        process = _SERVER.Process(target=runpy.run_path, args=(__file__, task, "child"))
        process.start()
        process.join()
        assert process.exitcode is not None
        return subprocess.CompletedProcess(command, process.exitcode, *(path.read_text() for path in outputs))


def _become(command: Sequence[str], folder: Path, environment: Mapping[str, str], outputs: Sequence[Path]) -> None:
    for number, path in enumerate(outputs, start=1):
        os.dup2(os.open(path, os.O_CREAT | os.O_WRONLY), number)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = list(command)
    try:
        runpy.run_path(command[0], run_name="__main__")
    finally:
        atexit._run_exitfuncs()  # which multiprocessing leaves out


if __name__ == "child":
    _become(COMMAND, FOLDER, ENVIRONMENT, OUTPUTS)  # type: ignore[name-defined]  # noqa: F821
