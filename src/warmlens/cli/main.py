"""Commands for people: start, watch, check and look at a campaign. `cli.stages` has those of the workflow."""

from __future__ import annotations

import io
import logging
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from warmlens import runtime
from warmlens.cli import stages
from warmlens.text import visible

if TYPE_CHECKING:
    from warmlens.config.model import Config

_HELP = "From the image of a strong gravitational lens to a lower bound on the mass of warm dark matter."
app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help=_HELP)

Output = Annotated[Path, typer.Option(help="File to write.")]
ConfigFiles = Annotated[
    list[Path] | None,
    typer.Option("--configfile", help="Overlays on config.yaml, later ones win."),
]
Artifacts = Annotated[
    list[str] | None,
    typer.Option(help="stage=path of an input; repeat the option."),
]
Results = Annotated[Path, typer.Argument(help="Results folder of a campaign.")]
Cores = Annotated[int, typer.Option(help="Jobs at a time; 0: all cores.")]
Yes = Annotated[
    bool, typer.Option("--yes", help="Discard finished artifacts that do not fit the configuration, unasked.")
]
_PASSED_ON = {"allow_extra_args": True}  # to Snakemake


@app.command(context_settings=_PASSED_ON)
def run(context: typer.Context, configfile: ConfigFiles = None, cores: Cores = 0, yes: Yes = False) -> None:
    """Start the campaign of config.yaml and overlays, or go on with it; what follows `--` goes to Snakemake.

    Another profile goes there too: `-- --workflow-profile workflow/profiles/slurm`.
    """
    from warmlens.campaign import run as front_end

    raise typer.Exit(front_end.run(_load(configfile), configfile or [], cores, context.args, yes))


@app.command(context_settings=_PASSED_ON)
def resume(context: typer.Context, results: Results, cores: Cores = 0, yes: Yes = False) -> None:
    """Go on with a campaign as it was last started, also after a kill; what follows `--` goes to Snakemake."""
    from warmlens.campaign import run as front_end

    raise typer.Exit(front_end.resume(results, cores, context.args, yes))


@app.command(context_settings=_PASSED_ON)
def extend(
    context: typer.Context,
    results: Results,
    n_samples: Annotated[int, typer.Argument(help="Samples in all, more than there are.")],
    cores: Cores = 0,
    yes: Yes = False,
) -> None:
    """Raise the number of samples of a campaign; finished work is kept."""
    from warmlens.campaign import run as front_end

    raise typer.Exit(front_end.extend(results, n_samples, cores, context.args, yes))


@app.command()
def status(
    results: Results,
    cores: Annotated[int, typer.Option(help="Cores that the campaign runs on, for the time left.")] = 0,
) -> None:
    """Show what is done, what failed and how long the rest will take."""
    from warmlens.campaign.answer import answer_problems
    from warmlens.campaign.status import campaign_status, failures, print_status, read_campaign

    config = read_campaign(results)
    print_status(campaign_status(config), failures(config), cores or os.cpu_count() or 1)
    for problem in answer_problems(config):
        typer.echo(problem)


@app.command()
def result(results: Results) -> None:
    """Print the bound of a finished campaign, or what its grid excludes, with its checks and where to look."""
    from warmlens.report.exclusion import is_grid, print_exclusion
    from warmlens.report.result import print_result

    (print_exclusion if is_grid(results) else print_result)(results)


@app.command()
def report(
    results: Results,
    output: Annotated[Path | None, typer.Option(help="HTML file; RESULTS/report.html unless given.")] = None,
) -> None:
    """Write one self-contained HTML page with all results of a finished campaign."""
    from warmlens.report.campaign_page import write_report

    typer.echo(write_report(results, output))


@app.command()
def show(
    results: Results,
    sample: Annotated[int, typer.Argument(help="Number of the sample, from 0.")],
    output: Annotated[Path | None, typer.Option(help="HTML file; under RESULTS/samples unless given.")] = None,
) -> None:
    """Write one self-contained HTML page of a sample: subhalos, deflection, mock, scan and summaries."""
    from warmlens.report.sample_page import write_sample

    typer.echo(write_sample(results, sample, output))


