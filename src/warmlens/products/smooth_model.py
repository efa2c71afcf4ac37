"""The smooth model as datasets of its artifact, and back."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warmlens.artifacts.file import Artifact, Dataset, open_artifact, reading
from warmlens.fitting.smooth_model import BandFit
from warmlens.imaging.observation import Band, Observation
from warmlens.imaging.psf import Convolution
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.rays import SmoothRays
from warmlens.products.observation import _RATE, _RAY, _SKY
from warmlens.types import FloatArray


@dataclass(frozen=True)
class SmoothModel:
    """What the campaign reads of the smooth model.

    Attributes
    ----------
    deflection
        At the pixel centres [2, ny, nx] [arcsec].
    rays
        Sub-pixels on the sky and in the source plane.
    sets, supersampling, ridge
        Source basis, sub-pixels per pixel and axis, and prior of the linear fit.
    names, fixed
        Per band: names and blurred images [npix, n_fixed] of the columns that no perturber moves.
    fits
        Per band: amplitudes, model and chi2.
    lens_models, kwargs_lens
        The lens in lenstronomy's names.
    quasars
        Positions of the quasar images [n_quasars, 2] [arcsec].
    macro
        Per band: what the image changes by when the fitted parameters move along the axes of their errors, by
        one sigma each [npix, n_axes]; none for a given lens, whose errors are not known.
    macro_sigma
        Width of the fit's own prior along each axis, in units of that sigma [n_axes], >= 1.
    """

    deflection: FloatArray
    rays: SmoothRays
    sets: tuple[ShapeletSet, ...]
    supersampling: int
    ridge: float
    names: tuple[str, ...]
    fixed: dict[str, FloatArray]
    n_quasars: int
    fits: dict[str, BandFit]
    lens_models: tuple[str, ...]
    kwargs_lens: tuple[dict[str, Any], ...]
    quasars: FloatArray
    macro: dict[str, FloatArray]
    macro_sigma: FloatArray


def smooth_model_datasets(model: SmoothModel) -> tuple[dict[str, Dataset], dict[str, Any]]:
    """Datasets and metadata of a smooth model."""
    arcsec = "arcsec"
    datasets = {
        "deflection": Dataset(model.deflection, arcsec, ("component", *_SKY), "smooth deflection (x, y)"),
        "rays/theta_x": Dataset(model.rays.theta_x, arcsec, _RAY, "sky position, to the West"),
        "rays/theta_y": Dataset(model.rays.theta_y, arcsec, _RAY, "sky position, to the North"),
        "rays/source_x": Dataset(model.rays.source_x, arcsec, _RAY, "source position, to the West"),
        "rays/source_y": Dataset(model.rays.source_y, arcsec, _RAY, "source position, to the North"),
        "quasars": Dataset(model.quasars, arcsec, ("quasar", "component"), "quasar images (x, y)"),
        "macro_sigma": Dataset(model.macro_sigma, "", ("axis",), "width of the fit's prior, in sigma of the fit"),
    }
    for band, fit in model.fits.items():
        datasets |= {
            f"{band}/source_coefficients": Dataset(
                fit.source_coefficients, _RATE, ("shapelet",), "amplitudes of the source, lenstronomy's order"
            ),
            f"{band}/fixed_coefficients": Dataset(
                fit.fixed_coefficients, _RATE, ("column",), "amplitudes of quasars, light and background"
            ),
            f"{band}/fixed_columns": Dataset(
                model.fixed[band], "", ("pixel", "column"), "blurred images of these for amplitude 1"
            ),
            f"{band}/fixed_image": Dataset(fit.fixed_image, _RATE, _SKY, "quasars, lens light and background"),
            f"{band}/model": Dataset(fit.model, _RATE, _SKY, "smooth model of the image"),
            f"{band}/sigma": Dataset(fit.sigma, _RATE, _SKY, "noise with the PSF error, inf where masked"),
            f"{band}/psf": Dataset(fit.psf, "", _SKY, "point spread function of the model, sum 1"),
            f"{band}/macro_columns": Dataset(
                model.macro[band],
                _RATE,
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


def scan_band(observation: Observation, model: SmoothModel, name: str) -> tuple[Band, Convolution]:
    """Band `name` with the noise, the mask and the PSF of the smooth model, and its convolution."""
    band = next(item for item in observation.bands if item.name == name)
    fit = model.fits[name]
    used = band.mask & np.isfinite(fit.sigma)
    return (
        dataclasses.replace(band, sigma=fit.sigma, mask=used, psf=fit.psf),
        Convolution(fit.psf, observation.grid.shape),
    )
