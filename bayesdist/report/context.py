"""Input of the report of a run, and the additional results of a campaign."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from bayesdist.calibration.plane import ARCSEC
from bayesdist.model import Chip, LookupTable
from bayesdist.report.figures.mosaic import Mosaic
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.checks import Check, warnings_of
from bayesdist.utils.numbers import MISSING, count, number, with_mas

if TYPE_CHECKING:
    from astropy.table import Table

    from bayesdist.assess import AreaMap, Margin, UncertaintyMap, VectorMap
    from bayesdist.assess.budget import ErrorBudget
    from bayesdist.assess.budget_surface import BudgetSurface
    from bayesdist.assess.comparison.compare import Comparison
    from bayesdist.assess.requirements.margins import ValidityPeriod
    from bayesdist.data import MagnitudeErrors
    from bayesdist.diagnose import ScoreTest
    from bayesdist.diagnose.holdout.validation import HoldoutValidation
    from bayesdist.diagnose.overlap import OverlapTest
    from bayesdist.diagnose.periods import TimeVariation
    from bayesdist.diagnose.residuals.binned import BinnedResiduals
    from bayesdist.diagnose.residuals.stars import ExposureSums, StarSample
    from bayesdist.infer import LinearFit, Posterior
    from bayesdist.infer.catalogue.added_errors import GroupedErrors


@dataclass(frozen=True)
class Product:
    """A file that the run wrote."""

    path: str  # relative to the folder of the run
    what: str  # description
    checks: tuple[Check, ...] = ()  # checks of the written file, such as its closure


@dataclass(frozen=True, eq=False)
class ChipResults:
    """Results for one chip."""

    chip: Chip
    formal_map: UncertaintyMap  # of the least-squares fit
    posterior_map: UncertaintyMap | None
    displacement: VectorMap  # distortion without its constant term
    non_linear: VectorMap
    area: AreaMap
    binned: BinnedResiduals
    place: tuple[int, int] = (0, 0)  # row (0 at the top) and column of the chip on the detector
    relative_map: UncertaintyMap | None = None  # of relative positions, if the gauge matters

    @property
    def maps(self) -> tuple[UncertaintyMap, ...]:
        """The last two of the available uncertainty maps; these are shown.

        The order is least squares, posterior, and relative positions.
        """
        available = (self.formal_map, self.posterior_map, self.relative_map)
        return tuple(m for m in available if m is not None)[-2:]

    @property
    def best_map(self) -> UncertaintyMap:
        """Uncertainty map of the posterior if there is one, else of least squares."""
        return self.formal_map if self.posterior_map is None else self.posterior_map


@dataclass(frozen=True, eq=False)
class SelfcalResults:
    """Additional results of a run without a catalogue."""

    words: str  # description of the gauge
    gauge: Table  # content of gauge.ecsv
    matching: Table  # one row per exposure
    stars: Table  # content of stars.ecsv
    outlines: tuple[Float, ...]  # (M, 2), closed, of each chip in each exposure, on the sky
    summary: Mapping[str, Any]  # as in summary.json


NEW_EXPOSURE = "a new exposure whose shift and rotation are fitted by its user"


@dataclass(frozen=True)
class Terminology:
    """Words of a report that differ between the kinds of runs."""

    rows: str = "stars"  # name of the rows that are fitted
    all_rows: str = "matched stars"  # name of the rows before rejection
    false_rows: str = "false matches"
    rejection: str = "least-squares fit"  # sampling itself rejects nothing
    fit: str = "linear fit"  # the fit before sampling
    fit_title: str = "Least-squares fit"  # of its section
    constraint: str = "a prior"  # on parameters that the data do not constrain
    leverage: str = ""  # clause on why residuals are smaller than errors; may be empty
    # True to print the general sections on the data; False if those of the kind say more
    prints_data: bool = True
    held: str = (  # parameters that the data do not constrain
        "Held, and therefore not shown: a prior alone says what these parameters are, and the data"
        " add nothing to it"
    )
    # clauses and sentences on the exposures that errors of positions hold for; may be empty
    whom: str = ""
    new_exposure: str = ""
    # clause on a common shift and rotation in errors of positions of several exposures
    with_shift: str = ", shift and rotation included"
    gauge_of_maps: str = (  # `first`: the first exposure
        "Shift and rotation of the detector as a whole count as errors here, relative to exposure"
        " {first}."
    )
    relative_map: str = ""  # sentence on the map of relative positions, if it is shown
    residuals: str = ""  # sentence on the binned residuals; may be empty


MATCHED = Terminology()
PAIRED = Terminology(
    prints_data=False,
    whom=f" for {NEW_EXPOSURE}",
    new_exposure=f"For {NEW_EXPOSURE}: what a shift and a rotation of all chips together take up is"
    " no error here.",
    residuals=" These are the residuals of the joint fit, with all tables, in the cells of the test"
    " for structure (see the status).",
)
DETECTED = Terminology(
    rows="detections",
    all_rows="detections of stars",
    false_rows="false detections",
    rejection="limits of residuals",
    fit="solution",
    fit_title="Solution",
    constraint="the gauge",
    leverage=", less what the fitted stars take of them",
    held="Held by the gauge, and therefore not shown: the detections say nothing of what these"
    " parameters stand for",
    with_shift=", in the gauge of the solution",
    gauge_of_maps="What the gauge holds by convention, shift and rotation of the detector as a"
    " whole among them unless something fixes them, has no error here.",
    relative_map=" That of relative positions is the same in any gauge of shift, rotation and scale"
    " (and skew, where all exposures have one roll angle); the other is that of the run's gauge.",
    residuals=" Stars were fitted to these detections, so that fewer may do so than by chance; the"
    " status has the test that allows for it.",
)


@dataclass(frozen=True, eq=False)
class ReportInput:
    """Results of a run in the form needed by the report.

    Columns of `coefficients`, which contains Legendre coefficients and all other parameters: name,
    chip, axis, i, j, lsq_value, lsq_sigma (least squares), mean, sd, lo68, hi68, lo95, hi95, rhat,
    ess_bulk, unit; those of the posterior may be missing or masked.
    """

    name: str  # of the calibration, used as title
    config: Mapping[str, Any]  # resolved configuration
    stars: StarSample  # all stars, or a sample if there are too many to draw individually
    exposures: ExposureSums  # of all stars, at the least-squares fit
    fit: LinearFit
    posterior: Posterior | None  # if None, errors are called formal
    chips: tuple[ChipResults, ...]  # in the order of the model's chips
    coefficients: Table
    budget: ErrorBudget | None = None
    surface: BudgetSurface | None = None  # budget at every position and epoch, for the HTML page
    margins: tuple[Margin, ...] = ()
    validity: tuple[ValidityPeriod, ...] = ()  # empty if nothing depends on time
    products: tuple[Product, ...] = ()
    checks: tuple[Check, ...] = ()  # all checks except those of requirements and products
    score_tests: tuple[ScoreTest, ...] = ()  # of the residuals
    magnitude_errors: MagnitudeErrors | None = None  # if the stars had no quoted errors
    added_errors: GroupedErrors | None = None  # in addition to the quoted errors, by group
    flagged: Int | None = None  # (E,), number of stars that are more likely false than true
    provenance: Mapping[str, Any] = field(default_factory=dict)  # nested
    campaign: CampaignResults | None = None  # for a run on star lists
    previous: tuple[Comparison, ...] = ()  # difference from the previous release, per chip
    periods: TimeVariation | None = None  # comparison of the models of several periods
    held_out: HoldoutValidation | None = None  # stars set aside before the fit
    selfcal: SelfcalResults | None = None  # for a run without a catalogue
    tables: tuple[LookupTable, ...] = ()  # look-up tables that the fit has used
    held: frozenset[str] = frozenset()  # parameters that a prior or the gauge alone constrains
    words: Terminology = MATCHED  # for the kind of run

    @property
    def unit(self) -> str:
        """Unit of u and v."""
        return self.fit.model.unit

    @property
    def simulated(self) -> bool:
        """True if the configuration marks the input as simulated."""
        sections = (section for section in self.config.values() if isinstance(section, Mapping))
        return any(bool(section.get("simulated")) for section in sections)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences to show at the top of the report."""
        return warnings_of(self.checks)

    @property
    def sample(self) -> str:
        """'a sample of 200 000 of 11 213 542 stars'; empty if all stars are shown."""
        if not self.stars.partial:
            return ""
        n_shown, n_all = count(len(self.stars)), count(self.stars.n_total)
        return f"a sample of {n_shown} of {n_all} {self.words.rows}"

    @property
    def provisional(self) -> bool:
        """True if the sampler has not converged, so that its results are unreliable."""
        return self.posterior is not None and not self.posterior.convergence.converged

    @property
    def solution(self) -> LinearFit | Posterior:
        """Posterior if there is one, else the fit."""
        return self.fit if self.posterior is None else self.posterior

    @property
    def mosaic(self) -> Mosaic:
        """Arrangement of the chips."""
        return Mosaic.of_chips([c.chip for c in self.chips], [c.place for c in self.chips])

    @property
    def several(self) -> bool:
        """True if the detector has more than one chip."""
        return len(self.chips) > 1

    def length(self, value: float, *, like: float | None = None) -> str:
        """Length in the unit of u and v, and in mas or micrometres if these scales are known.

        `like`: length that determines the display unit (default: `value`).
        """
        text = with_mas(value, self.unit, self.scale_mas, like=like)
        return text if text == MISSING else text + self.on_focal_plane(value, self.unit)

    def on_focal_plane(self, value: float, unit: str) -> str:
        """' (1.20 µm)' of an angle if the plate scale is known, else empty."""
        plate_scale = self.setting("data", "plate_scale", None)  # arcsec per mm
        if plate_scale is None or unit not in ARCSEC:
            return ""
        return f" ({number(1e3 * value * ARCSEC[unit] / float(plate_scale))}\u202fµm)"

    def marked(self, text: str) -> str:
        """Number that depends on the sampler, with a dagger if the sampler did not converge."""
        return f"{text}\u202f†" if self.provisional and text != MISSING else text

    def on_chip(self, chip: Chip) -> str:
        """' of WFC1' if there are several chips, else empty."""
        return f" of {chip.name}" if self.several else ""

    def position(self, pixel: tuple[float, float], chip: int) -> str:
        """'(508, 509)', with the name of the chip if there are several."""
        chip_with_position = next(c.chip for c in self.chips if c.chip.number == chip)
        return "({:.0f}, {:.0f})".format(*pixel) + self.on_chip(chip_with_position)

    @property
    def scale_mas(self) -> float | None:
        """Size of a pixel in mas, if the configuration states it."""
        value = self.config.get("detector", {}).get("scale_mas")
        return None if value is None else float(value)

    def setting(self, section: str, key: str, default: Any) -> Any:
        """Value from the resolved configuration."""
        return self.config.get(section, {}).get(key, default)

    def sampled_mean(self, key: str) -> float:
        """Posterior mean of 'f', 'j' or 's_out'; 0 if it was not sampled."""
        if self.posterior is None or key not in self.posterior.hyper:
            return 0.0
        return float(np.mean(self.posterior.hyper[key]))


