"""Fit and parts of a run, as files in its folder.

Parts are results of the matching or the fit that only some kinds of runs have.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Required, TypedDict

from astropy.table import Table

from bayesdist.app.stars import ErrorLaw
from bayesdist.app.store.record import write_table
from bayesdist.data.matches import Matches
from bayesdist.diagnose.tables import BetweenNodes
from bayesdist.errors import InputError
from bayesdist.files.faults import restoring
from bayesdist.files.hdf5 import read_record, write_record
from bayesdist.infer import (
    GaussianPriors,
    LinearFit,
    Posterior,
    load_fit,
    load_posterior,
    save_fit,
)
from bayesdist.infer.catalogue.added_errors import GroupedErrors
from bayesdist.infer.nodes import corrected_matches, on_the_chips
from bayesdist.model import DistortionModel, LookupTable
from bayesdist.plugin import packages
from bayesdist.utils.arrays import Float

TABLES = "tables.h5"

FIT, RECORD, MAGNITUDE_ERRORS = "fit.nc", "fit.h5", "magnitude_errors.ecsv"
# artefacts of the stage 'fit' by their names in fit.h5, which holds parts as well
RECORDED = {
    "errors": "errors",
    "priors": "priors",
    "grouped": "added_errors",
    "facts": "fit_facts",
}
FIT_AGAIN = "run the stage 'fit' again"


class Part:
    """Result of the matching or the fit that only some kinds of runs have.

    Subclasses override what they contribute; the methods of this class contribute nothing.
    """

    title: ClassVar[str]  # what a run lacks without it, for errors
    stage: ClassVar[str] = "fit"  # or "match": the stage that makes it
    # True for a dataclass of numbers, texts and arrays, which is stored in fit.h5 and restored by
    # `read_stored_fit`; other parts are written by `save` and read by `load_fit` of their kind
    recorded: ClassVar[bool] = False
    is_hierarchy: ClassVar[bool] = False  # exposures scatter about the solution of the fit
    applies_errors: ClassVar[bool] = False  # stars from `placed` have their errors already

    def save(self, folder: Path) -> None:
        """Write the part to the folder of a run."""

    def placed(self, stars: Matches, model: DistortionModel) -> Matches:
        """Stars at the positions that the fit has used."""
        return stars

    def gauge_sentence(self) -> str:
        """Sentence that states the gauge of the products; may be empty."""
        return ""


@dataclass(frozen=True, eq=False)
class StoredLookupTables(Part):
    """Look-up tables of a run with their errors."""

    title = "look-up tables"

    tables: tuple[LookupTable, ...] = ()  # tables of the detector come first
    # by chip, (ny, nx, 2): position errors caused by the errors of all tables, in the unit of u, v
    position_sigma: Mapping[int, Float] = field(default_factory=dict)
    # by chip, if measured: distortion between the nodes that no table follows
    between: Mapping[int, BetweenNodes] = field(default_factory=dict)

    def save(self, folder: Path) -> None:
        """Write the tables to the folder of a run."""
        write_tables(folder / TABLES, self)

    def placed(self, stars: Matches, model: DistortionModel) -> Matches:
        """Stars with corrected pixels, without those moved off their chip."""
        if not self.tables or not stars.in_memory:
            return stars
        return on_the_chips(corrected_matches(self.tables, stars), model)


def write_tables(path: Path, stored: StoredLookupTables) -> None:
    """Write look-up tables to a file, or remove the file if there are no tables."""
    if stored.tables:
        write_record(path, stored)
    else:
        path.unlink(missing_ok=True)


NO_TABLES = StoredLookupTables()


def read_tables(path: Path, *, do: str) -> StoredLookupTables:
    """Look-up tables of a file written by `write_tables`; empty if there is no file.

    `do` completes the message of an error: what the user should do.
    """
    if not path.exists():
        return StoredLookupTables()
    return read_record(path, StoredLookupTables, "a file of look-up tables", do=do)


class FitArtefacts(TypedDict, total=False):
    """Artefacts of the stage 'fit' by their names; see the members of `bayesdist.Run`."""

    fit: Required[LinearFit]
    errors: ErrorLaw
    priors: GaussianPriors
    added_errors: GroupedErrors | None
    parts: Mapping[str, Part]
    fit_facts: Mapping[str, Any]


def write_stored_fit(
    folder: Path,
    fit: LinearFit,
    errors: ErrorLaw,
    parts: Mapping[str, Part],
    **further: Any,
) -> None:
    """Write a fit, its parts and the other artefacts of its stage to the folder of a run."""
    if errors.by_magnitude is not None:
        write_table(Table(vars(errors.by_magnitude)), folder / MAGNITUDE_ERRORS)
    save_fit(fit, folder / FIT)
    artefacts = {"errors": errors, **further}
    content = {key: artefacts[name] for key, name in RECORDED.items()}
    recorded = {name: part for name, part in parts.items() if part.recorded}
    write_record(folder / RECORD, {**content, "parts": recorded})
    for part in parts.values():
        part.save(folder)


def read_stored_fit(folder: Path) -> FitArtefacts:
    """Artefacts of the stage 'fit', with the parts of fit.h5."""
    record = _read_record(folder)
    return {
        "fit": load_fit(folder / FIT),
        "errors": record["errors"],
        "priors": record["priors"],
        "added_errors": record["grouped"],
        "fit_facts": record["facts"],
        "parts": record["parts"],
    }


def load_errors(folder: Path) -> ErrorLaw:
    """Load the error law of an earlier fit; raises InputError as `read_stored_fit` does."""
    errors: ErrorLaw = _read_record(folder)["errors"]
    return errors


def hierarchy_of(fit: LinearFit, parts: Mapping[str, Part]) -> LinearFit | None:
    """The fit, if its exposures scatter about its solution; else None."""
    return fit if any(part.is_hierarchy for part in parts.values()) else None


def _read_record(folder: Path) -> dict[str, Any]:
    """Content of fit.h5."""
    content = "what a fit rests on"
    record = read_record(folder / RECORD, dict, content, do=FIT_AGAIN, packages=packages())
    with restoring(folder / RECORD, content, do=FIT_AGAIN):
        return {name: record[name] for name in (*RECORDED, "parts")}


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
