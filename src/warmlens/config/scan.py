"""Blocks of config.yaml that describe the scan and its summary statistics."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, model_validator

from warmlens.config import plausible
from warmlens.config.plausible import Usual
from warmlens.config.types import (
    MAX_IN_FILE_NAMES,
    Ascending,
    Block,
    FileNumber,
    Negative,
    Point,
    Positive,
)

MIN_STEP_ARCSEC = 1e-4


class PerturberBlock(Block):
    """Perturber of the scan: an isothermal deflection with a linear truncation."""

    theta_e_arcsec: Annotated[Positive, plausible.EINSTEIN_OF_PERTURBER] = Field(
        description="Deflection of the perturber [arcsec]"
    )
    r_trunc_arcsec: Annotated[Positive, Usual(1e-3, 10, "arcsec", plausible.MAS)] = Field(
        description="The deflection is constant within this radius, 0 from twice this radius on [arcsec]"
    )


class NestedBlock(Block):
    """Shapelets at the source point of each position, in both fits; null: none."""

    n_max: int = Field(ge=0, le=12, description="Order of the shapelets")
    ridge: Annotated[Positive, plausible.RIDGE] = Field(
        description="Gaussian prior, in units of the largest squared norm of their columns"
    )
    beta_range_arcsec: Annotated[tuple[Positive, Positive], Usual(1e-4, 5, "arcsec", plausible.MAS)] = Field(
        description="Limits of their scale r_trunc / sqrt(mean magnification within r_trunc) [arcsec]"
    )

    @model_validator(mode="after")
    def _range(self) -> NestedBlock:
        low, high = self.beta_range_arcsec
        if low > high:
            raise ValueError(f"beta_range_arcsec: the lower end {low:g} must not be above the upper end {high:g}")
        return self


class SensitivityBlock(Block):
    """Smallest perturber mass that would be seen; null: none; needs statistics: [delta_r, amplitude]."""

    theta_e_arcsec: Annotated[list[Positive], Ascending, plausible.EINSTEIN_OF_PERTURBER] = Field(
        min_length=1, description="Deflections to test [arcsec], ascending"
    )
    delta_r: Annotated[Positive, Usual(0.1, 1e5)] = Field(description="-Delta R that counts as a detection")


class ScanBlock(Block):
    """Raster of the substructure scan and freedom of its fits."""

    perturber: PerturberBlock
    nested: NestedBlock | None
    marginalise_lens: bool = Field(
        False,
        description="Each image has its own best lens, to first order, under the priors of the smooth fit; "
        "false: the lens of the observation, as needed with smooth_model.mode: given",
    )
    step_arcsec: Annotated[Positive, Usual(0.001, 2, "arcsec", plausible.MAS, plausible.DEGREES)] = Field(
        description="Step of the raster [arcsec]"
    )
    window_arcsec: Annotated[tuple[Positive, Positive] | None, plausible.EXTENT] = Field(
        description="Width and height of the scanned window [arcsec]; null: box around unmasked pixels"
    )
    center: Annotated[Point, plausible.POSITION] = Field(description="Centre [x, y] of the window [arcsec]")
    shard_size: FileNumber = Field(description="Positions per job of the operator; each reads the design, 1.4 GB")
    residual_samples: list[NonNegativeInt] = Field(
        [], description="Samples whose R_smooth, R_pert and R_sens are written, besides the observation's"
    )
    statistics: list[Literal["delta_r", "amplitude"]] = Field(
        ["delta_r"],
        description="[delta_r] or [delta_r, amplitude], with score and Fisher information of the amplitude",
    )
    sensitivity: SensitivityBlock | None = None

    @model_validator(mode="after")
    def _statistics(self) -> ScanBlock:
        if self.statistics not in (["delta_r"], ["delta_r", "amplitude"]):
            raise ValueError(f"statistics must be [delta_r] or [delta_r, amplitude], got {self.statistics}")
        if self.sensitivity is not None and "amplitude" not in self.statistics:
            raise ValueError(
                "sensitivity is made from the linear response; with it set statistics: [delta_r, amplitude]"
            )
        return self

    @model_validator(mode="after")
    def _window(self) -> ScanBlock:
        if self.step_arcsec < MIN_STEP_ARCSEC:
            raise ValueError(f"step_arcsec {self.step_arcsec:g} must be at least {MIN_STEP_ARCSEC:g}")
        for side in self.window_arcsec or ():
            if side / self.step_arcsec > MAX_IN_FILE_NAMES:
                raise ValueError(f"window_arcsec {side:g} holds too many steps of {self.step_arcsec:g} arcsec")
            if side < self.step_arcsec:
                raise ValueError(f"window_arcsec {side:g} is smaller than step_arcsec {self.step_arcsec:g}")
        if self.window_arcsec is None and self.center != (0.0, 0.0):
            raise ValueError("center is that of window_arcsec; with window_arcsec: null leave it at [0.0, 0.0]")
        if len(set(self.residual_samples)) != len(self.residual_samples):
            raise ValueError(f"residual_samples names a sample twice: {self.residual_samples}")
        return self


class SummariesBlock(Block):
    """Two-point correlation function and cumulative distribution of Delta R."""

    threshold: Annotated[Negative, plausible.DELTA_R] = Field(description="Only Delta R below this value counts")
    max_separation_arcsec: Annotated[Positive, plausible.EXTENT] = Field(
        description="Largest separation of the correlation function [arcsec]"
    )
    cumulative_min: Annotated[Negative, plausible.DELTA_R] = Field(
        description="Lowest Delta R of the cumulative distribution, up to threshold"
    )
    cumulative_bins: int = Field(ge=2, description="Number of values of the cumulative distribution")
    count_thresholds: Annotated[list[Negative], Ascending, plausible.DELTA_R] = Field(
        [-25.0, -10.0, -4.0], min_length=1, description="Positions with Delta R below each are counted; ascending"
    )

    @model_validator(mode="after")
    def _order(self) -> SummariesBlock:
        if self.cumulative_min >= self.threshold:
            raise ValueError(f"cumulative_min {self.cumulative_min:g} must be below threshold {self.threshold:g}")
        return self
