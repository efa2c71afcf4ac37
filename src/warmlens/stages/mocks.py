"""Stage `mocks`: the image that the observation would have been with each sample's substructure."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warmlens.artifacts import Dataset, Provenance, open_artifact, write_artifact
from warmlens.campaign import stream
from warmlens.imaging.mock import lensed_image, subpixel_field
from warmlens.stages.products import read_observation, read_smooth_model, scan_band
from warmlens.stages.samples import SampleTable
from warmlens.stages.settings import MocksSettings


def run(settings: MocksSettings, deflections: Path, observation: Path, smooth_model: Path, output: Path) -> None:
    """Write the noisy image of each sample and band.

    Rays go where smooth lens and substructure send them (Birrer+2017 sec. 3.2, alpha_mock); source, light,
    PSF and noise are the observation's.
    """
    observed = read_observation(observation)
    model = read_smooth_model(smooth_model)
    bands = [scan_band(observed, model, band.name) for band in observed.bands]
    with open_artifact(deflections, "deflections") as artifact:
        provenance = Provenance(
            "mocks",
            settings.as_dict(),
            {"deflections": deflections, "observation": observation, "smooth_model": smooth_model},
            seed_key=f"{settings.seed}/mocks/SAMPLE/BAND",
            span=artifact.span,
        )
        table = SampleTable.read(artifact)
        images = {
            band.name: np.full((len(table), *observed.grid.shape), np.nan, dtype=np.float32) for band, _ in bands
        }

        def image(row: int) -> None:
            delta = subpixel_field(artifact["delta_alpha"][row].astype(np.float64), model.supersampling)
            source_x, source_y = model.rays.source_x - delta[0], model.rays.source_y - delta[1]
            sample = int(table.parameters.sample_id[row])
            for band, convolution in bands:
                fit = model.fits[band.name]
                light = lensed_image(model.sets, fit.source_coefficients, source_x, source_y, convolution)
                rng = stream(settings.seed, "mocks", sample, band.name)
                images[band.name][row] = band.noise.draw(light + fit.fixed_image, band.sigma, rng)

        table.for_each(image, "mocks")
    datasets = {
        f"{name}/image": Dataset(data, "electron / s", ("sample", "y", "x"), "noisy mock of the observation")
        for name, data in images.items()
    }
    write_artifact(output, provenance, {**table.datasets(), **datasets}, {"bands": list(images)})
