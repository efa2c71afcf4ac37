"""Stages `scan_design` and `scan_operator`: what is expensive in the scan, done once per lens."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from warmlens.artifacts.file import (
    Artifact,
    ArtifactError,
    Dataset,
    Provenance,
    input_digest,
    open_artifact,
    write_artifact,
)
from warmlens.config.model import ScanBlock
from warmlens.fitting.linear import LinearModel, build_linear_model
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
from warmlens.products.smooth_model import SmoothModel, read_smooth_model, scan_band
from warmlens.sampling import Span
from warmlens.scan.operator import build_shard, project_band
from warmlens.scan.shard import ScanBand
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
        linear = scan_linear_model(settings.scan, observed, model, name)
        projection = project_band(ScanBand(linear, model.sets, model.rays, perturber, convolution, band.weights))
        datasets |= design_datasets(name, linear, projection)
        log.info("%s: %d columns", name, linear.design.shape[1])
    metadata = {
        "bands": list(model.fits),
        "ridge": model.ridge,
        "n_source": sum(item.n_coefficients for item in model.sets),
        "n_image_columns": observed.grid.nx,
    }
    write_artifact(output, provenance, datasets, metadata)


def scan_linear_model(block: ScanBlock, observed: Observation, model: SmoothModel, name: str) -> LinearModel:
    """Whitened design of band `name`: source, fixed columns and, if asked for, derivatives by the lens' fit."""
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


def run(
    settings: ScanSettings, span: Span, observation: Path, smooth_model: Path, design: Path, output: Path
) -> None:
    """Write the operator of positions start..stop-1 of the raster."""
    inputs = {"observation": observation, "smooth_model": smooth_model, "design": design}
    provenance = Provenance("scan_operator", settings.as_dict(), inputs, span=span)
    observed = read_observation(observation)
    model = read_smooth_model(smooth_model)
    raster = scan_raster(settings.scan, observed)
    if not 0 <= span[0] < span[1] <= raster.n_positions:
        raise ValueError(
            f"positions {span[0]} to {span[1]} were asked for, the raster has {raster.n_positions}; "
            "start the campaign again, so that the list of shards is made anew"
        )
    positions = raster.coordinates()[span[0] : span[1]]
    datasets = {
        "positions": Dataset(positions, "arcsec", ("position", "component"), "perturber on the sky (x, y)")
    }
    nested = scan_nested(settings.scan)
    with open_artifact(design, "scan_design") as artifact:
        check_origin(artifact, settings, {"observation": observation, "smooth_model": smooth_model})
        for name in artifact.metadata["bands"]:
            band, convolution = scan_band(observed, model, name)
            linear, perturber = read_linear_model(artifact, name), scan_perturber(settings.scan)
            scanned = ScanBand(linear, model.sets, model.rays, perturber, convolution, band.weights)
            response = "amplitude" in settings.scan.statistics
            shard = build_shard(scanned, read_projection(artifact, name), positions, nested, response=response)
            datasets |= shard_datasets(name, shard)
            log.info("%s: positions %d to %d", name, *span)
        metadata = {"bands": artifact.metadata["bands"], "nested_n_max": -1 if nested is None else nested.n_max}
    write_artifact(output, provenance, datasets, metadata)


def check_origin(artifact: Artifact, settings: ScanSettings, inputs: dict[str, Path]) -> None:
    """Refuse a design or shard that was made with other settings or from other inputs than these.

    Raises
    ------
    ArtifactError
        Naming the file, and the setting or input that differs.
    """
    remedy = "delete the file and run the campaign again"
    expected = settings.without_samples().as_dict()
    if artifact.settings != expected:
        found, wanted = artifact.settings.get("scan", {}), expected["scan"]
        keys = [key for key in wanted if found.get(key) != wanted[key]]
        what = ", ".join(f"scan.{key} = {found.get(key)!r}, expected {wanted[key]!r}" for key in keys)
        version = f"stage_version = {artifact.settings.get('stage_version')}, expected {expected['stage_version']}"
        raise ArtifactError(f"{artifact.path}: was made with other settings ({what or version}); {remedy}")
    for name, path in inputs.items():
        found = artifact.inputs.get(name, {}).get("digest", "none")
        wanted = input_digest(path)
        if found != wanted:
            raise ArtifactError(
                f"{artifact.path}: was made from another {name} (digest {found[:12]}, {path} has {wanted[:12]}); "
                f"{remedy}"
            )
