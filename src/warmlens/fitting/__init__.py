"""Linear source inversion and the smooth-model fit."""
