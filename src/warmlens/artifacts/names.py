"""Names of all files below a results folder."""

from __future__ import annotations

from pathlib import Path

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
FIGURE_GROUPS = {  # one job each: the imports take longer than drawing
    "lens": ("smooth_model", "psf", "scan_plane"),
    "samples": ("halo_maps", "deflection_maps", "mocks", "delta_r", "correlation"),
    "answer": ("posterior", "likelihood", "calibration", "convergence", "predictive", "information"),
}
FIGURES = tuple(name for names in FIGURE_GROUPS.values() for name in names)
FIGURE_VERSION = 5  # raise it when a figure changes: finished campaigns then redraw theirs
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
ANSWER_FILES = {"abc": (TABLE, NUMBERS), "exclusion": (EXCLUSION_TABLE, EXCLUSION_NUMBERS)}  # next to the artifact


def sample_page(sample: int) -> str:
    """Path of the page of a sample under the results folder."""
    return f"samples/sample-{sample:07d}.html"


def results_folder(path: Path, stage: str) -> Path:
    """Results folder that the artifact `path` of a stage lies in."""
    return path.parents[SINGLE.get(stage, f"{stage}/chunk").count("/")]
