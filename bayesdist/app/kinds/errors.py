"""The errors of the stars as a fit took them: one value for fitted and held-out stars alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.table import Table

from bayesdist.app.tables.output import write_table
from bayesdist.data.magnitude_errors import AddedErrors, MagnitudeErrors
from bayesdist.data.matches import Matches
from bayesdist.reading.faults import restoring
from bayesdist.reading.tables import read_ecsv

__all__ = ["QUOTED", "ErrorLaw", "read_magnitude_errors"]

MAGNITUDE_ERRORS = "magnitude_errors.ecsv"
COLUMNS = ("mag", "sigma_u", "sigma_v", "n", "scatter_u", "scatter_v")


@dataclass(frozen=True, eq=False)
class ErrorLaw:
    """Law by which errors of stars follow from those that their table quotes.

    Parameters
    ----------
    factor : float
        On all quoted errors; 1 where they will do.
    by_magnitude : MagnitudeErrors or None
        Errors of the centroids, in place of the quoted ones.
    added : AddedErrors or None
        Beyond these, by groups of stars.
    with_catalogue : bool
        Errors by magnitude are added in quadrature to the quoted ones, which are the catalogue's.
    """

    factor: float = 1.0
    by_magnitude: MagnitudeErrors | None = None
    added: AddedErrors | None = None
    with_catalogue: bool = False

    def applied(self, matches: Matches) -> Matches:
        """Matches with these errors; they themselves where the quoted errors stand."""
        if self.factor != 1.0:
            matches = matches.with_scaled_errors(self.factor)
        if self.by_magnitude is not None:
            matches = matches.with_errors(self.by_magnitude, in_quadrature=self.with_catalogue)
        return (
            matches if self.added is None else matches.with_errors(self.added, in_quadrature=True)
        )

    def save(self, folder: Path) -> None:
        """Write the errors by magnitude; the rest is in the summary of the fit."""
        errors = self.by_magnitude
        if errors is not None:
            table = Table({name: getattr(errors, name) for name in COLUMNS})
            write_table(table, folder / MAGNITUDE_ERRORS)


QUOTED = ErrorLaw()


def read_magnitude_errors(folder: Path) -> MagnitudeErrors | None:
    """Errors by magnitude in a run's folder; None where there are none."""
    path = folder / MAGNITUDE_ERRORS
    if not path.exists():
        return None
    with restoring(path, "a table of errors by magnitude", do="run the stage 'fit' again"):
        table = read_ecsv(path)
        return MagnitudeErrors(**{name: np.asarray(table[name], float) for name in COLUMNS})
