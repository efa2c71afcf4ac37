"""The smooth model as datasets of its artifact, and back."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from warmlens.artifacts.file import Artifact, Dataset, open_artifact, reading
from warmlens.fitting.smooth_model import BandFit, SmoothModel
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.rays import SmoothRays
from warmlens.products.observation import RATE, RAY, SKY


def smooth_model_datasets(model: SmoothModel) -> tuple[dict[str, Dataset], dict[str, Any]]:
    """Datasets and metadata of a smooth model."""
    arcsec = "arcsec"
    datasets = {
        "deflection": Dataset(model.deflection, arcsec, ("component", *SKY), "smooth deflection (x, y)"),
        "rays/theta_x": Dataset(model.rays.theta_x, arcsec, RAY, "sky position, to the West"),
        "rays/theta_y": Dataset(model.rays.theta_y, arcsec, RAY, "sky position, to the North"),
        "rays/source_x": Dataset(model.rays.source_x, arcsec, RAY, "source position, to the West"),
        "rays/source_y": Dataset(model.rays.source_y, arcsec, RAY, "source position, to the North"),
        "quasars": Dataset(model.quasars, arcsec, ("quasar", "component"), "quasar images (x, y)"),
        "macro_sigma": Dataset(model.macro_sigma, "", ("axis",), "width of the fit's prior, in sigma of the fit"),
    }
    for band, fit in model.fits.items():
        datasets |= {
            f"{band}/source_coefficients": Dataset(
                fit.source_coefficients, RATE, ("shapelet",), "amplitudes of the source, lenstronomy's order"
            ),
            f"{band}/fixed_coefficients": Dataset(
                fit.fixed_coefficients, RATE, ("column",), "amplitudes of quasars, light and background"
            ),
            f"{band}/fixed_columns": Dataset(
                model.fixed[band], "", ("pixel", "column"), "blurred images of these for amplitude 1"
            ),
            f"{band}/fixed_image": Dataset(fit.fixed_image, RATE, SKY, "quasars, lens light and background"),
            f"{band}/model": Dataset(fit.model, RATE, SKY, "smooth model of the image"),
            f"{band}/sigma": Dataset(fit.sigma, RATE, SKY, "noise with the PSF error, inf where masked"),
            f"{band}/psf": Dataset(fit.psf, "", SKY, "point spread function of the model, sum 1"),
            f"{band}/macro_columns": Dataset(
                model.macro[band],
                RATE,
                ("pixel", "axis"),
                "change of the image for one sigma of the fitted parameters",
            ),
        }
    metadata = {
        "sets": [dataclasses.asdict(item) for item in model.sets],
        "supersampling": model.supersampling,
        "ridge": model.ridge,
        "columns": list(model.names),
        "n_quasars": model.n_quasars,
        "bands": list(model.fits),
        "fits": {
            band: {
                **{name: getattr(fit, name) for name in _FIT_NUMBERS},
                "chi2_red": fit.chi2_red,
                "chi2_red_outside_cores": fit.chi2_red_outside_cores,
                "chi2_red_noise_only": fit.chi2_red_noise_only,
            }
            for band, fit in model.fits.items()
        },
        "lens_models": list(model.lens_models),
        "kwargs_lens": list(model.kwargs_lens),
    }
    return datasets, metadata


def read_smooth_model(path: Path) -> SmoothModel:
    """Smooth model of an artifact."""
    with open_artifact(path, "smooth_model") as artifact, reading(path):
        meta = artifact.metadata
        rays = SmoothRays(
            *(artifact.array(f"rays/{name}") for name in ("theta_x", "theta_y", "source_x", "source_y"))
        )
        return SmoothModel(
            deflection=artifact.array("deflection"),
            rays=rays,
            sets=tuple(ShapeletSet(**item) for item in meta["sets"]),
            supersampling=meta["supersampling"],
            ridge=meta["ridge"],
            names=tuple(meta["columns"]),
            fixed={band: artifact.array(f"{band}/fixed_columns") for band in meta["bands"]},
            n_quasars=meta["n_quasars"],
            fits={band: _read_fit(artifact, band) for band in meta["bands"]},
            lens_models=tuple(meta["lens_models"]),
            kwargs_lens=tuple(meta["kwargs_lens"]),
            quasars=artifact.array("quasars"),
            macro={band: artifact.array(f"{band}/macro_columns") for band in meta["bands"]},
            macro_sigma=artifact.array("macro_sigma"),
        )


_FIT_NUMBERS = (
    "chi2",
    "n_pixels",
    "chi2_outside_cores",
    "n_pixels_outside_cores",
    "chi2_noise_only",
    "n_columns",
)


def _read_fit(artifact: Artifact, band: str) -> BandFit:
    numbers = artifact.metadata["fits"][band]
    return BandFit(
        source_coefficients=artifact.array(f"{band}/source_coefficients"),
        fixed_coefficients=artifact.array(f"{band}/fixed_coefficients"),
        fixed_image=artifact.array(f"{band}/fixed_image"),
        model=artifact.array(f"{band}/model"),
        sigma=artifact.array(f"{band}/sigma"),
        psf=artifact.array(f"{band}/psf"),
        **{name: numbers[name] for name in _FIT_NUMBERS},
    )