def needed(value: T | None) -> T:
    """Value that must not be None here, because the registry has checked it."""
    if value is None:
        raise LookupError("a figure is drawn without what it needs")
    return value


@dataclass(frozen=True, eq=False)
class CatalogStars:
    """Quoted errors of the catalogue, and the limit above which its proper motions are not used."""

    mag: Float  # (N,), instrumental
    sigma: Float | None  # (N,), errors of the positions, hypot of both axes
    sigma_motion: Float | None  # (N,), errors of the proper motions, the larger axis
    limit: tuple[Float, Float] | None  # magnitudes and largest errors used; None for no limit
    unit: str
    n_used: int  # number of selected stars


@dataclass(frozen=True, eq=False)
class Detections:
    """Quality of the detections, and the selection cuts."""

    mag: Float  # (N,), of the detections that are drawn
    q: Float  # (N,)
    kept: Bool  # (N,), True if they pass the cuts
    n_total: int  # number of all detections
    n_kept: int  # number of all detections that pass the cuts
    mag_cuts: tuple[float, ...]  # limits in magnitude
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
    """Residuals on one chip, without look-up tables and, if there are any, with them.

    In both cases the polynomial and a linear map of each exposure are fitted. Residuals (N, 2) are
    data minus model of the same matches in pixels, rotated to the detector axes, because exposures
    have different rolls and effects of the detector are visible only along x and y.
    """

    chip: Chip
    without: Float
    with_tables: Float | None
    binned_without: BinnedResiduals
    binned_with: BinnedResiduals | None  # in the same cells


