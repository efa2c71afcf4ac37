"""The smooth model as datasets of its artifact, and back."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from warmlens.artifacts.file import Artifact, Dataset, open_input, reading
from warmlens.fitting.judgement import Judgement
from warmlens.fitting.lens_fit import LensFit
from warmlens.fitting.smooth_model import BandFit, SmoothModel
from warmlens.fitting.variable_projection import covariance
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.rays import SmoothRays
from warmlens.products.observation import OFFSET, RATE, RAY, SKY

_RAYS = {
    "theta_x": "sky position, to the West",
    "theta_y": "sky position, to the North",
    "source_x": "source position, to the West",
    "source_y": "source position, to the North",
}
_BAND_ARRAYS = {  # unit, axes and description of each array of a `BandFit`
    "source_coefficients": (RATE, ("shapelet",), "amplitudes of the source, lenstronomy's order"),
    "fixed_coefficients": (RATE, ("column",), "amplitudes of quasars, light and background"),
    "fixed_image": (RATE, SKY, "quasars, lens light and background"),
    "model": (RATE, SKY, "smooth model of the image"),
    "sigma": (RATE, SKY, "noise with the PSF error, inf where masked"),
    "psf": ("", SKY, "point spread function of the model, sum 1"),
}
_BAND_NUMBERS = (
    "chi2", "n_pixels", "chi2_outside_cores", "n_pixels_outside_cores", "chi2_noise_only", "n_columns"
)  # fmt: skip
_DERIVED_NUMBERS = ("chi2_red", "chi2_red_outside_cores", "chi2_red_noise_only")


def smooth_model_datasets(model: SmoothModel) -> tuple[dict[str, Dataset], dict[str, Any]]:
    """Return datasets and metadata of what the campaign reads of a smooth model."""
    arcsec = "arcsec"
    datasets = {
        "deflection": Dataset(model.deflection, arcsec, ("component", *SKY), "smooth deflection (x, y)"),
        "quasars": Dataset(model.quasars, arcsec, ("quasar", "component"), "quasar images (x, y)"),
        "macro_sigma": Dataset(model.macro_sigma, "", ("axis",), "width of the fit's prior, in sigma of the fit"),
    }
    for name, description in _RAYS.items():
        datasets[f"rays/{name}"] = Dataset(getattr(model.rays, name), arcsec, RAY, description)
    for band, fit in model.fits.items():
        for name, (unit, axes, description) in _BAND_ARRAYS.items():
            datasets[f"{band}/{name}"] = Dataset(getattr(fit, name), unit, axes, description)
        what = "blurred images of the fixed columns for amplitude 1"
        datasets[f"{band}/fixed_columns"] = Dataset(model.fixed[band], "", ("pixel", "column"), what)
        what = "change of the image for one sigma of the fitted parameters"
        datasets[f"{band}/macro_columns"] = Dataset(model.macro[band], RATE, ("pixel", "axis"), what)
    metadata = {
        "sets": [dataclasses.asdict(shapelets) for shapelets in model.sets],
        "supersampling": model.supersampling,
        "ridge": model.ridge,
        "columns": list(model.names),
        "n_quasars": model.n_quasars,
        "bands": list(model.fits),
        "fits": {
            band: {name: getattr(fit, name) for name in (*_BAND_NUMBERS, *_DERIVED_NUMBERS)}
            for band, fit in model.fits.items()
        },
        "lens_models": list(model.lens_models),
        "kwargs_lens": list(model.kwargs_lens),
    }
    return datasets, metadata


def fit_datasets(fitted: LensFit, judgement: Judgement) -> tuple[dict[str, Dataset], dict[str, Any]]:
    """Return datasets and metadata of how the model was fitted: parameters, errors, history and judgement."""
    model, solution = fitted.model, fitted.solution
    datasets: dict[str, Dataset] = {}
    if model.space.parameters:
        matrix, axis = covariance(model, solution), "parameter"
        datasets["parameters/value"] = Dataset(solution.vector, "", (axis,), "best fit, as the metadata name them")
        datasets["parameters/error"] = Dataset(np.sqrt(np.diag(matrix)), "", (axis,), "one sigma, priors included")
        datasets["parameters/covariance"] = Dataset(matrix, "", (axis, axis), "from the final curvature")
    for band, error in zip(model.bands, fitted.psf_errors or (), strict=bool(fitted.psf_errors)):
        datasets[f"{band.name}/psf_error_radius"] = Dataset(
            error.radius, "arcsec", ("ring",), "outer edges of the rings"
        )
        datasets[f"{band.name}/psf_error"] = Dataset(error.sigma, "", ("ring",), "error of the PSF in each ring")
    for name, correlation in judgement.residual_correlation.items():
        datasets[f"{name}/residual_correlation"] = Dataset(
            correlation,
            "",
            OFFSET,
            "correlation of the residuals between pixels outside the quasars' cores, in units of the noise",
        )
    metadata = {
        "converged": fitted.converged,
        "history": [dataclasses.asdict(step) for step in fitted.history],
        "parameters": [
            {key: getattr(parameter, key) for key in ("name", "start", "lower", "upper", "sigma")}
            for parameter in model.space.parameters
        ],
        "source_center": solution.center.tolist(),
        "kwargs_lens_light": list(solution.macro.kwargs_light),
        "problems": judgement.problems,
        "notes": judgement.notes,
    }
    return datasets, metadata


def read_smooth_model(path: Path) -> SmoothModel:
    """Read the smooth model of an artifact."""
    with open_input(path, "smooth_model") as artifact, reading(path):
        meta = artifact.metadata
        return SmoothModel(
            deflection=artifact.array("deflection"),
            rays=SmoothRays(*(artifact.array(f"rays/{name}") for name in _RAYS)),
            sets=tuple(ShapeletSet(**shapelets) for shapelets in meta["sets"]),
            supersampling=meta["supersampling"],
            ridge=meta["ridge"],
            names=tuple(meta["columns"]),
            fixed={band: artifact.array(f"{band}/fixed_columns") for band in meta["bands"]},
            fits={band: _read_fit(artifact, band) for band in meta["bands"]},
            lens_models=tuple(meta["lens_models"]),
            kwargs_lens=tuple(meta["kwargs_lens"]),
            quasars=artifact.array("quasars"),
            macro={band: artifact.array(f"{band}/macro_columns") for band in meta["bands"]},
            macro_sigma=artifact.array("macro_sigma"),
        )


def _read_fit(artifact: Artifact, band: str) -> BandFit:
    stored: dict[str, Any] = {name: artifact.array(f"{band}/{name}") for name in _BAND_ARRAYS}
    stored |= {name: artifact.metadata["fits"][band][name] for name in _BAND_NUMBERS}
    return BandFit(**stored)
