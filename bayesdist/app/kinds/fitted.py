"""Artefact of the stage 'fit': the least-squares solution and the inputs that it depends on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from astropy.table import Table

from bayesdist.app.kinds.errors import QUOTED, ErrorLaw
from bayesdist.app.kinds.parts import Part, StoredLookupTables
from bayesdist.app.store.output import write_table
from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.files.faults import restoring
from bayesdist.files.records import read_record, write_record
from bayesdist.infer import GaussianPriors, LinearFit, Posterior, load_fit, load_posterior, save_fit
from bayesdist.infer.catalogue.added_errors import GroupedErrors
from bayesdist.infer.nodes import corrected_matches, inside_chips
from bayesdist.utils.arrays import Bool

P = TypeVar("P", bound=Part)

FIT, RECORD, MAGNITUDE_ERRORS = "fit.nc", "fit.h5", "magnitude_errors.ecsv"
RESTS_ON = ("errors", "priors", "grouped", "facts")  # content of fit.h5, in addition to parts
FIT_AGAIN = "run the stage 'fit' again"
NO_TABLES = StoredLookupTables()


@dataclass(frozen=True, eq=False)
class Fitted:
    """A least-squares solution with everything that it depends on."""

    linear: LinearFit
    errors: ErrorLaw  # of fitted and held-out stars
    priors: GaussianPriors
    # errors in addition to the quoted ones, if groups of stars were compared
    grouped: GroupedErrors | None = None
    # what only some kinds of runs have, by name
    parts: Mapping[str, Part] = field(default_factory=dict)
    # sections of summary.json that are known only while the fit is made
    facts: Mapping[str, Any] = field(default_factory=dict)

    def part(self, kind: type[P]) -> P:
        """Part of the given class, which the kind of run has; raises InputError if it is absent."""
        for part in self.parts.values():
            if isinstance(part, kind):
                return part
        raise InputError(f"has no {kind.title}", where=FIT, do=FIT_AGAIN)

    @property
    def tables(self) -> StoredLookupTables:
        """Look-up tables with their errors; empty if the fit has none."""
        tables = (part for part in self.parts.values() if isinstance(part, StoredLookupTables))
        return next(tables, NO_TABLES)

    @property
    def hierarchy(self) -> LinearFit | None:
        """The fit, if its exposures scatter about its solution; else None."""
        is_hierarchy = any(part.is_hierarchy for part in self.parts.values())
        return self.linear if is_hierarchy else None

    @property
    def gauge_words(self) -> str:
        """Sentence that states the gauge of the products; may be empty."""
        return " ".join(filter(None, (part.gauge_sentence() for part in self.parts.values())))

    @property
    def remaining_errors(self) -> ErrorLaw:
        """Errors to apply to the stars that `placed` returns."""
        applied = any(part.applies_errors for part in self.parts.values())
        return QUOTED if applied else self.errors

    def placed(self, stars: Matches) -> Matches:
        """Stars at the positions that the fit has used, for example corrected by tables."""
        for part in self.parts.values():
            stars = part.placed(stars, self.linear.model)
        return stars

    def inside(self, stars: Matches) -> Bool:
        """Boolean mask (N,) of the stars that the tables do not move off their chip."""
        if not self.tables.tables:
            return np.ones(len(stars), bool)
        return inside_chips(corrected_matches(self.tables.tables, stars), self.linear.model)

    def save(self, folder: Path) -> None:
        """Write the fit to the folder of a run."""
        if self.errors.by_magnitude is not None:
            write_table(Table(vars(self.errors.by_magnitude)), folder / MAGNITUDE_ERRORS)
        save_fit(self.linear, folder / FIT)
        recorded = {name: part for name, part in self.parts.items() if part.recorded}
        rests_on = {name: getattr(self, name) for name in RESTS_ON}
        write_record(folder / RECORD, {**rests_on, "parts": recorded})
        for part in self.parts.values():
            part.save(folder)


def load_fitted(folder: Path) -> Fitted:
    """Load the fit of an earlier stage from the folder of a run, with the parts of fit.h5."""
    return Fitted(load_fit(folder / FIT), **_read_record(folder))


def load_errors(folder: Path) -> ErrorLaw:
    """Load the error law of an earlier fit; raises InputError as `load_fitted` does."""
    errors: ErrorLaw = _read_record(folder)["errors"]
    return errors


def _read_record(folder: Path) -> dict[str, Any]:
    """Content of fit.h5, by the names of fields of `Fitted`."""
    content = "what a fit rests on"
    record = read_record(folder / RECORD, dict, content, do=FIT_AGAIN)
    with restoring(folder / RECORD, content, do=FIT_AGAIN):
        return {name: record[name] for name in (*RESTS_ON, "parts")}


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
