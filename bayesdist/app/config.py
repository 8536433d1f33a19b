"""The configuration file: every key, its type and its default."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    create_model,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from bayesdist.app.campaign.config import CampaignBlock, ReleaseBlock, TablesBlock
from bayesdist.app.config_errors import as_config_error
from bayesdist.app.holdout_config import HoldoutBlock
from bayesdist.app.rvb_config import RvbBlock
from bayesdist.app.section import Section
from bayesdist.app.selfcal.config import GaugeBlock, SelfcalBlock
from bayesdist.assess import Requirement, UserTerm
from bayesdist.assess.solution import Solution
from bayesdist.assess.terms.correlated import DEVIATIONS, STRUCTURE, STRUCTURE_IN_FIT
from bayesdist.assess.terms.forms import GIVEN, ErrorTerm
from bayesdist.assess.terms.given import TERM_KINDS, said_by_user
from bayesdist.assess.terms.kinds import one_size_kinds, one_size_term
from bayesdist.assess.terms.solution import COEFFICIENTS, EXPOSURE_FRAME, TIME_DEPENDENCE
from bayesdist.data.tables.units import length_advice
from bayesdist.errors import ConfigError, InputError
from bayesdist.infer import Compute, OutlierMixture
from bayesdist.infer.compare.period_dates import check_periods, mjd_periods
from bayesdist.infer.discrepancy import DiscrepancyPriors
from bayesdist.model import FRAME_KINDS, Chip, TimeDependence
from bayesdist.products.formats.common.document import FormatSettings
from bayesdist.products.registry import product_settings

__all__ = [
    "CATALOGUE_WORDS",
    "ChipBlock",
    "Config",
    "Detector",
    "chips_of",
    "load_config",
    "load_requirements",
    "load_text",
    "parse_config",
    "reference_first",
    "require_detector",
    "require_own_names",
    "validated",
]

Pair = tuple[PositiveFloat, PositiveFloat]
Unit = Literal["pix", "arcsec", "mas", "deg"]
Probability = Annotated[float, Field(gt=0, lt=1)]


class Data(Section):
    """What is read, and how."""

    matches: str | list[str]
    format: Literal["auto", "table", "hst1pass", "matchup", "astrometry.net", "rvb"] = "auto"
    band: str | None = None
    columns: dict[str, str] | None = None
    unit: Unit | None = None
    sigma: Literal["columns", "by_magnitude"] | PositiveFloat = "columns"
    pixel_origin: Literal[0, 1] | None = None
    tangent_point: tuple[float, float] | None = None
    epoch: float | str | None = None
    catalogue_epoch: float | None = None
    not_finite: Literal["refuse", "reject"] = "refuse"
    rvb: RvbBlock | None = None

    @field_validator("unit", mode="before")
    @classmethod
    def _no_length(cls, unit: Any) -> Any:
        advice = length_advice(unit) if isinstance(unit, str) else ""
        if advice:
            raise ValueError(
                f"data.unit is {unit!r}, and positions are in pixels or angles; {advice}"
            )
        return unit

    @model_validator(mode="after")
    def _only_of_rvb(self) -> Data:
        for key in ("band", "rvb"):
            if self.format != "rvb" and getattr(self, key) is not None:
                raise ValueError(
                    f"data.{key} is given, but data.format is {self.format!r}; set the format to "
                    f"'rvb', or leave {key} out"
                )
        if self.format == "rvb" and self.tangent_point is not None:
            raise ValueError(
                "data.tangent_point is given, but RvB pairs lie in pixels of the band frame; "
                "leave it out"
            )
        for key in ("epoch", "catalogue_epoch"):
            if self.format == "rvb" and getattr(self, key) is not None:
                raise ValueError(
                    f"data.{key} is given, and RvB pairs have no proper motions; leave it out"
                )
        return self


class Detector(Section):
    """A detector of one chip."""

    name: str = ""
    size: Pair | None = None
    scale_mas: PositiveFloat | None = None


class ChipBlock(Section):
    """One of several chips."""

    number: int
    name: str
    size: Pair
    reference_pixel: Pair
    reference: bool = False


def require_detector(
    chips: Sequence[ChipBlock], detector: Detector, reference_pixel: Pair | None
) -> None:
    """Refuse chips that contradict each other, or no detector at all.

    Raises
    ------
    ValueError
        As validators raise it.
    """
    if sum(c.reference for c in chips) > 1:
        raise ValueError("reference = true stands in several [[chip]] blocks; keep it in one")
    for key in ("number", "name"):
        values = [getattr(c, key) for c in chips]
        twice = next((v for v in values if values.count(v) > 1), None)
        if twice is not None:
            raise ValueError(f"two [[chip]] blocks have the {key} {twice!r}; give each its own")
    if chips and (detector.size or reference_pixel):
        raise ValueError(
            "[[chip]] blocks stand in place of detector.size and model.reference_pixel; "
            "give one of the two"
        )
    if not chips and detector.size is None:
        raise ValueError("detector.size is missing; give it, or [[chip]] blocks")


def reference_first(chips: Sequence[ChipBlock]) -> list[ChipBlock]:
    """The blocks with the reference chip in front: it defines the frame."""
    return sorted(chips, key=lambda c: not c.reference)


def chips_of(chips: Sequence[ChipBlock]) -> tuple[Chip, ...]:
    """Chips of the model."""
    blocks = reference_first(chips)
    return tuple(Chip(c.number, c.name, c.size, c.reference_pixel) for c in blocks)


def require_own_names(block: str, names: Sequence[str]) -> None:
    """Refuse blocks of one name.

    Raises
    ------
    ValueError
        As validators raise it.
    """
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"two [[{block}]] blocks have the name {twice!r}; give each its own")


class Tdd(Section):
    """Terms that drift linearly with time."""

    epoch0: float | list[float]
    terms: list[tuple[Literal["u", "v"], Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]]
    breaks: list[float] = Field(default_factory=list)
    rates: str = "free"


class ModelBlock(Section):
    """Structure of the distortion model."""

    order: Annotated[int, Field(ge=1, le=9)]
    reference_pixel: Pair | None = None
    frames: Literal[FRAME_KINDS] = "none"  # type: ignore[valid-type]
    tdd: Tdd | None = None


class Fit(Section):
    """The linear fit."""

    clip_chi2: PositiveFloat = 25.0
    clip_abs: PositiveFloat = 2.0
    radial_weight: PositiveFloat = 1.0
    skew: bool = False


class Outliers(Section):
    """The outlier mixture."""

    model: Literal["gaussian", "uniform", "none"] = "gaussian"
    match_radius: PositiveFloat | None = None
    jitter: Literal["fit"] | Annotated[float, Field(ge=0)] = "fit"
    jitter_by: Literal["auto", "one", "chip", "exposure", "filter"] = "auto"
    fraction_prior: Pair = (1.0, 9.0)
    jitter_scale: PositiveFloat | None = None
    outlier_scale: PositiveFloat | None = None

    @model_validator(mode="after")
    def _groups_of_what_is_fitted(self) -> Outliers:
        if self.jitter_by not in ("auto", "one") and self.jitter != "fit":
            raise ValueError(
                f"outliers.jitter_by is {self.jitter_by!r}, and outliers.jitter gives the one "
                "jitter of all stars; leave one of the two out"
            )
        return self


class Sampler(Section):
    """When to stop, and from which seed."""

    method: Literal["exact", "certified"] = "exact"
    second_stage: Literal["auto", "always", "never"] = "auto"
    seed: Annotated[int, Field(ge=0)] = 1
    ensembles: Annotated[int, Field(ge=2)] = 4
    walkers: PositiveInt | None = None
    target_ess: PositiveFloat = 400.0
    target_rhat: Annotated[float, Field(gt=1)] = 1.01
    max_steps: PositiveInt = 20_000
    checkpoint_every: PositiveInt = 200


class ComputeBlock(Section):
    """Where the work is done."""

    engine: Literal["threads", "dask"] = "threads"
    scheduler: str | None = None
    workers: PositiveInt | None = None
    memory_mb: PositiveFloat = 1000.0

    @model_validator(mode="after")
    def _only_of_a_cluster(self) -> ComputeBlock:
        for key in ("scheduler", "workers"):
            if self.engine != "dask" and getattr(self, key) is not None:
                raise ValueError(
                    f"compute.{key} is given, but compute.engine is {self.engine!r}; set the "
                    f"engine to 'dask', or leave {key} out"
                )
        if self.scheduler is not None and self.workers is not None:
            raise ValueError(
                "compute.workers is given, but the cluster of compute.scheduler has its own; "
                "leave one of the two out"
            )
        return self


class Periods(Section):
    """Periods whose models are compared."""

    centres: list[float]
    days: PositiveFloat


class Assess(Section):
    """Where and when errors are assessed."""

    epoch: float | None = None
    grid: tuple[Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)]] = (33, 17)
    draws: Annotated[int, Field(ge=100)] = 4000
    exposure: Literal["mean", "single"] = "mean"
    horizon: Annotated[float, Field(ge=0)] = 10.0


# by which a row of the budget says that it is the error of the reference catalogue
CATALOGUE_WORDS = ("catalog", "reference")


class BudgetBlock(Section):
    """An error term that the data cannot show."""

    name: str
    kind: str
    sigma_u: Annotated[float, Field(ge=0)] | None = None
    sigma_v: Annotated[float, Field(ge=0)] | None = None
    sigma: Annotated[float, Field(ge=0)] | None = None
    unit: Unit = "pix"
    source: str = GIVEN
    in_residuals: bool = False

    @field_validator("kind")
    @classmethod
    def _known_kind(cls, kind: str) -> str:
        *others, last = known = (*TERM_KINDS, *one_size_kinds())
        if kind not in known:  # in the words of a Literal
            listed = ", ".join(map(repr, others))
            raise PydanticCustomError("literal_error", f"Input should be {listed} or {last!r}")
        return kind

    def names(self, *words: str) -> bool:
        """Whether one of some words is in the row's name."""
        return any(word in self.name.lower() for word in words)

    @property
    def stated(self) -> bool:
        """Whether the row states an error: one of size 0 does so with its source only."""
        sizes = (self.sigma_u, self.sigma_v, self.sigma)
        return any(sizes) or self.source != GIVEN

    @model_validator(mode="after")
    def _sigma_of_its_kind(self) -> BudgetBlock:
        axes = self.sigma_u is not None and self.sigma_v is not None
        neither = self.sigma_u is None and self.sigma_v is None
        if self.kind not in TERM_KINDS:
            if self.sigma is None or not neither:
                raise ValueError(
                    f"a budget term of kind {self.kind!r} has one sigma, relative or in radians; "
                    "give sigma, and neither sigma_u nor sigma_v"
                )
        elif not axes or self.sigma is not None:
            raise ValueError(
                f"a budget term of kind {self.kind!r} has a sigma on each axis; give sigma_u and "
                "sigma_v, and no sigma"
            )
        if self.in_residuals and self.kind != "random":
            raise ValueError(
                "in_residuals is of a random budget term, which scatters from star to star; "
                "leave it out"
            )
        return self


