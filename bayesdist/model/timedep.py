"""Terms of the polynomial that drift linearly with time, segment by segment.

    C(t) = C + step_s + rate_s (t - t0_s)          for t in segment s; step_0 = 0

This is Equation 3 of ACS ISR 2015-06, where the segments are before and after Servicing Mission 4
and each has its own reference date.
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
    """Drifting terms, their reference dates, and the dates at which the drift may break.

    Parameters
    ----------
    terms : tuple of (str, int, int)
        Axis ('u' or 'v'), power of x, power of y.
    epoch0 : tuple of float
        Reference date of each segment, decimal years; one date serves all segments.
    breaks : tuple of float
        Dates at which a new segment begins, rising.

    Raises
    ------
    InputError
        For an unknown axis, a repeated term, breaks that do not rise, or a number of reference
        dates that is neither one nor one for each segment.

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
        where = "model.tdd"
        for term in self.terms:
            if not _is_term(term):
                raise InputError(
                    f"term {term!r} is not (axis, power of x, power of y)",
                    where=f"{where}.terms",
                    do="write for example ['u', 1, 0]",
                )
        if len(set(self.terms)) != len(self.terms):
            raise InputError(
                "a term stands twice", where=f"{where}.terms", do="name each term once"
            )
        if list(self.breaks) != sorted(set(self.breaks)):
            raise InputError(
                f"breaks {list(self.breaks)} do not rise",
                where=f"{where}.breaks",
                do="sort them and name each once",
            )
        if len(self.epoch0) == 1:
            object.__setattr__(self, "epoch0", self.epoch0 * self.n_segments)
        elif len(self.epoch0) != self.n_segments:
            raise InputError(
                f"{len(self.epoch0)} reference dates for {self.n_segments} segments",
                where=f"{where}.epoch0",
                do="give one date, or one for each segment",
            )

        for name in ("epoch0", "breaks"):
            if not all(isinstance(date, Real) for date in getattr(self, name)):
                raise InputError(
                    f"{name} is {getattr(self, name)!r}",
                    where=where,
                    do="give dates in decimal years",
                )

    @property
    def n_segments(self) -> int:
        """Number of segments: one more than the breaks."""
        return len(self.breaks) + 1

    @property
    def n_values(self) -> int:
        """Parameters of one term: a rate for each segment, a step for each but the first."""
        return 2 * self.n_segments - 1

    def value_names(self) -> tuple[str, ...]:
        """Names of one term's parameters, in their order: rate, step_2, rate_2, ..."""
        names = ["rate"]
        for s in range(1, self.n_segments):
            names += [f"step_{s + 1}", f"rate_{s + 1}"]
        return tuple(names)

    def weights(self, epoch: ArrayLike) -> Float:
        """Derivatives of a coefficient by each parameter of a drifting term, at an epoch.

        Parameters
        ----------
        epoch : array_like, shape (N,)
            Decimal years.

        Returns
        -------
        ndarray, shape (N, n_values)
            1 in the column of the segment's step, t - t0 in that of its rate, else 0.
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
