"""`warmlens systematics`: campaigns with one change each, on the same observation, and how bound and scan move."""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError
from rich.console import Console
from rich.markup import escape

from warmlens.artifacts.atomic import ArtifactError, atomic_path
from warmlens.artifacts.chain import audit
from warmlens.artifacts.names import SINGLE
from warmlens.campaign.answer import check_chain
from warmlens.campaign.branch import StageBranch, branch
from warmlens.campaign.files import resolve_window, stage_files
from warmlens.campaign.run import lift_abandoned_lock
from warmlens.campaign.snakemake import SNAKEMAKE, arguments
from warmlens.campaign.start import YES
from warmlens.config.file import ConfigError, load_config, merge
from warmlens.config.model import Config
from warmlens.config.types import Block, Name, ResultsFolder
from warmlens.config.yaml import read_yaml
from warmlens.stage_table import campaign_stages, stage_digests
from warmlens.systematics import table
from warmlens.text import Terminal, duration

CONFIG = Path("config.yaml")
OVERLAY, LOG, BASE = "overlay.yaml", "systematics.log", "base"


class VariantBlock(Block):
    """One change of the base campaign."""

    group: str
    description: str
    overlay: dict[str, Any]
    bound: bool = True


class SystematicsBlock(Block):
    """The base campaign and its variants."""

    base: list[str]
    results: ResultsFolder
    variants: dict[Name, VariantBlock]


def run(path: Path, cores: int, base_overlays: Sequence[Path] = ()) -> None:
    """Run the base campaign and the variants of a `SystematicsBlock` in YAML; write table and figure.

    What is finished is kept. `base_overlays` replace those that the file names for the base campaign; table and
    variants then go to RESULTS_systematics.

    Raises
    ------
    ConfigError
        With one line per problem, before anything is run.
    ArtifactError
        If the base campaign fails, or its artifacts are not what they should be.
    """
    block = read_systematics(path)
    layers = [CONFIG, *(base_overlays or (Path(name) for name in block.base))]
    base = load_config(layers)
    if base_overlays:
        block = block.model_copy(update={"results": f"{base.results}_{table.NAME}"})
    folder = Path(block.results)
    overlays = write_overlays(block, base)
    configs = _load_variants(layers, overlays)
    console = Terminal()
    started = time.monotonic()
    console.print(f"base campaign: {base.results}", markup=False)
    if reason := _snakemake(base, layers[1:], "abc", cores, folder / f"{BASE}.log"):
        raise ArtifactError(f"the base campaign {base.results} failed: {reason}")
    check_chain(resolve_window(base), stage_files(base, "abc"))
    numbers = table.read_numbers(base, None, bound=True)
    rows = [table.Row(BASE, BASE, "the campaign that the others differ from", **numbers)]
    for number, (name, variant) in enumerate(block.variants.items(), start=1):
        elapsed = duration(time.monotonic() - started)
        console.print(f"[bold]variant {number} of {len(block.variants)}: {name}[/], {elapsed} so far")
        numbers = _run_variant(variant, configs[name], base, [*layers[1:], overlays[name]], cores, console)
        rows.append(table.Row(name, variant.group, variant.description, **numbers))
        table.write_table(folder, [*rows, *table.prior_rows(base)])
    rows += table.prior_rows(base)
    table.write_table(folder, rows)
    table.draw_table(folder, rows)
    console.print(f"{len(block.variants)} variants in {duration(time.monotonic() - started)}")
    table.print_table(rows, console)
    console.print(f"table and figure: {folder / table.NAME}.csv, .json, .png", markup=False)


def read_systematics(path: Path) -> SystematicsBlock:
    """Read and check the file of variants."""
    try:
        return SystematicsBlock.model_validate(read_yaml(path))
    except ValidationError as error:
        problems = [(".".join(map(str, problem["loc"])), problem["msg"]) for problem in error.errors()]
        raise ConfigError([f"{path}: {key}: {message}" for key, message in problems]) from None


