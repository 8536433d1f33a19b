"""Error of an exposure's scale from what is not known of its velocity aberration.

VAFACTOR holds for an instant, and a telescope in a low orbit turns its velocity while it exposes.
At which instant the factor was computed no log says: it is taken to lie anywhere in the exposure.
Computed from the Earth's motion alone it lacks the orbit altogether.

All of it makes exposures scatter in scale, and that scatter is measured: the term is a part of it.
"""

from __future__ import annotations

import math

import numpy as np

from bayesdist.app.kinds.campaign.inputs import Inputs
from bayesdist.app.kinds.errors import ExposureScatter
from bayesdist.assess.terms.parameters import ABERRATION, EXPOSURE_SCATTER, ScaleError
from bayesdist.infer.solution.solution import Solution

# Cox & Gilliland (2002, HST Calibration Workshop): the scale varies by up to 5e-5 over an orbit
SWING = 5e-5
PERIOD = 5760.0  # s, of 96 minutes
LONG_EXPOSURE = 1000.0  # s, where the log has no exposure times
PUBLISHED = "published: 5e-5 in an orbit (Cox & Gilliland 2002)"


def scale_error(exptime: float | None) -> float:
    """Relative standard deviation of the scale.

    Over `exptime` seconds the instant of VAFACTOR is uniform; None where the factor lacks the
    orbit. A sine of amplitude SWING / 2 at any phase has the standard deviation of its amplitude by
    the root of 2, and its rate 2 pi / PERIOD times as much.
    """
    spread = SWING / 2 / math.sqrt(2)
    if exptime is None:
        return spread
    return min(spread, spread * 2 * math.pi / PERIOD * exptime / math.sqrt(12))


def aberration_term(scatter: ExposureScatter, inputs: Inputs, solution: Solution) -> ScaleError:
    """The error of the scale that VAFACTOR leaves, at most as large as exposures scatter."""
    source = PUBLISHED
    if inputs.config.campaign.vafactor_source == "earth":
        sigma = scale_error(None)
        source += ", not corrected"
    else:
        given = [one.exptime for one in inputs.log if one.exptime is not None]
        seconds = math.sqrt(np.mean(np.square(given))) if given else LONG_EXPOSURE
        sigma = scale_error(seconds)
        source += f", over {seconds:.0f} s"
        if not given:
            source += " (assumed: the log has no times)"
    if "scale" in scatter.kinds:
        found = scatter.tau[:, scatter.kinds.index("scale")]
        measured = float(np.sqrt(np.mean(found**2)))
        if measured < sigma:
            sigma, source = measured, f"{source}, and no more than exposures scatter"
    source = f"{source}; part of {EXPOSURE_SCATTER}"
    return ScaleError(ABERRATION, "scale", sigma, solution, source, in_total=False)
