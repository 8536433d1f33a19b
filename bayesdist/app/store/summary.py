"""Data model of summary.json, the results of a run for scripts; the package has its JSON Schema."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypedDict

from pydantic import BaseModel, ConfigDict, Field, field_validator

from bayesdist.app.config import installed_kinds

Number = float | None  # null where it is not finite, or not known
Fraction = Annotated[float, Field(ge=0, le=1)]
PositiveLength = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class SummaryPart(BaseModel):
    """Part of summary.json; later versions of the package may add keys to it."""

    model_config = ConfigDict(extra="allow", frozen=True)

    @classmethod
    def row(cls, *objects: Any, **others: Any) -> dict[str, Any]:
        """Row with these fields, each from `others`, or else from the first object that has it."""
        return {name: cls._value(name, objects, others) for name in cls.model_fields}

    @staticmethod
    def _value(name: str, objects: tuple[Any, ...], others: dict[str, Any]) -> Any:
        if name in others:
            return others[name]
        return getattr(next(source for source in objects if hasattr(source, name)), name)


class MeanAndSd(SummaryPart):
    """Posterior mean and standard deviation."""

    mean: Number
    sd: Number


class AddedErrorRow(SummaryPart):
    """Error of a group of matches along an axis, in addition to the quoted one."""

    label: str
    axis: str
    n: float = Field(description="good stars")
    added: Number
    added_error: Number
    excess: Number = Field(description="beyond the smallest of all groups, which the jitter has")
    variance: float = Field(description="square of `added`, as it was estimated")
    variance_error: Number


class MapRow(SummaryPart):
    """Largest position errors over a chip."""

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


class MisfitRow(SummaryPart):
    """Structure that the least-squares fit leaves in the residuals."""

    chip: int | None = None
    p_value: Number
    partition: str = Field(description="the bins that tell most")
    structure: Number = Field(description="rms of the structure, in the unit of u and v")
    power: Number = Field(
        description="fraction of the patterns that would be seen; below 1 where stars are fitted"
    )


class StructureRow(SummaryPart):
    """Structure beyond the model on one axis of a chip."""

    chip: int
    axis: Literal["u", "v"]
    rms: Number = Field(description="over the chip and the draws")
    median: float = Field(description="of the draws' rms")
    most: float = Field(description="95 % quantile of the draws' rms")
    length_pix: Number = Field(description="correlation length, pixels")


class ScoreTestRow(SummaryPart):
    """Targeted test of the residuals for an effect that the model lacks."""

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
    cause: str = Field("", description="name or group of the finding that this one may come from")


class CoverageRow(SummaryPart):
    """Fraction of the stars within a number of sigma of the prediction."""

    axis: str
    sigma: float
    n: int
    value: Number
    expected: Number
    interval: list[Number] = Field(description="95 %")


class HoldoutTest(SummaryPart):
    """Test of the held-out stars."""

    name: str
    part: str
    is_omnibus: bool = Field(description="all bins of the part at once")
    where: str
    n: int
    value: Number
    expected: Number
    p_value: Number
    p_corrected: Number = Field(description="Holm")


class BudgetRow(SummaryPart):
    """Row of the error budget: rms over all chips."""

    name: str
    kind: Literal["random", "systematic", "scale", "rotation", "local", "product"] | str
    u: Number
    v: Number
    radial: Number
    radial_error: Number = None
    source: str = ""


class WorstPositionRow(SummaryPart):
    """Position with the largest error for a requirement."""

    chip: int
    x: float
    y: float
    rms: Number


class MarginRow(SummaryPart):
    """Margin of a requirement."""

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
    n_effective: Number = Field(description="independent draws that probability_met rests on")
    verdict: str = Field(description="met, missed, not shown or undecided")
    reason: str
    rests_on: list[str]
    worst: WorstPositionRow
    remedy: str | None


class ValidityRow(SummaryPart):
    """Date until which a requirement is met."""

    name: str
    probability: float
    date: Number = Field(description="null: not before `until`")
    interval: list[Number]
    until: float
    sentence: str


class ProductRow(SummaryPart):
    """File for a pipeline, and the results of checks of the file as written."""

    path: str
    kind: str
    findings: list[str]
    forward_rms: Number = None
    inverse_rms: Number = None
    total_rms: Number = Field(None, description="total error for those who use the file forward")


class DataSection(SummaryPart):
    """Numbers of rows that were read and used, and their sources."""

    n_rows: int
    n_used: int
    n_rejected: int
    rejected: dict[str, int] = Field(description="rows by reason")
    n_exposures: int
    sources: list[str]
    tangent_point: Annotated[list[float], Field(min_length=2, max_length=2)] | None = Field(
        description="RA and Dec in degrees"
    )


class AddedErrorsSection(SummaryPart):
    """Errors of groups of matches, in addition to the quoted ones."""

    grouping: str
    by: str = Field(description="what the groups differ in; empty for one group")
    evidence: dict[str, float] = Field(description="ln evidence gained, by grouping")
    dispersion: float
    groups: list[AddedErrorRow] = Field(description="along u and v by turns")

    @field_validator("groups")
    @classmethod
    def _axes(cls, rows: list[AddedErrorRow]) -> list[AddedErrorRow]:
        if [row.axis for row in rows] != ["u", "v"] * (len(rows) // 2):
            raise ValueError("the axes are not u and v by turns")
        return rows


class GeometryRow(SummaryPart):
    """Linear part of the map of a chip in the least-squares fit, and its largest distortion."""

    chip: int
    unit: str = Field(description="of u and v")
    scale_x: Number = Field(description="units of u and v per pixel along x")
    scale_y: Number = Field(description="units of u and v per pixel along y")
    position_angle: Number = Field(description="degrees from +v towards +u of +y")
    parity: Literal[-1, 1] = Field(description="-1 if u, v is a mirror image of x, y")
    skew: Number = Field(description="radians: angle from x to y, less 90 degrees")
    distortion: Number = Field(description="pixels: largest deviation from the best linear map")
    sentence: str


class FitSection(SummaryPart):
    """Least-squares fit."""

    order: int
    chi2: Number
    dof: int
    rms_u: Number
    rms_v: Number
    unit: str
    condition: Number
    n_parameters: int
    error_scale: Number = Field(1.0, description="factor on the quoted errors")
    added_errors: AddedErrorsSection | None = None
    geometry: list[GeometryRow] = Field([], description="of each chip")


class OutliersSection(SummaryPart):
    """Outlier mixture."""

    model: Literal["gaussian", "uniform", "none"]
    unit: str
    fraction: MeanAndSd | None = None
    jitter: MeanAndSd | None = None
    scale: MeanAndSd | None = None
    n_flagged: int = Field(description="with a probability above 0.5")
    match_circle: Number = None


class SamplerSection(SummaryPart):
    """Sampling of the posterior, and convergence of the chains."""

    method: str
    converged: bool
    reasons: list[str] = Field(description="why it has not converged")
    rhat_max: Number
    ess_bulk_min: Number
    ess_tail_min: Number
    pareto_k: Number
    importance_efficiency: Number
    ensembles: int
    walkers: int
    steps: int
    passes: int
    acceptance: Number
    wall_s: Number


class MapSection(MapRow):
    """Largest position errors: of all chips, and of each chip."""

    unit: str
    epoch: Number
    chips: list[MapRow]


class MisfitSection(MisfitRow):
    """Structure in the residuals: of the worst chip, corrected for their number, and of each."""

    unit: str
    significant: bool
    chips: list[MisfitRow] = Field(default_factory=list)


class CorrelatedErrorsSection(SummaryPart):
    """Distortion that the model may leave out, estimated from the residuals of all stars."""

    structure: list[StructureRow]
    structure_correlation: list[tuple[Fraction, PositiveLength]] = Field(
        [], description="fraction of the variance and correlation length (pixels) of each field"
    )
    unit: str
    noise_ratio: Number = Field(description="variance by the stars' scatter over the formal one")


class HoldoutSection(SummaryPart):
    """Quality of the prediction for held-out stars."""

    n: int
    n_excluded: int = Field(description="stars of exposures with too few to be predicted")
    exposures: list[str]
    p_value: Number
    verdict: str
    level: Literal["pass", "warn", "fail"]
    coverage: list[CoverageRow]
    tests: list[HoldoutTest]


class PeriodsSection(SummaryPart):
    """Change of the distortion with time."""

    verdict: str
    significant: bool
    unit: str
    periods: list[dict[str, Any]]
    first_vs_last: dict[str, Any]


class Warned(SummaryPart):
    """Section with warnings."""

    warnings: list[str] = Field(default_factory=list)


class VerdictSection(SummaryPart):
    """Worst of all checks, requirements and validity periods, in words."""

    level: Literal["pass", "warn", "fail"]
    headline: str


class Sections(SummaryPart):
    """Results of the completed stages, by section."""

    matching: Warned | None = Field(None, description="of a campaign")
    selfcal: Warned | None = Field(None, description="of a self-calibration")
    data: DataSection | None = None
    fit: FitSection | None = None
    outliers: OutliersSection | None = None
    sampler: SamplerSection | None = None
    discrepancy: CorrelatedErrorsSection | None = None
    score_tests: list[ScoreTestRow] | None = None
    holdout: HoldoutSection | None = None
    periods: PeriodsSection | None = None
    map: MapSection | None = None
    budget: list[BudgetRow] | None = None
    misfit: MisfitSection | None = None
    margins: list[MarginRow] | None = None
    validity_periods: list[ValidityRow] | None = None
    warnings: list[str] | None = None
    products: list[ProductRow] | None = None
    figures: list[str] | None = None
    verdict: VerdictSection | None = Field(None, description="headline of the report")
    gauge: dict[str, Any] | None = Field(None, description="exposures: what holds the solution")
    lines: list[dict[str, Any]] | None = Field(None, description="linear terms against time")
    tables: Warned | None = Field(None, description="look-up tables")
    scatter: dict[str, Any] | None = Field(None, description="variation from exposure to exposure")
    deviations: Warned | None = Field(None, description="exposures that deviate")
    exposures_skipped: dict[str, Any] | None = None
    exposures_outlying: list[Any] | None = None
    time_dependence: Warned | None = Field(None, description="linear terms, exposure by exposure")


class Summary(Sections):
    """Content of summary.json: the run as a whole, and the results of the completed stages."""

    schema_: Literal[2] = Field(alias="schema")
    bayesdist: str = Field(description="version of the package")
    kind: str = Field(description="what the run begins with")
    detector: str = Field(description="name of detector or chips, and filter of a campaign")
    began: str = Field(description="when the run began, UTC")
    simulated: bool = Field(description="the input is simulated, as the configuration has it")


class SummaryHead(TypedDict):
    """Entries of summary.json about the run as a whole."""

    bayesdist: str
    kind: str
    detector: str
    began: str
    simulated: bool


def head_of(facts: Mapping[str, Any]) -> SummaryHead:
    """Entries of summary.json about the run as a whole."""
    config = facts["config"]
    kind = next(name for name in installed_kinds() if name in config)
    # a damaged run.json may lack names, which are for display only
    chips = " and ".join(chip.get("name", "") for chip in config.get("chip", ()))
    parts = [config.get("detector", {}).get("name") or chips, config[kind].get("filter")]
    return {
        "bayesdist": facts["versions"]["bayesdist"],
        "kind": kind,
        "detector": ", ".join(part for part in parts if part),
        "began": facts["created"],
        "simulated": config[kind].get("simulated", False),
    }


def schema_text() -> str:
    """Text of the JSON Schema of summary.json."""
    return json.dumps(Summary.model_json_schema(), indent=1) + "\n"
