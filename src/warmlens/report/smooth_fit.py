"""The smooth model for the report: how well it fits, its parameters, and the truth where that is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from warmlens.artifacts.file import Artifact
from warmlens.imaging.noise_correlation import neighbours
from warmlens.text import parameter_unit
from warmlens.types import FloatArray


@dataclass(frozen=True)
class BandFit:
    """Fit of one band.

    Attributes
    ----------
    name
        Of the band.
    chi2_red
        Outside the cores of the quasar images, which the gate judges.
    chi2_red_all, chi2_red_noise_only
        With the cores; and outside them without the error of the PSF in the variance.
    neighbours
        Correlation of neighbouring pixels' residuals outside the cores, along rows and along columns.
    n_pixels, n_pixels_all, n_amplitudes
        Unmasked pixels outside the cores and with them, linear amplitudes.
    """

    name: str
    chi2_red: float
    chi2_red_all: float
    chi2_red_noise_only: float
    neighbours: tuple[float, float]
    n_pixels: int
    n_pixels_all: int
    n_amplitudes: int


@dataclass(frozen=True)
class LensParameter:
    """One parameter of the smooth model; no error if it was given, no truth if that is not known."""

    name: str
    unit: str
    value: float
    error: float | None
    truth: float | None

    @property
    def pull(self) -> float | None:
        """(fit - truth) / error."""
        if self.error is None or self.truth is None or not self.error > 0.0:
            return None
        return (self.value - self.truth) / self.error


@dataclass(frozen=True)
class SmoothFit:
    """The smooth model.

    Attributes
    ----------
    mode
        given or fit.
    converged
        Whether the last fit did.
    gate
        Range of chi2_red that is taken.
    bands
        One entry a band.
    models
        Lens models, in lenstronomy's names.
    parameters, shapelets, quasars
        Lens, light and source; coefficients of the potential shapelets; positions of the quasar images.
    history
        Steps of the fit.
    """

    mode: str
    converged: bool
    gate: tuple[float, float]
    bands: tuple[BandFit, ...]
    models: tuple[str, ...]
    parameters: tuple[LensParameter, ...]
    shapelets: tuple[LensParameter, ...]
    quasars: tuple[LensParameter, ...]
    history: tuple[dict[str, Any], ...]


def read_smooth_fit(artifact: Artifact, simulated: Mapping[str, Any] | None) -> SmoothFit:
    """Smooth model of an artifact, beside the truth of a simulated observation.

    Parameters
    ----------
    artifact
        Of the stage `smooth_model`.
    simulated
        Settings `observation.simulated` of the observation, if it is simulated.
    """
    meta, block = artifact.metadata, artifact.settings["smooth_model"]
    truth = true_parameters(meta["lens_models"], block["lens_light"], simulated) if simulated else {}
    if meta["parameters"]:
        names = [item["name"] for item in meta["parameters"]]
        values = artifact.array("parameters/value").tolist()
        errors: list[float | None] = artifact.array("parameters/error").tolist()
    else:
        given = flat_parameters("lens", meta["kwargs_lens"])
        names, values = list(given), list(given.values())
        errors = [None] * len(names)
    parameters = [
        LensParameter(name, parameter_unit(name), value, error, truth.get(name))
        for name, value, error in zip(names, values, errors, strict=True)
    ]
    shapelets = tuple(item for item in parameters if ".coeffs_" in item.name)
    quasars = tuple(item for item in parameters if item.name.startswith("quasar_"))
    low, high = block["chi2_red_range"]
    return SmoothFit(
        mode=block["mode"],
        converged=bool(meta["converged"]),
        gate=(float(low), float(high)),
        bands=tuple(
            _band(name, meta["fits"][name], artifact.array(f"{name}/residual_correlation"))
            for name in meta["bands"]
        ),
        models=tuple(meta["lens_models"]),
        parameters=tuple(item for item in parameters if item not in (*shapelets, *quasars)),
        shapelets=shapelets,
        quasars=quasars,
        history=tuple(meta["history"]),
    )


def _band(name: str, fit: Mapping[str, Any], residual_correlation: FloatArray) -> BandFit:
    return BandFit(
        name,
        fit["chi2_red_outside_cores"],
        fit["chi2_red"],
        fit["chi2_red_noise_only"],
        neighbours(residual_correlation)[:2],
        fit["n_pixels_outside_cores"],
        fit["n_pixels"],
        fit["n_columns"],
    )


def true_parameters(
    lens_models: Sequence[str], light: Mapping[str, Any], simulated: Mapping[str, Any]
) -> dict[str, float]:
    """Parameters that the observation was simulated with, where the fitted model has the same components.

    Parameters
    ----------
    lens_models
        Lens models of the fit.
    light
        Settings `smooth_model.lens_light`.
    simulated
        Settings `observation.simulated`.
    """
    truth: dict[str, float] = {}
    if list(lens_models) == simulated["lens"]["lens_model_list"]:
        truth |= flat_parameters("lens", simulated["lens"]["kwargs_lens"])
    of_light = simulated["lens_light"]
    if light["lens_light_model_list"] == of_light["lens_light_model_list"]:
        truth |= flat_parameters("light", of_light["kwargs_lens_light"])
    truth |= {
        f"quasar_{i}.{axis}": float(value)
        for i, position in enumerate(simulated["quasar_images"])
        for axis, value in zip("xy", position, strict=True)
    }
    return truth


def flat_parameters(kind: str, components: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Numbers of lenstronomy's kwargs under the names that the fit gives them, such as lens_0.theta_E."""
    flat: dict[str, float] = {}
    for i, kwargs in enumerate(components):
        for key, value in kwargs.items():
            if isinstance(value, list):
                flat |= {f"{kind}_{i}.{key}_{j}": float(item) for j, item in enumerate(value)}
            elif isinstance(value, int | float):
                flat[f"{kind}_{i}.{key}"] = float(value)
    return flat
