"""Where every artifact of a campaign lies under its results folder."""

from __future__ import annotations

from pathlib import Path

from warmlens.campaign import Span, chunk_spans, shard_spans, span_name
from warmlens.config import Config
from warmlens.scan.raster import Raster

SINGLE = {
    "observation": "observation.h5",
    "smooth_model": "smooth_model.h5",
    "scan_design": "scan_operator/design.h5",
    "observed_scan": "observed_scan.h5",
    "observed_summary": "observed_summary.h5",
    "abc": "abc.h5",
}
CHUNKED = ("halos", "deflections", "mocks", "scans", "summaries")
FIGURES = (
    "smooth_model",
    "psf",
    "halo_maps",
    "deflection_maps",
    "mocks",
    "delta_r",
    "scan_plane",
    "correlation",
    "posterior",
)
FIGURE_VERSION = 3  # raise it when a figure is drawn otherwise: finished campaigns then redraw theirs
CONFIG = "config.json"
TABLE = "abc.csv"
NUMBERS = "abc.json"


def chunks(config: Config) -> list[Span]:
    """Spans of samples, one a chunk."""
    return chunk_spans(config.campaign.n_samples, config.campaign.chunk_size)


def shards(config: Config) -> list[Span]:
    """Spans of scan positions, one a shard of the operator."""
    return shard_spans(_n_positions(config), config.scan.shard_size)


def _n_positions(config: Config) -> int:
    scan = config.scan
    if scan.window_arcsec is not None:
        return Raster(*scan.window_arcsec, scan.step_arcsec, scan.center).n_positions
    # Without a window the raster follows the masks, which are in the images themselves.
    from warmlens.stages.observation import planned_mask

    grid, mask = planned_mask(config.observation)
    return Raster.around(mask, grid, scan.step_arcsec).n_positions


def stage_files(config: Config, stage: str) -> list[Path]:
    """All artifacts of one stage."""
    root = Path(config.results)
    if stage in SINGLE:
        return [root / SINGLE[stage]]
    if stage == "scan_operator":
        return [root / f"scan_operator/shard-{span_name(span)}.h5" for span in shards(config)]
    if stage in CHUNKED:
        return [root / f"{stage}/chunk-{span_name(span)}.h5" for span in chunks(config)]
    raise ValueError(f"unknown stage {stage!r}")
