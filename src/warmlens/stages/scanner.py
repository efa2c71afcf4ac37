"""Scan of images with the operator of a campaign, shard by shard."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Artifact, Dataset, open_input
from warmlens.fitting.linear import LinearFit, physical_coefficients, solve
from warmlens.fitting.smooth_model import SmoothModel, scan_band
from warmlens.imaging.observation import Observation
from warmlens.physics import scan_perturber, scan_raster
from warmlens.products.observation import read_observation
from warmlens.products.scan_operator import read_linear_model, read_shard
from warmlens.products.smooth_model import read_smooth_model
from warmlens.scan.apply import delta_r, delta_r_and_response
from warmlens.scan.maps import residual_images, residual_maps
from warmlens.scan.response import LinearResponse, expected_delta_r
from warmlens.scan.shard import ScanBand
from warmlens.stage_table import ScanSettings
from warmlens.stages.job import Job
from warmlens.stages.scan_operator import check_origin
from warmlens.types import BoolArray, FloatArray, IntArray

log = logging.getLogger(__name__)

RESIDUALS = ("r_smooth", "r_pert", "r_sens")


@dataclass(frozen=True)
class BandScan:
    """Scan of n images in one band.

    Attributes
    ----------
    delta_r, chi2
        Maps [n, ny, nx] and chi2 of the smooth fit without nested shapelets [n].
    valid
        Positions whose perturber moves an unmasked pixel [ny, nx].
    residuals
        r_smooth, r_pert and r_sens of the images they were asked for [n_asked, ny, nx].
    response
        Score and Fisher information of each image [n, ny, nx], if statistics has the amplitude.
    expected
        Expected Delta R of the first image's smooth fit [n_theta_e, ny, nx], if asked for.
    """

    delta_r: FloatArray
    chi2: FloatArray
    valid: BoolArray
    residuals: dict[str, FloatArray]
    response: LinearResponse | None = None
    expected: FloatArray | None = None


class Scanner:
    """Scan images of one campaign: holds observation, smooth model and the paths of the operator."""

    def __init__(self, job: Job[ScanSettings]) -> None:
        scan = job.settings.scan
        self.observed: Observation = read_observation(job.path("observation"))
        self.model: SmoothModel = read_smooth_model(job.path("smooth_model"))
        self.bands = list(self.model.fits)
        self.raster = scan_raster(scan)
        self._perturber = scan_perturber(scan)
        self._amplitude = "amplitude" in scan.statistics
        self._design, self._shards = job.path("design"), job.paths("shards")
        with job.open("design") as artifact:
            check_origin(artifact, job)
        self._check_shards(job)

    def _check_shards(self, job: Job[ScanSettings]) -> None:
        """Check, before anything is computed, that the shards are this campaign's and together hold the raster."""
        spans = []
        for path in self._shards:
            with open_input(path, "scan_operator") as artifact:
                check_origin(artifact, job)
                spans.append(artifact.span or (0, 0))
        edges = [(0, 0), *spans, (self.raster.n_positions, self.raster.n_positions)]
        if any(before[1] != after[0] for before, after in pairwise(edges)):
            raise ArtifactError(
                f"{self._shards[0].parent}: the shards hold the positions {spans}, which do not add up to the "
                f"{self.raster.n_positions} of the raster; delete the folder and run the campaign again"
            )

    def scan(
        self, name: str, images: FloatArray, residual_rows: IntArray, theta_e: Sequence[float] = ()
    ) -> BandScan:
        """Scan images in a band.

        Parameters
        ----------
        name
            Band.
        images
            Brightness [n, image ny, image nx] [e-/s per pixel].
        residual_rows
            Images whose residual maps are wanted too.
        theta_e
            Deflections [arcsec] for which the expected Delta R of the first image's smooth fit is wanted.
        """
        band, convolution = scan_band(self.observed, self.model, name)
        with open_input(self._design, "scan_design") as design:
            linear = read_linear_model(design, name)
        whitened = (band.weights * images).reshape(len(images), -1).T
        fit = solve(linear, np.ascontiguousarray(whitened))
        chosen = LinearFit(
            fit.coefficients[:, residual_rows],
            fit.residual[:, residual_rows],
            fit.chi2[residual_rows],
            fit.penalty[residual_rows],
        )
        coefficients = physical_coefficients(linear, fit.coefficients)[: linear.n_source]
        scanned = ScanBand(linear, self.model.sets, self.model.rays, self._perturber, convolution, band.weights)
        back_projected = residual_images(fit, convolution, band.weights)
        maps, valid, residuals, responses, expected = [], [], [], [], []
        start = time.monotonic()
        for count, path in enumerate(self._shards, start=1):
            with open_input(path, "scan_operator") as artifact:
                shard = read_shard(artifact, name, sensitivity=residual_rows.size > 0)
                self._check_positions(artifact, shard.positions)
            if self._amplitude:
                delta, response = delta_r_and_response(shard, scanned, coefficients, back_projected)
                responses.append(response)
            else:
                delta = delta_r(shard, scanned, coefficients, back_projected)
            maps.append(delta)
            valid.append(np.diff(shard.pixel_offsets) > 0)
            if residual_rows.size:
                residuals.append(residual_maps(shard, scanned, chosen))
            if theta_e:
                expected.append(expected_delta_r(shard, scanned, theta_e, coefficients[:, 0]))
            left = (time.monotonic() - start) / count * (len(self._shards) - count)
            log.info("%s: shard %d of %d, %.0f s left", name, count, len(self._shards), left)
        shape = self.raster.shape
        names = RESIDUALS if residual_rows.size else ()
        together = None
        if self._amplitude:
            score, fisher, noise = (
                np.concatenate([getattr(part, name) for part in responses]).T.reshape(-1, *shape)
                for name in ("score", "fisher", "noise")
            )
            together = LinearResponse(score, fisher, noise[0])
        return BandScan(
            np.concatenate(maps).T.reshape(len(images), *shape),
            fit.chi2,
            np.concatenate(valid).reshape(shape),
            {n: np.concatenate([getattr(part, n) for part in residuals]).T.reshape(-1, *shape) for n in names},
            together,
            np.concatenate(expected, axis=1).reshape(-1, *shape) if theta_e else None,
        )

    def _check_positions(self, artifact: Artifact, positions: FloatArray) -> None:
        start, stop = artifact.span or (0, 0)
        if not np.array_equal(positions, self.raster.coordinates()[start:stop]):
            raise ArtifactError(
                f"{artifact.path}: does not hold the positions {start} to {stop} of the raster; "
                "delete the file and run the campaign again"
            )

    def raster_datasets(self, valid: BoolArray) -> dict[str, Dataset]:
        """Return where the maps' positions lie, and which of them a perturber can be seen at."""
        x, y = self.raster.coordinates().T.reshape(2, *self.raster.shape)
        sky = ("y", "x")
        return {
            "raster/x": Dataset(x, "arcsec", sky, "position, to the West"),
            "raster/y": Dataset(y, "arcsec", sky, "position, to the North"),
            "raster/valid": Dataset(valid, "", sky, "1 where the perturber moves an unmasked pixel"),
        }
