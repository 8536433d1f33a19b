"""Self-calibration: distortion, exposure frames and star positions from detections alone.

The parameters of the stars are eliminated star by star, so that no matrix grows with their number.
The remaining parameters are those of a `DistortionModel`.

    problem     detections sorted by star on a common plane, linearised about a solution
    elimination normal equations with the stars eliminated, and passes in pieces of the detections
    sky_moves   moves of the entire sky as changes of the parameters
    prior       information from other sources: commanded offsets, ties, reference stars, a start
    gauge       directions that the detections do not determine, with names and constraints
    mode        joint mode of all parameters in that gauge; expected covariance of planned exposures
    calibrate   alternating grouping and solution, errors by magnitude, catalogue of the stars
    posterior   posterior density, proposal and draws
"""

from bayesdist.infer.equations.priors import Prior
from bayesdist.kinds.selfcal.infer.calibrate import (
    SelfCalibration,
    StarCatalogue,
    self_calibrate,
    star_catalogue,
)
from bayesdist.kinds.selfcal.infer.gauge import Gauge, NamedDirection
from bayesdist.kinds.selfcal.infer.mode import SelfCalibrationMode
from bayesdist.kinds.selfcal.infer.posterior import sample_selfcal
from bayesdist.kinds.selfcal.infer.prior import ReferenceStars, pointing_prior, tie
from bayesdist.kinds.selfcal.infer.problem import TangentPlane

__all__ = [
    "Gauge",
    "NamedDirection",
    "Prior",
    "ReferenceStars",
    "SelfCalibration",
    "SelfCalibrationMode",
    "StarCatalogue",
    "TangentPlane",
    "pointing_prior",
    "sample_selfcal",
    "self_calibrate",
    "star_catalogue",
    "tie",
]
