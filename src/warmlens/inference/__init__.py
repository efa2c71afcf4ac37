"""Approximate Bayesian computation on the table of samples; `analysis` runs all steps.

1. `table`: samples as points; `distance`, `learned` and `summary_sets` make the points from summaries.
2. `acceptance` of the nearest samples -> `bound` with its errors (`bootstrap`, `convergence` of the threshold).
3. `likelihood` ratio B(m) -> `combine` several lenses and forecast; `adjustment` and other `priors`.
4. `calibration`, `checks` and the `null` test: whether the bound can be trusted; `information`: what it is worth.
5. `exclusion` of halo masses: the same acceptance on a grid instead of the prior.
"""
