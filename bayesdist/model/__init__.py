"""Distortion model: polynomial basis, exposure frames, time dependence, and look-up tables."""

from bayesdist.model.basis import PolynomialBasis, polynomial_terms
from bayesdist.model.distortion import DistortionModel
from bayesdist.model.effective import Groups, merge_groups
from bayesdist.model.frames import DEVIATIONS, FRAME_KINDS
from bayesdist.model.layout import GAUGES, Chip
from bayesdist.model.lookup import LookupTable, corrected
from bayesdist.model.timedep import AXES, TimeDependence

__all__ = [
    "AXES",
    "DEVIATIONS",
    "FRAME_KINDS",
    "GAUGES",
    "Chip",
    "DistortionModel",
    "Groups",
    "LookupTable",
    "PolynomialBasis",
    "TimeDependence",
    "corrected",
    "merge_groups",
    "polynomial_terms",
]
