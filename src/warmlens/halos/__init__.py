"""Halo realizations: from the power spectrum to subhalos on the sky.

In the order of Birrer et al. 2017, sec. 3.1: `power_spectrum` (sigma(M), sharp-k), `dark_matter` (transfer
function), `barrier` (collapse threshold), `merger_tree` and `tree_walk` (accretion), `concentration` and
`profiles` (structure at infall), `stripping` (mass loss and dynamical friction), `positions`. `population` makes
a whole halo of them, `lens_halo` the part of it that lies in the field of the image.
"""
