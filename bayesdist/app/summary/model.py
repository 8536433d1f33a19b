"""summary.json as a model, of which the package has a JSON Schema."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from bayesdist.app.summary.rows import (
    AddedErrorRow,
    BudgetRow,
    CoverageRow,
    HoldoutTest,
    MapRow,
    MarginRow,
    MeanAndSd,
    MisfitRow,
    Number,
    Part,
    ProductRow,
    ScoreTestRow,
    StructureRow,
    ValidityRow,
)

__all__ = ["Sections", "Summary", "head_of", "schema_text"]


class Data(Part):
    """What was read and used."""

    n_rows: int
    n_used: int
    n_rejected: int
    rejected: dict[str, int] = Field(description="rows by reason")
    n_exposures: int
    sources: list[str]
    tangent_point: Annotated[list[float], Field(min_length=2, max_length=2)] | None = Field(
        description="RA and Dec in degrees"
    )


class AddedErrors(Part):
    """Errors beyond the quoted ones that groups of matches have."""

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


class Fit(Part):
    """The least-squares fit."""

    order: int
    chi2: Number
    dof: int
    rms_u: Number
    rms_v: Number
    unit: str
    condition: Number
    n_parameters: int
    error_scale: Number = Field(1.0, description="factor on the quoted errors")
    added_errors: AddedErrors | None = None


class Outliers(Part):
    """The outlier mixture."""

    model: Literal["gaussian", "uniform", "none"]
    unit: str
    fraction: MeanAndSd | None = None
    jitter: MeanAndSd | None = None
    scale: MeanAndSd | None = None
    n_flagged: int = Field(description="with a probability above 0.5")
    match_circle: Number = None


class Sampler(Part):
    """How the posterior was drawn, and whether the chains have converged."""

    method: str
    exact: bool = Field(description="false of draws that stand for the posterior")
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


class Map(MapRow):
    """Largest errors of positions: of all chips, and of each."""

    unit: str
    epoch: Number
    chips: list[MapRow]


class Misfit(MisfitRow):
    """Structure in the residuals: of the worst chip, corrected for their number, and of each."""

    unit: str
    significant: bool
    chips: list[MisfitRow] = Field(default_factory=list)


class CorrelatedErrors(Part):
    """What the model may leave out, as the residuals of all stars show it."""

    structure: list[StructureRow]
    unit: str
    noise_ratio: Number = Field(description="variance by the stars' scatter over the formal one")


class Holdout(Part):
    """How the prediction holds for stars that were set aside."""

    n: int
    n_excluded: int = Field(description="stars of exposures with too few to be predicted")
    exposures: list[str]
    p_value: Number
    verdict: str
    level: Literal["pass", "warn", "fail"]
    coverage: list[CoverageRow]
    tests: list[HoldoutTest]


class Periods(Part):
    """Whether the distortion changes with time."""

    verdict: str
    significant: bool
    unit: str
    periods: list[dict[str, Any]]
    first_vs_last: dict[str, Any]


class Warned(Part):
    """A section with warnings."""

    warnings: list[str] = Field(default_factory=list)


class Verdict(Part):
    """The worst of all checks, requirements and validity periods, in words."""

    level: Literal["pass", "warn", "fail"]
    headline: str


class Sections(Part):
    """What the stages that have ended found, section by section."""

    matching: Warned | None = Field(None, description="of a campaign")
    selfcal: Warned | None = Field(None, description="of a self-calibration")
    data: Data | None = None
    fit: Fit | None = None
    outliers: Outliers | None = None
    sampler: Sampler | None = None
    discrepancy: CorrelatedErrors | None = None
    score_tests: list[ScoreTestRow] | None = None
    holdout: Holdout | None = None
    periods: Periods | None = None
    map: Map | None = None
    budget: list[BudgetRow] | None = None
    misfit: Misfit | None = None
    margins: list[MarginRow] | None = None
    validity_periods: list[ValidityRow] | None = None
    warnings: list[str] | None = None
    products: list[ProductRow] | None = None
    figures: list[str] | None = None
    verdict: Verdict | None = Field(None, description="headline of the report")
    gauge: dict[str, Any] | None = Field(None, description="exposures: what holds the solution")
    lines: list[dict[str, Any]] | None = Field(None, description="linear terms against time")
    tables: Warned | None = Field(None, description="look-up tables")
    scatter: dict[str, Any] | None = Field(None, description="variation from exposure to exposure")
    deviations: Warned | None = Field(None, description="exposures that deviate")
    exposures_skipped: dict[str, Any] | None = None
    exposures_outlying: list[Any] | None = None
    time_dependence: Warned | None = Field(None, description="linear terms, exposure by exposure")


class Summary(Sections):
    """Content of summary.json: the run as a whole, and what the stages that have ended found."""

    schema_: Literal[2] = Field(alias="schema")
    bayesdist: str = Field(description="version of the package")
    kind: Literal["data", "campaign", "selfcal"] = Field(description="what the run begins with")
    detector: str = Field(description="name of detector or chips, and filter of a campaign")
    began: str = Field(description="when the run began, UTC")
    simulated: bool = Field(description="the input is simulated, as the configuration has it")


def head_of(facts: Mapping[str, Any]) -> dict[str, Any]:
    """What summary.json says of the run as a whole.

    Parameters
    ----------
    facts : mapping
        Of run.json.
    """
    config = facts["config"]
    kind = next(one for one in ("data", "campaign", "selfcal") if one in config)
    chips = " and ".join(chip["name"] for chip in config["chip"])
    parts = [config["detector"]["name"] or chips, config[kind].get("filter")]
    return {
        "bayesdist": facts["versions"]["bayesdist"],
        "kind": kind,
        "detector": ", ".join(part for part in parts if part),
        "began": facts["created"],
        "simulated": config[kind]["simulated"],
    }


def schema_text() -> str:
    """Text of the JSON Schema of summary.json."""
    return json.dumps(Summary.model_json_schema(), indent=1) + "\n"
