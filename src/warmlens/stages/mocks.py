"""Stage `mocks`: the image that the observation would have been with each sample's substructure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Dataset
from warmlens.fitting.smooth_model import SmoothModel, scan_band
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.mock import bent_rays, lensed_image, subpixel_field
from warmlens.imaging.observation import Band
from warmlens.imaging.psf import Convolution, point_source
from warmlens.lensing.images import DeflectionField, moved_images
from warmlens.products.observation import read_observation
from warmlens.products.samples import SampleTable
from warmlens.products.smooth_model import read_smooth_model
from warmlens.sampling import stream
from warmlens.stage_table import MocksSettings, NullMocksSettings
from warmlens.stages.job import Job
from warmlens.types import FloatArray

FloatImages = NDArray[np.float32]  # [n, ny, nx]


def run(job: Job[MocksSettings]) -> None:
    """Write the noisy image of each sample and band.

    Rays go where smooth lens and substructure send them (Birrer+2017 sec. 3.2, alpha_mock). Source, light,
    PSF and noise are the observation's. The quasar images stay, or move as the lens equation says.
    """
    settings = job.settings
    observed = read_observation(job.path("observation"))
    model = read_smooth_model(job.path("smooth_model"))
    grid = observed.grid
    bands = [scan_band(observed, model, band.name) for band in observed.bands]
    solved = settings.mocks.quasar_positions == "solved"
    if solved and not model.n_quasars:
        raise ArtifactError(
            f"{job.path('smooth_model')}: mocks.quasar_positions: solved needs quasar images, the smooth model "
            "has none; set it to observed"
        )
    smooth = DeflectionField(model.deflection, grid)
    with job.open("deflections") as deflections:
        table, span = SampleTable.read(deflections), deflections.span
        images = _no_images(bands, len(table), grid)
        positions = np.full((len(table), model.n_quasars, 2), np.nan)

        def image(row: int) -> None:
            delta = deflections.array("delta_alpha", row).astype(np.float64)
            moved = None
            if solved:
                moved = moved_images(smooth, DeflectionField(model.deflection + delta, grid), model.quasars)
                positions[row] = moved
            sample = int(table.parameters.sample_id[row])
            for band, convolution in bands:
                clean = noise_free_image(model, grid, band, convolution, delta, moved)
                images[band.name][row] = _noisy(clean, band, stream(settings.seed, "mocks", sample, band.name))

        table.for_each(image, "mocks", job.sample_seconds)
    datasets = _image_datasets(images)
    if solved:
        datasets["quasar_positions"] = Dataset(
            positions, "arcsec", ("sample", "image", "component"), "positions of the quasar images (x, y)"
        )
    seed_key = f"{settings.seed}/mocks/SAMPLE/BAND"
    job.write({**table.datasets(), **datasets}, {"bands": list(images)}, span, seed_key)


def run_null(job: Job[NullMocksSettings]) -> None:
    """Write noisy images of the smooth model alone, Delta alpha = 0, as many as the null test asks for."""
    settings, n = job.settings, job.settings.null_test.n_mocks
    observed = read_observation(job.path("observation"))
    model = read_smooth_model(job.path("smooth_model"))
    grid = observed.grid
    table = SampleTable.without_substructure(n)
    bands = [scan_band(observed, model, band.name) for band in observed.bands]
    nothing = np.zeros((2, *grid.shape))
    clean = {band.name: noise_free_image(model, grid, band, convolution, nothing) for band, convolution in bands}
    images = _no_images(bands, n, grid)

    def image(row: int) -> None:
        for band, _ in bands:
            rng = stream(settings.seed, "null", row, band.name)
            images[band.name][row] = _noisy(clean[band.name], band, rng)

    table.for_each(image, job.stage.name, job.sample_seconds)
    seed_key = f"{settings.seed}/null/MOCK/BAND"
    job.write({**table.datasets(), **_image_datasets(images)}, {"bands": list(images)}, (0, n), seed_key)


def _no_images(bands: Sequence[tuple[Band, Convolution]], n: int, grid: PixelGrid) -> dict[str, FloatImages]:
    """Return n images of NaN for each band."""
    return {band.name: np.full((n, *grid.shape), np.nan, dtype=np.float32) for band, _ in bands}


def _noisy(clean: FloatArray, band: Band, rng: np.random.Generator) -> FloatArray:
    image = band.noise.draw(clean, band.sigma, rng)
    if not np.isfinite(image).all():
        raise FloatingPointError(f"the image in {band.name} is not finite")
    return image


def _image_datasets(images: Mapping[str, FloatImages]) -> dict[str, Dataset]:
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
    """Return the image [ny, nx] [e-/s per pixel] of a band with substructure, before noise.

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
    source_x, source_y = bent_rays((model.rays.source_x, model.rays.source_y), delta)
    image = lensed_image(model.sets, fit.source_coefficients, source_x, source_y, convolution) + fit.fixed_image
    if quasars is None:
        return image
    fluxes = fit.fixed_coefficients[: model.n_quasars]
    for i, (flux, (x, y)) in enumerate(zip(fluxes, quasars, strict=True)):
        image += flux * (point_source(band.psf, grid, x, y) - model.fixed[band.name][:, i].reshape(grid.shape))
    return image
