"""Halo realizations: from the power spectrum to subhaloes on the sky."""