class RequirementBlock(Section):
    """A limit on a statistic of the position error."""

    name: str
    statistic: str
    limit: PositiveFloat
    unit: Unit = "pix"
    probability: Probability = 0.95
    epoch: float | None = None
    chip: int | None = None
    region: str | list[tuple[float, float]] = "whole"
    epochs: tuple[float, float] | None = None
    relative: bool = False
    separation: PositiveFloat | None = None
    magnitude: float | None = None


class DiscrepancyBlock(Section):
    """Prior medians of what the model may leave out."""

    higher_order: PositiveFloat = DiscrepancyPriors.higher_order
    structure: PositiveFloat = DiscrepancyPriors.structure
    exposure: PositiveFloat = DiscrepancyPriors.exposure
    curvature: PositiveFloat = DiscrepancyPriors.curvature
    star: PositiveFloat = DiscrepancyPriors.star

    def priors(self) -> DiscrepancyPriors:
        """The block as priors."""
        return DiscrepancyPriors(**self.model_dump())


class PriorBlock(Section):
    """A Gaussian prior on one parameter."""

    parameter: str
    mean: float
    sigma: PositiveFloat


class _Products(Section):
    """Files for pipelines: a table for each format that can be built, and the set of a release."""

    release: ReleaseBlock | None = None

    def asked(self) -> dict[str, FormatSettings]:
        """Settings of the files that are asked for, by format."""
        found = {key: getattr(self, key) for key in product_settings()}
        return {key: settings for key, settings in found.items() if settings is not None}


