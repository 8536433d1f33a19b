"""Artefact of the stage 'fit': the least-squares solution and the inputs that it depends on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bayesdist.app.kinds.errors import ErrorLaw, ExposureScatter
from bayesdist.app.store.output import write_table
from bayesdist.data import ReferenceCatalog
from bayesdist.data.matches import Matches
from bayesdist.diagnose.tables.between_nodes import BetweenNodes
from bayesdist.errors import InputError
from bayesdist.files.faults import restoring
from bayesdist.files.hdf5 import write_arrays
from bayesdist.files.records import read_record, write_record
from bayesdist.infer import GaussianPriors, LinearFit, Posterior, load_fit, load_posterior, save_fit
from bayesdist.infer.catalogue.added_errors import GroupedErrors
from bayesdist.infer.nodes import corrected_matches, inside_chips, on_the_chips
from bayesdist.model import LookupTable
from bayesdist.utils.arrays import Bool, Float

if TYPE_CHECKING:
    from bayesdist.infer.selfcal import Gauge, SelfCalibrationMode
    from bayesdist.infer.series import Series

SOLUTION, GAUGE = "solution.h5", "gauge.ecsv"


@dataclass(frozen=True, eq=False)
class SelfCalibrated:
    """Mode of a self-calibration with its gauge and matches."""

    mode: SelfCalibrationMode
    gauge: Gauge  # degeneracies of the detections, and the constraints that remove them
    fixed: Mapping[str, str]  # constraint on each property of the solution, by its name
    gauge_words: str  # sentence that states the gauge of the solution
    gauge_table: Table  # one row for each property of the solution
    matches: Matches  # detections matched with their stars
    arrays: Mapping[str, NDArray[Any]]  # from which the solution is restored
    # sentences about constraints that contradict the detections
    contradictions: tuple[str, ...] = ()
    references: ReferenceCatalog | None = None  # reference stars that are also in a catalogue
    # point (u, v) where the tangent plane of the stars touches the sky; None if the sky is flat
    contact: tuple[float, float] | None = None

    def save(self, folder: Path) -> None:
        """Write the solution and the gauge to the folder of a run."""
        write_arrays(folder / SOLUTION, "", self.arrays)
        write_table(self.gauge_table, folder / GAUGE)


T = TypeVar("T")

FIT, PARTS, TABLES, MAGNITUDE_ERRORS = "fit.nc", "fit.h5", "tables.h5", "magnitude_errors.ecsv"
RESTS_ON = ("errors", "priors", "grouped", "scatter", "alone", "facts")  # content of fit.h5
FIT_AGAIN = "run the stage 'fit' again"


@dataclass(frozen=True, eq=False)
class StoredLookupTables:
    """Look-up tables of a run with their errors."""

    tables: tuple[LookupTable, ...] = ()  # tables of the detector come first
    # by chip, (ny, nx, 2): position errors caused by the errors of all tables, in the unit of u, v
    position_sigma: Mapping[int, Float] = field(default_factory=dict)
    # by chip, if measured: distortion between the nodes that no table follows
    between: Mapping[int, BetweenNodes] = field(default_factory=dict)


def write_tables(path: Path, stored: StoredLookupTables) -> None:
    """Write look-up tables to a file, or remove the file if there are no tables."""
    if stored.tables:
        write_record(path, stored)
    else:
        path.unlink(missing_ok=True)


def read_tables(path: Path, *, do: str) -> StoredLookupTables:
    """Look-up tables of a file written by `write_tables`; empty if there is no file.

    `do` completes the message of an error: what the user should do.
    """
    if not path.exists():
        return StoredLookupTables()
    return read_record(path, StoredLookupTables, "a file of look-up tables", do=do)


@dataclass(frozen=True, eq=False)
class Fitted:
    """A least-squares solution with everything that it depends on.

    Fields that do not apply to the kind of run are None.
    """

    linear: LinearFit
    errors: ErrorLaw  # of fitted and held-out stars
    priors: GaussianPriors
    # errors in addition to the quoted ones, if groups of stars were compared
    grouped: GroupedErrors | None = None
    tables: StoredLookupTables = field(default_factory=StoredLookupTables)
    scatter: ExposureScatter | None = None  # None if exposures were not fitted jointly
    alone: Series | None = None  # linear terms of exposures that were fitted one by one
    # solution and gauge of a self-calibration
    solved: SelfCalibrated | None = None
    # sections of summary.json that are known only while the fit is made
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def gauge_words(self) -> str:
        """Sentence that states the gauge of the products; empty except for self-calibrations."""
        return "" if self.solved is None else self.solved.gauge_words

    def placed(self, stars: Matches) -> Matches:
        """Stars with pixels corrected by the look-up tables, without those moved off their chip.

        Their errors are the quoted ones.  For a self-calibration the result is the detections,
        matched with the positions of the solved stars.
        """
        if self.solved is not None:
            return self.solved.matches
        if not self.tables.tables or not stars.in_memory:
            return stars
        return on_the_chips(corrected_matches(self.tables.tables, stars), self.linear.model)

    def inside(self, stars: Matches) -> Bool:
        """Boolean mask (N,) of the stars that the tables do not move off their chip."""
        if not self.tables.tables:
            return np.ones(len(stars), bool)
        return inside_chips(corrected_matches(self.tables.tables, stars), self.linear.model)

    def save(self, folder: Path) -> None:
        """Write the fit to the folder of a run."""
        write_tables(folder / TABLES, self.tables)
        if self.errors.by_magnitude is not None:
            write_table(Table(vars(self.errors.by_magnitude)), folder / MAGNITUDE_ERRORS)
        save_fit(self.linear, folder / FIT)
        write_record(folder / PARTS, {name: getattr(self, name) for name in RESTS_ON})
        if self.solved is not None:
            self.solved.save(folder)


def load_fitted(folder: Path) -> Fitted:
    """Load the fit of an earlier stage from the folder of a run.

    The solution of a self-calibration is not included; see `load_selfcal`.
    """
    tables = read_tables(folder / TABLES, do=FIT_AGAIN)
    return Fitted(load_fit(folder / FIT), tables=tables, **_read_parts(folder))


def load_errors(folder: Path) -> ErrorLaw:
    """Load the error law of an earlier fit; raises InputError as `load_fitted` does."""
    errors: ErrorLaw = _read_parts(folder)["errors"]
    return errors


def _read_parts(folder: Path) -> dict[str, Any]:
    """Parts of a fit other than the solution and the tables, by name."""
    content = "what a fit rests on"
    parts = read_record(folder / PARTS, dict, content, do=FIT_AGAIN)
    with restoring(folder / PARTS, content, do=FIT_AGAIN):
        return {name: parts[name] for name in RESTS_ON}


def converged_posterior(path: Path, use: str) -> Posterior:
    """Load the posterior of another run, which must have converged.

    Parameters
    ----------
    path : Path
        File of the posterior.
    use : str
        Clause that completes the error message: what the posterior is needed for.

    Raises
    ------
    InputError
        If the run has not converged.
    """
    posterior: Posterior = load_posterior(path)
    if not posterior.convergence.converged:
        raise InputError(
            f"the run has not converged ({'; '.join(posterior.convergence.reasons)})",
            where=str(path.parent),
            do=f"resume it with more steps before {use}",
        )
    return posterior


def required(part: T | None, what: str) -> T:
    """Return a part of a fit that may be None; raises InputError if it is None.

    `what` is the name of the part in the error message.
    """
    if part is None:
        raise InputError(f"has no {what}", where=FIT, do=FIT_AGAIN)
    return part
