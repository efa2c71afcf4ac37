"""The smooth model for the report: how well it fits, its parameters, and the truth where that is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from warmlens.artifacts.file import Artifact
from warmlens.imaging.noise_correlation import neighbours
from warmlens.text import parameter_unit


def read_smooth_fit(artifact: Artifact, simulated: Mapping[str, Any] | None) -> dict[str, Any]:
    """Read the smooth model from its artifact, and the truth from the settings `observation.simulated`, if any.

    Returns
    -------
    dict
        `mode` (given or fit), `converged`, `gate` (accepted range of chi2_red), `models` (in lenstronomy's names),
        `history` (steps of the fit); `bands`, each with the numbers of its `fit` and the correlation of the
        residuals of `neighbours`; `parameters` (lens, light and source), `shapelets` (of the potential) and
        `quasars` (image positions), each with value, error, truth and pull, None where there is none.
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
    groups: dict[str, list[dict[str, Any]]] = {"parameters": [], "shapelets": [], "quasars": []}
    for name, value, error in zip(names, values, errors, strict=True):
        group = "shapelets" if ".coeffs_" in name else "quasars" if name.startswith("quasar_") else "parameters"
        groups[group].append(
            {
                "name": name,
                "unit": parameter_unit(name),
                "value": value,
                "error": error,
                "truth": truth.get(name),
                "pull": pull(value, error, truth.get(name)),
            }
        )
    correlations = {band: neighbours(artifact.array(f"{band}/residual_correlation")) for band in meta["bands"]}
    return {
        "mode": block["mode"],
        "converged": meta["converged"],
        "gate": block["chi2_red_range"],
        "models": meta["lens_models"],
        "history": meta["history"],
        "bands": [
            {"name": band, "fit": meta["fits"][band], "neighbours": correlation}
            for band, correlation in correlations.items()
        ],
        **groups,
    }


def pull(value: float, error: float | None, truth: float | None) -> float | None:
    """Return (fit - truth) / error; None without an error, or if the truth is not known."""
    if error is None or truth is None or not error > 0.0:
        return None
    return (value - truth) / error


def true_parameters(
    lens_models: Sequence[str], light: Mapping[str, Any], simulated: Mapping[str, Any]
) -> dict[str, float]:
    """Return the true parameters of a simulated observation whose fitted model has the same components.

    The fit has `lens_models` and the settings `smooth_model.lens_light`, the observation `observation.simulated`.
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
    """Return the numbers of lenstronomy's kwargs under the fit's names for them, such as lens_0.theta_E."""
    flat: dict[str, float] = {}
    for i, kwargs in enumerate(components):
        for key, value in kwargs.items():
            if isinstance(value, list):
                flat |= {f"{kind}_{i}.{key}_{j}": float(number) for j, number in enumerate(value)}
            elif isinstance(value, int | float):
                flat[f"{kind}_{i}.{key}"] = float(value)
    return flat
