"""The substructure scan: perturber, exact low-rank operator, Delta R maps."""
