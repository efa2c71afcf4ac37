"""Halo realizations: from the power spectrum to subhalos on the sky."""
