"""Observation, smooth model and scan design as datasets of artifacts, and back."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warmlens.artifacts import Artifact, Dataset, open_artifact
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
    metadata = {
        "kind": observation.kind,
        "grid": dataclasses.asdict(observation.grid),
        "bands": [band.name for band in observation.bands],
        "noise": {band.name: dataclasses.asdict(band.noise) for band in observation.bands},
    }
    return datasets, metadata


def read_observation(path: Path) -> Observation:
    """Observation of an artifact."""
    with open_artifact(path, "observation") as artifact:
        bands = tuple(
            Band(
                name=name,
                image=artifact.array(f"{name}/image"),
                sigma=artifact.array(f"{name}/sigma"),
                mask=artifact.array(f"{name}/mask"),
                psf=artifact.array(f"{name}/psf"),
                noise=NoiseModel(**artifact.metadata["noise"][name]),
            )
            for name in artifact.metadata["bands"]
        )
        return Observation(artifact.metadata["kind"], _grid(artifact.metadata["grid"]), bands)


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


def smooth_model_datasets(model: SmoothModel) -> tuple[dict[str, Dataset], dict[str, Any]]:
    """Datasets and metadata of a smooth model."""
    arcsec = "arcsec"
    datasets = {
        "deflection": Dataset(model.deflection, arcsec, ("component", *_SKY), "smooth deflection (x, y)"),
        "rays/theta_x": Dataset(model.rays.theta_x, arcsec, _RAY, "sky position, to the West"),
        "rays/theta_y": Dataset(model.rays.theta_y, arcsec, _RAY, "sky position, to the North"),
        "rays/source_x": Dataset(model.rays.source_x, arcsec, _RAY, "source position, to the West"),
        "rays/source_y": Dataset(model.rays.source_y, arcsec, _RAY, "source position, to the North"),
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
            f"{band}/sigma": Dataset(fit.sigma, _RATE, _SKY, "noise with the PSF error near quasars"),
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
                "chi2": fit.chi2,
                "n_pixels": fit.n_pixels,
                "n_columns": fit.n_columns,
                "chi2_red": fit.chi2_red,
            }
            for band, fit in model.fits.items()
        },
    }
    return datasets, metadata


def read_smooth_model(path: Path) -> SmoothModel:
    """Smooth model of an artifact."""
    with open_artifact(path, "smooth_model") as artifact:
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
        )


def _read_fit(artifact: Artifact, band: str) -> BandFit:
    numbers = artifact.metadata["fits"][band]
    return BandFit(
        source_coefficients=artifact.array(f"{band}/source_coefficients"),
        fixed_coefficients=artifact.array(f"{band}/fixed_coefficients"),
        fixed_image=artifact.array(f"{band}/fixed_image"),
        model=artifact.array(f"{band}/model"),
        sigma=artifact.array(f"{band}/sigma"),
        chi2=numbers["chi2"],
        n_pixels=numbers["n_pixels"],
        n_columns=numbers["n_columns"],
    )


def design_datasets(band: str, model: LinearModel, projection: BandProjection) -> dict[str, Dataset]:
    """Datasets of the scan design of one band."""
    square = ("column", "column")
    return {
        f"{band}/design": Dataset(model.design, "", ("pixel", "column"), "whitened columns of unit norm, A"),
        f"{band}/column_norms": Dataset(model.column_norms, "", ("column",), "their norms before scaling"),
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
        ridge=design.metadata["ridge"],
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
    "matrices": (("element",), "lower triangles of the quadratic forms M, row by row"),
}


def shard_datasets(band: str, shard: OperatorShard) -> dict[str, Dataset]:
    """Datasets of a shard of the scan operator of one band."""
    return {
        f"{band}/{name}": Dataset(getattr(shard, name), "", axes, description)
        for name, (axes, description) in _SHARD.items()
    }


def read_shard(artifact: Artifact, band: str) -> OperatorShard:
    """Shard of the scan operator of one band."""
    arrays = {name: artifact.array(f"{band}/{name}") for name in _SHARD}
    return OperatorShard(positions=artifact.array("positions"), **arrays)


def scan_band(observation: Observation, model: SmoothModel, name: str) -> tuple[Band, Convolution]:
    """Band `name` with the noise of the smooth model, and its PSF."""
    band = next(item for item in observation.bands if item.name == name)
    return dataclasses.replace(band, sigma=model.fits[name].sigma), Convolution(band.psf, observation.grid.shape)
