"""Input of the report of a run, and what a campaign adds to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from bayesdist.model import Chip, LookupTable
from bayesdist.report.figures.mosaic import Mosaic
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.checks import Check, warnings_of
from bayesdist.utils.numbers import MISSING, count, with_mas

if TYPE_CHECKING:
    from astropy.table import Table

    from bayesdist.assess import AreaMap, Margin, UncertaintyMap, VectorMap
    from bayesdist.assess.budget.budget import ErrorBudget
    from bayesdist.assess.budget.surface import BudgetSurface
    from bayesdist.assess.comparison.compare import Comparison
    from bayesdist.assess.requirements.validity import ValidityPeriod
    from bayesdist.data import MagnitudeErrors
    from bayesdist.diagnose import ScoreTest
    from bayesdist.diagnose.holdout.validation import HoldoutValidation
    from bayesdist.diagnose.overlap import OverlapTest
    from bayesdist.diagnose.periods import TimeVariation
    from bayesdist.diagnose.residuals.binned import BinnedResiduals
    from bayesdist.diagnose.residuals.sample import StarSample
    from bayesdist.diagnose.residuals.star_sums import ExposureSums
    from bayesdist.infer import LinearFit, Posterior
    from bayesdist.infer.catalogue.added_errors import GroupedErrors


@dataclass(frozen=True)
class Product:
    """File that the run wrote."""

    path: str  # relative to the run's folder
    what: str
    checks: tuple[Check, ...] = ()  # of the file as written, such as its closure


@dataclass(frozen=True, eq=False)
class ChipResults:
    """Results of the assessment of one chip."""

    chip: Chip
    formal_map: UncertaintyMap  # of the least-squares fit
    posterior_map: UncertaintyMap | None
    displacement: VectorMap  # distortion with its zeroth order suppressed
    non_linear: VectorMap
    area: AreaMap
    binned: BinnedResiduals
    place: tuple[int, int] = (0, 0)  # row (0 on top) and column of the chip among the others
    relative_map: UncertaintyMap | None = None  # of relative positions, where the gauge matters

    @property
    def maps(self) -> tuple[UncertaintyMap, ...]:
        """Uncertainty maps that are shown: two, or one where there is no other.

        Least squares and posterior; or posterior and relative positions, where there are such.
        """
        known = (self.formal_map, self.posterior_map, self.relative_map)
        return tuple(m for m in known if m is not None)[-2:]

    @property
    def best_map(self) -> UncertaintyMap:
        """Uncertainty map of the posterior where there is one, else of least squares."""
        return self.formal_map if self.posterior_map is None else self.posterior_map


@dataclass(frozen=True, eq=False)
class SelfcalResults:
    """Results that a run without a catalogue adds."""

    words: str  # the gauge in words
    gauge: Table  # as gauge.ecsv
    matching: Table  # one row for each exposure
    stars: Table  # as stars.ecsv
    outlines: tuple[Float, ...]  # (M, 2), closed, of each chip in each exposure, on the sky
    held: tuple[str, ...]  # parameters that the gauge holds
    summary: Mapping[str, Any]  # as in summary.json


@dataclass(frozen=True)
class Terminology:
    """Names by which a report calls what differs between the kinds of runs."""

    rows: str  # that are fitted
    all_rows: str  # as they come into the fit
    false_rows: str
    rejection: str  # sampling rejects nothing
    fit: str  # before sampling
    constraint: str  # on parameters that the data do not constrain
    leverage: str = ""  # clause on why residuals are smaller than errors; else empty


MATCHED = Terminology(
    rows="stars",
    all_rows="matched stars",
    false_rows="false matches",
    rejection="least-squares fit",
    fit="linear fit",
    constraint="a prior",
)
DETECTED = Terminology(
    rows="detections",
    all_rows="detections of stars",
    false_rows="false detections",
    rejection="limits of residuals",
    fit="solution",
    constraint="the gauge",
    leverage=", less what the fitted stars take of them",
)


@dataclass(frozen=True, eq=False)
class ReportInput:
    """Results of a run, as the report shows them.

    Columns of `coefficients`, Legendre coefficients and all other parameters: name, chip, axis, i,
    j, lsq_value, lsq_sigma (least squares), mean, sd, lo68, hi68, lo95, hi95, rhat, ess_bulk, unit;
    those of the posterior may be missing or masked.
    """

    name: str  # of the calibration: the title
    config: Mapping[str, Any]  # resolved
    stars: StarSample  # all, or a sample of very many: those drawn one by one
    exposures: ExposureSums  # of all stars, at the least-squares fit
    fit: LinearFit
    posterior: Posterior | None  # None: errors are then called formal
    chips: tuple[ChipResults, ...]  # in the order of the model's chips
    coefficients: Table
    budget: ErrorBudget | None = None
    surface: BudgetSurface | None = None  # budget at every position and epoch, for the page
    margins: tuple[Margin, ...] = ()
    validity: tuple[ValidityPeriod, ...] = ()  # empty where nothing depends on time
    products: tuple[Product, ...] = ()
    checks: tuple[Check, ...] = ()  # criteria and remarks but those of requirements and products
    score_tests: tuple[ScoreTest, ...] = ()  # of the residuals
    magnitude_errors: MagnitudeErrors | None = None  # where the stars had no errors
    added_errors: GroupedErrors | None = None  # beyond the quoted ones, by groups
    flagged: Int | None = None  # (E,), stars more likely false than not
    provenance: Mapping[str, Any] = field(default_factory=dict)  # nested
    campaign: CampaignResults | None = None  # of a run on star lists
    previous: tuple[Comparison, ...] = ()  # minus the release that is replaced, of each chip
    periods: TimeVariation | None = None  # models of several periods compared
    held_out: HoldoutValidation | None = None  # stars set aside before the fit
    selfcal: SelfcalResults | None = None  # of a run without a catalogue

    @property
    def unit(self) -> str:
        """Unit of u and v."""
        return self.fit.model.unit

    @property
    def simulated(self) -> bool:
        """True where the configuration says that the input is simulated."""
        kinds = ("data", "campaign", "selfcal")
        return any(bool(self.setting(kind, "simulated", False)) for kind in kinds)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences that belong on top."""
        return warnings_of(self.checks)

    @property
    def words(self) -> Terminology:
        """Terminology for the kind of run."""
        return MATCHED if self.selfcal is None else DETECTED

    @property
    def sample(self) -> str:
        """'a sample of 200 000 of 11 213 542 stars'; empty where all stars are shown."""
        if not self.stars.partial:
            return ""
        some, every = count(len(self.stars)), count(self.stars.n_total)
        return f"a sample of {some} of {every} {self.words.rows}"

    @property
    def provisional(self) -> bool:
        """True where the sampler's results must not be relied on."""
        return self.posterior is not None and not self.posterior.convergence.converged

    @property
    def solution(self) -> LinearFit | Posterior:
        """Posterior where there is one, else the fit."""
        return self.fit if self.posterior is None else self.posterior

    @property
    def mosaic(self) -> Mosaic:
        """Arrangement of the chips."""
        return Mosaic.of_chips([c.chip for c in self.chips], [c.place for c in self.chips])

    @property
    def several(self) -> bool:
        """True where the detector has more than one chip."""
        return len(self.chips) > 1

    def length(self, value: float) -> str:
        """Length in the unit of u and v, and in mas where the size of a pixel is known."""
        return with_mas(value, self.unit, self.scale_mas)

    def marked(self, text: str) -> str:
        """Number that depends on the sampler, with a dagger where that did not converge."""
        return f"{text}\u202f†" if self.provisional and text != MISSING else text

    def on_chip(self, chip: Chip) -> str:
        """' of WFC1' where there are several chips, else nothing."""
        return f" of {chip.name}" if self.several else ""

    def position(self, pixel: tuple[float, float], chip: int) -> str:
        """'(508, 509)', with the name of the chip where there are several."""
        where = next(c.chip for c in self.chips if c.chip.number == chip)
        return "({:.0f}, {:.0f})".format(*pixel) + self.on_chip(where)

    @property
    def held(self) -> frozenset[str]:
        """Parameters that a prior or the gauge holds: they are no measurements."""
        if self.selfcal is not None:
            return frozenset(self.selfcal.held)
        return frozenset(() if self.campaign is None else self.campaign.held)

    @property
    def scale_mas(self) -> float | None:
        """Size of a pixel in mas, where the configuration gives it."""
        value = self.config.get("detector", {}).get("scale_mas")
        return None if value is None else float(value)

    def setting(self, section: str, key: str, default: Any) -> Any:
        """Value of the resolved configuration."""
        return self.config.get(section, {}).get(key, default)

    def sampled_mean(self, key: str) -> float:
        """Posterior mean of 'f', 'j' or 's_out'; 0 where it was not sampled."""
        if self.posterior is None or key not in self.posterior.hyper:
            return 0.0
        return float(np.mean(self.posterior.hyper[key]))


