"""Checks of a configuration's physics before the first job: lens, light, limits of the fit, halos of the prior."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from warmlens.config.file import ConfigError
from warmlens.config.model import Config
from warmlens.config.observation import SimulatedBlock
from warmlens.config.plausible import keep
from warmlens.config.smooth_model import LensBlock, LensLightBlock
from warmlens.fitting.parameters import beta_parameter, free_parameters
from warmlens.halos.lens_halo import HaloGenerator
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.model_check import Components, model_problems, unusual_limits
from warmlens.physics import halo_generator
from warmlens.types import FloatArray

_NODES = 401  # of the prior in each parameter


def checked_physics(config: Config, grid: PixelGrid) -> list[str]:
    """Evaluate lens, light and halos once.

    Parameters
    ----------
    grid
        Pixels of the image.

    Returns
    -------
    lines
        One on the part of the prior without subhalos, if there is any.

    Raises
    ------
    ConfigError
        One line per problem.
    """
    x, y = grid.coordinates()
    smooth, simulated = config.smooth_model, config.observation.simulated
    problems: list[str] = []
    blocks = [("smooth_model", smooth.lens, smooth.lens_light)]
    if config.observation.kind == "simulated" and simulated is not None:
        blocks.append(("observation.simulated", simulated.lens, simulated.lens_light))
        problems += _off_the_image("observation.simulated.quasar_images", simulated.quasar_images, x, y)
        problems += _source_off_the_image(config, simulated, x, y)
    for key, lens, light in blocks:
        for components in _components(key, lens, light):
            problems += model_problems(components, x, y, config.unusual)
    if not problems:
        problems += _fit_problems(config)
    lines: list[str] = []
    try:
        generator = halo_generator(config.cosmology, config.redshifts, config.halos)
        lines += prior_without_subhalos(config, generator)
    except ValueError as error:
        problems.append(f"halos: {error}")
    if problems:
        raise ConfigError(problems)
    return lines


def _components(key: str, lens: LensBlock, light: LensLightBlock) -> tuple[Components, Components]:
    return (
        Components("lens", f"{key}.lens", lens.lens_model_list, lens.kwargs_lens),
        Components("light", f"{key}.lens_light", light.lens_light_model_list, light.kwargs_lens_light),
    )


def _off_the_image(
    key: str, positions: Sequence[tuple[float, float]], x: FloatArray, y: FloatArray
) -> Iterator[str]:
    for number, (px, py) in enumerate(positions):
        if not (x.min() <= px <= x.max() and y.min() <= py <= y.max()):
            yield (
                f"{key}[{number}]: [{px:g}, {py:g}] arcsec from the origin lies outside the image, which reaches "
                f"from {x.min():.3g} to {x.max():.3g} and from {y.min():.3g} to {y.max():.3g}; positions are "
                "arcsec, not pixels"
            )


def _source_off_the_image(config: Config, simulated: SimulatedBlock, x: FloatArray, y: FloatArray) -> list[str]:
    key = "observation.simulated.source.center"
    off = () if key in config.unusual else _off_the_image(key, [simulated.source.center], x, y)
    return [line.replace("[0]:", ":") + keep(key) for line in off]


def _fit_problems(config: Config) -> list[str]:
    """Return what is wrong with starts, limits and names of the free parameters, a line each."""
    block = config.smooth_model
    fit = block.fit
    if fit is None or block.mode == "given":
        return []
    problems = []
    lens = block.fitted_lens.kwargs_lens, fit.lens_free, "lens"
    light = block.lens_light.kwargs_lens_light, fit.lens_light_free, "light"
    for models, free, kind in (lens, light):
        for component, ranges in enumerate(free):
            for key, limits in ranges.items():
                alone = [{key: limits} if i == component else {} for i in range(len(free))]
                try:
                    free_parameters(kind, models, alone)  # type: ignore[arg-type]
                except ValueError as error:
                    problems.append(str(error))
        key = f"smooth_model.fit.{'lens_free' if kind == 'lens' else 'lens_light_free'}"
        problems += [] if key in config.unusual else unusual_limits(key, free)
    for of_lens, of_light in fit.satellites:
        if not {"center_x", "center_y"} <= lens[0][of_lens].keys():
            problems.append(
                f"smooth_model.fit.satellites: [{of_lens}, {of_light}]: lens model {of_lens} has no center_x and "
                "center_y for its light to follow"
            )
    if fit.source_beta is not None:
        try:
            beta_parameter(block.source.beta_arcsec, fit.source_beta)
        except ValueError as error:
            problems.append(f"{error} (source.beta_arcsec, fit.source_beta)")
    return problems


def prior_without_subhalos(config: Config, generator: HaloGenerator) -> list[str]:
    """Return a line on the part of the prior, or of the nodes, whose hosts are too light for subhalos.

    Such samples are smooth halos (`HaloPopulation.lightest_host_msun`). If all are, that is an error.
    """
    grid, prior, population = config.campaign.grid, config.dark_matter, generator.population
    if grid is not None:
        share, masses, hosts = "nodes", np.array(grid.m_th_kev), np.array(grid.log10_m_halo_msun)
        lowest = float(hosts[0])
    else:
        share, masses, hosts = "prior", _midpoints(prior.m_th_kev), _midpoints(prior.log10_m_halo_msun)
        lowest = prior.log10_m_halo_msun[0]
    lightest = np.array([population.lightest_host_msun(generator.dark_matter(float(m))) for m in masses])
    fraction = float((10.0**hosts <= lightest[:, None]).mean())
    if fraction == 0.0:
        return []
    if fraction == 1.0:
        raise ValueError(
            f"no host of the {share} has subhalos: that takes {lightest.min():.3g} Msun, twice the resolution of "
            f"the tree; raise dark_matter, or lower halos.min_mass_msun = {config.halos.min_mass_msun:g}"
        )
    without = masses[10.0**lowest <= lightest]
    corner = f"below {without.max():.2g} keV" if without.max() < masses[-1] else "at any relic mass"
    return [
        f"halos: {100.0 * fraction:.2g}% of the {share} are hosts without subhalos, lighter than twice the "
        f"resolution of their trees: {corner} at 10^{lowest:g} Msun"
    ]


def _midpoints(interval: tuple[float, float]) -> FloatArray:
    low, high = interval
    return low + (high - low) * (np.arange(_NODES) + 0.5) / _NODES
