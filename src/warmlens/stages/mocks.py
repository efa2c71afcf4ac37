"""Stage `mocks`: the image that the observation would have been with each sample's substructure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from warmlens.artifacts.file import ArtifactError, Dataset, Provenance, open_artifact, write_artifact
from warmlens.fitting.smooth_model import SmoothModel, scan_band
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.mock import lensed_image, subpixel_field
from warmlens.imaging.observation import Band
from warmlens.imaging.psf import Convolution, point_source
from warmlens.lensing.images import DeflectionField, moved_images
from warmlens.products.observation import read_observation
from warmlens.products.samples import SampleTable, null
from warmlens.products.smooth_model import read_smooth_model
from warmlens.products.time_limit import SAMPLE_SECONDS
from warmlens.sampling import stream
from warmlens.stages.settings import MocksSettings, NullMocksSettings
from warmlens.types import FloatArray


def run(
    settings: MocksSettings,
    deflections: Path,
    observation: Path,
    smooth_model: Path,
    output: Path,
    sample_seconds: float = SAMPLE_SECONDS,
) -> None:
    """Write the noisy image of each sample and band.

    Rays go where smooth lens and substructure send them (Birrer+2017 sec. 3.2, alpha_mock); source, light,
    PSF and noise are the observation's. The quasars stay, or move as the lens equation says.
    """
    observed = read_observation(observation)
    model = read_smooth_model(smooth_model)
    grid = observed.grid
    bands = [scan_band(observed, model, band.name) for band in observed.bands]
    solved = settings.mocks.quasar_positions == "solved"
    if solved:
        if not model.n_quasars:
            raise ArtifactError(
                f"{smooth_model}: mocks.quasar_positions: solved needs quasar images, the smooth model has none; "
                "set it to observed"
            )
        smooth = DeflectionField(model.deflection, grid)
    with open_artifact(deflections, "deflections") as artifact:
        provenance = Provenance(
            "mocks",
            settings.as_dict(),
            {"deflections": deflections, "observation": observation, "smooth_model": smooth_model},
            seed_key=f"{settings.seed}/mocks/SAMPLE/BAND",
            span=artifact.span,
        )
        table = SampleTable.read(artifact)
        images = {band.name: np.full((len(table), *grid.shape), np.nan, dtype=np.float32) for band, _ in bands}
        positions = np.full((len(table), model.n_quasars, 2), np.nan)

        def image(row: int) -> None:
            delta = artifact.array("delta_alpha", row).astype(np.float64)
            moved = None
            if solved:
                moved = moved_images(smooth, DeflectionField(model.deflection + delta, grid), model.quasars)
                positions[row] = moved
            sample = int(table.parameters.sample_id[row])
            for band, convolution in bands:
                clean = noise_free_image(model, grid, band, convolution, delta, moved)
                rng = stream(settings.seed, "mocks", sample, band.name)
                images[band.name][row] = _finite(band.noise.draw(clean, band.sigma, rng), band.name)

        table.for_each(image, "mocks", sample_seconds)
    datasets = _image_datasets(images)
    if solved:
        datasets["quasar_positions"] = Dataset(
            positions, "arcsec", ("sample", "image", "component"), "where the quasar images stand (x, y)"
        )
    write_artifact(output, provenance, {**table.datasets(), **datasets}, {"bands": list(images)})


def run_null(
    settings: NullMocksSettings,
    observation: Path,
    smooth_model: Path,
    output: Path,
    sample_seconds: float = SAMPLE_SECONDS,
) -> None:
    """Write noisy images of the smooth model alone, Delta alpha = 0, as many as the null test asks for."""
    n = settings.null_test.n_mocks
    observed = read_observation(observation)
    model = read_smooth_model(smooth_model)
    provenance = Provenance(
        null("mocks"),
        settings.as_dict(),
        {"observation": observation, "smooth_model": smooth_model},
        seed_key=f"{settings.seed}/null/MOCK/BAND",
        span=(0, n),
    )
    table = SampleTable.without_substructure(n)
    grid = observed.grid
    nothing = np.zeros((2, *grid.shape))
    bands = [scan_band(observed, model, band.name) for band in observed.bands]
    clean = {band.name: noise_free_image(model, grid, band, convolution, nothing) for band, convolution in bands}
    images = {name: np.full((n, *grid.shape), np.nan, dtype=np.float32) for name in clean}

    def image(row: int) -> None:
        for band, _ in bands:
            rng = stream(settings.seed, "null", row, band.name)
            images[band.name][row] = _finite(band.noise.draw(clean[band.name], band.sigma, rng), band.name)

    table.for_each(image, null("mocks"), sample_seconds)
    write_artifact(output, provenance, {**table.datasets(), **_image_datasets(images)}, {"bands": list(images)})


def _finite(image: FloatArray, band: str) -> FloatArray:
    if not np.isfinite(image).all():
        raise FloatingPointError(f"the image in {band} is not finite")
    return image


def _image_datasets(images: Mapping[str, NDArray[np.float32]]) -> dict[str, Dataset]:
    return {
        f"{name}/image": Dataset(data, "electron / s", ("sample", "y", "x"), "noisy mock of the observation")
        for name, data in images.items()
    }


def noise_free_image(
    model: SmoothModel,
    grid: PixelGrid,
    band: Band,
    convolution: Convolution,
    delta_alpha: FloatArray,
    quasars: FloatArray | None = None,
) -> FloatArray:
    """Image [ny, nx] [e-/s per pixel] of a band with substructure, before noise.

    Parameters
    ----------
    model
        Smooth model: rays, source, light and quasars as fitted.
    grid
        Pixels.
    band, convolution
        The band, and its PSF ready to convolve with.
    delta_alpha
        What the substructure adds to the deflection, [2, ny, nx] [arcsec].
    quasars
        Where the quasar images stand, [n_quasars, 2] [arcsec]; as in the smooth model unless given.

    Reference: Birrer+2017 sec. 3.2, alpha_mock = alpha_smooth + Delta alpha_dm.
    """
    fit = model.fits[band.name]
    delta = subpixel_field(delta_alpha, model.supersampling)
    source_x, source_y = model.rays.source_x - delta[0], model.rays.source_y - delta[1]
    image = lensed_image(model.sets, fit.source_coefficients, source_x, source_y, convolution) + fit.fixed_image
    if quasars is None:
        return image
    fluxes = fit.fixed_coefficients[: model.n_quasars]
    for i, (flux, (x, y)) in enumerate(zip(fluxes, quasars, strict=True)):
        image += flux * (point_source(band.psf, grid, x, y) - model.fixed[band.name][:, i].reshape(grid.shape))
    return image
