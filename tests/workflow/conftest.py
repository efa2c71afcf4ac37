"""Small campaigns in folders of their own, run by Snakemake as a user runs it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import REPORT
from warmlens.campaign.start import YES

from ..shared import shared_folder
from . import forked

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent

TINY: dict[str, Any] = {
    "results": "results/tiny",
    "campaign": {"n_samples": 14, "chunk_size": 7},
    "halos": {"preset": "calibrated", "field_half_width_arcsec": 3.8, "min_mass_msun": 1.0e8},
    "observation": {
        "simulated": {
            "shape": [96, 96],
            "psf_pixels": 31,
            "source": {"n_clumps": 4, "clump_sigma_arcsec": [0.09, 0.14]},
        }
    },
    "smooth_model": {"mode": "given", "allow_poor_fit": True, "source": {"n_max": 8, "clumps": None}},
    "scan": {"marginalise_lens": False, "step_arcsec": 0.3, "window_arcsec": [4.2, 4.2], "shard_size": 100},
    "summaries": {"max_separation_arcsec": 2.4},
    "null_test": {"n_mocks": 3},
    "abc": {"fraction": 0.3, "bootstrap": 100},
}
N_CHUNKED_STAGES = 5
COMPILING = "results/tiny/scans/chunk-0000000-0000007.h5"  # that and what it is made from compile the kernels


@dataclass(frozen=True)
class Project:
    """A working folder with the workflow in it."""

    folder: Path

    @property
    def results(self) -> Path:
        return self.folder / "results/tiny"

    def configure(self, *layers: dict[str, Any]) -> None:
        for number, layer in enumerate((TINY, *layers)):
            (self.folder / f"overlay-{number}.yaml").write_text(yaml.safe_dump(layer))

    def command(self, *arguments: str, cores: int = 2) -> list[str]:
        overlays = sorted(str(path) for path in self.folder.glob("overlay-*.yaml"))
        profile = ["--workflow-profile", "workflow/profiles/local", "--cores", str(cores)]
        return [str(BIN / "snakemake"), *arguments, *profile, "--configfile", *overlays]

    def snakemake(
        self, *arguments: str, cores: int = 2, check: bool = True, yes: bool = False
    ) -> subprocess.CompletedProcess[str]:
        """Run Snakemake; with `yes`, artifacts that do not fit the configuration are discarded."""
        environment = {**os.environ, "NO_COLOR": "1", YES: "1" if yes else ""}
        done = forked.run(self.command(*arguments, cores=cores), self.folder, environment)
        if check and done.returncode:
            raise AssertionError(f"snakemake failed:\n{done.stdout}\n{done.stderr}")
        return done

    def planned(self, *arguments: str) -> dict[str, int]:
        """Jobs that a dry run lists, by rule; nothing is run."""
        lines = self.snakemake(*arguments, "--dry-run", "--quiet", "rules").stdout.splitlines()
        jobs: dict[str, int] = {}
        for line in lines:
            words = line.split()
            if len(words) == 2 and words[1].isdigit() and words[0] not in ("total", "job"):
                jobs[words[0]] = int(words[1])
        return jobs

    def warmlens(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(BIN / "warmlens"), *arguments],
            cwd=self.folder,
            capture_output=True,
            text=True,
            check=False,
        )

    def digests(self) -> dict[str, str]:
        found = {}
        for path in sorted(self.results.rglob("*.h5")):
            with open_artifact(path) as artifact:
                found[str(path.relative_to(self.results))] = artifact.digest
        return found


def make_project(folder: Path) -> Project:
    for name in ("Snakefile", "workflow", "config.yaml"):
        (folder / name).symlink_to(ROOT / name)
    project = Project(folder)
    project.configure()
    return project


def finished_campaign(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """The finished campaign of a test run: the first process that asks for it runs it, the others wait."""
    with shared_folder(tmp_path_factory, "finished") as folder:
        project = Project(folder)
        if not any(folder.iterdir()):
            make_project(folder)
        if not (project.results / REPORT).exists():
            project.snakemake(COMPILING, cores=1)  # or two jobs at a time would each compile the same
            project.snakemake(cores=2)
    return project


@pytest.fixture
def project(tmp_path: Path) -> Project:
    """An empty project."""
    return make_project(tmp_path)


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """A campaign that has run on two cores, figures and all; read it, do not change it."""
    return finished_campaign(tmp_path_factory)


@pytest.fixture
def copy_of(finished: Project, tmp_path: Path) -> Callable[[], Project]:
    """A copy of the finished campaign that a test may change, times and Snakemake's records kept."""

    def copy() -> Project:
        subprocess.run(["cp", "-a", f"{finished.folder}/.", str(tmp_path)], check=True)
        return Project(tmp_path)

    return copy
