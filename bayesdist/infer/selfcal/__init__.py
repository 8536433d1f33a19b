"""Self-calibration: distortion, exposures' frames and stars' positions from detections alone.

The stars' parameters are eliminated star by star, so that nothing is dense in their number; what
is left are the parameters of a `DistortionModel`.

    problem     detections sorted by star, linearised about a solution
    elimination one pass: normal equations with the stars eliminated, or log densities of draws
    sky_moves   moves of the whole sky, as changes of the parameters
    prior       from other sources: commanded offsets, ties, reference stars
    gauge       directions that detections leave free, by name, and what fixes them
    mode        of everything together, and the directions that are free there: one decision
    tangent     the exposures' tangent planes, mapped to one
    start       start of the search
    calibrate   grouping and solving in turn; errors of detections, by magnitude
    pieces      detections in pieces of whole stars, here or on a cluster
    posterior   density, proposal and draws
    relative    solutions without their gauge
    catalogue   the stars
    expected    covariance before any exposure is taken
"""

from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.selfcal.calibrate import SelfCalibration, self_calibrate
from bayesdist.infer.selfcal.catalogue import StarCatalogue, star_catalogue
from bayesdist.infer.selfcal.gauge import Gauge, NamedDirection
from bayesdist.infer.selfcal.mode import SelfCalibrationMode
from bayesdist.infer.selfcal.posterior import sample_selfcal
from bayesdist.infer.selfcal.prior import ReferenceStars, pointing_prior, tie
from bayesdist.infer.selfcal.sky_moves import gauge_free
from bayesdist.infer.selfcal.tangent import TangentPlane

__all__ = [
    "Gauge",
    "NamedDirection",
    "Prior",
    "ReferenceStars",
    "SelfCalibration",
    "SelfCalibrationMode",
    "StarCatalogue",
    "TangentPlane",
    "gauge_free",
    "pointing_prior",
    "sample_selfcal",
    "self_calibrate",
    "star_catalogue",
    "tie",
]
