"""What of a campaign's matching a reader has to know: exposures left out, incomplete or odd."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.exposure_log import ExposureLog
from bayesdist.data.matching.campaign import CampaignMatches

__all__ = ["match_doubts"]

Float = NDArray[np.float64]

FEWEST = 5  # exposures, of which one can be called odd
NORMAL = 1.4826022185056018  # standard deviations in a median absolute deviation of normal numbers
SIGMAS = 5.0  # of the other exposures
LACKING = 0.15  # of completeness, at least
FALSE = 0.05  # of the matches, at least
SCALE = 2e-5  # at least: less is what telescopes breathe
NAMED = 5  # exposures in a sentence


def match_doubts(found: CampaignMatches, log: ExposureLog) -> list[str]:
    """Exposures that were left out, that lack a chip, or that are unlike the others.

    An exposure is unlike the others when its completeness lies far below theirs, when far more of
    its matches are expected to be false, or when its scale, free of aberration, is another: five
    robust standard deviations of all exposures, and no less than 0.15, 0.05 and 2e-5.

    Parameters
    ----------
    found : CampaignMatches
    log : ExposureLog
        With VAFACTOR, where the scales are to be compared.

    Returns
    -------
    list of str
        Clauses that name the exposures.
    """
    reports = found.reports
    out = []
    if found.left_out:
        n = len(reports) + len(found.left_out)
        texts = [f"{name} ({cause})" for name, cause in found.left_out.items()]
        verb = "were" if len(texts) > 1 else "was"
        out.append(f"{len(texts)} of {n} exposures {verb} left out: {_listed(texts)}")
    for chip in sorted({chip for one in reports for chip in one.missing_chips}):
        names = [one.exposure for one in reports if chip in one.missing_chips]
        out.append(f"no detection on chip {chip} passes the cuts in exposure {_listed(names)}")
    for chip in sorted({chip for one in reports for chip in one.astray}):
        names = [one.exposure for one in reports if chip in one.astray]
        out.append(f"the detections of chip {chip} hardly match in exposure {_listed(names)}")
    if len(reports) < FEWEST:
        return out
    completeness = np.array([one.completeness for one in reports])
    false = np.array([one.false_share for one in reports])
    factor = log.select(names=[one.exposure for one in reports])
    whole = np.array([not one.missing_chips and not one.astray for one in reports])
    scale = np.array(
        [one.scale / (factor[one.exposure].vafactor or np.nan) if full else np.nan
         for one, full in zip(reports, whole, strict=True)]
    )  # fmt: skip
    for what, values, odd, form in (
        ("completeness", completeness, _away(-completeness, LACKING) > 0, ".2f"),
        ("share of false matches", false, _away(false, FALSE) > 0, ".2f"),
        ("scale", scale - _median(scale), np.abs(_away(scale, SCALE)) > 0, "+.1e"),
    ):
        named = [
            f"{one.exposure} ({value:{form}})"
            for one, value, is_odd in zip(reports, values, odd, strict=True)
            if is_odd
        ]
        if named:
            usual = "of the others" if what == "scale" else f"of {_median(values):.2f}"
            out.append(f"the {what} is unlike that {usual} in exposure {_listed(named)}")
    return out


def _median(values: Float) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0


def _away(values: Float, least: float) -> Float:
    """Distances from the median where they are large in both ways; else 0."""
    d = np.nan_to_num(values - _median(values))
    limit = max(SIGMAS * NORMAL * _median(np.abs(values - _median(values))), least)
    return np.where(np.abs(d) > limit, d, 0.0)


def _listed(texts: Sequence[str]) -> str:
    more = f" and {len(texts) - NAMED} more" if len(texts) > NAMED else ""
    return ", ".join(texts[:NAMED]) + more
