"""Approximate Bayesian computation on the table of samples."""
