"""Command line: `warmlens STAGE` for the workflow; `validate`, `status`, `audit`, `params` for people."""

from __future__ import annotations

import json
import logging
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from warmlens import runtime

if TYPE_CHECKING:
    from warmlens.config import Config

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help=__doc__)

Params = Annotated[str, typer.Option(help="Settings of the stage as JSON; see `warmlens params`.")]
Output = Annotated[Path, typer.Option(help="Artifact to write.")]
SpanOption = Annotated[tuple[int, int], typer.Option(help="First, and last + 1, of what to compute.")]
Input = Annotated[Path, typer.Option(help="Artifact of that stage.")]
Inputs = Annotated[list[Path], typer.Option(help="Artifacts of that stage; repeat the option.")]
ConfigFiles = Annotated[
    Optional[list[Path]],  # noqa: UP045 (typer reads the annotation at run time)
    typer.Option("--configfile", help="Overlays on config.yaml, later ones win."),
]
Artifacts = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option(help="stage=path of an input; repeat the option."),
]
Results = Annotated[Path, typer.Argument(help="Results folder of a campaign.")]
Cores = Annotated[int, typer.Option(help="Jobs at a time; 0: all cores.")]
_PASSED_ON = {"allow_extra_args": True}  # to Snakemake


@app.command()
def observation(params: Params, output: Output) -> None:
    """Read the FITS images, or make the simulated observation."""
    from warmlens.stages import observation as stage
    from warmlens.stages.settings import ObservationSettings

    stage.run(ObservationSettings.model_validate(json.loads(params)), output)


@app.command()
def smooth_model(params: Params, observation: Input, output: Output) -> None:
    """Fit the amplitudes of the smooth model."""
    from warmlens.stages import smooth_model as stage
    from warmlens.stages.settings import SmoothModelSettings

    stage.run(SmoothModelSettings.model_validate(json.loads(params)), observation, output)


@app.command()
def scan_design(params: Params, observation: Input, smooth_model: Input, output: Output) -> None:
    """Build what all shards of the scan operator share."""
    from warmlens.stages import scan_operator as stage
    from warmlens.stages.settings import ScanSettings

    settings = ScanSettings.model_validate(json.loads(params))
    stage.run_design(settings, observation, smooth_model, output)


@app.command()
def scan_operator(
    params: Params, span: SpanOption, observation: Input, smooth_model: Input, design: Input, output: Output
) -> None:
    """Build the scan operator of a span of positions."""
    from warmlens.stages import scan_operator as stage
    from warmlens.stages.settings import ScanSettings

    settings = ScanSettings.model_validate(json.loads(params))
    stage.run(settings, span, observation, smooth_model, design, output)


@app.command()
def observed_scan(
    params: Params, observation: Input, smooth_model: Input, design: Input, shard: Inputs, output: Output
) -> None:
    """Scan the observation."""
    from warmlens.stages import scans as stage
    from warmlens.stages.settings import ScanSettings

    settings = ScanSettings.model_validate(json.loads(params))
    stage.run_observed(settings, observation, smooth_model, design, shard, output)


@app.command()
def observed_summary(params: Params, observed_scan: Input, output: Output) -> None:
    """Summarise the scan of the observation."""
    from warmlens.stages import summaries as stage
    from warmlens.stages.settings import SummariesSettings

    stage.run_observed(SummariesSettings.model_validate(json.loads(params)), observed_scan, output)


@app.command()
def halos(params: Params, span: SpanOption, output: Output) -> None:
    """Draw the halo realizations of a chunk."""
    from warmlens.stages import halos as stage
    from warmlens.stages.settings import HalosSettings

    stage.run(HalosSettings.model_validate(json.loads(params)), span, output)


@app.command()
def deflections(params: Params, halos: Input, observation: Input, output: Output) -> None:
    """Compute the filtered deflections of a chunk."""
    from warmlens.stages import deflections as stage
    from warmlens.stages.settings import DeflectionsSettings

    stage.run(DeflectionsSettings.model_validate(json.loads(params)), halos, observation, output)


