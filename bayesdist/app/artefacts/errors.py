"""Measurement errors assumed by a fit."""

from __future__ import annotations

from dataclasses import dataclass

from bayesdist.data.magnitude_errors import AddedErrors, MagnitudeErrors
from bayesdist.data.matches import Matches


@dataclass(frozen=True, eq=False)
class ErrorLaw:
    """Rule that derives the errors of fitted and held-out stars from the quoted errors.

    Parameters
    ----------
    factor : float
        Factor on all quoted errors; 1 if these are adequate.
    by_magnitude : MagnitudeErrors or None
        Centroid errors as a function of magnitude, which replace the quoted errors or are added to
        them.
    added : AddedErrors or None
        Additional errors of groups of stars, added in quadrature.
    with_catalogue : bool
        True if `by_magnitude` is added in quadrature to the quoted errors, because these are the
        errors of the catalogue.
    """

    factor: float = 1.0
    by_magnitude: MagnitudeErrors | None = None
    added: AddedErrors | None = None
    with_catalogue: bool = False

    def applied(self, matches: Matches) -> Matches:
        """Matches with these errors applied; returned unchanged if the quoted errors are kept."""
        if self.factor != 1.0:
            matches = matches.with_scaled_errors(self.factor)
        if self.by_magnitude is not None:
            matches = matches.with_errors(self.by_magnitude, in_quadrature=self.with_catalogue)
        return (
            matches if self.added is None else matches.with_errors(self.added, in_quadrature=True)
        )


QUOTED = ErrorLaw()
