"""The configuration of a run: one of three kinds, each with the sections that mean something in it.

What a kind does not have is a constant of its class, so that nobody has to ask for the kind.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, TypeAlias

from pydantic import Discriminator, Field, Tag, TypeAdapter, model_validator

from bayesdist.app.config.assess import Assess, BudgetBlock, Periods, RequirementBlock
from bayesdist.app.config.campaign import CampaignBlock, TablesBlock
from bayesdist.app.config.common import RunConfig
from bayesdist.app.config.data import DataOfFormat, names_nominal
from bayesdist.app.config.detector import ChipBlock, Detector
from bayesdist.app.config.holdout import HoldoutBlock
from bayesdist.app.config.model import (
    CampaignFit,
    CampaignModel,
    CampaignOutliers,
    ComputeBlock,
    DiscrepancyBlock,
    Fit,
    MatchedModel,
    Outliers,
    PriorBlock,
    Sampler,
    SelfcalModel,
    SelfcalOutliers,
    SelfcalSampler,
)
from bayesdist.app.config.products import CampaignProducts, MatchedProducts, SelfcalProducts
from bayesdist.app.config.selfcal import GaugeBlock, SelfcalBlock
from bayesdist.errors import InputError
from bayesdist.infer import Compute, OutlierMixture
from bayesdist.infer.compare.period_dates import check_periods, mjd_periods

__all__ = ["CONFIG", "KINDS", "CampaignConfig", "Config", "MatchesConfig", "SelfcalConfig"]


class MatchesConfig(RunConfig):
    """A run that begins with matched stars."""

    campaign: ClassVar[None] = None
    selfcal: ClassVar[None] = None
    gauge: ClassVar[GaugeBlock] = GaugeBlock()
    tables: ClassVar[TablesBlock] = TablesBlock()

    data: DataOfFormat
    model: MatchedModel
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
    products: MatchedProducts = MatchedProducts()

    @model_validator(mode="after")
    def _one_array(self) -> MatchesConfig:
        if self.data.one_array and self.chip:
            raise ValueError(
                f"matches of the format {self.data.format!r} are of one array; give "
                "detector.size in place of [[chip]] blocks"
            )
        return self

    @model_validator(mode="after")
    def _jitter_beyond_quoted_errors(self) -> MatchesConfig:
        by = self.outliers.jitter_by
        if by != "auto" and self.data.sigma == "by_magnitude":
            raise ValueError(
                f"outliers.jitter_by is {by!r}, which is of quoted errors, and data.sigma = "
                "'by_magnitude' takes errors of both axes from the residuals; leave it out, or "
                "give columns of errors or a number"
            )
        if by == "chip" and not self.chip:
            raise ValueError(
                "outliers.jitter_by is 'chip', and there is one chip; leave it out, or give "
                "[[chip]] blocks"
            )
        return self

    @model_validator(mode="after")
    def _matched_in_a_circle(self) -> MatchesConfig:
        if self.data.has_nominal:
            self.refuse_circle()
        return self

    @model_validator(mode="after")
    def _periods_of_polynomials(self) -> MatchesConfig:
        if self.periods is None:
            return self
        if self.model.frames != "none" or self.model.tdd is not None:
            key = "tdd" if self.model.tdd is not None else "frames"
            raise ValueError(
                f"[periods] compares polynomials alone, and model.{key} is given; drop one of them"
            )
        if (self.data.columns or {}).get("epoch") == "":
            raise ValueError(
                "[periods] needs an epoch for every pair, and data.columns leaves the epoch out; "
                "name its column there"
            )
        return self

    @property
    def compares_jitters(self) -> bool:
        """Boolean: groups of stars may have jitters of their own, if the data ask for it."""
        quoted = self.data.sigma != "by_magnitude"
        return quoted and self.outliers.jitter == "fit" and self.outliers.jitter_by != "one"

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
        if self.data.sigma == "by_magnitude":
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

    def resources(self) -> Compute:
        """Where the work is done."""
        return self.compute.resources()

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


class CampaignConfig(RunConfig):
    """A run that begins with star lists and a catalogue."""

    data: ClassVar[None] = None
    selfcal: ClassVar[None] = None
    gauge: ClassVar[GaugeBlock] = GaugeBlock()
    periods: ClassVar[None] = None
    prior: ClassVar[tuple[PriorBlock, ...]] = ()

    campaign: CampaignBlock
    tables: TablesBlock = TablesBlock()
    model: CampaignModel
    detector: Detector = Detector()
    chip: list[ChipBlock] = Field(default_factory=list)
    fit: CampaignFit = CampaignFit()
    outliers: CampaignOutliers = CampaignOutliers()
    sampler: Sampler = Sampler()
    compute: ComputeBlock = ComputeBlock()
    assess: Assess = Assess()
    holdout: HoldoutBlock | None = None
    budget: list[BudgetBlock] = Field(default_factory=list)
    requirement: list[RequirementBlock] = Field(default_factory=list)
    discrepancy: DiscrepancyBlock = DiscrepancyBlock()
    products: CampaignProducts = CampaignProducts()

    @model_validator(mode="after")
    def _has_chips(self) -> CampaignConfig:
        if not self.chip:
            raise ValueError("a [campaign] has no [[chip]] blocks; give them, one as the reference")
        return self

    @property
    def named_detector(self) -> str:
        """Empty: formats of one detector do not know those of campaigns by name."""
        return ""

    def resources(self) -> Compute:
        """Where the work is done."""
        return self.compute.resources()


class SelfcalConfig(RunConfig):
    """A run that begins with star lists alone."""

    data: ClassVar[None] = None
    campaign: ClassVar[None] = None
    tables: ClassVar[TablesBlock] = TablesBlock()
    fit: ClassVar[Fit] = Fit()
    compute: ClassVar[ComputeBlock] = ComputeBlock()
    periods: ClassVar[None] = None
    holdout: ClassVar[None] = None

    selfcal: SelfcalBlock
    gauge: GaugeBlock = GaugeBlock()
    model: SelfcalModel
    detector: Detector = Detector()
    chip: list[ChipBlock] = Field(default_factory=list)
    outliers: SelfcalOutliers = SelfcalOutliers()
    sampler: SelfcalSampler = SelfcalSampler()
    assess: Assess = Assess()
    budget: list[BudgetBlock] = Field(default_factory=list)
    requirement: list[RequirementBlock] = Field(default_factory=list)
    prior: list[PriorBlock] = Field(default_factory=list)
    discrepancy: DiscrepancyBlock = DiscrepancyBlock()
    products: SelfcalProducts = SelfcalProducts()

    @model_validator(mode="after")
    def _no_nominal_positions(self) -> SelfcalConfig:
        if names_nominal(self.selfcal.columns):
            raise ValueError(
                "nominal positions are of matches in [data], and a [selfcal] finds its matches "
                "itself; leave u_nominal and v_nominal out"
            )
        return self

    @model_validator(mode="after")
    def _errors_of_frames_that_are_fitted(self) -> SelfcalConfig:
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
        return self

    @model_validator(mode="after")
    def _size_of_a_pixel(self) -> SelfcalConfig:
        angles = self.gauge.scale is not None or self.gauge.reference is not None
        if (angles or self.selfcal.unit != "pix") and self.detector.scale_mas is None:
            raise ValueError(
                "detector.scale_mas is missing, which turns pixels into seconds of arc; give it"
            )
        return self

    def mixture(self) -> OutlierMixture:
        """The outlier mixture."""
        return self.outliers.mixture(self.selfcal.match_radius)

    def resources(self) -> Compute:
        """Where the work is done."""
        return self.compute.resources()


# by the section that says of which kind a configuration is
KINDS: dict[str, type[RunConfig]] = {
    "data": MatchesConfig,
    "campaign": CampaignConfig,
    "selfcal": SelfcalConfig,
}


def _kind_of(raw: Any) -> str | None:
    """The section that says of which kind a configuration is; None where not just one does."""
    found = [kind for kind in KINDS if isinstance(raw, dict) and raw.get(kind) is not None]
    return found[0] if len(found) == 1 else None


Config: TypeAlias = MatchesConfig | CampaignConfig | SelfcalConfig

CONFIG: TypeAdapter[Config] = TypeAdapter(
    Annotated[
        Annotated[MatchesConfig, Tag("data")]
        | Annotated[CampaignConfig, Tag("campaign")]
        | Annotated[SelfcalConfig, Tag("selfcal")],
        Discriminator(
            _kind_of,
            custom_error_type="no_kind",
            custom_error_message=(
                "a run begins with [data], matched stars, with [campaign], star lists and a "
                "catalogue, or with [selfcal], star lists alone; give one"
            ),
        ),
    ]
)
