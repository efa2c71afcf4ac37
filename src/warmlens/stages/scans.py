"""Stages `scans` and `observed_scan`: Delta R maps of mocks and of the observation."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from warmlens.artifacts.file import Artifact, ArtifactError, Dataset, Provenance, open_artifact, write_artifact
from warmlens.fitting.linear import LinearFit, physical_coefficients, solve
from warmlens.imaging.observation import Observation
from warmlens.physics import geometry, scan_perturber, scan_raster
from warmlens.products.observation import read_observation
from warmlens.products.samples import SampleTable, after, null
from warmlens.products.scan_operator import read_linear_model, read_shard
from warmlens.products.smooth_model import SmoothModel, read_smooth_model, scan_band
from warmlens.scan.apply import delta_r, delta_r_and_response
from warmlens.scan.maps import residual_images, residual_maps
from warmlens.scan.response import (
    LinearResponse,
    detectable_theta_e,
    expected_delta_r,
    mass_within_truncation,
)
from warmlens.scan.shard import ScanBand
from warmlens.stages.scan_operator import check_origin
from warmlens.stages.settings import ScanSettings
from warmlens.types import BoolArray, FloatArray, IntArray

log = logging.getLogger(__name__)


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
    """Scans images of one campaign: holds observation, smooth model and where the operator lies."""

    def __init__(
        self,
        settings: ScanSettings,
        observation: Path,
        smooth_model: Path,
        design: Path,
        shards: Sequence[Path],
    ) -> None:
        origin = {"observation": observation, "smooth_model": smooth_model}
        self.inputs = {**origin, "design": design} | {shard.stem: shard for shard in shards}
        self.observed: Observation = read_observation(observation)
        self.model: SmoothModel = read_smooth_model(smooth_model)
        self.bands = list(self.model.fits)
        self.raster = scan_raster(settings.scan, self.observed)
        self._perturber = scan_perturber(settings.scan)
        self._amplitude = "amplitude" in settings.scan.statistics
        self._design, self._shards = design, shards
        with open_artifact(design, "scan_design") as artifact:
            check_origin(artifact, settings, origin)
        self._check_shards(settings, {**origin, "design": design})

    def _check_shards(self, settings: ScanSettings, origin: dict[str, Path]) -> None:
        """Before anything is computed: every shard is this campaign's, and together they are the raster."""
        spans = []
        for path in self._shards:
            with open_artifact(path, "scan_operator") as artifact:
                check_origin(artifact, settings, origin)
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
        with open_artifact(self._design, "scan_design") as design:
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
            with open_artifact(path, "scan_operator") as artifact:
                shard = read_shard(artifact, name, sensitivity=residual_rows.size > 0)
                self._check_positions(artifact, shard.positions)
            if self._amplitude:
                found, response = delta_r_and_response(shard, scanned, coefficients, back_projected)
                responses.append(response)
            else:
                found = delta_r(shard, scanned, coefficients, back_projected)
            maps.append(found)
            valid.append(np.diff(shard.pixel_offsets) > 0)
            if residual_rows.size:
                residuals.append(residual_maps(shard, scanned, chosen))
            if theta_e:
                expected.append(expected_delta_r(shard, scanned, theta_e, coefficients[:, 0]))
            left = (time.monotonic() - start) / count * (len(self._shards) - count)
            log.info("%s: shard %d of %d, %.0f s left", name, count, len(self._shards), left)
        shape = self.raster.shape
        names = _RESIDUALS if residual_rows.size else {}
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
        """Where the maps' positions lie, and which of them a perturber can be seen at."""
        x, y = self.raster.coordinates().T.reshape(2, *self.raster.shape)
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
    """Write Delta R and the chi2 of the smooth fit of every mock of a chunk, or of the null test."""
    scanner = Scanner(settings, observation, smooth_model, design, shards)
    with open_artifact(mocks, "mocks", null("mocks")) as artifact:
        inputs = {"mocks": mocks, **scanner.inputs}
        provenance = Provenance(after(artifact, "scans"), settings.as_dict(), inputs, span=artifact.span)
        table = SampleTable.read(artifact)
        done = table.done
        ids = table.parameters.sample_id[done]
        residual_rows = np.flatnonzero(np.isin(ids, settings.scan.residual_samples))
        valid = np.zeros(scanner.raster.shape, dtype=bool)
        results: dict[str, dict[str, FloatArray]] = {}
        datasets: dict[str, Dataset] = {}
        if residual_rows.size:
            datasets["residuals/sample_id"] = Dataset(
                ids[residual_rows], "", ("residual sample",), "samples of r_smooth, r_pert and r_sens"
            )
        for band in scanner.bands:
            images = artifact.array(f"{band}/image").astype(np.float64)
            results[band] = _empty(settings, len(table), scanner.raster.shape)
            if done.any():
                scan = scanner.scan(band, images[done], residual_rows)
                for name, values in _numbers(scan).items():
                    results[band][name][done] = values
                valid |= scan.valid
                datasets |= _residual_datasets(band, scan.residuals, ("residual sample",)) | _noise_dataset(
                    band, scan
                )
    table.for_each(lambda row: _check_row(results, row), "scans")
    datasets = {**table.datasets(), **scanner.raster_datasets(valid), **datasets}
    for band, numbers in results.items():
        datasets |= _scan_datasets(band, numbers, ("sample",))
    write_artifact(output, provenance, datasets, {"bands": scanner.bands})