@app.command()
def figure(
    name: Annotated[str, typer.Argument(help="Name of a campaign's figure, or 1 to 8: the paper's.")],
    output: Annotated[
        Path, typer.Option(help="Picture to write (.png, .pdf, .svg); its data go beside it as .csv.")
    ],
    artifact: Artifacts = None,
    results: Annotated[
        list[Path] | None,
        typer.Option(help="Results folder of a campaign; repeat the option to compare several in Figs. 6 and 7."),
    ] = None,
    configfile: ConfigFiles = None,
) -> None:
    """Draw a figure of a campaign, or one of the paper; Figs. 1, 2 and 8 need the configuration alone."""
    from warmlens.campaign.status import read_campaign
    from warmlens.figures import registry

    if name in registry.FROM_CONFIG:
        registry.write_from_config(name, read_campaign(results[0]) if results else _load(configfile), output)
    elif results:
        registry.write_from_results(name, results, output)
    else:
        inputs = {key: Path(path) for key, _, path in (word.partition("=") for word in artifact or [])}
        registry.write_from_artifacts(name, inputs, output)


@app.command()
def combine(
    results: Annotated[list[Path], typer.Argument(help="Results folders of campaigns, each of another lens.")],
    output: Annotated[Path | None, typer.Option(help="JSON file for the numbers.")] = None,
) -> None:
    """Multiply the likelihood ratios of several lenses in the relic mass, and print the bound."""
    from warmlens.report.combination import combine_results

    combine_results(results, output)


@app.command()
def audit(
    results: Results,
    configfile: ConfigFiles = None,
    json_: Annotated[
        bool, typer.Option("--json", help="Print JSON for scripts (docs/audit.md has the keys).")
    ] = False,
    remove: Annotated[
        bool, typer.Option("--remove", help="Delete the files that are wrong; the next start makes them again.")
    ] = False,
) -> None:
    """Hash every file and follow the chain from the posterior to the observation; exit code 1 if any is wrong.

    It ends with the commands that mend what is wrong.
    """
    from warmlens.audit.campaign import audit_campaign
    from warmlens.audit.mending import mending, remove_files
    from warmlens.audit.report import as_json, print_audit
    from warmlens.campaign.derived import derived_files
    from warmlens.campaign.files import artifact_files
    from warmlens.campaign.status import read_campaign
    from warmlens.cli.progress import progress

    config = _load_campaign(configfile) if configfile else read_campaign(results)
    config = config.model_copy(update={"results": str(results)})
    with progress("audit", [*artifact_files(config), *derived_files(config)]) as done:
        checked = audit_campaign(config, done)
    mend = mending(checked, configfile or ())
    if json_:
        typer.echo(as_json(checked, mend))
    elif not remove:
        print_audit(checked, mend)
    if not remove:
        raise typer.Exit(0 if checked.sound else 1)
    remove_files(mend.remove)
    for path in mend.remove:
        typer.echo(f"removed {path}", err=json_)


@app.command()
def manifest(
    results: Results,
    license_url: Annotated[
        str | None,
        typer.Option("--license", help="URL of the license of the data, for the RO-Crate."),
    ] = None,
) -> None:
    """Write manifest.json and ro-crate-metadata.json of a finished campaign, for publication."""
    from warmlens.artifacts.names import CRATE, MANIFEST
    from warmlens.audit.crate import write_crate
    from warmlens.audit.manifest import make_manifest, write_manifest
    from warmlens.campaign.derived import derived_files
    from warmlens.campaign.files import artifact_files
    from warmlens.campaign.status import read_campaign
    from warmlens.cli.progress import progress

    config = read_campaign(results)
    with progress("manifest", [*artifact_files(config), *derived_files(config)]) as done:
        made, headers = make_manifest(config, done)
    write_manifest(made, results / MANIFEST)
    write_crate(results, made, headers, license_url)
    for name in (MANIFEST, CRATE):
        typer.echo(results / name)


@app.command()
def branch(
    base: Annotated[Path, typer.Argument(help="Results folder of the campaign to start from.")],
    configfile: ConfigFiles = None,
    yes: Yes = False,
) -> None:
    """Start a campaign from another one: artifacts that the change does not affect are hard-linked."""
    from warmlens.campaign.branch import branch as take_over
    from warmlens.campaign.snakemake import snakemake_command

    config = _load_campaign(configfile)
    stages = take_over(base, config, yes)
    for stage in stages:
        left = stage.n_files - stage.n_linked - stage.n_there
        gone = f", {stage.n_removed} of other settings removed" if stage.n_removed else ""
        typer.echo(f"{stage.stage}: {stage.n_linked} linked, {stage.n_there} in place, {left} to make{gone}")
    if config.observation.kind == "simulated" and not stages[0].complete:
        typer.echo(
            "The simulated observation will be another one. To keep the image set "
            f"observation: {{kind: artifact, artifact: {base / 'observation.h5'}}}"
        )
    typer.echo(f"now run: {snakemake_command(configfile or [])}")


