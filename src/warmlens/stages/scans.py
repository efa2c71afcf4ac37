"""Stages `scans` and `observed_scan`: Delta R maps of mocks and of the observation."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warmlens.artifacts import ArtifactError, Dataset, Provenance, open_artifact, write_artifact
from warmlens.fitting.linear import physical_coefficients, solve
from warmlens.imaging.observation import Observation
from warmlens.scan.maps import delta_r, residual_images
from warmlens.stages.products import (
    SmoothModel,
    read_linear_model,
    read_observation,
    read_shard,
    read_smooth_model,
    scan_band,
)
from warmlens.stages.samples import SampleTable
from warmlens.stages.scan_operator import scan_perturber, scan_raster
from warmlens.stages.settings import ScanSettings
from warmlens.types import BoolArray, FloatArray

log = logging.getLogger(__name__)


class Scanner:
    """Scans images of one campaign: holds observation, smooth model and where the operator lies."""

    def __init__(
        self,
        settings: ScanSettings,
        observation: Path,
        smooth_model: Path,
        design: Path,
        shards: Sequence[Path],
    ) -> None:
        self.inputs = {"observation": observation, "smooth_model": smooth_model, "design": design}
        self.inputs |= {shard.stem: shard for shard in shards}
        self.observed: Observation = read_observation(observation)
        self.model: SmoothModel = read_smooth_model(smooth_model)
        self.bands = list(self.model.fits)
        self._raster = scan_raster(settings.scan)
        self._perturber = scan_perturber(settings.scan)
        self._design, self._shards = design, shards

    def scan(self, name: str, images: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Delta R maps [n, ny, nx], chi2 of the smooth fit [n] and valid positions [ny, nx] of images in a band.

        Parameters
        ----------
        name
            Band.
        images
            Brightness [n, image ny, image nx] [e-/s per pixel].
        """
        band, convolution = scan_band(self.observed, self.model, name)
        with open_artifact(self._design, "scan_design") as design:
            linear = read_linear_model(design, name)
        whitened = (band.weights * images).reshape(len(images), -1).T
        fit = solve(linear, np.ascontiguousarray(whitened))
        coefficients = physical_coefficients(linear, fit.coefficients)[: linear.n_source]
        tau = residual_images(fit, convolution, band.weights)
        maps, valid, positions = [], [], []
        start = time.monotonic()
        for count, path in enumerate(self._shards, start=1):
            with open_artifact(path, "scan_operator") as artifact:
                shard = read_shard(artifact, name)
            maps.append(delta_r(shard, self.model.sets, self.model.rays, self._perturber, coefficients, tau))
            valid.append(np.diff(shard.pixel_offsets) > 0)
            positions.append(shard.positions)
            left = (time.monotonic() - start) / count * (len(self._shards) - count)
            log.info("%s: shard %d of %d, %.0f s left", name, count, len(self._shards), left)
        if not np.array_equal(np.concatenate(positions), self._raster.coordinates()):
            raise ArtifactError(
                f"{self._shards[0].parent}: the shards do not hold the positions of the raster; "
                "delete the folder and run the campaign again"
            )
        shape = self._raster.shape
        return (
            np.concatenate(maps).T.reshape(len(images), *shape),
            fit.chi2,
            np.concatenate(valid).reshape(shape),
        )

    def raster_datasets(self, valid: BoolArray) -> dict[str, Dataset]:
        """Where the maps' positions lie, and which of them a perturber can be seen at."""
        x, y = self._raster.coordinates().T.reshape(2, *self._raster.shape)
        sky = ("y", "x")
        return {
            "raster/x": Dataset(x, "arcsec", sky, "position, to the West"),
            "raster/y": Dataset(y, "arcsec", sky, "position, to the North"),
            "raster/valid": Dataset(valid, "", sky, "1 where the perturber moves an unmasked pixel"),
        }


def run(
    settings: ScanSettings,
    mocks: Path,
    observation: Path,
    smooth_model: Path,
    design: Path,
    shards: Sequence[Path],
    output: Path,
) -> None:
    """Write Delta R and the chi2 of the smooth fit of every mock of a chunk."""
    scanner = Scanner(settings, observation, smooth_model, design, shards)
    with open_artifact(mocks, "mocks") as artifact:
        inputs = {"mocks": mocks, **scanner.inputs}
        provenance = Provenance("scans", settings.as_dict(), inputs, span=artifact.span)
        table = SampleTable.read(artifact)
        done = table.done
        valid = np.zeros(scan_raster(settings.scan).shape, dtype=bool)
        results: dict[str, tuple[FloatArray, FloatArray]] = {}
        for band in scanner.bands:
            images = artifact.array(f"{band}/image").astype(np.float64)
            delta = np.full((len(table), *scan_raster(settings.scan).shape), np.nan)
            chi2 = np.full(len(table), np.nan)
            if done.any():
                delta[done], chi2[done], seen = scanner.scan(band, images[done])
                valid |= seen
            results[band] = delta, chi2
    table.for_each(lambda row: _check_row(results, row), "scans")
    datasets = {**table.datasets(), **scanner.raster_datasets(valid)}
    for band, (delta, chi2) in results.items():
        datasets |= _scan_datasets(band, delta, chi2, ("sample",))
    write_artifact(output, provenance, datasets, {"bands": scanner.bands})


def _check_row(results: dict[str, tuple[FloatArray, FloatArray]], row: int) -> None:
    for band, (delta, chi2) in results.items():
        if not (np.isfinite(delta[row]).all() and np.isfinite(chi2[row])):
            raise FloatingPointError(f"the scan in {band} is not finite")


def run_observed(
    settings: ScanSettings,
    observation: Path,
    smooth_model: Path,
    design: Path,
    shards: Sequence[Path],
    output: Path,
) -> None:
    """Write Delta R and the chi2 of the smooth fit of the observation."""
    scanner = Scanner(settings, observation, smooth_model, design, shards)
    provenance = Provenance("observed_scan", settings.as_dict(), scanner.inputs)
    valid = np.zeros(scan_raster(settings.scan).shape, dtype=bool)
    datasets: dict[str, Dataset] = {}
    for band in scanner.observed.bands:
        delta, chi2, seen = scanner.scan(band.name, band.image[None])
        valid |= seen
        datasets |= _scan_datasets(band.name, delta[0], chi2[0], ())
    write_artifact(output, provenance, {**datasets, **scanner.raster_datasets(valid)}, {"bands": scanner.bands})


def _scan_datasets(band: str, delta: FloatArray, chi2: FloatArray, lead: tuple[str, ...]) -> dict[str, Dataset]:
    return {
        f"{band}/delta_r": Dataset(
            delta, "", (*lead, "y", "x"), "chi2 with the perturber minus chi2 without, source refitted"
        ),
        f"{band}/chi2": Dataset(np.asarray(chi2), "", lead, "chi2 of the fit with the smooth lens"),
    }
