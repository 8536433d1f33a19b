"""Error terms that the data cannot show and the user must give."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from bayesdist.assess.names import require_known
from bayesdist.assess.units import UNITS, convert
from bayesdist.errors import InputError

__all__ = ["TERM_KINDS", "UserTerm", "combined_sigma"]

TERM_KINDS = ("random", "systematic")


@dataclass(frozen=True)
class UserTerm:
    """A Gaussian error given by the user, the same at every place of the detector.

    Parameters
    ----------
    name : str
    kind : str
        'random': independent at every position; 'systematic': one offset shared by the whole field.
    sigma_u, sigma_v : float
        Standard deviation of each axis.
    unit : str
        'pix', 'arcsec', 'mas' or 'deg'.

    Raises
    ------
    InputError
        For an unknown kind or unit, or a sigma that is negative or not finite.
    """

    name: str
    kind: str
    sigma_u: float
    sigma_v: float
    unit: str = "pix"

    def __post_init__(self) -> None:
        where = f"budget term {self.name!r}"
        require_known(self.kind, TERM_KINDS, "kind", where=where)
        require_known(self.unit, UNITS, "unit", where=where)
        for axis, sigma in (("u", self.sigma_u), ("v", self.sigma_v)):
            if not (math.isfinite(sigma) and sigma >= 0):
                raise InputError(
                    f"sigma_{axis} is {sigma}", where=where, do="give a number that is not negative"
                )

    def sigma(self, unit: str, pixel_scale: float | None = None) -> tuple[float, float]:
        """(sigma_u, sigma_v) in a unit; `pixel_scale` in mas as in `units.convert`."""
        where = f"budget term {self.name!r}"
        su, sv = (
            convert(s, self.unit, unit, pixel_scale, where=where)
            for s in (self.sigma_u, self.sigma_v)
        )
        return float(su), float(sv)


def combined_sigma(
    terms: Iterable[UserTerm], kind: str, unit: str, pixel_scale: float | None = None
) -> tuple[float, float]:
    """Quadrature sum (u, v) of all terms of one kind, in a unit: they are independent."""
    sigmas = [t.sigma(unit, pixel_scale) for t in terms if t.kind == kind]
    return math.hypot(*(s[0] for s in sigmas)), math.hypot(*(s[1] for s in sigmas))
