"""Observation, smooth model and scan design as datasets of artifacts, and back."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warmlens.artifacts import Artifact, Dataset, open_artifact, reading
from warmlens.fitting.linear import LinearModel
from warmlens.fitting.smooth_model import BandFit
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.observation import Band, Observation
from warmlens.imaging.psf import Convolution
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.operator import BandProjection, OperatorShard
from warmlens.types import FloatArray

_SKY = ("y", "x")
_OFFSET = ("row offset", "column offset")
_RAY = ("pixel", "sub-pixel")
_RATE = "electron / s"


def observation_datasets(observation: Observation) -> tuple[dict[str, Dataset], dict[str, Any]]:
    """Datasets and metadata of an observation."""
    datasets: dict[str, Dataset] = {}
    for band in observation.bands:
        datasets |= {
            f"{band.name}/image": Dataset(band.image, _RATE, _SKY, "observed brightness per pixel"),
            f"{band.name}/sigma": Dataset(band.sigma, _RATE, _SKY, "noise per pixel, inf where masked"),
            f"{band.name}/mask": Dataset(band.mask, "", _SKY, "1 on pixels that are used"),
            f"{band.name}/psf": Dataset(band.psf, "", _SKY, "point spread function, sum 1"),
        }
        if band.noise.correlation is not None:
            datasets[f"{band.name}/noise_correlation"] = Dataset(
                band.noise.correlation, "", _OFFSET, "correlation of the noise between pixels, 1 in the middle"
            )
    metadata = {
        "kind": observation.kind,
        "grid": dataclasses.asdict(observation.grid),
        "bands": [band.name for band in observation.bands],
        "noise": {
            band.name: {"background_rms": band.noise.background_rms, "exposure_s": band.noise.exposure_s}
            for band in observation.bands
        },
    }
    return datasets, metadata


def read_observation(path: Path) -> Observation:
    """Observation of an artifact."""
    with open_artifact(path, "observation") as artifact, reading(path):
        grid = _grid(artifact.metadata["grid"])
        bands = tuple(
            Band(
                name=name,
                image=artifact.array(f"{name}/image"),
                sigma=artifact.array(f"{name}/sigma"),
                mask=artifact.array(f"{name}/mask"),
                psf=artifact.array(f"{name}/psf"),
                noise=NoiseModel(
                    **artifact.metadata["noise"][name],
                    correlation=artifact.array(f"{name}/noise_correlation")
                    if f"{name}/noise_correlation" in artifact.file
                    else None,
                ),
            )
            for name in artifact.metadata["bands"]
        )
        for band in bands:
            for label, array in (("image", band.image), ("sigma", band.sigma), ("mask", band.mask)):
                if array.shape != grid.shape:
                    raise ValueError(f"{label} of band {band.name} has shape {array.shape}, not {grid.shape}")
            if band.psf.ndim != 2:
                raise ValueError(f"the PSF of band {band.name} has {band.psf.ndim} dimensions")
        return Observation(artifact.metadata["kind"], grid, bands)


def _grid(stored: dict[str, Any]) -> PixelGrid:
    (xx, xy), (yx, yy) = stored["axes"]
    return PixelGrid(**{**stored, "axes": ((xx, xy), (yx, yy))})


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


def design_datasets(band: str, model: LinearModel, projection: BandProjection) -> dict[str, Dataset]:
    """Datasets of the scan design of one band."""
    square = ("column", "column")
    return {
        f"{band}/design": Dataset(model.design, "", ("pixel", "column"), "whitened columns of unit norm, A"),
        f"{band}/column_norms": Dataset(model.column_norms, "", ("column",), "their norms before scaling"),
        f"{band}/prior": Dataset(model.prior, "", ("column",), "weight of the Gaussian prior on each, Lambda"),
        f"{band}/inverse_factor": Dataset(
            model.inverse_factor, "", square, "inverse Cholesky factor of the normal matrix, 1/L"
        ),
        f"{band}/projected": Dataset(projection.projected, "", ("pixel", "column"), "transpose of G"),
        f"{band}/overlap": Dataset(
            projection.overlap,
            "",
            ("row offset", "column offset", "pixel"),
            "elements of S by pixel and offset",
        ),
    }


def read_linear_model(design: Artifact, band: str) -> LinearModel:
    """Linear model of one band."""
    return LinearModel(
        design=design.array(f"{band}/design"),
        column_norms=design.array(f"{band}/column_norms"),
        inverse_factor=design.array(f"{band}/inverse_factor"),
        prior=design.array(f"{band}/prior"),
        n_source=design.metadata["n_source"],
    )


def read_projection(design: Artifact, band: str) -> BandProjection:
    """What all shards of the operator share, of one band."""
    return BandProjection(
        design.array(f"{band}/projected"), design.array(f"{band}/overlap"), design.metadata["n_image_columns"]
    )


_SHARD = {
    "pixel_offsets": (
        ("position edge",),
        "pixels of position i are pixels[pixel_offsets[i]:pixel_offsets[i + 1]]",
    ),
    "pixels": (("moved pixel",), "flat index of each pixel that a perturber moves"),
    "matrix_offsets": (("position edge",), "where the matrix of each position begins"),
    "matrices": (("element",), "lower triangles of the quadratic forms Q, row by row"),
    "points": (("position", "component"), "source position (x, y) and scale of the nested shapelets [arcsec]"),
    "nested_inverse": (("position", "element"), "lower triangle of the nested shapelets' 1/C_s"),
}
_SENSITIVITY = (("element",), "lower triangles of the quadratic forms Gamma, as the matrices")
_RESPONSE = {
    "responses": (("response element",), "K (lower triangle) and R of each position, one after the other"),
    "response_noise": (("position",), "what noise adds to the Fisher information on the mean"),
}


def shard_datasets(band: str, shard: OperatorShard) -> dict[str, Dataset]:
    """Datasets of a shard of the scan operator of one band."""
    described = {**_SHARD, "sensitivity": _SENSITIVITY}
    if shard.responses.size:
        described |= _RESPONSE
    return {
        f"{band}/{name}": Dataset(getattr(shard, name), "", axes, description)
        for name, (axes, description) in described.items()
    }


def read_shard(artifact: Artifact, band: str, *, sensitivity: bool) -> OperatorShard:
    """Shard of the scan operator of one band; `sensitivity` is half of it, and only residual maps need it."""
    arrays = {name: artifact.array(f"{band}/{name}") for name in _SHARD}
    arrays["sensitivity"] = artifact.array(f"{band}/sensitivity") if sensitivity else np.empty(0)
    for name in _RESPONSE:
        arrays[name] = artifact.array(f"{band}/{name}") if f"{band}/{name}" in artifact.file else np.empty(0)
    return OperatorShard(
        positions=artifact.array("positions"), nested_n_max=artifact.metadata["nested_n_max"], **arrays
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
