"""A run as the report reads it: its members, and texts of its lengths, positions, gauge and kind.

A change that is common to all frames is equivalent to a change of the polynomials. Shift and
rotation of a solution are therefore meaningless until their zero points are defined.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Protocol, cast

from bayesdist.assess.solution import chip_places
from bayesdist.calibration.plane import ARCSEC
from bayesdist.model import Chip
from bayesdist.utils.text import MISSING, count, number, with_mas

if TYPE_CHECKING:
    from bayesdist.assess import UncertaintyMap
    from bayesdist.assess.comparison.compare import Comparison
    from bayesdist.assess.evaluation import Evaluation
    from bayesdist.data import MagnitudeErrors
    from bayesdist.diagnose.diagnostics import Diagnostics
    from bayesdist.diagnose.residuals.binned import BinnedResiduals
    from bayesdist.infer import LinearFit, Posterior
    from bayesdist.infer.catalogue.added_errors import GroupedErrors
    from bayesdist.model import DistortionModel, LookupTable

Size = tuple[float, float]

MAX_COLUMNS = 3  # of panels; more would be too narrow


class AssumedErrors(Protocol):
    """Errors that a fit assumed."""

    @property
    def by_magnitude(self) -> MagnitudeErrors | None:
        """Errors by magnitude that were assigned to the stars; None if there are none."""


class UsedTables(Protocol):
    """Look-up tables of a run."""

    @property
    def tables(self) -> tuple[LookupTable, ...]:
        """Tables that the fit used; empty if there are none."""


class ReportedKind(Protocol):
    """Kind of a run."""

    @property
    def words(self) -> Terminology:
        """Words that differ between the kinds of runs."""


class ReportedRun(Protocol):
    """Members of a run that the report and the plots use; `bayesdist.Run` has more."""

    @property
    def title(self) -> str:
        """Name of the calibration, the title of its report."""

    @property
    def configuration(self) -> Mapping[str, Any]:
        """Resolved configuration as in JSON, by section."""

    @property
    def kind(self) -> ReportedKind:
        """Kind of the run."""

    @property
    def fit(self) -> LinearFit:
        """Least-squares fit."""

    @property
    def model(self) -> DistortionModel:
        """Model of the fit and of the posterior."""

    @property
    def errors(self) -> AssumedErrors:
        """Errors that the fit assumed."""

    @property
    def added_errors(self) -> GroupedErrors | None:
        """Errors in addition to the quoted ones; None if no groups of stars were compared."""

    @property
    def held_parameters(self) -> frozenset[str]:
        """Names of the parameters that a prior or the gauge alone constrains."""

    @property
    def tables(self) -> UsedTables:
        """Look-up tables that the fit used."""

    @property
    def posterior(self) -> Posterior:
        """Posterior as it was sampled."""

    @property
    def solution(self) -> Posterior:
        """Posterior with the errors that the diagnostics found added."""

    @property
    def diagnostics(self) -> Diagnostics:
        """Results of the tests of the residuals."""

    @property
    def evaluation(self) -> Evaluation:
        """Maps, budget, margins, validity periods and checks."""

    @property
    def previous(self) -> tuple[Comparison, ...]:
        """Difference from the release that the run replaces, by chip; empty if none is named."""

    @property
    def report_data(self) -> Any:
        """Additional data that the figures of this kind of run draw; None if there are none."""

    @property
    def summary(self) -> Mapping[str, Any]:
        """Sections of summary.json."""

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Folder, command, start, seed, inputs, versions and stages of the run, if known."""


def to_be_drawn(run: ReportedRun) -> ReportedRun:
    """What the report reads of a run, without its configuration, folder and stars.

    Processes that draw figures receive it: to receive the run they would import all that runs are
    made with, which takes longer than some figures.
    """
    names = [name for name in vars(ReportedRun) if not name.startswith("_")]
    members = {name: getattr(run, name) for name in names} | {
        "kind": SimpleNamespace(words=run.kind.words),
        "errors": SimpleNamespace(by_magnitude=run.errors.by_magnitude),
        "tables": SimpleNamespace(tables=run.tables.tables),
    }
    return cast(ReportedRun, SimpleNamespace(**members))


def shown_maps(run: ReportedRun) -> tuple[tuple[UncertaintyMap, UncertaintyMap], ...]:
    """Two uncertainty maps of each chip: formal and posterior errors.

    If the gauge matters, they are those of the posterior and of relative positions.
    """
    evaluation = run.evaluation
    first, second = evaluation.formal, evaluation.maps
    if evaluation.relative:
        first, second = evaluation.maps, evaluation.relative
    return tuple(zip(first, second, strict=True))


def shown_residuals(run: ReportedRun) -> tuple[BinnedResiduals, ...]:
    """Mean residuals of cells that are drawn, one per chip."""
    return tuple(sums.residuals() for sums in run.diagnostics.shown)


def has_several_chips(run: ReportedRun) -> bool:
    """True if the detector has more than one chip."""
    return len(run.model.chips) > 1


def mosaic_of(run: ReportedRun) -> Mosaic:
    """Arrangement of the chips of a run."""
    places = chip_places(run.solution, epoch=run.evaluation.settings.epoch)
    return Mosaic.of_chips(run.model.chips, places)


