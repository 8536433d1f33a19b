"""Artefact of the stage 'fit': the least-squares solution, and what its stars were given."""

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
    """The mode of a self-calibration, with its gauge and matches."""

    mode: SelfCalibrationMode
    gauge: Gauge  # degeneracies of the detections, and the constraints that remove them
    fixed: Mapping[str, str]  # what fixes each property of the solution
    gauge_words: str  # in which gauge the solution stands, as a sentence
    gauge_table: Table  # one row for each property of the solution
    matches: Matches  # detections beside their stars
    arrays: Mapping[str, NDArray[Any]]  # from which the solution is made again
    # where what is known beside the detections does not go with them, as sentences
    contradictions: tuple[str, ...] = ()
    references: ReferenceCatalog | None = None  # stars that a catalogue has, too
    # where the plane of the stars touches the sky, in u and v; None if the sky is taken as flat
    contact: tuple[float, float] | None = None

    def save(self, folder: Path) -> None:
        """Write the files of a run's folder that belong to it."""
        write_arrays(folder / SOLUTION, "", self.arrays)
        write_table(self.gauge_table, folder / GAUGE)


T = TypeVar("T")

FIT, PARTS, TABLES, MAGNITUDE_ERRORS = "fit.nc", "fit.h5", "tables.h5", "magnitude_errors.ecsv"
RESTS_ON = ("errors", "priors", "grouped", "scatter", "alone", "facts")  # what fit.h5 holds
FIT_AGAIN = "run the stage 'fit' again"


@dataclass(frozen=True, eq=False)
class StoredLookupTables:
    """Look-up tables of a run, with their errors."""

    tables: tuple[LookupTable, ...] = ()  # the detector's first
    # (ny, nx, 2), by chip: errors of positions by those of all tables, in the unit of u, v
    position_sigma: Mapping[int, Float] = field(default_factory=dict)
    # by chip, where it has been measured: what all tables leave between their nodes
    between: Mapping[int, BetweenNodes] = field(default_factory=dict)


def write_tables(path: Path, stored: StoredLookupTables) -> None:
    """Write look-up tables to a file; without tables there is none."""
    if stored.tables:
        write_record(path, stored)
    else:
        path.unlink(missing_ok=True)


def read_tables(path: Path, *, do: str) -> StoredLookupTables:
    """Read what `write_tables` wrote; nothing where there is no file."""
    if not path.exists():
        return StoredLookupTables()
    return read_record(path, StoredLookupTables, "a file of look-up tables", do=do)


@dataclass(frozen=True, eq=False)
class Fitted:
    """A least-squares solution with all that it rests on; what a kind of run lacks is None."""

    linear: LinearFit
    errors: ErrorLaw  # of fitted and held-out stars
    priors: GaussianPriors
    # errors beyond the quoted ones, where groups of stars were compared
    grouped: GroupedErrors | None = None
    # empty where there are none
    tables: StoredLookupTables = field(default_factory=StoredLookupTables)
    scatter: ExposureScatter | None = None  # how exposures deviate, where they were fitted jointly
    alone: Series | None = None  # linear terms of exposures that were each fitted alone
    # solution and gauge of detections whose stars are not known otherwise
    solved: SelfCalibrated | None = None
    # sections of summary.json that only the making of the fit knows
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def gauge_words(self) -> str:
        """In which gauge the products stand, as a sentence; empty where that is no question."""
        return "" if self.solved is None else self.solved.gauge_words

    def placed(self, stars: Matches) -> Matches:
        """Stars at the pixels that the tables move them to, on their chips, with quoted errors.

        Of a self-calibration they are the detections beside the stars as they were solved.
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
        """Write the files of a run's folder that belong to it."""
        write_tables(folder / TABLES, self.tables)
        if self.errors.by_magnitude is not None:
            write_table(Table(vars(self.errors.by_magnitude)), folder / MAGNITUDE_ERRORS)
        save_fit(self.linear, folder / FIT)
        write_record(folder / PARTS, {name: getattr(self, name) for name in RESTS_ON})
        if self.solved is not None:
            self.solved.save(folder)


def load_fitted(folder: Path) -> Fitted:
    """The fit of an earlier stage, but for the solution of detections."""
    tables = read_tables(folder / TABLES, do=FIT_AGAIN)
    return Fitted(load_fit(folder / FIT), tables=tables, **_read_parts(folder))


def load_errors(folder: Path) -> ErrorLaw:
    """The errors of the stars of an earlier fit; InputError as `load_fitted`."""
    errors: ErrorLaw = _read_parts(folder)["errors"]
    return errors


def _read_parts(folder: Path) -> dict[str, Any]:
    """What a fit rests on, by name."""
    what = "what a fit rests on"
    found = read_record(folder / PARTS, dict, what, do=FIT_AGAIN)
    with restoring(folder / PARTS, what, do=FIT_AGAIN):
        return {name: found[name] for name in RESTS_ON}


def converged_posterior(path: Path, use: str) -> Posterior:
    """The posterior of another run that this one goes by; `use` is for what, as a clause."""
    posterior: Posterior = load_posterior(path)
    if not posterior.convergence.converged:
        raise InputError(
            f"the run has not converged ({'; '.join(posterior.convergence.reasons)})",
            where=str(path.parent),
            do=f"resume it with more steps before {use}",
        )
    return posterior


def required(part: T | None, what: str) -> T:
    """A part of a fit that its kind of run has."""
    if part is None:
        raise InputError(f"has no {what}", where=FIT, do=FIT_AGAIN)
    return part
