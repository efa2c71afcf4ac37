"""Design and shards of the scan operator as datasets of their artifacts, and back."""

from __future__ import annotations

import numpy as np

from warmlens.artifacts.file import Artifact, Dataset
from warmlens.fitting.linear import LinearModel
from warmlens.scan.operator import BandProjection
from warmlens.scan.shard import OperatorShard


def design_datasets(band: str, model: LinearModel, projection: BandProjection) -> dict[str, Dataset]:
    """Return the datasets of the scan design of one band."""
    square = ("column", "column")
    return {
        f"{band}/design": Dataset(model.design, "", ("pixel", "column"), "whitened columns of unit norm, A"),
        f"{band}/column_norms": Dataset(model.column_norms, "", ("column",), "their norms before scaling"),
        f"{band}/prior": Dataset(model.prior, "", ("column",), "weight of the Gaussian prior on each, Lambda"),
        f"{band}/inverse_factor": Dataset(
            model.inverse_factor, "", square, "inverse Cholesky factor of the normal matrix, 1/L"
        ),
        f"{band}/projected": Dataset(projection.projected, "", ("pixel", "column"), "transpose of G"),
        f"{band}/overlap": Dataset(
            projection.overlap,
            "",
            ("row offset", "column offset", "pixel"),
            "elements of S by pixel and offset",
        ),
    }


def read_linear_model(design: Artifact, band: str) -> LinearModel:
    """Read the linear model of one band."""
    return LinearModel(
        design=design.array(f"{band}/design"),
        column_norms=design.array(f"{band}/column_norms"),
        inverse_factor=design.array(f"{band}/inverse_factor"),
        prior=design.array(f"{band}/prior"),
        n_source=design.metadata["n_source"],
    )


def read_projection(design: Artifact, band: str) -> BandProjection:
    """Read what all shards of the operator share, of one band."""
    return BandProjection(
        design.array(f"{band}/projected"), design.array(f"{band}/overlap"), design.metadata["n_image_columns"]
    )


_SHARD = {
    "pixel_offsets": (
        ("position edge",),
        "pixels of position i are pixels[pixel_offsets[i]:pixel_offsets[i + 1]]",
    ),
    "pixels": (("moved pixel",), "flat index of each pixel that a perturber moves"),
    "matrix_offsets": (("position edge",), "where the matrix of each position begins"),
    "matrices": (("element",), "lower triangles of the quadratic forms Q, row by row"),
    "points": (("position", "component"), "source position (x, y) and scale of the nested shapelets [arcsec]"),
    "nested_inverse": (("position", "element"), "lower triangle of the nested shapelets' 1/C_s"),
}


_SENSITIVITY = (("element",), "lower triangles of the quadratic forms Gamma, as the matrices")


_RESPONSE = {
    "responses": (("response element",), "K (lower triangle) and R of each position, one after the other"),
    "response_noise": (("position",), "what noise adds to the Fisher information on the mean"),
}


def shard_datasets(band: str, shard: OperatorShard) -> dict[str, Dataset]:
    """Return the datasets of a shard of the scan operator of one band."""
    described = {**_SHARD, "sensitivity": _SENSITIVITY}
    if shard.responses.size:
        described |= _RESPONSE
    return {
        f"{band}/{name}": Dataset(getattr(shard, name), "", axes, description)
        for name, (axes, description) in described.items()
    }


def read_shard(artifact: Artifact, band: str, *, sensitivity: bool) -> OperatorShard:
    """Read the shard of one band; `sensitivity` is half of it, and only residual maps need that."""
    arrays = {name: artifact.array(f"{band}/{name}") for name in _SHARD}
    arrays["sensitivity"] = artifact.array(f"{band}/sensitivity") if sensitivity else np.empty(0)
    for name in _RESPONSE:
        arrays[name] = artifact.array(f"{band}/{name}") if f"{band}/{name}" in artifact.file else np.empty(0)
    return OperatorShard(
        positions=artifact.array("positions"), nested_n_max=artifact.metadata["nested_n_max"], **arrays
    )
