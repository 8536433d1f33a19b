"""The distortion as mathematics: bases, frames, time dependence, and the model that joins them."""

from bayesdist.model.basis import PolynomialBasis, polynomial_terms
from bayesdist.model.distortion import Chip, DistortionModel
from bayesdist.model.frames import FRAME_KINDS
from bayesdist.model.grouping import Groups, merge_groups
from bayesdist.model.timedep import AXES, TimeDependence

__all__ = [
    "AXES",
    "FRAME_KINDS",
    "Chip",
    "DistortionModel",
    "Groups",
    "PolynomialBasis",
    "TimeDependence",
    "merge_groups",
    "polynomial_terms",
]