def _numbers(scan: BandScan) -> dict[str, FloatArray]:
    """What is written of each image, by the name of its dataset."""
    numbers = {"delta_r": scan.delta_r, "chi2": scan.chi2}
    if scan.response is not None:
        numbers |= {"score": scan.response.score, "fisher": scan.response.fisher}
    return numbers


def _empty(settings: ScanSettings, n: int, shape: tuple[int, int]) -> dict[str, FloatArray]:
    """NaN for n images."""
    amplitude = ("score", "fisher") if "amplitude" in settings.scan.statistics else ()
    return {name: np.full((n, *shape), np.nan) for name in ("delta_r", *amplitude)} | {"chi2": np.full(n, np.nan)}


def _check_row(results: dict[str, dict[str, FloatArray]], row: int) -> None:
    for band, numbers in results.items():
        for name, values in numbers.items():
            if not np.isfinite(values[row]).all():
                raise FloatingPointError(f"{name} of the scan in {band} is not finite")


def run_observed(
    settings: ScanSettings,
    observation: Path,
    smooth_model: Path,
    design: Path,
    shards: Sequence[Path],
    output: Path,
) -> None:
    """Write Delta R, R_smooth, R_pert, R_sens and the chi2 of the smooth fit of the observation.

    As `scan.statistics` and `scan.sensitivity` say also the linear response, and what mass would be seen.
    """
    scanner = Scanner(settings, observation, smooth_model, design, shards)
    provenance = Provenance("observed_scan", settings.as_dict(), scanner.inputs)
    valid = np.zeros(scanner.raster.shape, dtype=bool)
    datasets: dict[str, Dataset] = {}
    asked = settings.scan.sensitivity
    theta_e = [] if asked is None else asked.theta_e_arcsec
    expected = np.zeros((len(theta_e), *scanner.raster.shape))
    for band in scanner.observed.bands:
        scan = scanner.scan(band.name, band.image[None], np.array([0]), theta_e)
        valid |= scan.valid
        datasets |= _scan_datasets(band.name, {name: item[0] for name, item in _numbers(scan).items()}, ())
        datasets |= _residual_datasets(band.name, {name: maps[0] for name, maps in scan.residuals.items()}, ())
        datasets |= _noise_dataset(band.name, scan)
        if scan.expected is not None:
            expected += scan.expected
    if theta_e:
        datasets |= _sensitivity_datasets(settings, expected)
    write_artifact(output, provenance, {**datasets, **scanner.raster_datasets(valid)}, {"bands": scanner.bands})


_RESIDUALS = {
    "r_smooth": "chi2 of the fit without the perturber, nested shapelets included",
    "r_pert": "chi2 of the fit with the perturber, nested shapelets included",
    "r_sens": "squared difference of the two models, in units of the noise",
}


def _residual_datasets(band: str, maps: dict[str, FloatArray], lead: tuple[str, ...]) -> dict[str, Dataset]:
    return {f"{band}/{name}": Dataset(maps[name], "", (*lead, "y", "x"), _RESIDUALS[name]) for name in maps}


_NUMBERS = {
    "delta_r": "minimum of chi2 + prior with the perturber minus that without",
    "chi2": "chi2 of the smooth fit, nothing nested",
    "score": "-1/2 of the derivative of that minimum by the perturber's amplitude, 1 for the configured one, at 0",
    "fisher": "Fisher information of the amplitude, the variance of the score",
}


def _scan_datasets(band: str, numbers: dict[str, FloatArray], lead: tuple[str, ...]) -> dict[str, Dataset]:
    return {
        f"{band}/{name}": Dataset(
            np.asarray(values), "", lead if name == "chi2" else (*lead, "y", "x"), _NUMBERS[name]
        )
        for name, values in numbers.items()
    }


def _noise_dataset(band: str, scan: BandScan) -> dict[str, Dataset]:
    """What is the same for every image of the band."""
    if scan.response is None:
        return {}
    what = "part of fisher that noise in the fitted source makes on the mean; score / (fisher - it) is unbiased"
    return {f"{band}/fisher_noise": Dataset(scan.response.noise, "", ("y", "x"), what)}


def _sensitivity_datasets(settings: ScanSettings, expected: FloatArray) -> dict[str, Dataset]:
    """What the bands together would see of perturbers [theta_e, y, x], and the smallest mass that they would."""
    asked, cosmology, redshifts = settings.scan.sensitivity, settings.cosmology, settings.redshifts
    if asked is None or cosmology is None or redshifts is None:
        raise ValueError("scan.sensitivity needs the cosmology and the redshifts in the settings of the stage")
    _, lens = geometry(cosmology, redshifts)
    theta_e = np.array(asked.theta_e_arcsec)
    r_trunc = settings.scan.perturber.r_trunc_arcsec
    smallest = detectable_theta_e(theta_e, expected, asked.delta_r)
    mass = mass_within_truncation(smallest, r_trunc, lens.sigma_crit_msun_arcsec2)
    sky = ("y", "x")
    return {
        "sensitivity/theta_e": Dataset(theta_e, "arcsec", ("theta_e",), "deflections inside r_trunc"),
        "sensitivity/expected_delta_r": Dataset(
            expected, "", ("theta_e", *sky), "expected Delta R of an image that contains the perturber, all bands"
        ),
        "sensitivity/min_mass": Dataset(
            mass, "Msun", sky, f"mass within r_trunc that brings it to {-asked.delta_r:g}; NaN: none in the list"
        ),
    }