Products = create_model(
    "Products",
    __base__=_Products,
    **{key: (settings | None, None) for key, settings in product_settings().items()},
)


# rows of every budget, and what its totals are called
MEASURED_TERMS = (
    *(COEFFICIENTS, TIME_DEPENDENCE, EXPOSURE_FRAME),
    *("total", "model", STRUCTURE, STRUCTURE_IN_FIT, DEVIATIONS, "look-up tables"),
)


class Config(Section):
    """The whole file."""

    data: Data | None = None
    campaign: CampaignBlock | None = None
    selfcal: SelfcalBlock | None = None
    gauge: GaugeBlock = GaugeBlock()
    tables: TablesBlock = TablesBlock()
    model: ModelBlock
    detector: Detector = Detector()
    chip: list[ChipBlock] = Field(default_factory=list)
    fit: Fit = Fit()
    outliers: Outliers = Outliers()
    sampler: Sampler = Sampler()
    compute: ComputeBlock = ComputeBlock()
    assess: Assess = Assess()
    periods: Periods | None = None
    holdout: HoldoutBlock | None = None
    budget: list[BudgetBlock] = Field(default_factory=list)
    requirement: list[RequirementBlock] = Field(default_factory=list)
    prior: list[PriorBlock] = Field(default_factory=list)
    discrepancy: DiscrepancyBlock = DiscrepancyBlock()
    products: Products = Products()

    @model_validator(mode="after")
    def _data_or_campaign(self) -> Config:
        if sum(one is not None for one in (self.data, self.campaign, self.selfcal)) != 1:
            raise ValueError(
                "a run begins with [data], matched stars, with [campaign], star lists and a "
                "catalogue, or with [selfcal], star lists alone; give one"
            )
        if self.campaign is None and self.products.release is not None:
            raise ValueError("products.release is of a [campaign]; ask for sip or idctab")
        if self.campaign is None and self.tables.detector is not None:
            raise ValueError("tables.detector is of a [campaign]; leave it out")
        if self.campaign is None and self.model.tdd is not None and self.model.tdd.rates != "free":
            raise ValueError("model.tdd.rates is of a [campaign]; give [[prior]] blocks")
        if self.campaign is not None and self.model.frames != "none":
            raise ValueError("a [campaign] has frames of its own; leave model.frames out")
        if self.data is not None and self.data.format == "rvb" and self.chip:
            raise ValueError(
                "RvB pairs are of one array; give detector.size in place of [[chip]] blocks"
            )
        if self.campaign is not None and len(self.chip) == 0:
            raise ValueError("a [campaign] has no [[chip]] blocks; give them, one as the reference")
        return self

    @model_validator(mode="after")
    def _alone_without_catalogue(self) -> Config:
        if self.selfcal is None:
            if self.gauge != GaugeBlock():
                raise ValueError("[gauge] is of a [selfcal]; leave it out")
            return self
        if self.model.frames != "none":
            raise ValueError(
                "a [selfcal] has frames of its own; leave model.frames out and set selfcal.frames"
            )
        # what a self-calibration does otherwise or not at all
        others: dict[str, tuple[object, object, str]] = {
            "tables": (self.tables, TablesBlock(), "leave it out"),
            "periods": (self.periods, None, "leave it out"),
            "holdout": (self.holdout, None, "leave it out"),
            "fit": (self.fit, Fit(), "leave it out"),
            "compute": (self.compute, ComputeBlock(), "leave it out"),
            "products.wise_meta": (self.products.wise_meta, None, "ask for sip or idctab"),
            "outliers.match_radius": (
                self.outliers.match_radius,
                None,
                "set selfcal.match_radius",
            ),
            "outliers.outlier_scale": (self.outliers.outlier_scale, None, "leave it out"),
            "sampler.method": (self.sampler.method, "exact", "leave it out"),
            "sampler.walkers": (self.sampler.walkers, None, "leave it out"),
            "sampler.second_stage": (self.sampler.second_stage, "auto", "leave it out"),
        }
        for key, (value, default, do) in others.items():
            if value != default:
                raise ValueError(f"{key} has no meaning in a [selfcal]; {do}")
        said = "model" in self.outliers.model_fields_set
        if said and self.outliers.model != "uniform":
            raise ValueError(
                f"outliers.model is '{self.outliers.model}', and in a [selfcal] false detections "
                "are uniform within the match radius; leave it out"
            )
        if self.gauge.exposure_scale_sigma is not None and "scale" not in self.selfcal.frames:
            raise ValueError(
                "gauge.exposure_scale_sigma is given, and the exposures have no scales; set "
                "selfcal.frames to 'shift_rotation_scale'"
            )
        if self.gauge.roll_sigma_deg is not None and "rotation" not in self.selfcal.frames:
            raise ValueError(
                "gauge.roll_sigma_deg is given, and the exposures have no rotations; set "
                "selfcal.frames to 'shift_rotation'"
            )
        if self._needs_scale and self.detector.scale_mas is None:
            raise ValueError(
                "detector.scale_mas is missing, which turns pixels into seconds of arc; give it"
            )
        uniform = self.outliers.model_copy(update={"model": "uniform"})
        return self.model_copy(update={"outliers": uniform})

    @property
    def _needs_scale(self) -> bool:
        """Whether a self-calibration has to know what a pixel is on the sky."""
        assert self.selfcal is not None
        angles = self.gauge.scale is not None or self.gauge.reference is not None
        return angles or self.selfcal.unit != "pix"

    @model_validator(mode="after")
    def _names_of_their_own(self) -> Config:
        require_own_names("budget", [b.name for b in self.budget])
        require_own_names("requirement", [r.name for r in self.requirement])
        taken = next((b.name for b in self.budget if b.name in MEASURED_TERMS), None)
        if taken is not None:
            raise ValueError(
                f"a [[budget]] block has the name {taken!r}, which is that of a measured row; "
                "give it another"
            )
        return self

    @model_validator(mode="after")
    def _jitter_beyond_quoted_errors(self) -> Config:
        by = self.outliers.jitter_by
        if by == "auto":
            return self
        head = f"outliers.jitter_by is {by!r}, which is of quoted errors, and"
        if self.data is None:
            kind = "campaign" if self.campaign is not None else "selfcal"
            raise ValueError(f"{head} a [{kind}] has a model of errors of its own; leave it out")
        if self.data.sigma == "by_magnitude":
            raise ValueError(
                f"{head} data.sigma = 'by_magnitude' takes errors of both axes from the "
                "residuals; leave it out, or give columns of errors or a number"
            )
        if by == "chip" and not self.chip:
            raise ValueError(
                "outliers.jitter_by is 'chip', and there is one chip; leave it out, or give "
                "[[chip]] blocks"
            )
        return self

    @property
    def compares_jitters(self) -> bool:
        """Whether groups of stars may have jitters of their own, if the data ask for it."""
        of_quoted = self.data is not None and self.data.sigma != "by_magnitude"
        return of_quoted and self.outliers.jitter == "fit" and self.outliers.jitter_by != "one"

    @model_validator(mode="after")
    def _matched_in_a_circle(self) -> Config:
        if self.selfcal is not None and _names_nominal(self.selfcal.columns):
            raise ValueError(
                "nominal positions are of matches in [data], and a [selfcal] finds its matches "
                "itself; leave u_nominal and v_nominal out"
            )
        if self.data is not None and _names_nominal(self.data.columns):
            if self.data.format not in ("auto", "table"):
                raise ValueError(
                    f"nominal positions are columns of tables, and data.format is "
                    f"{self.data.format!r}; leave u_nominal and v_nominal out"
                )
            self.refuse_circle()
        return self

    def refuse_circle(self) -> None:
        """Refuse what cannot go with matches in a circle about their nominal positions.

        Raises
        ------
        ValueError
            As validators raise it.
        """
        if self.outliers.match_radius is None:
            return
        head = "matches with nominal positions and outliers.match_radius are"
        if self.data is not None and self.data.sigma == "by_magnitude":
            raise ValueError(
                f"{head} cut by the match circle, and so are residuals, from which data.sigma = "
                "'by_magnitude' takes the errors; give columns of errors, or a number"
            )
        if self.outliers.jitter_by not in ("auto", "one"):
            raise ValueError(
                f"{head} cut by the match circle, and so are residuals, from which "
                "outliers.jitter_by takes the jitters of groups; leave it out"
            )
        if self.holdout is not None:
            raise ValueError(
                f"{head} cut by the match circle, which the prediction of [holdout] does not "
                "know; leave [holdout] out, or the nominal positions"
            )
        if self.periods is not None:
            raise ValueError(
                f"{head} cut by the match circle, which draws the least-squares fits of [periods] "
                "to the nominal solution; leave [periods] out, or the nominal positions"
            )

    @model_validator(mode="after")
    def _periods_of_polynomials(self) -> Config:
        if self.periods is None:
            return self
        if self.campaign is not None:
            raise ValueError("[periods] is of matched stars, and a [campaign] has drift; drop one")
        if self.model.frames != "none" or self.model.tdd is not None:
            key = "tdd" if self.model.tdd is not None else "frames"
            raise ValueError(
                f"[periods] compares polynomials alone, and model.{key} is given; drop one of them"
            )
        if self.data is not None and (self.data.columns or {}).get("epoch") == "":
            raise ValueError(
                "[periods] needs an epoch for every pair, and data.columns leaves the epoch out; "
                "name its column there"
            )
        return self

    @model_validator(mode="after")
    def _chips_or_detector(self) -> Config:
        require_detector(self.chip, self.detector, self.model.reference_pixel)
        return self

    @model_validator(mode="after")
    def _files_of_this_detector(self) -> Config:
        name = self.detector.name if self.campaign is None else ""
        for settings in self.products.asked().values():
            settings.check(name, self.detector.size, self.model.reference_pixel)
        return self

    def chips(self) -> tuple[Chip, ...]:
        """Chips of the model; empty for a detector of one chip."""
        return chips_of(self.chip)

    def time(self) -> TimeDependence | None:
        """Time dependence of the model."""
        tdd = self.model.tdd
        if tdd is None or not tdd.terms:
            return None
        epochs = tdd.epoch0 if isinstance(tdd.epoch0, list) else [tdd.epoch0]
        return TimeDependence(tuple(tdd.terms), tuple(epochs), tuple(tdd.breaks))

    def mixture(self) -> OutlierMixture:
        """The outlier mixture."""
        o = self.outliers
        return OutlierMixture(
            model=o.model,
            match_radius=o.match_radius if self.selfcal is None else self.selfcal.match_radius,
            jitter=None if o.jitter == "fit" else o.jitter,
            fraction_prior=o.fraction_prior,
            jitter_scale=o.jitter_scale,
            outlier_scale=o.outlier_scale,
        )

    def spans(self) -> dict[str, tuple[float, float]]:
        """Begin and end of each of the periods, decimal years; empty where none are asked for."""
        if self.periods is None:
            return {}
        centres = self.periods.centres
        twice = next((c for c in centres if centres.count(c) > 1), None)
        if twice is not None:
            raise InputError(
                f"the period centred on {twice:.10g} is given twice",
                where="periods.centres",
                do="give each once",
            )
        spans = mjd_periods(centres, self.periods.days)
        check_periods(spans)
        return spans

    def resources(self) -> Compute:
        """Where the work is done."""
        return Compute(**self.compute.model_dump())

    def states(self, *words: str) -> bool:
        """Whether a [[budget]] row with one of some words in its name states an error."""
        return any(row.stated and row.names(*words) for row in self.budget)

    def user_terms(self) -> tuple[UserTerm, ...]:
        """The user's terms of the error budget that are the same at every place."""
        return tuple(
            UserTerm(
                b.name,
                b.kind,
                b.sigma_u,
                b.sigma_v,
                b.unit,
                said_by_user(b.source),
                varies=b.names(*CATALOGUE_WORDS),
            )
            for b in self.budget
            if b.sigma_u is not None and b.sigma_v is not None
        )

    def linear_terms(self, solution: Solution) -> tuple[ErrorTerm, ...]:
        """The user's terms of the error budget that have one size: scale, rotation, a mission's."""
        return tuple(
            one_size_term(b.name, b.kind, b.sigma, solution, said_by_user(b.source))
            for b in self.budget
            if b.sigma is not None
        )

    def in_residuals(self) -> tuple[UserTerm, ...]:
        """Those of the user's terms that the scatter of residuals holds already."""
        held = {b.name for b in self.budget if b.in_residuals}
        return tuple(t for t in self.user_terms() if t.name in held)

    def held_in_residuals(self, unit: str) -> list[tuple[str, float, float]]:
        """Name and standard deviation on each axis of these terms, in the unit of u and v."""
        scale = self.detector.scale_mas
        return [(t.name, *t.sigma(unit, scale)) for t in self.in_residuals()]

    def requirements(self) -> tuple[Requirement, ...]:
        """The requirements."""
        return tuple(Requirement(**r.model_dump()) for r in self.requirement)