def needed(value: T | None) -> T:
    """Value that the registry has found to be there."""
    if value is None:
        raise LookupError("a figure is drawn without what it needs")
    return value


@dataclass(frozen=True, eq=False)
class CatalogStars:
    """Errors of the catalogue, as quoted, and the limit above which its motions are not used."""

    mag: Float  # (N,), instrumental
    sigma: Float | None  # (N,), of the positions, hypot of both axes
    sigma_motion: Float | None  # (N,), of the proper motions, the larger axis
    limit: tuple[Float, Float] | None  # magnitudes and largest errors used; None where all are
    unit: str
    n_used: int  # stars that the selection leaves


@dataclass(frozen=True, eq=False)
class Detections:
    """Quality of the detections, and the cuts."""

    mag: Float  # (N,), of those that are drawn
    q: Float  # (N,)
    kept: Bool  # (N,), True where they pass the cuts
    n_total: int  # of all
    n_kept: int  # of all
    mag_cuts: tuple[float, ...]  # magnitudes beyond which detections are left out
    q_max: float | None


@dataclass(frozen=True, eq=False)
class Footprints:
    """Positions of the exposures on the catalogue."""

    u: Float  # (N,), catalogue stars
    v: Float
    outlines: tuple[Float, ...]  # (M, 2), closed, of each chip in each exposure
    epoch: Float  # of each outline
    unit: str


