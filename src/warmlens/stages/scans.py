"""Stages `scans`, `null_scans` and `observed_scan`: Delta R maps of mocks and of the observation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warmlens.artifacts.file import Dataset
from warmlens.physics import geometry
from warmlens.products.samples import SampleTable
from warmlens.scan.response import detectable_theta_e, mass_within_truncation
from warmlens.stage_table import ScanSettings
from warmlens.stages.job import Job
from warmlens.stages.scanner import BandScan, Scanner
from warmlens.types import FloatArray


def run(job: Job[ScanSettings]) -> None:
    """Write Delta R and the chi2 of the smooth fit of every mock of a chunk, or of the null test."""
    scan = job.settings.scan
    scanner = Scanner(job)
    with job.open("mocks") as mocks:
        table, span = SampleTable.read(mocks), mocks.span
        done = table.done
        ids = table.parameters.sample_id[done]
        residual_rows = np.flatnonzero(np.isin(ids, scan.residual_samples))
        valid = np.zeros(scanner.raster.shape, dtype=bool)
        numbers: dict[str, dict[str, FloatArray]] = {}
        datasets: dict[str, Dataset] = {}
        if residual_rows.size:
            datasets["residuals/sample_id"] = Dataset(
                ids[residual_rows], "", ("residual sample",), "samples of r_smooth, r_pert and r_sens"
            )
        for band in scanner.bands:
            images = mocks.array(f"{band}/image").astype(np.float64)
            numbers[band] = _empty(scan.statistics, len(table), scanner.raster.shape)
            if done.any():
                result = scanner.scan(band, images[done], residual_rows)
                for name, values in _numbers(result).items():
                    numbers[band][name][done] = values
                valid |= result.valid
                datasets |= _residual_datasets(band, result.residuals, ("residual sample",))
                datasets |= _noise_dataset(band, result)
    table.for_each(lambda row: _check_row(numbers, row), "scans")
    datasets = {**table.datasets(), **scanner.raster_datasets(valid), **datasets}
    for band, of_band in numbers.items():
        datasets |= _scan_datasets(band, of_band, ("sample",))
    job.write(datasets, {"bands": scanner.bands}, span)


def run_observed(job: Job[ScanSettings]) -> None:
    """Write Delta R, R_smooth, R_pert, R_sens and the chi2 of the smooth fit of the observation.

    With `scan.statistics` and `scan.sensitivity` also the linear response, and which mass the image would show.
    """
    scanner, asked = Scanner(job), job.settings.scan.sensitivity
    valid = np.zeros(scanner.raster.shape, dtype=bool)
    datasets: dict[str, Dataset] = {}
    theta_e = [] if asked is None else asked.theta_e_arcsec
    expected = np.zeros((len(theta_e), *scanner.raster.shape))
    for band in scanner.observed.bands:
        result = scanner.scan(band.name, band.image[None], np.array([0]), theta_e)
        valid |= result.valid
        datasets |= _scan_datasets(band.name, {name: values[0] for name, values in _numbers(result).items()}, ())
        datasets |= _residual_datasets(band.name, {name: maps[0] for name, maps in result.residuals.items()}, ())
        datasets |= _noise_dataset(band.name, result)
        if result.expected is not None:
            expected += result.expected
    if theta_e:
        datasets |= _sensitivity_datasets(job.settings, expected)
    job.write({**datasets, **scanner.raster_datasets(valid)}, {"bands": scanner.bands})


def _numbers(scan: BandScan) -> dict[str, FloatArray]:
    """Return what is written of each image, by the name of its dataset."""
    numbers = {"delta_r": scan.delta_r, "chi2": scan.chi2}
    if scan.response is not None:
        numbers |= {"score": scan.response.score, "fisher": scan.response.fisher}
    return numbers


def _empty(statistics: Sequence[str], n: int, shape: tuple[int, int]) -> dict[str, FloatArray]:
    """Return NaN for n images."""
    amplitude = ("score", "fisher") if "amplitude" in statistics else ()
    return {name: np.full((n, *shape), np.nan) for name in ("delta_r", *amplitude)} | {"chi2": np.full(n, np.nan)}


def _check_row(results: dict[str, dict[str, FloatArray]], row: int) -> None:
    for band, numbers in results.items():
        for name, values in numbers.items():
            if not np.isfinite(values[row]).all():
                raise FloatingPointError(f"{name} of the scan in {band} is not finite")


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
    """Return what is the same for every image of the band."""
    if scan.response is None:
        return {}
    what = "part of fisher that noise in the fitted source makes on the mean; score / (fisher - it) is unbiased"
    return {f"{band}/fisher_noise": Dataset(scan.response.noise, "", ("y", "x"), what)}


def _sensitivity_datasets(settings: ScanSettings, expected: FloatArray) -> dict[str, Dataset]:
    """Return the expected Delta R of perturbers [theta_e, y, x], and the smallest mass that would be seen."""
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
