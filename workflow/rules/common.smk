# Configuration, paths and what every rule shares.
import os
import shlex
import sys
from pathlib import Path

from snakemake.exceptions import WorkflowError

from warmlens import runtime
from warmlens.campaign import locks
from warmlens.artifacts.file import ArtifactError, atomic_path, canonical_json, settings_digest
from warmlens.campaign.records import check_unrecorded
from warmlens.config.file import ConfigError, parse_config
from warmlens.config.yaml import read_yaml
from warmlens.figures.inputs import drawn_groups, figure_inputs
from warmlens.artifacts.names import (
    ANSWER_FILES,
    CONFIG,
    CRATE,
    EXCLUSION_NUMBERS,
    EXCLUSION_TABLE,
    FIGURE_VERSION,
    MANIFEST,
    MANIFEST_VERSION,
    NUMBERS,
    REPORT,
    REPORT_VERSION,
    SINGLE,
    TABLE,
)
from warmlens.campaign.files import stage_files
from warmlens.audit.manifest import derived_files
from warmlens.campaign.settings import campaign_stages, stage_digests, stage_settings
from warmlens.products.time_limit import SAMPLE_SECONDS

# Jobs run the `warmlens` that belongs to this Snakemake, one thread each.
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
runtime.prepare()

try:
    for path in workflow.configfiles:
        read_yaml(Path(path))  # refuses what Snakemake lets pass, such as a key given twice
    CAMPAIGN = parse_config(config)
except ConfigError as error:
    raise WorkflowError(f"the configuration has {len(error.problems)} problem(s):\n{error}") from None

CAMPAIGN_STAGES = campaign_stages(CAMPAIGN)
ANSWER = CAMPAIGN_STAGES[-1]  # abc, or exclusion on a grid, which has no posterior to draw
DRAWN = drawn_groups(CAMPAIGN)


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


def pictures(names):
    return [results(f"figures/{name}.{kind}") for name in names for kind in ("png", "csv")]


def unique(paths):
    return list(dict.fromkeys(str(path) for path in paths))


def repeated(option, paths):
    return " ".join(f"--{option} {shlex.quote(str(path))}" for path in paths)


if workflow.is_main_process:
    try:
        check_unrecorded(
            {path: stage for stage in CAMPAIGN_STAGES for path in stage_files(CAMPAIGN, stage)},
            stage_digests(CAMPAIGN),
            Path(),
        )
    except (ArtifactError, ConfigError) as error:
        raise WorkflowError(str(error)) from None


onstart:
    try:
        locks.begin(Path(), Path(CAMPAIGN.results))
    except (ArtifactError, locks.LockedError) as error:
        raise WorkflowError(str(error)) from None
    with atomic_path(Path(results(CONFIG))) as temporary:
        temporary.write_text(CAMPAIGN.model_dump_json(indent=2))
    print(f"What is done, what is left and how long: warmlens status {CAMPAIGN.results}")


onsuccess:
    locks.end(Path(), Path(CAMPAIGN.results))
    if Path(single(ANSWER)).exists():
        shell(f"warmlens result {shlex.quote(CAMPAIGN.results)}")


onerror:
    locks.end(Path(), Path(CAMPAIGN.results))
    print(f"Finished artifacts are kept. `warmlens status {CAMPAIGN.results}` shows what is done and what failed;")
    print("start the same command again to go on from there.")