def write_overlays(block: SystematicsBlock, base: Config) -> dict[str, Path]:
    """Write each variant's overlay with a results folder of its own and the base's observation."""
    observed = {"kind": "artifact", "artifact": str(Path(base.results) / SINGLE["observation"])}
    paths = {}
    for name, variant in block.variants.items():
        folder = Path(block.results) / name
        paths[name] = folder / OVERLAY
        layer = merge(variant.overlay, {"results": str(folder), "observation": observed})
        with atomic_path(paths[name]) as temporary:
            temporary.write_text(yaml.safe_dump(layer, sort_keys=False), encoding="utf-8")
    return paths


def _load_variants(layers: Sequence[Path], overlays: Mapping[str, Path]) -> dict[str, Config]:
    configs, problems = {}, []
    for name, overlay in overlays.items():
        try:
            configs[name] = load_config([*layers, overlay])
        except ConfigError as error:
            problems += [f"variant {name}: {problem}" for problem in error.problems]
    if problems:
        raise ConfigError(problems)
    return configs


def _run_variant(
    variant: VariantBlock, config: Config, base: Config, overlays: Sequence[Path], cores: int, console: Console
) -> dict[str, Any]:
    """Branch a variant from the base and run it; return the fields of its `Row`."""
    started = time.monotonic()
    last = "abc" if variant.bound else "observed_summary"
    try:
        _print_state(branch(Path(base.results), config, yes=True), last, console)  # variants follow their file
        log = Path(config.results) / LOG
        reason = _snakemake(config, overlays, last, cores, log, yes=True) or _audit(config, last)
    except ArtifactError as error:
        reason = str(error)
    if reason:
        console.print(f"  [bold red]failed[/] after {duration(time.monotonic() - started)}: {escape(reason)}")
        return {"state": table.FAILED, "reason": reason, **table.read_numbers_of_failed(config, base)}
    console.print(f"  done in {duration(time.monotonic() - started)}")
    return table.read_numbers(config, base, bound=variant.bound)


def _print_state(stages: Sequence[StageBranch], last: str, console: Console) -> None:
    names = [stage.stage for stage in stages]
    wanted = stages[: names.index(last) + 1] if last in names else stages
    n_there, n_files = sum(s.n_linked + s.n_there for s in wanted), sum(s.n_files for s in wanted)
    left = ", ".join(stage.stage for stage in wanted if not stage.complete)
    console.print(f"  {n_there} of {n_files} artifacts are there" + (f"; to make: {left}" if left else ""))


def _snakemake(
    config: Config, overlays: Sequence[Path], stage: str, cores: int, log: Path, yes: bool = False
) -> str:
    """Run the workflow up to a stage, its output in `log`; return why it failed, "" if it did not."""
    lift_abandoned_lock(Path(), overlays)
    command = [SNAKEMAKE, *arguments(cores, overlays, [str(stage_files(config, stage)[0])])]
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = os.environ | ({YES: "1"} if yes else {})
    with log.open("w", encoding="utf-8") as handle:
        done = subprocess.run(command, stdout=handle, stderr=subprocess.STDOUT, env=environment, check=False)
    return "" if done.returncode == 0 else last_words(log)


def last_words(log: Path) -> str:
    """Return the last message of a failed run, that of the stage that failed if there is one."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", log.read_text(encoding="utf-8", errors="replace"))
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    own = [line.partition("warmlens: ")[2] for line in lines if line.startswith("warmlens: ")]
    return own[-1] if own else f"{lines[-1] if lines else 'Snakemake said nothing'} (see {log})"


def _audit(config: Config, last: str) -> str:
    """Return the first problem of the finished artifacts, "" if there is none."""
    stages = campaign_stages(config)
    files = {path: stage for stage in stages[: stages.index(last) + 1] for path in stage_files(config, stage)}
    findings = audit(files, stage_digests(config))
    return f"audit: {findings[0].path}: {findings[0].problem}" if findings else ""
