"""Self-calibration: distortion, exposure frames and star positions from detections alone.

The parameters of the stars are eliminated star by star, so that no matrix grows with their number.
The remaining parameters are those of a `DistortionModel`.

    problem     detections sorted by star, linearised about a solution
    elimination normal equations with the stars eliminated, and marginal densities of draws
    sky_moves   moves of the entire sky as changes of the parameters; errors without them
    prior       information from other sources: commanded offsets, ties, reference stars
    gauge       directions that the detections do not determine, with names and constraints
    mode        joint mode of all parameters, with the gauge that is determined there
    tangent     mapping of the exposures' tangent planes to a common plane
    start       starting point of the search
    calibrate   alternating grouping and solution; errors of detections by magnitude
    pieces      division of the detections into pieces, in this process or on a cluster
    posterior   posterior density, proposal and draws
    catalogue   positions of the stars with their covariances
    expected    expected covariance for planned exposures
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
