"""Precedence among findings: causes, and the symptoms that they produce in other tests.

One fault of the data affects several tests.  The remedy of a symptom does not help while the cause
persists: a higher order does not help if a ghost displaces stars, and errors that depend on
position do not help if exposures differ.  A symptom is therefore reported with the remedy of its
cause, and is tested again in the run after the cause has been removed.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from bayesdist.utils.distributions import f_sf

# p-value below which a few of many functions are regarded as the common cause
LEADING_CHANCE = 0.01
OF_FIELD = ("orders", "edges", "jumps", "rings", "repeating pattern")
# polynomials of missing orders resemble these, and follow them in part
STEEP = ("jumps", "rings", "repeating pattern")
OF_NOISE = ("noise by position", "noise by axis")
OF_EXPOSURES = ("noise by exposure", *OF_NOISE)


@dataclass(frozen=True)
class Cause:
    """A finding that accounts for other findings."""

    words: str  # the cause, as the object of "may come from"
    symptoms: tuple[str, ...]  # names or groups of the findings that are given its remedy


# By the name or the group of the finding. If there are several causes, the first one has
# precedence.
CAUSES: dict[str, Cause] = {
    "matching": Cause("the match radius", ("shape", *OF_FIELD, *OF_NOISE)),
    "shape": Cause("the shape of the residuals", (*OF_FIELD, *OF_NOISE, "noise by magnitude")),
    "cut-off positions": Cause("positions that were cut off", OF_FIELD),
    # a cause only if it explains more than deviations of single exposures do: see `explains_more`
    "pointing": Cause(
        "the curved sky",
        ("second order of exposures", "fields of exposures", "exposures", *OF_EXPOSURES),
    ),
    "second order of exposures": Cause(
        "second-order terms that differ between exposures", ("pointing", *OF_EXPOSURES)
    ),
    "fields of exposures": Cause(
        "fields that differ between exposures", ("pointing", *OF_EXPOSURES)
    ),
    # causes only if larger than missing orders, and the most significant one of them
    "jumps": Cause("the jump", ("orders", "edges", "rings", "repeating pattern", *OF_NOISE)),
    "repeating pattern": Cause("the pattern", ("orders", "edges", "jumps", "rings", *OF_NOISE)),
    "rings": Cause("the rings", ("orders", "edges", "jumps", "repeating pattern", *OF_NOISE)),
    # a cause only if it explains more than missing orders do
    "edges": Cause(
        "what rises towards the edges", ("orders", "jumps", "repeating pattern", *OF_NOISE)
    ),
    "exposures in time": Cause(
        "deviations of exposures that are correlated in time", ("curvature in time",)
    ),
    "exposures": Cause("deviations of exposures", ("pointing", *OF_EXPOSURES)),
    "orders": Cause("the missing orders", ("edges", *STEEP, *OF_NOISE)),
    "magnitude": Cause("the dependence on magnitude", ("noise by magnitude",)),
}


def cause_of(names: Collection[str], found: Collection[str]) -> str:
    """Name or group of the finding that accounts for another one; empty if there is none.

    Parameters
    ----------
    names : collection of str
        Name and group of the symptom.
    found : collection of str
        Names and groups of all significant findings that may be causes.

    Returns
    -------
    str
    """
    for name, cause in CAUSES.items():
        if name not in found:
            continue
        if name in names:
            return ""
        if not set(names).isdisjoint(cause.symptoms):
            return name
    return ""


def explains_more(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """True if a few functions explain more, for their number, than the many of another test.

    Terms that differ randomly between exposures correlate with the pointing to some extent, whereas
    a curved sky concentrates all deviations in the few functions of the pointing.  Missing orders
    rise towards the edges, whereas effects confined to the edges are spread over many orders.

    Parameters
    ----------
    one, other : tuple of float
        Statistic and degrees of freedom of the few functions, and of the many.

    Returns
    -------
    bool
    """
    ratio = (one[0] / one[1]) / (other[0] / other[1])
    return bool(f_sf(ratio, one[1], other[1]) < LEADING_CHANCE)
