"""Which finding overrules which: causes and the symptoms that they make in other tests.

One fault of the data is seen by several tests. The remedy of a symptom does not help as long as the
cause is there: a higher order does not help where a ghost displaces stars, and errors that depend
on position do not help where exposures differ. A symptom is therefore reported with the remedy of
its cause, and tested again in the run after the cause was removed.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from bayesdist.utils.distributions import f_sf

POINTING_CHANCE = 0.01  # with which random terms of single exposures are taken for a curved sky
OF_FIELD = ("orders", "edges", "jumps", "rings", "repeating pattern")
OF_NOISE = ("noise by position", "noise by axis")
OF_EXPOSURES = ("noise by exposure", *OF_NOISE)


@dataclass(frozen=True)
class Cause:
    """A finding that accounts for others."""

    words: str  # the cause, as the object of "may come from"
    symptoms: tuple[str, ...]  # names or groups of the findings that have its remedy


# By the name or the group of the finding. Where several causes are found, the first one leads.
CAUSES: dict[str, Cause] = {
    "matching": Cause("the match radius", ("shape", *OF_FIELD, *OF_NOISE)),
    "shape": Cause("the shape of the residuals", (*OF_FIELD, *OF_NOISE, "noise by magnitude")),
    "cut-off positions": Cause("positions that were cut off", OF_FIELD),
    # a cause only if it explains more than deviations of single exposures do: see `is_pointing`
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
    "exposures in time": Cause(
        "deviations of exposures that are correlated in time", ("curvature in time",)
    ),
    "exposures": Cause("deviations of exposures", ("pointing", *OF_EXPOSURES)),
    "orders": Cause("the missing order", OF_NOISE),
    "magnitude": Cause("the dependence on magnitude", ("noise by magnitude",)),
}


def cause_of(names: Collection[str], found: Collection[str]) -> str:
    """Name or group of the finding that accounts for another one; empty if none does.

    Parameters
    ----------
    names : collection of str
        Name and group of the symptom.
    found : collection of str
        Names and groups of all significant findings that may be causes.
    """
    for name, cause in CAUSES.items():
        if name not in found:
            continue
        if name in names:
            return ""
        if not set(names).isdisjoint(cause.symptoms):
            return name
    return ""


def is_pointing(pointing: tuple[float, float], single: tuple[float, float]) -> bool:
    """True if a dependence on the pointing explains more than deviations of single exposures.

    Terms that differ from exposure to exposure at random go with the pointing to some extent. A
    curved sky puts all of the deviations into the few functions of the pointing.

    Parameters
    ----------
    pointing, single : tuple of float
        Statistic and degrees of freedom of both tests.
    """
    ratio = (pointing[0] / pointing[1]) / (single[0] / single[1])
    return bool(f_sf(ratio, pointing[1], single[1]) < POINTING_CHANCE)
