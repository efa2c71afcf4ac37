# Configuration, paths and what every rule shares.
import os
import shlex
import sys
from pathlib import Path

from snakemake.exceptions import WorkflowError

from warmlens import runtime
from warmlens.artifacts import atomic_path, canonical_json
from warmlens.config_file import ConfigError, parse_config
from warmlens.layout import CONFIG, FIGURE_VERSION, FIGURES, NUMBERS, SINGLE, TABLE, stage_files
from warmlens.stages.settings import STAGES, stage_settings

# Jobs run the `warmlens` that belongs to this Snakemake, one thread each.
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
runtime.prepare()

try:
    CAMPAIGN = parse_config(config)
except ConfigError as error:
    raise WorkflowError(f"the configuration has {len(error.problems)} problem(s):\n{error}") from None


wildcard_constraints:
    start=r"\d{7}",
    stop=r"\d{7}",


def results(name):
    return f"{CAMPAIGN.results}/{name}"


def single(stage):
    return results(SINGLE[stage])


def chunk(stage):
    return results(f"{stage}/chunk-{{start}}-{{stop}}.h5")


def all_chunks(stage):
    return [str(path) for path in stage_files(CAMPAIGN, stage)]


def settings(stage):
    # just what changes the numbers of this stage: a change reruns this stage and what depends on it
    return canonical_json(stage_settings(CAMPAIGN, stage).as_dict())


def repeated(option, paths):
    return " ".join(f"--{option} {shlex.quote(str(path))}" for path in paths)


onstart:
    with atomic_path(Path(results(CONFIG))) as temporary:
        temporary.write_text(CAMPAIGN.model_dump_json(indent=2))
    print(f"What is done, what is left and how long: warmlens status {CAMPAIGN.results}")


onsuccess:
    if Path(single("abc")).exists():
        shell(f"warmlens result {shlex.quote(CAMPAIGN.results)}")


onerror:
    print(f"Finished artifacts are kept. `warmlens status {CAMPAIGN.results}` shows what is done and what failed;")
    print("start the same command again to go on from there.")
