"""Command line of the stages, as the workflow calls them: settings as JSON, artifacts in, artifact out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Optional

import typer

from warmlens.products.time_limit import SAMPLE_SECONDS

app = typer.Typer()
PANEL = "Stages, called by the workflow"

Params = Annotated[str, typer.Option(help="Settings of the stage as JSON; see `warmlens params`.")]
Output = Annotated[Path, typer.Option(help="Artifact to write.")]
SpanOption = Annotated[tuple[int, int], typer.Option(help="First, and last + 1, of what to compute.")]
Input = Annotated[Path, typer.Option(help="Artifact of that stage.")]
SampleSeconds = Annotated[float, typer.Option(help="Longest time of one sample; one that takes longer fails.")]
Inputs = Annotated[list[Path], typer.Option(help="Artifacts of that stage; repeat the option.")]


@app.command(rich_help_panel=PANEL)
def observation(params: Params, output: Output) -> None:
    """Read the FITS images, or make the simulated observation."""
    from warmlens.stages import observation as stage
    from warmlens.stages.settings import ObservationSettings

    stage.run(ObservationSettings.model_validate(json.loads(params)), output)


@app.command(rich_help_panel=PANEL)
def smooth_model(params: Params, observation: Input, output: Output) -> None:
    """Fit the amplitudes of the smooth model."""
    from warmlens.stages import smooth_model as stage
    from warmlens.stages.settings import SmoothModelSettings

    stage.run(SmoothModelSettings.model_validate(json.loads(params)), observation, output)


@app.command(rich_help_panel=PANEL)
def scan_design(params: Params, observation: Input, smooth_model: Input, output: Output) -> None:
    """Build what all shards of the scan operator share."""
    from warmlens.stages import scan_operator as stage
    from warmlens.stages.settings import ScanSettings

    settings = ScanSettings.model_validate(json.loads(params))
    stage.run_design(settings, observation, smooth_model, output)


@app.command(rich_help_panel=PANEL)
def scan_operator(
    params: Params, span: SpanOption, observation: Input, smooth_model: Input, design: Input, output: Output
) -> None:
    """Build the scan operator of a span of positions."""
    from warmlens.stages import scan_operator as stage
    from warmlens.stages.settings import ScanSettings

    settings = ScanSettings.model_validate(json.loads(params))
    stage.run(settings, span, observation, smooth_model, design, output)


@app.command(rich_help_panel=PANEL)
def observed_scan(
    params: Params, observation: Input, smooth_model: Input, design: Input, shard: Inputs, output: Output
) -> None:
    """Scan the observation."""
    from warmlens.stages import scans as stage
    from warmlens.stages.settings import ScanSettings

    settings = ScanSettings.model_validate(json.loads(params))
    stage.run_observed(settings, observation, smooth_model, design, shard, output)


@app.command(rich_help_panel=PANEL)
def observed_summary(params: Params, observed_scan: Input, output: Output) -> None:
    """Summarise the scan of the observation."""
    from warmlens.stages import summaries as stage
    from warmlens.stages.settings import SummariesSettings

    stage.run_observed(SummariesSettings.model_validate(json.loads(params)), observed_scan, output)


@app.command(rich_help_panel=PANEL)
def halos(
    params: Params, span: SpanOption, output: Output, sample_seconds: SampleSeconds = SAMPLE_SECONDS
) -> None:
    """Draw the halo realizations of a chunk."""
    from warmlens.stages import halos as stage
    from warmlens.stages.settings import HalosSettings

    stage.run(HalosSettings.model_validate(json.loads(params)), span, output, sample_seconds)


@app.command(rich_help_panel=PANEL)
def deflections(
    params: Params,
    halos: Input,
    observation: Input,
    output: Output,
    sample_seconds: SampleSeconds = SAMPLE_SECONDS,
) -> None:
    """Compute the filtered deflections of a chunk."""
    from warmlens.stages import deflections as stage
    from warmlens.stages.settings import DeflectionsSettings

    settings = DeflectionsSettings.model_validate(json.loads(params))
    stage.run(settings, halos, observation, output, sample_seconds)


@app.command(rich_help_panel=PANEL)
def mocks(
    params: Params,
    deflections: Input,
    observation: Input,
    smooth_model: Input,
    output: Output,
    sample_seconds: SampleSeconds = SAMPLE_SECONDS,
) -> None:
    """Make the mock images of a chunk."""
    from warmlens.stages import mocks as stage
    from warmlens.stages.settings import MocksSettings

    settings = MocksSettings.model_validate(json.loads(params))
    stage.run(settings, deflections, observation, smooth_model, output, sample_seconds)


@app.command(rich_help_panel=PANEL)
def null_mocks(
    params: Params,
    observation: Input,
    smooth_model: Input,
    output: Output,
    sample_seconds: SampleSeconds = SAMPLE_SECONDS,
) -> None:
    """Make the mock images without substructure of the null test."""
    from warmlens.stages import mocks as stage
    from warmlens.stages.settings import NullMocksSettings

    settings = NullMocksSettings.model_validate(json.loads(params))
    stage.run_null(settings, observation, smooth_model, output, sample_seconds)


@app.command("null-scans", rich_help_panel=PANEL)
@app.command(rich_help_panel=PANEL)
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


@app.command("null-summaries", rich_help_panel=PANEL)
@app.command(rich_help_panel=PANEL)
def summaries(params: Params, scans: Input, output: Output) -> None:
    """Summarise the scans of a chunk, or of the null test."""
    from warmlens.stages import summaries as stage
    from warmlens.stages.settings import SummariesSettings

    stage.run(SummariesSettings.model_validate(json.loads(params)), scans, output)


@app.command(rich_help_panel=PANEL)
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
    from warmlens.stages.abc import run as stage
    from warmlens.stages.settings import AbcSettings

    settings = AbcSettings.model_validate(json.loads(params))
    stage.run(settings, summary, observed_summary, smooth_model, output, table, numbers, null_summaries)


@app.command(rich_help_panel=PANEL)
def figures(
    results: Annotated[Path, typer.Argument(help="Results folder of a campaign.")],
    names: Annotated[list[str], typer.Argument(help="Its figures.")],
) -> None:
    """Draw figures of a campaign into its folder; see `warmlens figure` for one of them elsewhere."""
    from warmlens.figures import registry

    for number, name in enumerate(names, start=1):
        registry.write_from_results(name, [results], results / f"figures/{name}.png")
        typer.echo(f"{name}: drawn, {number} of {len(names)}")


@app.command(rich_help_panel=PANEL)
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
