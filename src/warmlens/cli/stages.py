"""Commands that the workflow calls: any stage of the table, and the figures of a campaign."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from warmlens.products.time_limit import SAMPLE_SECONDS

app = typer.Typer()
PANEL = "Called by the workflow"


@app.command(rich_help_panel=PANEL)
def stage(
    name: Annotated[str, typer.Argument(help="Name of the stage, as the README lists them.")],
    settings: Annotated[
        str,
        typer.Option(metavar="FILE", help="Its settings: a JSON file, or JSON; `warmlens params` prints them."),
    ],
    output: Annotated[Path, typer.Option(help="Artifact to write.")],
    input_: Annotated[
        list[str] | None,
        typer.Option(
            "--input",
            metavar="NAME=FILE",
            help="Artifact that it reads; repeat the option. NAME=@FILE: all that the JSON list in FILE names.",
        ),
    ] = None,
    span: Annotated[
        tuple[int, int] | None,
        typer.Option(help="First, and last + 1, of the samples or positions to compute."),
    ] = None,
    sample_seconds: Annotated[
        float, typer.Option(help="Longest processor time of one sample; one that takes longer fails.")
    ] = SAMPLE_SECONDS,
) -> None:
    """Run one stage of a campaign: read its inputs, do its work, write its artifact."""
    from warmlens.campaign.settings import read_paths, read_settings
    from warmlens.stages.job import make_job, run_job

    inputs: dict[str, list[Path]] = {}
    for key, _, path in (word.partition("=") for word in input_ or []):
        inputs.setdefault(key, []).extend(read_paths(path))
    run_job(make_job(name, read_settings(name, settings), output, inputs, span, sample_seconds))


def translate(words: Sequence[str]) -> list[str]:
    """Return the words of a command line; the command of one stage, which 0.1 had, becomes `stage NAME`."""
    if "--params" not in words:
        return list(words)
    name = words[0].replace("-", "_")
    typer.echo(f"`warmlens {words[0]}` is now `warmlens stage {name}`: see `warmlens stage --help`", err=True)
    translated, rest = ["stage", name], list(words[1:])
    while rest:
        option = rest.pop(0)
        if option == "--params":
            translated += ["--settings", rest.pop(0)]
        elif option in ("--table", "--numbers"):
            rest.pop(0)  # they lie beside the artifact
        elif option in ("--span", "--output", "--sample-seconds") or not option.startswith("--"):
            translated.append(option)
        else:
            key = option.removeprefix("--").replace("-", "_")
            translated += ["--input", f"{_PLURALS.get(key, key)}={rest.pop(0)}"]
    return translated


_PLURALS = {"shard": "shards", "summary": "summaries"}


@app.command(rich_help_panel=PANEL)
def figures(
    results: Annotated[Path, typer.Argument(help="Results folder of a campaign.")],
    names: Annotated[list[str], typer.Argument(help="Its figures.")],
) -> None:
    """Draw figures of a campaign into its folder; `warmlens figure` draws one of them elsewhere."""
    from warmlens.figures import registry

    for number, name in enumerate(names, start=1):
        registry.write_from_results(name, [results], results / f"figures/{name}.png")
        typer.echo(f"{name}: drawn, {number} of {len(names)}")