@dataclass(frozen=True, eq=False)
class LinearSeries:
    """Linear terms of the exposures, each fitted separately."""

    exposures: Table  # content of series.ecsv
    drift: Table  # content of drift.ecsv
    vafactor: Float  # (E,)
    pa_v3: Float  # (E,), degrees, NaN if unknown
    breaks: tuple[float, ...]

    @property
    def epoch(self) -> Float:
        """Epochs of the exposures."""
        return np.asarray(self.exposures["epoch"], float)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the terms with their chips, 'WFC1.A_2'."""
        names = self.exposures.colnames
        return tuple(n for n in names if f"sigma_{n}" in names)

    @property
    def segment(self) -> Int:
        """Segment of each exposure, from 0."""
        return np.searchsorted(np.asarray(self.breaks, float), self.epoch, side="right")

    @property
    def outlying(self) -> Bool:
        """Mask of the exposures that are more likely outliers than not."""
        return np.asarray(self.exposures["outlier_probability"], float) > 0.5


@dataclass(frozen=True, eq=False)
class CampaignResults:
    """Additional results of a campaign."""

    summary: Mapping[str, Any]  # as in summary.json
    filter: str
    matching: Table  # content of matching.ecsv
    chips: tuple[Chip, ...]  # in the order of the model
    unit: str  # of u and v
    catalog: CatalogStars | None = None
    centroids: MagnitudeErrors | None = None  # errors of single detections, from the residuals
    detections: Detections | None = None
    footprints: Footprints | None = None
    residuals: tuple[ChipResiduals, ...] = ()
    series: LinearSeries | None = None
    overlap: OverlapTest | None = None

    def section(self, name: str) -> Mapping[str, Any]:
        """Section of summary.json; empty if there is none."""
        part: Mapping[str, Any] = self.summary.get(name) or {}
        return part

    def chip_name(self, number: int) -> str:
        """Name of a chip."""
        return next(c.name or f"chip {number}" for c in self.chips if c.number == number)


T = TypeVar("T")
