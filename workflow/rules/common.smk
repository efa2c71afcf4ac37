# Configuration, paths and what every rule shares.
import atexit
import os
import shlex
import sys
import time
from pathlib import Path

from snakemake.exceptions import WorkflowError

from warmlens import runtime
from warmlens.artifacts.atomic import ArtifactError, atomic_path
from warmlens.artifacts.names import (
    ANSWER_FILES,
    CONFIG,
    CRATE,
    FIGURE_VERSION,
    FILES,
    LEDGER,
    MANIFEST,
    MANIFEST_VERSION,
    REPORT,
    REPORT_VERSION,
    SETTINGS,
)
from warmlens.campaign import locks
from warmlens.campaign.derived import REPORT_LEDGER, derived_files, drawn_groups, figure_inputs, ledgers
from warmlens.campaign.files import artifact_files, note_name, resolve_window, stage_inputs
from warmlens.campaign.settings import LISTED, write_settings
from warmlens.campaign.start import check_consent, compare_present, order_times, write_started
from warmlens.campaign.status import failure_lines, note_ended
from warmlens.config.digest import canonical_json, settings_digest
from warmlens.config.file import ConfigError, parse_config
from warmlens.config.yaml import read_yaml
from warmlens.products.time_limit import SAMPLE_SECONDS
from warmlens.stage_table import STAGES, answer_memory_mb, campaign_stages, stage_settings

# Jobs run the `warmlens` that belongs to this Snakemake, one thread each.
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
runtime.prepare()

if not Path("config.yaml").is_file():
    raise WorkflowError(
        f"{Path.cwd()}: no config.yaml; start in the folder that holds it, without --directory: "
        "the key `results` says where results go"
    )

try:
    for path in workflow.configfiles:
        read_yaml(Path(path))  # refuses what Snakemake lets pass, such as a key given twice
    CAMPAIGN = resolve_window(parse_config(config))
except ConfigError as error:
    raise WorkflowError(f"the configuration has {len(error.problems)} problem(s):\n{error}") from None

ARTIFACTS = artifact_files(CAMPAIGN)
ANSWER = campaign_stages(CAMPAIGN)[-1]  # abc, or exclusion on a grid, which has no posterior to draw
DRAWN = drawn_groups(CAMPAIGN)
FORCED = set()  # artifacts that do not fit the configuration, whatever Snakemake knows of them

if workflow.is_main_process:
    try:
        PRESENT = compare_present(CAMPAIGN)
        if n_changed := order_times(PRESENT):
            print(f"{n_changed} finished files were older than what they were made from: times set", file=sys.stderr)
    except (ArtifactError, ConfigError) as error:
        raise WorkflowError(str(error)) from None
    FORCED.update(map(str, PRESENT.to_make))
    for line in filter(None, (PRESENT.describe(), PRESENT.describe_derived())):
        print(line, file=sys.stderr)


wildcard_constraints:
    start=r"\d{7}",
    stop=r"\d{7}",


def results(name):
    return f"{CAMPAIGN.results}/{name}"


# What a rule of a stage consists of. The table of stages says what it reads, writes and depends on.


def inputs(stage):
    def of_job(wildcards):
        if FORCED:  # as --forcerun does, which would add them to the targets
            workflow.dag.forcefiles.update(FORCED)
            FORCED.clear()
        span = (int(wildcards.start), int(wildcards.stop)) if "{span}" in STAGES[stage].output else None
        return {
            name: str(paths) if isinstance(paths, Path) else [str(path) for path in paths]
            for name, paths in stage_inputs(CAMPAIGN, stage, span).items()
        }

    return of_job


def output(stage):
    return results(STAGES[stage].output.format(span="{start}-{stop}"))


def settings(stage):
    # just what changes the numbers of this stage: a change reruns this stage and what depends on it
    return canonical_json(stage_settings(CAMPAIGN, stage).as_dict())


def note(folder, stage):
    # a file for people beside the artifact of a job: logs/halos/0000000-0000250.log
    return results(note_name(stage, folder, "{start}-{stop}"))


def input_words(wildcards, input):
    # thousands of chunks do not fit into a command line: those that are read together stand in a file
    lists = {name: f"@{results(FILES.format(stage=source))}" for name, source in LISTED.items()}
    pairs = ((name, lists.get(name, path)) for name, path in input.items())
    return " ".join(f"--input {name}={shlex.quote(path)}" for name, path in pairs)


TIMED = "--sample-seconds {resources.sample_seconds}"


def command(stage, *options):
    row = STAGES[stage]
    words = [f"warmlens stage {stage} --settings {shlex.quote(results(SETTINGS.format(stage=stage)))}"]
    words += ["--span {wildcards.start} {wildcards.stop}"] if row.needs_span else []
    words += ["{params.inputs}"] if row.inputs else []
    return " ".join([*words, "--output {output[0]:q}", *options, "> {log:q} 2>&1"])


def pictures(names):
    return [results(f"figures/{name}.{kind}") for name in names for kind in ("png", "csv")]


def unique(paths):
    return list(dict.fromkeys(str(path) for path in paths))


def print_failures(started):
    if workflow.scheduler is None:
        return
    failed = [job for each in workflow.scheduler.failed for job in (each if each.is_group() else [each])]
    note_ended([Path(log) for job in failed for log in job.log])
    for line in failure_lines(CAMPAIGN, started) if failed else []:
        print(line, file=sys.stderr)


onstart:
    try:
        locks.begin(Path(), Path(CAMPAIGN.results))
        if not workflow.touch:
            check_consent(PRESENT, {str(path) for job in workflow.dag.needrun_jobs() for path in job.output})
    except (ArtifactError, locks.LockedError) as error:
        locks.end(Path(), Path(CAMPAIGN.results))
        sys.exit(f"warmlens: {error}")  # as the last line
    with atomic_path(Path(results(CONFIG))) as temporary:
        temporary.write_text(CAMPAIGN.model_dump_json(indent=2), encoding="utf-8")
    write_settings(CAMPAIGN)
    write_started(PRESENT)
    atexit.register(print_failures, time.time())  # the last lines: Snakemake has some after `onerror`
    print(f"What is done, what is left and how long: warmlens status {CAMPAIGN.results}")


onsuccess:
    locks.end(Path(), Path(CAMPAIGN.results))
    if Path(results(STAGES[ANSWER].output)).exists():
        shell(f"warmlens result {shlex.quote(CAMPAIGN.results)} || true")  # of part of a run there may be none


onerror:
    locks.end(Path(), Path(CAMPAIGN.results))
    print(f"Finished artifacts are kept. `warmlens status {CAMPAIGN.results}` shows what is done and what failed;")
    print("start the same command again to go on from there.")