def _names_nominal(columns: dict[str, str] | None) -> bool:
    return any((columns or {}).get(key) for key in ("u_nominal", "v_nominal"))


class _RequirementFile(Section):
    requirement: Annotated[list[RequirementBlock], Field(min_length=1)]


def load_config(path: str | Path) -> tuple[Config, str]:
    """Read a configuration file.

    Parameters
    ----------
    path : path

    Returns
    -------
    config : Config
    text : str
        The file as it stands.

    Raises
    ------
    ConfigError
        With file, key and reason; an unknown key names the nearest known one.
    """
    text = load_text(path)
    return parse_config(text, str(path)), text


def parse_config(text: str, where: str) -> Config:
    """A configuration from the text of a file; `where` names it in errors."""
    config = validated(Config, text, where, begin="write one by 'bayesdist init'")
    try:
        config.time()
        config.mixture()
        config.user_terms()
        config.requirements()
        config.spans()
    except InputError as error:
        raise ConfigError(error.cause, where=f"{where}: {error.where}", do=error.do) from error
    return config


def load_requirements(path: str | Path) -> tuple[Requirement, ...]:
    """Read a file of ``[[requirement]]`` blocks.

    Raises
    ------
    ConfigError
    """
    text, begin = load_text(path), "give it [[requirement]] blocks"
    blocks = validated(_RequirementFile, text, str(path), begin=begin).requirement
    try:
        return tuple(Requirement(**r.model_dump()) for r in blocks)
    except InputError as error:
        raise ConfigError(error.cause, where=f"{path}: {error.where}", do=error.do) from error


def load_text(path: str | Path) -> str:
    """Text of a file as it stands, with its line ends.

    Raises
    ------
    ConfigError
    """
    try:
        with open(path, encoding="utf-8", newline="") as stream:
            return stream.read()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError(
            f"cannot be read ({reason})", where=str(path), do="check the path and the file"
        ) from error


def validated(kind: type[Section], text: str, where: str, *, begin: str) -> Any:
    """A file of sections from its text.

    Parameters
    ----------
    kind : type of Section
    text : str
    where : str
        The file, for errors.
    begin : str
        What to do about an empty one.

    Raises
    ------
    ConfigError
    """
    try:
        raw = tomllib.loads(text.removeprefix("\ufeff"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(
            f"is not valid TOML ({error})", where=where, do="correct it there"
        ) from error
    if not raw:
        raise ConfigError("holds no settings", where=where, do=begin)
    try:
        # by way of JSON: there arrays may become tuples, but no text a number
        return kind.model_validate_json(json.dumps(raw, default=str), strict=True)
    except ValidationError as error:
        raise as_config_error(kind, error, where) from error