@app.command()
def systematics(
    config: Annotated[Path, typer.Option(help="Base campaign and variants.")] = Path(
        "workflow/configs/systematics.yaml"
    ),
    configfile: ConfigFiles = None,
    cores: Annotated[int, typer.Option(help="For Snakemake.")] = 2,
) -> None:
    """Run variants of a campaign on the same observation, and print how the bound and the scan move.

    With --configfile these are variants of that campaign, not of the one that the file names, and go to
    RESULTS_systematics.
    """
    from warmlens.systematics.run import run

    run(config, cores, configfile or ())


@app.command()
def validate(
    configfile: ConfigFiles = None,
    figure: Annotated[
        Path | None, typer.Option(help="Draw the images as the program takes them: .png, .pdf or .svg.")
    ] = None,
) -> None:
    """Check config.yaml, overlays and the images that they name; print what they are, or one line per problem."""
    from warmlens.campaign.files import chunks, shards
    from warmlens.campaign.image_page import describe_images, draw_images
    from warmlens.campaign.preflight import check_images, simulate_images

    images = simulate_images(_load(configfile))
    for line in describe_images(images):
        typer.echo(visible(line))
    if figure is not None:
        draw_images(images, figure)
        typer.echo(f"\nfigure: {visible(str(figure))}")
    notes = check_images(images)  # after the page and the figure, which show what is wrong
    if notes:
        typer.echo(visible("\nlook at this:" + "".join(f"\n- {note}" for note in notes)))
    config = _load_campaign(configfile)
    typer.echo(
        f"\nvalid: {config.campaign.n_samples} samples in {len(chunks(config))} chunks, "
        f"{len(shards(config))} shards of the scan operator, results in {config.results}"
    )


@app.command()
def params(
    stage: Annotated[str, typer.Argument(help="Name of the stage.")], configfile: ConfigFiles = None
) -> None:
    """Print the settings that the workflow hands to a stage, for running it by hand."""
    from warmlens.config.digest import canonical_json
    from warmlens.stage_table import stage_settings

    typer.echo(canonical_json(stage_settings(_load_campaign(configfile), stage).as_dict()))


@app.command()
def config_reference() -> None:
    """Rewrite comments of config.yaml, docs/configuration.md and the JSON schema from the types of the keys."""
    from warmlens.artifacts.atomic import atomic_path
    from warmlens.config.reference import generated_files

    _load(None)  # an invalid config.yaml stays as it is
    for path, text in generated_files(Path("config.yaml").read_text(encoding="utf-8")).items():
        with atomic_path(Path(path)) as temporary:
            temporary.write_text(text, encoding="utf-8")


app.add_typer(stages.app)


def _load(overlays: list[Path] | None) -> Config:
    from warmlens.config.file import load_config

    return load_config([Path("config.yaml"), *(overlays or [])])


def _load_campaign(overlays: list[Path] | None) -> Config:
    """Read the configuration as a campaign starts with it: with the window of the scan."""
    from warmlens.campaign.files import resolve_window

    return resolve_window(_load(overlays))


class _Visible(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return visible(super().format(record))


def main() -> None:
    """Run the command line. Errors of user, machine or input end with a message, not with a traceback."""
    for stream in (sys.stdout, sys.stderr):  # a terminal that is not UTF-8 shows what it can
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    runtime.prepare()  # before anything numerical is imported
    from warmlens.artifacts.atomic import ArtifactError
    from warmlens.campaign.locks import LockedError
    from warmlens.config.file import ConfigError

    handler = logging.StreamHandler()
    handler.setFormatter(_Visible("%(asctime)s %(levelname)s %(message)s", datefmt="%H:%M:%S"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    try:
        app(stages.translate(sys.argv[1:]))
    except (ConfigError, ArtifactError, LockedError) as error:
        sys.exit(f"warmlens: {visible(str(error))}")
    except OSError as error:
        if error.filename is None:  # which would not be told from the message
            logging.exception("where it happened")
        what = f"{error.filename}: {error.strerror}" if error.filename is not None else str(error)
        sys.exit(f"warmlens: {visible(what)}")
    except ValueError as error:
        logging.exception("where it happened")
        sys.exit(f"warmlens: {visible(str(error))}")


if __name__ == "__main__":
    main()