@dataclass(frozen=True, eq=False)
class ChipResiduals:
    """Residuals on one chip, without the look-up tables and, where there are any, with them.

    Each time the polynomial is fitted, and a linear map of each exposure.  Residuals (N, 2) are of
    the same matches, data minus model in pixels, brought to the detector's axes: exposures are
    rolled, and what belongs to the detector shows only along x and y.
    """

    chip: Chip
    without: Float
    with_tables: Float | None
    binned_without: BinnedResiduals
    binned_with: BinnedResiduals | None  # of the same cells


@dataclass(frozen=True, eq=False)
class LinearSeries:
    """Linear terms of the exposures, each fitted by itself."""

    exposures: Table  # as series.ecsv
    drift: Table  # as drift.ecsv
    vafactor: Float  # (E,)
    pa_v3: Float  # (E,), degrees, NaN where it is not known
    breaks: tuple[float, ...]

    @property
    def epoch(self) -> Float:
        """Epochs of the exposures."""
        return np.asarray(self.exposures["epoch"], float)

    @property
    def labels(self) -> tuple[str, ...]:
        """Terms with the names of their chips, 'WFC1.A_2'."""
        names = self.exposures.colnames
        return tuple(n for n in names if f"sigma_{n}" in names)

    @property
    def segment(self) -> Int:
        """Segment of each exposure, from 0."""
        return np.searchsorted(np.asarray(self.breaks, float), self.epoch, side="right")

    @property
    def outlying(self) -> Bool:
        """Mask of the exposures that are more likely off the line than not."""
        return np.asarray(self.exposures["outlier_probability"], float) > 0.5


@dataclass(frozen=True, eq=False)
class CampaignResults:
    """Results that a campaign adds to a run."""

    summary: Mapping[str, Any]  # as summary.json
    config: Mapping[str, Any]  # resolved
    filter: str
    matching: Table  # as matching.ecsv
    chips: tuple[Chip, ...]  # in the order of the model
    unit: str  # of u and v
    catalog: CatalogStars | None = None
    centroids: MagnitudeErrors | None = None  # errors of single detections, from the residuals
    detections: Detections | None = None
    footprints: Footprints | None = None
    residuals: tuple[ChipResiduals, ...] = ()
    tables: tuple[LookupTable, ...] = field(default=())
    series: LinearSeries | None = None
    overlap: OverlapTest | None = None
    held: tuple[str, ...] = ()  # parameters constrained by their prior alone

    def section(self, name: str) -> Mapping[str, Any]:
        """Part of summary.json; empty where there is none."""
        found: Mapping[str, Any] = self.summary.get(name) or {}
        return found

    @property
    def table_filters(self) -> tuple[str, ...]:
        """Filters of the tables in order; '' is the detector's own."""
        return tuple(dict.fromkeys(table.filter for table in self.tables))

    def chip_name(self, number: int) -> str:
        """Name of a chip."""
        return next(c.name or f"chip {number}" for c in self.chips if c.number == number)


T = TypeVar("T")
