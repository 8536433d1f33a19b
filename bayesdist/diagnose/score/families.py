"""Words of the targeted tests: questions, remedies and findings, once."""

from __future__ import annotations

from dataclasses import dataclass

from bayesdist.model.basis import MAX_ORDER

__all__ = ["FAMILIES", "Family", "order_family"]


@dataclass(frozen=True)
class Family:
    """One thing that a model may lack, in words."""

    name: str
    remedy: str  # what to do about it, as a clause
    # subject and verb of the finding, where there is something and where there is not
    present: str
    absent: str


def order_family(total: int, order: int) -> Family:
    """Words of the test for terms of one total order, of a model that ends at another."""
    return Family(
        f"order {total}",
        f"raise model.order to {total}" if total <= MAX_ORDER else "fit a look-up table",
        f"the residuals hold terms of order {total}, and the model ends at order {order}",
        f"no terms of order {total} are left in the residuals",
    )


# where `present` depends on what was found, the test fills it in
_ALL = (
    Family(
        "edges",
        "leave out the margins of the detector, or fit a look-up table",
        "the residuals rise towards the edges of the detector",
        "the residuals do not rise towards the edges of the detector",
    ),
    Family(
        "magnitude",
        "add a magnitude term, cut the faint stars, or correct the charge-transfer efficiency",
        "the residuals go with the magnitude of the stars",
        "the residuals do not go with the magnitude of the stars",
    ),
    Family(
        "magnitude in time",
        "cut the faint stars, correct the charge-transfer efficiency, or leave out the late years",
        "how the residuals go with the magnitude of the stars changes with time",
        "how the residuals go with the magnitude of the stars does not change with time",
    ),
    Family(
        "colour",
        "add a colour term, or select a narrower range of colours",
        "the residuals go with the colour of the stars",
        "the residuals do not go with the colour of the stars",
    ),
    Family(
        "drift",
        "add time-dependent terms to model.tdd",
        "linear terms drift with time, and the model's do not",
        "no drift of the linear terms is left in the residuals",
    ),
    Family(
        "curvature in time",
        "give model.tdd a break, or shorter periods",
        "the time dependence is not linear",
        "no curvature of the time dependence is left in the residuals",
    ),
    Family(
        "exposures",
        "use a campaign, whose exposures have a hierarchy of deviations",
        "exposures deviate from each other in linear terms that their frames do not fit",
        "no deviations of single exposures are left in the residuals",
    ),
    Family(
        "gap",
        "",
        "",
        "no drift of the gap between the chips is left in the residuals",
    ),
    Family(
        "motions",
        "give the catalogue proper motions, or larger errors of those that it has, or leave out "
        "the stars that move",
        "stars move between the dates of the exposures in ways that the catalogue does not have",
        "no motions of the stars are left in the residuals",
    ),
    Family(
        "pointing",
        "give the true detector.scale_mas, by which tangent planes are taken to one",
        "the distortion goes with where exposures point, as if a curved sky were taken as flat",
        "the distortion does not go with where exposures point",
    ),
    Family(
        "noise by position",
        "give errors that go with position",
        "the noise differs from cell to cell",
        "the noise is described equally well from cell to cell",
    ),
    Family(
        "noise by magnitude",
        "give errors that go with magnitude, or finer ones if they do",
        "the noise differs from bright to faint stars",
        "the noise is described equally well from bright to faint stars",
    ),
    Family(
        "noise by exposure",
        "give each exposure errors of its own, or leave out exposures",
        "the noise differs from exposure to exposure",
        "the noise is described equally well from exposure to exposure",
    ),
    Family(
        "noise by axis",
        "give errors sigma_u and sigma_v of their own",
        "along the other axis, beside its errors",
        "the noise is described equally well along u and v",
    ),
    Family(
        "repeating pattern",
        "fit a look-up table with nodes closer than half the period",
        "",
        "no pattern repeats over the detector",
    ),
    Family(
        "truncation",
        "match again with a wider radius",
        "",
        "the residuals do not end abruptly",
    ),
)
FAMILIES = {one.name: one for one in _ALL}
