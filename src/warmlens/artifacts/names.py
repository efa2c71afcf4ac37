"""Names of all files below a results folder."""

from __future__ import annotations

from pathlib import Path

from warmlens.stage_table import STAGES

SINGLE = {name: stage.output for name, stage in STAGES.items() if not (stage.by_sample or stage.by_position)}
CHUNKED = tuple(name for name, stage in STAGES.items() if stage.by_sample)
NULL = tuple(name for name, stage in STAGES.items() if stage.of_null_test)
FIGURE_GROUPS = {  # one job each: the imports take longer than drawing
    "lens": ("smooth_model", "psf", "scan_plane"),
    "samples": ("halo_maps", "deflection_maps", "mocks", "delta_r", "correlation"),
    "answer": ("posterior", "likelihood", "calibration", "convergence", "predictive", "information"),
}
FIGURES = tuple(name for names in FIGURE_GROUPS.values() for name in names)
FIGURE_VERSION = 6  # raise it when a figure changes: finished campaigns then redraw theirs
CONFIG = "config.json"
EXTENDED = "config.extended.json"  # of `warmlens extend`, until the campaign has started with it
SETTINGS = "settings/{stage}.json"  # what the jobs of a stage read
FILES = "settings/{stage}.files.json"  # all artifacts of a stage, for the jobs that read them at once
STARTED = "settings/started.json"  # what the last start was about
TABLE = "abc.csv"
NUMBERS = "abc.json"
REPORT = "report.html"
REPORT_VERSION = 3
LEDGER = "derived/{name}.json"  # what a figure, or the report, was made from
MANIFEST = "manifest.json"
CRATE = "ro-crate-metadata.json"  # as RO-Crate wants it
MANIFEST_VERSION = 1
EXCLUSION_TABLE = "exclusion.csv"
EXCLUSION_NUMBERS = "exclusion.json"
ANSWER_FILES = {"abc": (TABLE, NUMBERS), "exclusion": (EXCLUSION_TABLE, EXCLUSION_NUMBERS)}  # next to the artifact


def sample_page(sample: int) -> str:
    """Return the path of the page of a sample under the results folder."""
    return f"samples/sample-{sample:07d}.html"


def results_folder(path: Path, stage: str) -> Path:
    """Return the results folder that the artifact `path` of a stage lies in."""
    return path.parents[STAGES[stage].output.count("/") if stage in STAGES else 1]
