"""The substructure scan of Birrer et al. 2017, sec. 4.1, as exact low-rank algebra (symbols of docs/scan.md).

`raster` has the positions, `perturber` its deflection, `nested` the shapelets at each position's source point.
`operator` and `forms` build the quadratic form Q of each position once per lens, in a `shard`. `apply` makes
Delta R = R_pert - R_smooth of any image with them, and its linear response (s, F: `response`). `maps` makes
R_smooth, R_pert and R_sens by themselves, for the images that these are asked for.
"""