@app.command()
def mocks(params: Params, deflections: Input, observation: Input, smooth_model: Input, output: Output) -> None:
    """Make the mock images of a chunk."""
    from warmlens.stages import mocks as stage
    from warmlens.stages.settings import MocksSettings

    settings = MocksSettings.model_validate(json.loads(params))
    stage.run(settings, deflections, observation, smooth_model, output)


@app.command()
def null_mocks(params: Params, observation: Input, smooth_model: Input, output: Output) -> None:
    """Make the mock images without substructure of the null test."""
    from warmlens.stages import mocks as stage
    from warmlens.stages.settings import NullMocksSettings

    stage.run_null(NullMocksSettings.model_validate(json.loads(params)), observation, smooth_model, output)


@app.command("null-scans")
@app.command()
def scans(
    params: Params,
    mocks: Input,
    observation: Input,
    smooth_model: Input,
    design: Input,
    shard: Inputs,
    output: Output,
) -> None:
    """Scan the mocks of a chunk, or of the null test."""
    from warmlens.stages import scans as stage
    from warmlens.stages.settings import ScanSettings

    settings = ScanSettings.model_validate(json.loads(params))
    stage.run(settings, mocks, observation, smooth_model, design, shard, output)


@app.command("null-summaries")
@app.command()
def summaries(params: Params, scans: Input, output: Output) -> None:
    """Summarise the scans of a chunk, or of the null test."""
    from warmlens.stages import summaries as stage
    from warmlens.stages.settings import SummariesSettings

    stage.run(SummariesSettings.model_validate(json.loads(params)), scans, output)


@app.command()
def abc(
    params: Params,
    summary: Inputs,
    observed_summary: Input,
    smooth_model: Input,
    output: Output,
    table: Output,
    numbers: Output,
    null_summaries: Annotated[Optional[Path], typer.Option(help="Of the null test, if there is one.")] = None,  # noqa: UP045
) -> None:
    """Accept samples and bound the mass of the thermal relic."""
    from warmlens.stages import abc as stage
    from warmlens.stages.settings import AbcSettings

    settings = AbcSettings.model_validate(json.loads(params))
    stage.run(settings, summary, observed_summary, smooth_model, output, table, numbers, null_summaries)


@app.command()
def exclusion(
    params: Params,
    summary: Inputs,
    observed_summary: Input,
    smooth_model: Input,
    output: Output,
    table: Output,
    numbers: Output,
) -> None:
    """Accept samples of a grid and tell which halo masses are excluded."""
    from warmlens.stages import exclusion as stage
    from warmlens.stages.settings import ExclusionSettings

    settings = ExclusionSettings.model_validate(json.loads(params))
    stage.run(settings, summary, observed_summary, smooth_model, output, table, numbers)


@app.command()
def figure(
    name: Annotated[str, typer.Argument(help="Of a campaign's figure, or 1 to 8: the paper's.")],
    output: Annotated[
        Path, typer.Option(help="Picture to write (.png, .pdf, .svg); its data go beside it as .csv.")
    ],
    artifact: Artifacts = None,
    results: Annotated[
        Optional[list[Path]],  # noqa: UP045
        typer.Option(help="Results folder of a campaign; repeat the option to compare several in Figs. 6 and 7."),
    ] = None,
    configfile: ConfigFiles = None,
) -> None:
    """Draw a figure of a campaign, or one of the paper; Figs. 1, 2 and 8 need the configuration alone."""
    from warmlens.figures import registry
    from warmlens.status import read_campaign

    if name in registry.FROM_CONFIG:
        registry.write_from_config(name, read_campaign(results[0]) if results else _load(configfile), output)
    elif results:
        registry.write_from_results(name, results, output)
    else:
        inputs = {key: Path(path) for key, _, path in (item.partition("=") for item in artifact or [])}
        registry.write_from_artifacts(name, inputs, output)


