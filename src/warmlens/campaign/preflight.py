"""What is checked before the first job of a campaign, and read by `warmlens validate`."""

from __future__ import annotations

import numpy as np

from warmlens.campaign.image_checks import CHECKS, Findings, Images
from warmlens.campaign.physics_check import checked_physics
from warmlens.config.file import ConfigError
from warmlens.config.model import Config
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.observation import checked_band
from warmlens.products.images import artifact_path, read_all
from warmlens.products.observation import read_observation
from warmlens.sampling import stream


def check_observation(config: Config) -> list[str]:
    """Read the images as the campaign will, and check them.

    Returns
    -------
    notes
        What a person should look at, one line each; none if there is nothing.

    Raises
    ------
    ConfigError
        One line per problem, naming file or key, value, what was expected and what to do.
    """
    return check_images(read_images(config))


def check_images(images: Images) -> list[str]:
    """Run all checks; return notes and raise problems as `check_observation` does."""
    findings = [check(images) for check in (*CHECKS, _check_physics)]
    problems = [problem for found in findings for problem in found.problems]
    if problems:
        raise ConfigError(problems)
    return [note for found in findings for note in found.notes]


def _check_physics(images: Images) -> Findings:
    try:
        return Findings(notes=checked_physics(images.config, images.grid))
    except ConfigError as error:
        return Findings(error.problems)


def read_images(config: Config) -> Images:
    """Return the images of a campaign; of a simulated one only their pixels."""
    observation = config.observation
    if observation.kind == "simulated":
        assert observation.simulated is not None  # config: kind simulated comes with its block
        block = observation.simulated
        return Images(config, PixelGrid.centred(block.shape, block.pixel_scale_arcsec), ())
    if observation.kind == "artifact":
        observed = read_observation(artifact_path(observation))
        bands = {band.name: band for band in observed.bands}
        missing = [name for name in observation.bands if name not in bands]
        if missing:
            raise ConfigError(
                [f"observation.bands: {observation.artifact} has no bands {missing}; it has {list(bands)}"]
            )
        return Images(config, observed.grid, tuple(bands[name] for name in observation.bands))
    assert observation.fits is not None
    files = read_all({name: observation.fits[name] for name in observation.bands})
    return Images(config, files[0].grid, tuple(read.band for read in files), files)


def simulate_images(config: Config) -> Images:
    """Return the images of a campaign, simulated ones too: as the stage makes them, but without subhalos."""
    images = read_images(config)
    checked_physics(config, images.grid)  # of a model that is none there is no image
    block = config.observation.simulated
    if config.observation.kind != "simulated" or block is None:
        return images
    from warmlens.stages.observation import true_image  # needs lenstronomy, which takes seconds to load

    bands = []
    for name in config.observation.bands:
        clean, psf = true_image(name, block, images.grid, np.zeros((2, *images.grid.shape)))
        noise = NoiseModel(block.bands[name].background_rms, block.bands[name].exposure_s)
        image = noise.draw(clean, clean, stream(block.truth.seed, "observation", 0, name))
        mask = np.ones(image.shape, dtype=bool)
        bands.append(checked_band(name, images.grid, image, noise.sigma(image), mask, psf, noise))
    return Images(config, images.grid, tuple(bands))
