"""Self-calibration: distortion, exposures' frames and stars' positions from detections alone.

The stars' parameters are eliminated star by star, so that nothing is dense in their number; what
is left are the parameters of a `DistortionModel`.

    problem     detections sorted by star, linearised about a solution
    normal      one pass: normal equations with the stars eliminated, or log densities of draws
    solve       the mode of everything together
    gauge       directions that detections leave free, by name, and what fixes them
    moves       of the whole sky, as changes of the parameters
    settled     the mode, and the directions that are free there: one decision
    information from other sources: commanded offsets, ties, priors
    references  stars of known position
    tangent     the exposures' tangent planes, mapped to one
    start       start of the search
    calibrate   grouping and solving in turn
    errors      of detections, by magnitude
    target, proposal, sampling      the posterior
    relative    solutions without their gauge
    catalogue   the stars
"""

from bayesdist.infer.selfcal.calibrate import SelfCalibration, self_calibrate
from bayesdist.infer.selfcal.catalogue import StarCatalogue, star_catalogue
from bayesdist.infer.selfcal.gauge import Gauge, NamedDirection
from bayesdist.infer.selfcal.information import Information, pointing_information, tie
from bayesdist.infer.selfcal.references import ReferenceStars
from bayesdist.infer.selfcal.relative import gauge_free
from bayesdist.infer.selfcal.sampling import sample_selfcal
from bayesdist.infer.selfcal.solve import Solution
from bayesdist.infer.selfcal.tangent import TangentPlane

__all__ = [
    "Gauge",
    "Information",
    "NamedDirection",
    "ReferenceStars",
    "SelfCalibration",
    "Solution",
    "StarCatalogue",
    "TangentPlane",
    "gauge_free",
    "pointing_information",
    "sample_selfcal",
    "self_calibrate",
    "star_catalogue",
    "tie",
]
