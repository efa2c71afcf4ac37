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
    "halo_maps",
    "deflection_maps",
    "mocks",
    "delta_r",
    "correlation",
    "posterior",
)
FIGURE_VERSION = 1  # raise it when a figure is drawn otherwise: finished campaigns then redraw theirs
CONFIG = "config.json"
TABLE = "abc.csv"


def chunks(config: Config) -> list[Span]:
    """Spans of samples, one a chunk."""
    return chunk_spans(config.campaign.n_samples, config.campaign.chunk_size)


def shards(config: Config) -> list[Span]:
    """Spans of scan positions, one a shard of the operator."""
    scan = config.scan
    n_positions = Raster(*scan.window_arcsec, scan.step_arcsec, scan.center).n_positions
    return shard_spans(n_positions, scan.shard_size)


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
