"""Polynomial terms that drift linearly with time in one or more segments.

    C(t) = C + step_s + rate_s (t - t0_s)          for t in segment s; step_0 = 0

This is Equation 3 of Kozhurina-Platais et al. (2015), in which the segments before and after
Servicing Mission 4 have different reference dates.
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float

AXES = ("u", "v")


@dataclass(frozen=True)
class TimeDependence:
    """Polynomial terms that drift linearly, and the dates at which value and rate may change.

    Parameters
    ----------
    terms : tuple of (str, int, int)
        Axis ('u' or 'v'), power of x and power of y of each drifting term.
    epoch0 : tuple of float
        Reference date of each segment in decimal years; a single date is used for all segments.
    breaks : tuple of float
        Start dates of the second and further segments in decimal years, ascending.

    Raises
    ------
    InputError
        If an axis is unknown, a term is repeated, the breaks are not in ascending order, or the
        number of reference dates is neither one nor the number of segments.

    Examples
    --------
    >>> drift = bd.TimeDependence((("u", 0, 1), ("v", 1, 0)), (2004.5, 2010.0), breaks=(2007.0,))
    >>> drift.n_segments
    2
    """

    terms: tuple[tuple[str, int, int], ...]
    epoch0: tuple[float, ...]
    breaks: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        location = "model.tdd"
        for term in self.terms:
            if not _is_term(term):
                raise InputError(
                    f"term {term!r} is not (axis, power of x, power of y)",
                    where=f"{location}.terms",
                    do="write, for example, ['u', 1, 0]",
                )
        if len(set(self.terms)) != len(self.terms):
            raise InputError(
                "a term is repeated", where=f"{location}.terms", do="list each term once"
            )
        if list(self.breaks) != sorted(set(self.breaks)):
            raise InputError(
                f"breaks {list(self.breaks)} are not in ascending order",
                where=f"{location}.breaks",
                do="sort them and list each date once",
            )
        if len(self.epoch0) == 1:
            object.__setattr__(self, "epoch0", self.epoch0 * self.n_segments)
        elif len(self.epoch0) != self.n_segments:
            raise InputError(
                f"{len(self.epoch0)} reference dates for {self.n_segments} segments",
                where=f"{location}.epoch0",
                do="give one date, or one per segment",
            )

        for name in ("epoch0", "breaks"):
            if not all(isinstance(date, Real) for date in getattr(self, name)):
                raise InputError(
                    f"{name} is {getattr(self, name)!r}",
                    where=location,
                    do="give dates in decimal years",
                )

    @property
    def n_segments(self) -> int:
        """Number of segments, which is one more than the number of breaks."""
        return len(self.breaks) + 1

    @property
    def n_values(self) -> int:
        """Number of parameters per term: a rate per segment, and a step per later segment."""
        return 2 * self.n_segments - 1

    def value_names(self) -> tuple[str, ...]:
        """Names of the parameters of a term, in order: rate, step_2, rate_2, ..."""
        names = ["rate"]
        for s in range(1, self.n_segments):
            names += [f"step_{s + 1}", f"rate_{s + 1}"]
        return tuple(names)

    def weights(self, epoch: ArrayLike) -> Float:
        """Derivatives of a coefficient with respect to the parameters of its drift.

        Parameters
        ----------
        epoch : array_like, shape (N,)
            Decimal years.

        Returns
        -------
        ndarray, shape (N, n_values)
            1 for the step of the segment that contains the epoch, t - t0 for its rate, and 0 for
            all other parameters.
        """
        t = np.atleast_1d(np.asarray(epoch, float))
        segment = np.searchsorted(self.breaks, t, side="right")
        out = np.zeros((t.size, self.n_values))
        rows = np.arange(t.size)
        out[rows, 2 * segment] = t - np.asarray(self.epoch0)[segment]
        later = segment > 0
        out[rows[later], 2 * segment[later] - 1] = 1.0
        return out


def _is_term(term: Any) -> bool:
    """True for an axis and two powers."""
    if not (isinstance(term, tuple | list) and len(term) == 3 and term[0] in AXES):
        return False
    return all(isinstance(power, Integral) and int(power) >= 0 for power in term[1:])
