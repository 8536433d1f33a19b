"""Rows of the lists in summary.json."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = [
    "BudgetRow",
    "CoverageRow",
    "HoldoutTest",
    "MapRow",
    "MarginRow",
    "MeanAndSd",
    "MisfitRow",
    "Part",
    "ProductRow",
    "ScoreTestRow",
    "StructureRow",
    "ValidityRow",
]

Number = float | None  # null where it is not finite, or not known


class Part(BaseModel):
    """A part of summary.json; a later version of the package may add keys to it."""

    model_config = ConfigDict(extra="allow", frozen=True)


class MeanAndSd(Part):
    """Posterior mean and standard deviation."""

    mean: Number
    sd: Number


class MapRow(Part):
    """Largest errors of positions over a chip."""

    chip: int
    sigma_u_max: Number
    sigma_v_max: Number
    sigma_max: Number = Field(None, description="largest per axis: rms of sigma_u and sigma_v")
    ce68_max: Number = Field(None, description="largest radius of a circle that holds 68 %")
    ce95_max: Number = Field(None, description="largest radius of a circle that holds 95 %")
    radius_max: Number = Field(description="largest hypot(sigma_u, sigma_v)")
    position_of_max: list[float] = Field(description="x and y, pixels")
    radius_max_least_squares: Number
    radius_max_relative: Number = Field(None, description="of relative positions, with a gauge")


class MisfitRow(Part):
    """Structure that the least-squares fit leaves in the residuals."""

    chip: int | None = None
    p_value: Number
    partition: str = Field(description="the bins that tell most")
    structure: Number = Field(description="rms of the structure, in the unit of u and v")
    power: Number = Field(
        description="fraction of the patterns that would be seen; below 1 where stars are fitted"
    )


class StructureRow(Part):
    """Structure beyond the model on one axis of a chip."""

    chip: int
    axis: Literal["u", "v"]
    rms: Number = Field(description="over the chip and the draws")
    median: float = Field(description="of the draws' rms")
    most: float = Field(description="95 % quantile of the draws' rms")
    length_pix: Number = Field(description="correlation length, pixels")


class ScoreTestRow(Part):
    """A targeted test of the residuals for what the model lacks."""

    name: str
    statistic: Number
    dof: Number
    dof_residual: Number
    p_value: Number
    size: Number
    smallest: Number = Field(description="size that would have been found")
    unit: str
    remedy: str
    finding: str
    significant: bool


class CoverageRow(Part):
    """Fraction of the stars within so many sigma of the prediction."""

    axis: str
    sigma: float
    n: int
    value: Number
    expected: Number
    interval: list[Number] = Field(description="95 %")


class HoldoutTest(Part):
    """A test of the stars that were held out."""

    name: str
    part: str
    is_omnibus: bool = Field(description="all bins of the part at once")
    where: str
    n: int
    value: Number
    expected: Number
    p_value: Number
    p_corrected: Number = Field(description="Holm")


class BudgetRow(Part):
    """A row of the error budget: rms over all chips."""

    name: str
    kind: Literal["random", "systematic", "scale", "rotation", "local", "product"] | str
    u: Number
    v: Number
    radial: Number
    radial_error: Number = None
    source: str = ""


class WorstPosition(Part):
    """Where a requirement is met worst."""

    chip: int
    x: float
    y: float
    rms: Number


class MarginRow(Part):
    """How a requirement is met."""

    name: str
    statistic: str
    limit: float
    value: Number
    interval: list[Number] = Field(description="95 %")
    margin: Number
    margin_percent: Number = Field(description="of the limit")
    unit: str
    epoch: Number = Field(description="of a range the worst one")
    chip: int | None = Field(description="null: all chips together")
    region: str | list[list[float]]
    epochs: list[float] | None
    relative: bool
    separation: Number
    magnitude: Number
    probability: float = Field(description="that is asked for")
    probability_met: Number
    mc_error: Number = Field(description="Monte-Carlo error of probability_met")
    verdict: str
    reason: str
    rests_on: list[str]
    worst: WorstPosition
    remedy: str | None


class ValidityRow(Part):
    """Until when a requirement is met."""

    name: str
    probability: float
    date: Number = Field(description="null: not before `until`")
    interval: list[Number]
    until: float
    sentence: str


class ProductRow(Part):
    """A file for a pipeline, and what was verified on it as written."""

    path: str
    kind: str
    findings: list[str]
    forward_rms: Number = None
    inverse_rms: Number = None
    total_rms: Number = Field(None, description="total error for those who use the file forward")