def is_provisional(run: ReportedRun) -> bool:
    """True if the sampler has not converged, so that its results are unreliable."""
    return not run.posterior.convergence.converged


def is_simulated(run: ReportedRun) -> bool:
    """True if the configuration marks the input as simulated."""
    sections = run.configuration.values()
    return any(bool(s.get("simulated")) for s in sections if isinstance(s, Mapping))


def setting(run: ReportedRun, section: str, key: str, default: Any) -> Any:
    """Value from the resolved configuration."""
    return run.configuration.get(section, {}).get(key, default)


def scale_mas(run: ReportedRun) -> float | None:
    """Size of a pixel in mas, if the configuration states it."""
    return run.evaluation.settings.scale_mas


# -- texts ----------------------------------------------------------------------------------------


def length_text(run: ReportedRun, value: float, *, like: float | None = None) -> str:
    """Length in the unit of u and v, and in mas or micrometres if these scales are known.

    `like`: length that determines the display unit (default: `value`).
    """
    text = with_mas(value, run.model.unit, scale_mas(run), like=like)
    return text if text == MISSING else text + on_focal_plane(run, value, run.model.unit)


def on_focal_plane(run: ReportedRun, value: float, unit: str) -> str:
    """' (1.20 µm)' of an angle if the plate scale is known, else empty."""
    plate_scale = setting(run, "data", "plate_scale", None)  # arcsec per mm
    if plate_scale is None or unit not in ARCSEC:
        return ""
    return f" ({number(1e3 * value * ARCSEC[unit] / float(plate_scale))}\u202fµm)"


def marked(run: ReportedRun, text: str) -> str:
    """Number that depends on the sampler, with a dagger if the sampler did not converge."""
    return f"{text}\u202f†" if is_provisional(run) and text != MISSING else text


def on_chip(run: ReportedRun, chip: Chip) -> str:
    """' of WFC1' if there are several chips, else empty."""
    return f" of {chip.name}" if has_several_chips(run) else ""


def position_text(run: ReportedRun, pixel: tuple[float, float], chip: int) -> str:
    """'(508, 509)', with the name of the chip if there are several."""
    chip_with_position = run.model.chips[run.model.chip_code(chip)]
    return "({:.0f}, {:.0f})".format(*pixel) + on_chip(run, chip_with_position)


def sample_words(run: ReportedRun) -> str:
    """'a sample of 200 000 of 11 213 542 stars'; empty if all stars are shown."""
    stars = run.diagnostics.sample
    if not stars.partial:
        return ""
    return f"a sample of {count(len(stars))} of {count(stars.n_total)} {run.kind.words.rows}"


def gauge_mark(run: ReportedRun) -> str:
    """Clause of a caption about the gauge; empty if a single system leaves no choice."""
    return ", in the fit's own gauge" if run.model.n_frame else ""


def gauge_note(run: ReportedRun) -> str:
    """Sentences on the gauge of the fit; empty if there is no choice."""
    model = run.model
    if not model.n_frame:
        return ""
    first = model.exposures[0]
    if model.gauge == "first":
        return f"The fit's own gauge: the polynomials are those of exposure {first}, as it lies."
    chip = model.chips[0].name
    return (
        f"The fit's own gauge: exposure {first} is held where its own stars on {chip} put it, so"
        f" that shift and rotation of {chip} are near zero, and not exactly zero. The linear terms"
        f" against time are in another gauge, in which they are."
    )


def gauge_of_maps(run: ReportedRun) -> str:
    """Sentence on shift and rotation in the maps of the uncertainty; empty without frames."""
    if not run.model.n_frame:
        return ""
    return run.kind.words.gauge_of_maps.format(first=run.model.exposures[0])


@dataclass(frozen=True)
class Mosaic:
    """Arrangement of the chips of a detector."""

    sizes: tuple[Size, ...]  # columns and rows of each chip, pixels
    names: tuple[str, ...] = ("",)  # shown if there are several chips
    places: tuple[tuple[int, int], ...] = ((0, 0),)  # row (0 at the top) and column of each chip

    @classmethod
    def of_chips(cls, chips: Sequence[Chip], places: Sequence[tuple[int, int]]) -> Mosaic:
        """Arrangement of the chips of a model, with their names if there are several."""
        names = tuple(chip.name if len(chips) > 1 else "" for chip in chips)
        return cls(tuple(chip.size for chip in chips), names, tuple(places))

    @property
    def several(self) -> bool:
        """True if there is more than one chip."""
        return len(self.sizes) > 1

    @property
    def largest(self) -> Size:
        """Numbers of columns and rows that are sufficient for every chip."""
        return max(s[0] for s in self.sizes), max(s[1] for s in self.sizes)

    @property
    def longest_side(self) -> float:
        """Longest side of a chip, in pixels."""
        return max(self.largest)

    @property
    def legible_places(self) -> tuple[tuple[int, int], ...]:
        """Row and column of each chip; a wide detector is wrapped to fewer columns."""
        if max(column for _, column in self.places) < MAX_COLUMNS:
            return self.places
        order = sorted(self.places)
        return tuple(divmod(order.index(place), MAX_COLUMNS) for place in self.places)


@dataclass(frozen=True)
class Terminology:
    """Words of messages and reports that differ between the kinds of runs."""

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
