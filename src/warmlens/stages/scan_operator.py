"""Stages `scan_design` and `scan_operator`: what is expensive in the scan, done once per lens."""

from __future__ import annotations

import logging
from pathlib import Path

from warmlens.artifacts import Dataset, Provenance, open_artifact, write_artifact
from warmlens.campaign import Span
from warmlens.config import ScanBlock
from warmlens.fitting.smooth_model import FixedColumns, linear_model
from warmlens.scan.operator import build_shard, project_band
from warmlens.scan.perturber import Perturber
from warmlens.scan.raster import Raster
from warmlens.stages.products import (
    design_datasets,
    read_linear_model,
    read_observation,
    read_projection,
    read_smooth_model,
    scan_band,
    shard_datasets,
)
from warmlens.stages.settings import ScanSettings

log = logging.getLogger(__name__)


def run_design(settings: ScanSettings, observation: Path, smooth_model: Path, output: Path) -> None:
    """Write the whitened design of each band and its projection on the PSF."""
    inputs = {"observation": observation, "smooth_model": smooth_model}
    provenance = Provenance("scan_design", settings.as_dict(), inputs)
    observed = read_observation(observation)
    model = read_smooth_model(smooth_model)
    perturber = scan_perturber(settings.scan)
    datasets: dict[str, Dataset] = {}
    for name in model.fits:
        band, convolution = scan_band(observed, model, name)
        fixed = FixedColumns(model.names, model.fixed[name], model.n_quasars)
        linear = linear_model(model.sets, model.rays, fixed, convolution, band.weights, model.ridge)
        projection = project_band(linear, convolution, band.weights, model.rays, perturber)
        datasets |= design_datasets(name, linear, projection)
        log.info("%s: %d columns", name, linear.design.shape[1])
    metadata = {
        "bands": list(model.fits),
        "ridge": model.ridge,
        "n_source": sum(item.n_coefficients for item in model.sets),
        "n_image_columns": observed.grid.nx,
    }
    write_artifact(output, provenance, datasets, metadata)


def run(
    settings: ScanSettings, span: Span, observation: Path, smooth_model: Path, design: Path, output: Path
) -> None:
    """Write the operator of positions start..stop-1 of the raster."""
    inputs = {"observation": observation, "smooth_model": smooth_model, "design": design}
    provenance = Provenance("scan_operator", settings.as_dict(), inputs, span=span)
    observed = read_observation(observation)
    model = read_smooth_model(smooth_model)
    positions = scan_raster(settings.scan).coordinates()[span[0] : span[1]]
    datasets = {
        "positions": Dataset(positions, "arcsec", ("position", "component"), "perturber on the sky (x, y)")
    }
    with open_artifact(design, "scan_design") as artifact:
        for name in artifact.metadata["bands"]:
            band, _ = scan_band(observed, model, name)
            shard = build_shard(
                read_linear_model(artifact, name),
                read_projection(artifact, name),
                band.weights,
                model.sets,
                model.rays,
                scan_perturber(settings.scan),
                positions,
            )
            datasets |= shard_datasets(name, shard)
            log.info("%s: positions %d to %d", name, *span)
        metadata = {"bands": artifact.metadata["bands"]}
    write_artifact(output, provenance, datasets, metadata)


def scan_perturber(block: ScanBlock) -> Perturber:
    """Perturber of the configuration."""
    return Perturber(block.perturber.theta_e_arcsec, block.perturber.r_trunc_arcsec)


def scan_raster(block: ScanBlock) -> Raster:
    """Raster of the configuration."""
    return Raster(*block.window_arcsec, block.step_arcsec, block.center)
