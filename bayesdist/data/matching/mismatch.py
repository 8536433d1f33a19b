"""Why a list of stars does not match: is the catalogue mirrored, or in another unit?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matching.similarity import PatternIndex, find_similarity
from bayesdist.errors import InputError

__all__ = ["MIRRORED", "mismatch_reason"]

Float = NDArray[np.float64]

# ratios of arcsec, mas, degrees and pixels of 0.05 arcsec
_RATIOS = (20.0, 50.0, 1000.0, 3600.0, 72_000.0, 3.6e6)
_WITHIN = 1.1  # of such a ratio; pixels have other sizes, too
_NEAR = 1.4  # a scale that is only badly known
_SAME = 0.03  # what the matching allows for
_AGREEING = 5.0  # stars that have a neighbour, for each whose triangles agree
_SURE = 16.0  # standard deviations of chance: of many tries one may well have half of it
MIRRORED = "its mirror image"


def mismatch_reason(plane: Float, mag: Float | None, reference: PatternIndex) -> str:
    """What would bring a list together with a reference list that it does not match as it is.

    Parameters
    ----------
    plane : ndarray, shape (N, 2)
        Positions after the known distortion.
    mag : ndarray, shape (N,), or None
    reference : PatternIndex

    Returns
    -------
    str
        A clause that names the scale or the mirror image; empty when nothing helps.
    """
    ratios = [factor for one in _RATIOS for factor in (one, 1.0 / one)]
    tries = [(1.0, _NEAR, False), *((one, _WITHIN, False) for one in ratios), (1.0, _NEAR, True)]
    best, reason = 0.0, ""
    # a wrong unit is found or dismissed in no time, a mirror image is not: it comes last
    for ratio, within, mirrored in tries:
        try:
            found = find_similarity(
                ratio * plane,
                reference,
                mag=mag,
                scale=(1.0 / within, within),
                mirrored=mirrored,
            )
        except InputError:
            continue
        # shrunk onto a crowded place any list finds neighbours; but few of its triangles agree
        if _AGREEING * found.coincidences < found.found:
            continue
        scale = ratio * found.scale
        as_it_is = abs(scale - 1.0) < _SAME
        if as_it_is and not mirrored:  # then neither scale nor image is what is wrong
            continue
        sigmas = (found.found - found.expected) / np.sqrt(found.expected)
        if sigmas <= best:
            continue
        image = MIRRORED if mirrored else "it"
        at = "" if as_it_is else f" at {scale:.4g} times the scale"
        best = sigmas
        reason = (
            f"{image} does match{at}: {found.found} stars, where chance gives {found.expected:.1f}"
        )
        if best > _SURE:
            break
    return reason
