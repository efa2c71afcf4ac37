"""Where every artifact of a campaign lies under its results folder, and which of them a stage reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warmlens.config.model import Config
from warmlens.config.types import MAX_IN_FILE_NAMES, MAX_PORTIONS, ConfigError
from warmlens.sampling import Span, chunk_spans, shard_spans, span_name
from warmlens.scan.raster import Raster
from warmlens.stage_table import STAGES, campaign_stages, stage_settings
from warmlens.stages.job import Job, make_job

_NOTES = {"logs": "log", "benchmarks": "tsv"}  # kinds of the files beside an artifact


def resolve_window(config: Config) -> Config:
    """Return the configuration with the window of the scan: as given, or around the unmasked pixels of all bands.

    Raises
    ------
    ConfigError
        If the images, which have the masks, cannot be read.
    """
    scan = config.scan
    if scan.window_arcsec is not None:
        return config
    from warmlens.products.images import planned_mask  # astropy takes a second to load

    grid, mask = planned_mask(config.observation)
    try:
        raster = Raster.around(mask, grid, scan.step_arcsec)
    except ValueError as error:
        raise ConfigError([f"scan.window_arcsec: null: {error}"]) from None
    window = {"window_arcsec": (raster.width, raster.height), "center": raster.center}
    return config.model_copy(update={"scan": scan.model_copy(update=window)})


def chunks(config: Config) -> list[Span]:
    """Return the spans of samples, one per chunk."""
    return chunk_spans(config.campaign.n_samples, config.campaign.chunk_size)


def shards(config: Config) -> list[Span]:
    """Return the spans of scan positions, one per shard of the operator."""
    scan = config.scan
    if scan.window_arcsec is None:
        raise ConfigError(
            ["scan.window_arcsec: null until the campaign starts, which sets it from the images; run it"]
        )
    n_positions, size = Raster(*scan.window_arcsec, scan.step_arcsec, scan.center).n_positions, scan.shard_size
    if n_positions > MAX_IN_FILE_NAMES or n_positions > size * MAX_PORTIONS:
        raise ConfigError(
            [
                f"scan: {n_positions} positions in shards of {size}; at most are {MAX_IN_FILE_NAMES} positions "
                f"and {MAX_PORTIONS} shards; raise step_arcsec or shard_size, or narrow the window"
            ]
        )
    return shard_spans(n_positions, size)


def stage_file(config: Config, name: str, span: Span | None = None) -> Path:
    """Return the artifact of a stage, of those in spans the one of `span`."""
    return Path(config.results) / STAGES[name].output.format(span=span_name(span) if span else "")


def stage_spans(config: Config, name: str) -> Sequence[Span | None]:
    """Return the span of every artifact of a stage, None for a whole; none of a null test that is switched off."""
    stage = STAGES[name]
    if stage.of_null_test and not config.null_test.n_mocks:
        return []
    if stage.by_sample or stage.by_position:
        return (chunks if stage.by_sample else shards)(config)
    return [None]


def stage_files(config: Config, name: str) -> list[Path]:
    """Return all artifacts of a stage; none of a null test that is switched off."""
    return [stage_file(config, name, span) for span in stage_spans(config, name)]


def note_file(config: Config, name: str, folder: str, span: Span | None = None) -> Path:
    """Return the file in "logs" or "benchmarks" that the job of an artifact writes."""
    return Path(config.results) / note_name(name, folder, span_name(span) if span else "")


def note_name(name: str, folder: str, span: str) -> str:
    """Return its path below the results folder: logs/halos/0000000-0000250.log."""
    artifact = STAGES[name].output.format(span=span).removesuffix(".h5")
    return f"{folder}/{artifact.replace('/chunk-', '/').replace('/shard-', '/')}.{_NOTES[folder]}"


def stage_inputs(config: Config, name: str, span: Span | None = None) -> dict[str, Path | Sequence[Path]]:
    """Return what a stage reads in a campaign, by the names of its row; a list where it reads several.

    Parameters
    ----------
    span
        Samples or positions of its artifact, if it has these.
    """
    stage = STAGES[name]
    inputs: dict[str, Path | Sequence[Path]] = {}
    for key, source in stage.inputs.items():
        if stage.reads_all_of(source):
            inputs[key] = stage_files(config, source)
        elif config.null_test.n_mocks or not STAGES[source].of_null_test:
            inputs[key] = stage_file(config, source, span)
    return inputs


def campaign_job(config: Config, name: str, span: Span | None = None, output: Path | None = None) -> Job[Any]:
    """Return the run of a stage on the artifacts of a campaign; `output` is another place to write to."""
    place = stage_file(config, name, span) if output is None else output
    return make_job(name, stage_settings(config, name), place, stage_inputs(config, name, span), span)


def artifact_files(config: Config) -> dict[Path, str]:
    """Return every artifact of a campaign with its stage."""
    return {path: stage for stage in campaign_stages(config) for path in stage_files(config, stage)}