@app.command()
def validate(configfile: ConfigFiles = None) -> None:
    """Check config.yaml, overlays and the images that they name: one line per problem."""
    config = _load(configfile)
    from warmlens.layout import chunks, shards
    from warmlens.preflight import check_observation

    for line in check_observation(config):
        typer.echo(line)
    typer.echo(
        f"valid: {config.campaign.n_samples} samples in {len(chunks(config))} chunks, "
        f"{len(shards(config))} shards of the scan operator, results in {config.results}"
    )


@app.command()
def config_reference(output: Output) -> None:
    """Write docs/configuration.md from the types of the configuration and the comments in config.yaml."""
    from warmlens.artifacts import atomic_path
    from warmlens.config_reference import reference

    with atomic_path(output) as temporary:
        temporary.write_text(reference(Path("config.yaml").read_text()))


@app.command()
def params(
    stage: Annotated[str, typer.Argument(help="Name of the stage.")], configfile: ConfigFiles = None
) -> None:
    """Print the settings that the workflow hands to a stage, for running it by hand."""
    from warmlens.artifacts import canonical_json
    from warmlens.stages.settings import stage_settings

    typer.echo(canonical_json(stage_settings(_load(configfile), stage).as_dict()))


@app.command()
def status(
    results: Results,
    cores: Annotated[int, typer.Option(help="Cores that the campaign runs on, for the time left.")] = 0,
) -> None:
    """Show what is done, what failed and how long the rest will take."""
    from warmlens.status import campaign_status, print_status, read_campaign

    print_status(campaign_status(read_campaign(results)), cores or os.cpu_count() or 1)


@app.command()
def audit(results: Results, configfile: ConfigFiles = None) -> None:
    """Re-hash every artifact and follow the chain from the posterior to the observation."""
    from warmlens.audit import audit as walk
    from warmlens.layout import stage_files
    from warmlens.stages.settings import campaign_stages, stage_digests
    from warmlens.status import read_campaign

    config = _load(configfile) if configfile else read_campaign(results)
    config = config.model_copy(update={"results": str(results)})
    files = {path: stage for stage in campaign_stages(config) for path in stage_files(config, stage)}
    findings = walk(files, stage_digests(config))
    for finding in findings:
        typer.echo(f"{finding.path}: {finding.problem}")
    if findings:
        typer.echo(f"{len(findings)} problems in {len(files)} artifacts; run the campaign again to mend them")
        raise typer.Exit(1)
    typer.echo(f"{len(files)} artifacts: complete, unaltered, and made from one another as recorded")


@app.command()
def branch(
    base: Annotated[Path, typer.Argument(help="Results folder of the campaign to start from.")],
    configfile: ConfigFiles = None,
) -> None:
    """Start a campaign from another one: what the change leaves as it is is linked, not made again."""
    from warmlens.branch import branch as take_over

    config = _load(configfile)
    stages = take_over(base, config)
    for stage in stages:
        left = stage.n_files - stage.n_linked - stage.n_there
        gone = f", {stage.n_removed} of other settings removed" if stage.n_removed else ""
        typer.echo(f"{stage.stage}: {stage.n_linked} linked, {stage.n_there} in place, {left} to make{gone}")
    if config.observation.kind == "simulated" and not stages[0].complete:
        typer.echo(
            "The simulated observation is made anew, with other content. To keep the image set "
            f"observation: {{kind: artifact, artifact: {base / 'observation.h5'}}}"
        )
    overlays = " ".join(str(path) for path in configfile or [])
    typer.echo(
        "now run: snakemake --cores 2 --workflow-profile workflow/profiles/local"
        + (f" --configfile {overlays}" if overlays else "")
    )


