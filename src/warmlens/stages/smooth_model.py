"""Stage `smooth_model`: the smooth lens, given or fitted, and amplitudes of source, light and quasars."""

from __future__ import annotations

import logging

from warmlens.fitting.judgement import judge_fit
from warmlens.fitting.lens_fit import fit_lens
from warmlens.fitting.smooth_model import finished_model
from warmlens.products.observation import read_observation
from warmlens.products.smooth_model import fit_datasets, smooth_model_datasets
from warmlens.stage_table import SmoothModelSettings
from warmlens.stages.job import Job

log = logging.getLogger(__name__)


def run(job: Job[SmoothModelSettings]) -> None:
    """Write the smooth model.

    Raises
    ------
    ConfigError
        If the fit is poor (`judge_fit`) and `smooth_model.allow_poor_fit` is false.
    """
    block = job.settings.smooth_model
    observed = read_observation(job.path("observation"))
    fitted = fit_lens(block, observed)
    model = finished_model(fitted)
    judgement = judge_fit(block, observed, fitted, model)
    for warning in (*judgement.problems, *judgement.notes):
        log.warning(warning)
    datasets, metadata = smooth_model_datasets(model)
    fit, description = fit_datasets(fitted, judgement)
    job.write({**datasets, **fit}, {**metadata, **description})
