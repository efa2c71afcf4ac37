"""Observation, smooth model and scan design as datasets of artifacts, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warmlens.artifacts.file import Dataset, open_artifact, open_input, reading
from warmlens.config.types import ConfigError
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.observation import Band, Observation

SKY = ("y", "x")
OFFSET = ("row offset", "column offset")
RAY = ("pixel", "sub-pixel")
RATE = "electron / s"


def observation_datasets(observation: Observation) -> tuple[dict[str, Dataset], dict[str, Any]]:
    """Return the datasets and metadata of an observation."""
    datasets: dict[str, Dataset] = {}
    for band in observation.bands:
        datasets |= {
            f"{band.name}/image": Dataset(band.image, RATE, SKY, "observed brightness per pixel"),
            f"{band.name}/sigma": Dataset(band.sigma, RATE, SKY, "noise per pixel, inf where masked"),
            f"{band.name}/mask": Dataset(band.mask, "", SKY, "1 on pixels that are used"),
            f"{band.name}/psf": Dataset(band.psf, "", SKY, "point spread function, sum 1"),
        }
        if band.noise.correlation is not None:
            datasets[f"{band.name}/noise_correlation"] = Dataset(
                band.noise.correlation, "", OFFSET, "correlation of the noise between pixels, 1 in the middle"
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
    """Read the observation of an artifact."""
    with open_input(path, "observation") as artifact, reading(path):
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


def copy_bands(source: Path, bands: Sequence[str]) -> tuple[dict[str, Dataset], dict[str, Any]]:
    """Return the datasets and metadata of some bands of another observation; of all bands its exact content.

    Raises
    ------
    ArtifactError
        If the file is damaged or no observation, naming it.
    ConfigError
        If it lacks a band.
    """
    read_observation(source)  # refuses what is no observation
    with open_artifact(source, "observation") as artifact:
        known = artifact.metadata["bands"]
        missing = [band for band in bands if band not in known]
        if missing:
            raise ConfigError([f"observation.bands: {source} has no bands {missing}; it has {known}"])
        left_out = [f"{band}/" for band in known if band not in bands]
        datasets = {
            name: artifact.dataset(name) for name in artifact.names if not name.startswith(tuple(left_out))
        }
        noise = {band: artifact.metadata["noise"][band] for band in bands}
        return datasets, {**artifact.metadata, "bands": list(bands), "noise": noise}
