"""Stages `scan_design` and `scan_operator`: what is expensive in the scan, done once per lens."""

from __future__ import annotations

import logging

import numpy as np

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Artifact, Dataset, input_digest
from warmlens.config.scan import ScanBlock
from warmlens.fitting.linear import LinearModel, build_linear_model
from warmlens.fitting.smooth_model import SmoothModel, scan_band
from warmlens.imaging.observation import Observation
from warmlens.imaging.shapelets import pixel_basis
from warmlens.physics import scan_nested, scan_perturber, scan_raster
from warmlens.products.observation import read_observation
from warmlens.products.scan_operator import (
    design_datasets,
    read_linear_model,
    read_projection,
    shard_datasets,
)
from warmlens.products.smooth_model import read_smooth_model
from warmlens.scan.operator import build_shard, project_band
from warmlens.scan.shard import ScanBand
from warmlens.stage_table import STAGES, ScanSettings
from warmlens.stages.job import Job

log = logging.getLogger(__name__)


def run_design(job: Job[ScanSettings]) -> None:
    """Write the whitened design of each band and its projection on the PSF."""
    scan = job.settings.scan
    observed = read_observation(job.path("observation"))
    model = read_smooth_model(job.path("smooth_model"))
    perturber = scan_perturber(scan)
    datasets: dict[str, Dataset] = {}
    for name in model.fits:
        band, convolution = scan_band(observed, model, name)
        linear = scan_linear_model(scan, observed, model, name)
        scanned = ScanBand(linear, model.sets, model.rays, perturber, convolution, band.weights)
        projection = project_band(scanned)
        datasets |= design_datasets(name, linear, projection)
        log.info("%s: %d columns", name, linear.design.shape[1])
    metadata = {
        "bands": list(model.fits),
        "ridge": model.ridge,
        "n_source": sum(shapelets.n_coefficients for shapelets in model.sets),
        "n_image_columns": observed.grid.nx,
    }
    job.write(datasets, metadata)


def scan_linear_model(block: ScanBlock, observed: Observation, model: SmoothModel, name: str) -> LinearModel:
    """Return the whitened design of a band: source, fixed columns, and derivatives by the lens if asked for."""
    band, convolution = scan_band(observed, model, name)
    columns, sigma = model.fixed[name], np.full(model.fixed[name].shape[1], np.inf)
    if block.marginalise_lens:
        macro = model.macro[name]
        if macro.shape[1] == 0:
            raise ValueError(
                "scan.marginalise_lens: true needs a smooth model that knows the errors of its parameters, "
                "but this one has none; set it to false, or let smooth_model.mode fit the lens"
            )
        columns = np.hstack([columns, macro])
        sigma = np.append(sigma, model.macro_sigma)
    source = pixel_basis(model.sets, model.rays.source_x, model.rays.source_y)
    return build_linear_model(source, columns, convolution, band.weights, model.ridge, sigma)


def run(job: Job[ScanSettings]) -> None:
    """Write the operator of positions start..stop-1 of the raster."""
    scan, span = job.settings.scan, job.span
    assert span is not None  # make_job checks it
    observed = read_observation(job.path("observation"))
    model = read_smooth_model(job.path("smooth_model"))
    raster = scan_raster(scan)
    if not 0 <= span[0] < span[1] <= raster.n_positions:
        raise ValueError(
            f"positions {span[0]} to {span[1]} were asked for, the raster has {raster.n_positions}; "
            "start the campaign again, which lists the shards again"
        )
    positions = raster.coordinates()[span[0] : span[1]]
    datasets = {
        "positions": Dataset(positions, "arcsec", ("position", "component"), "perturber on the sky (x, y)")
    }
    nested, perturber = scan_nested(scan), scan_perturber(scan)
    with job.open("design") as design:
        check_origin(design, job)
        bands = design.metadata["bands"]
        for name in bands:
            band, convolution = scan_band(observed, model, name)
            linear, projection = read_linear_model(design, name), read_projection(design, name)
            scanned = ScanBand(linear, model.sets, model.rays, perturber, convolution, band.weights)
            shard = build_shard(scanned, projection, positions, nested, response="amplitude" in scan.statistics)
            datasets |= shard_datasets(name, shard)
            log.info("%s: positions %d to %d", name, *span)
    job.write(datasets, {"bands": bands, "nested_n_max": -1 if nested is None else nested.n_max})


def check_origin(artifact: Artifact, job: Job[ScanSettings]) -> None:
    """Refuse a design or shard that was made with other settings, or from other inputs, than those of this job.

    Raises
    ------
    ArtifactError
        Naming the file, and the setting or input that differs.
    """
    remedy = "delete the file and run the campaign again"
    expected = job.settings.of_operator().as_dict()
    if artifact.settings != expected:
        recorded, wanted = artifact.settings.get("scan", {}), expected["scan"]
        keys = [key for key in wanted if recorded.get(key) != wanted[key]]
        what = ", ".join(f"scan.{key} = {recorded.get(key)!r}, expected {wanted[key]!r}" for key in keys)
        version = f"stage_version = {artifact.settings.get('stage_version')}, expected {expected['stage_version']}"
        raise ArtifactError(f"{artifact.path}: was made with other settings ({what or version}); {remedy}")
    for name in STAGES[artifact.stage].inputs:
        recorded = artifact.inputs.get(name, {}).get("digest", "none")
        wanted = input_digest(job.path(name))
        if recorded != wanted:
            raise ArtifactError(
                f"{artifact.path}: was made from another {name} (digest {recorded[:12]}, {job.path(name)} has "
                f"{wanted[:12]}); {remedy}"
            )