@app.command()
def systematics(
    config: Annotated[Path, typer.Option(help="Base campaign and variants.")] = Path(
        "workflow/configs/systematics.yaml"
    ),
    cores: Annotated[int, typer.Option(help="For Snakemake.")] = 2,
) -> None:
    """Run variants of a campaign on the same observation, and tell how the bound and the scan move."""
    from warmlens.systematics import run

    run(config, cores)


@app.command(context_settings=_PASSED_ON)
def run(context: typer.Context, configfile: ConfigFiles = None, cores: Cores = 0) -> None:
    """Start or go on with the campaign of config.yaml and overlays; what follows `--` goes to Snakemake."""
    from warmlens import front_end

    results = Path(_load(configfile).results)
    raise typer.Exit(front_end.run(configfile or [], results, cores or front_end.default_cores(), context.args))


@app.command(context_settings=_PASSED_ON)
def resume(context: typer.Context, results: Results, cores: Cores = 0) -> None:
    """Go on with a campaign as it was last started, also after a kill; what follows `--` goes to Snakemake."""
    from warmlens import front_end

    raise typer.Exit(front_end.resume(results, cores or front_end.default_cores(), context.args))


@app.command(context_settings=_PASSED_ON)
def extend(
    context: typer.Context,
    results: Results,
    n_samples: Annotated[int, typer.Argument(help="Samples in all, more than there are.")],
    cores: Cores = 0,
) -> None:
    """Raise the number of samples of a campaign; nothing that is finished is computed again."""
    from warmlens import front_end

    raise typer.Exit(front_end.extend(results, n_samples, cores or front_end.default_cores(), context.args))


@app.command()
def result(results: Results) -> None:
    """Print the bound of a finished campaign, or what its grid excludes, what stands beside it, where to look."""
    from warmlens.exclusion_result import is_grid, print_exclusion
    from warmlens.result import print_result

    (print_exclusion if is_grid(results) else print_result)(results)


@app.command()
def report(
    results: Results,
    output: Annotated[Optional[Path], typer.Option(help="HTML file; RESULTS/report.html unless given.")] = None,  # noqa: UP045
) -> None:
    """Write one self-contained HTML page with everything that a finished campaign found."""
    from warmlens.report.campaign_page import write_report

    typer.echo(write_report(results, output))


@app.command()
def show(
    results: Results,
    sample: Annotated[int, typer.Argument(help="Number of the sample, from 0.")],
    output: Annotated[Optional[Path], typer.Option(help="HTML file; under RESULTS/samples unless given.")] = None,  # noqa: UP045
) -> None:
    """Write one self-contained HTML page of a sample: subhaloes, deflection, mock, scan and summaries."""
    from warmlens.report.sample_page import write_sample

    typer.echo(write_sample(results, sample, output))


@app.command()
def combine(
    results: Annotated[list[Path], typer.Argument(help="Results folders of campaigns, each of another lens.")],
    output: Annotated[Optional[Path], typer.Option(help="JSON file for the numbers.")] = None,  # noqa: UP045
) -> None:
    """Combine lenses: the product of their likelihood ratios in the relic mass, and its bound."""
    from warmlens.combination import combine_results

    combine_results(results, output)


def _load(overlays: list[Path] | None) -> Config:
    from warmlens.config_file import load_config

    return load_config([Path("config.yaml"), *(overlays or [])])


def main() -> None:
    """Run the command line; errors of the user or of an input end with a message, not with a traceback."""
    runtime.prepare()  # before anything numerical is imported
    from warmlens.artifacts import ArtifactError
    from warmlens.config_file import ConfigError
    from warmlens.runs import LockedError

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s", datefmt="%H:%M:%S")
    try:
        app()
    except (ConfigError, ArtifactError, LockedError) as error:
        sys.exit(f"warmlens: {error}")
    except ValueError as error:
        logging.exception("where it happened")
        sys.exit(f"warmlens: {error}")


if __name__ == "__main__":
    main()
