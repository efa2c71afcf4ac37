"""Where every artifact of a campaign lies under its results folder."""

from __future__ import annotations

from pathlib import Path

from warmlens.campaign import Span, chunk_spans, shard_spans, span_name
from warmlens.config import MAX_IN_FILE_NAMES, MAX_PORTIONS, Config
from warmlens.config_types import ConfigError
from warmlens.scan.raster import Raster

SINGLE = {
    "observation": "observation.h5",
    "smooth_model": "smooth_model.h5",
    "scan_design": "scan_operator/design.h5",
    "observed_scan": "observed_scan.h5",
    "observed_summary": "observed_summary.h5",
    "null_mocks": "null/mocks.h5",
    "null_scans": "null/scans.h5",
    "null_summaries": "null/summaries.h5",
    "abc": "abc.h5",
    "exclusion": "exclusion.h5",
}
CHUNKED = ("halos", "deflections", "mocks", "scans", "summaries")
NULL = ("null_mocks", "null_scans", "null_summaries")
FIGURE_GROUPS = {  # one job each: loading what draws takes longer than to draw
    "lens": ("smooth_model", "psf", "scan_plane"),
    "samples": ("halo_maps", "deflection_maps", "mocks", "delta_r", "correlation"),
    "answer": ("posterior", "likelihood", "calibration", "convergence", "predictive", "information"),
}
FIGURES = tuple(name for names in FIGURE_GROUPS.values() for name in names)
FIGURE_VERSION = 5  # raise it when a figure is drawn otherwise: finished campaigns then redraw theirs
CONFIG = "config.json"
TABLE = "abc.csv"
NUMBERS = "abc.json"
REPORT = "report.html"
REPORT_VERSION = 2
MANIFEST = "manifest.json"
CRATE = "ro-crate-metadata.json"  # as RO-Crate wants it
MANIFEST_VERSION = 1
EXCLUSION_TABLE = "exclusion.csv"
EXCLUSION_NUMBERS = "exclusion.json"
ANSWER_FILES = {"abc": (TABLE, NUMBERS), "exclusion": (EXCLUSION_TABLE, EXCLUSION_NUMBERS)}  # beside the artifact


def chunks(config: Config) -> list[Span]:
    """Spans of samples, one a chunk."""
    return chunk_spans(config.campaign.n_samples, config.campaign.chunk_size)


def shards(config: Config) -> list[Span]:
    """Spans of scan positions, one a shard of the operator."""
    n_positions, size = _n_positions(config), config.scan.shard_size
    if n_positions > MAX_IN_FILE_NAMES or n_positions > size * MAX_PORTIONS:
        raise ConfigError(
            [
                f"scan: {n_positions} positions in shards of {size}; at most are {MAX_IN_FILE_NAMES} positions "
                f"and {MAX_PORTIONS} shards; raise step_arcsec or shard_size, or narrow the window"
            ]
        )
    return shard_spans(n_positions, size)


def _n_positions(config: Config) -> int:
    scan = config.scan
    if scan.window_arcsec is not None:
        return Raster(*scan.window_arcsec, scan.step_arcsec, scan.center).n_positions
    # Without a window the raster follows the masks, which are in the images themselves.
    from warmlens.stages.observation import planned_mask

    grid, mask = planned_mask(config.observation)
    return Raster.around(mask, grid, scan.step_arcsec).n_positions


def stage_files(config: Config, stage: str) -> list[Path]:
    """All artifacts of one stage; none of a null test that is switched off."""
    root = Path(config.results)
    if stage in NULL and not config.null_test.n_mocks:
        return []
    if stage in SINGLE:
        return [root / SINGLE[stage]]
    if stage == "scan_operator":
        return [root / f"scan_operator/shard-{span_name(span)}.h5" for span in shards(config)]
    if stage in CHUNKED:
        return [root / f"{stage}/chunk-{span_name(span)}.h5" for span in chunks(config)]
    raise ValueError(f"unknown stage {stage!r}")


def sample_page(sample: int) -> str:
    """Path of the page of a sample under the results folder."""
    return f"samples/sample-{sample:07d}.html"


def results_folder(path: Path, stage: str) -> Path:
    """Results folder that the artifact `path` of a stage lies in."""
    return path.parents[SINGLE.get(stage, f"{stage}/chunk").count("/")]
