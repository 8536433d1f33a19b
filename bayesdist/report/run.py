"""A run as the report reads it, and texts of its lengths and positions."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Protocol, cast

from bayesdist.assess.solution import chip_places
from bayesdist.calibration.plane import ARCSEC
from bayesdist.report.figures.mosaic import Mosaic
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
    from bayesdist.model import Chip, DistortionModel, LookupTable
    from bayesdist.report.words import Terminology


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
