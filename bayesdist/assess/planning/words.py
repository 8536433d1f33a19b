"""Shortcomings of a dither pattern, in words."""

from __future__ import annotations

import numpy as np

from bayesdist.assess.planning.dithers import PlannedPattern
from bayesdist.infer.selfcal.gauge import SAME_ROLL

__all__ = ["lacking", "nearly_free"]

SHORT = 0.25  # of the detector's side: the scales above it are not sampled
SKEWS = ("skew_plus", "skew_cross")
MOST = 4  # parameters that are named


def lacking(found: PlannedPattern) -> tuple[str, ...]:
    """Sentences on offsets and rolls that a pattern lacks, and what that costs.

    The result is empty for a pattern of large offsets in both directions and with rolls.
    """
    pattern, gauge = found.pattern, found.solution.gauge
    no_rolls = gauge.spread < SAME_ROLL
    out = []
    if no_rolls:
        out.append(_without_rolls(found))
    if pattern.reach == 0:
        out.append(
            "no offsets: the polynomials are free"
            if no_rolls
            else "no offsets: what a roll brings back onto itself, as radial distortion, is free"
        )
    elif pattern.along_one_line:
        what = "is free" if no_rolls else "rests on the rolls alone"
        out.append(f"offsets lie along one line: what changes only across it {what}")
    if 0 < pattern.reach < SHORT * found.camera.side:
        worst = max(found.by_degree, key=found.by_degree.__getitem__)
        out.append(
            f"no large offsets: two pointings are {pattern.reach:.3g} pix apart at most, "
            f"{pattern.reach / found.camera.side:.2g} of the detector; terms of degree {worst} are "
            f"known to {found.by_degree[worst]:.2g} pix"
        )
    if len(found.camera.chips) > 1 and not found.chips_share_stars:
        out.append("no star is seen on two chips: how the chips lie to each other is not tied")
    return tuple(out)


def _without_rolls(found: PlannedPattern) -> str:
    skews = [d for d in found.solution.gauge.directions if d.name in SKEWS]
    sigma = max(d.sigma_fixed for d in skews)
    what = "no rolls but half turns" if np.ptp(found.pattern.rolls) > SAME_ROLL else "no rolls"
    if not np.isfinite(sigma):
        return f"{what}: a linear skew of the distortion cannot be told from one of the sky"
    return (
        f"{what}: linear skew rests on the commanded offsets, "
        f"sigma {sigma:.2g} ({sigma * skews[0].edge_pix:.2g} pix at the edge)"
    )


def nearly_free(found: PlannedPattern) -> str:
    """Combinations that are nearly free, by the parameters that lead them; empty for none."""
    weakest = found.solution.gauge.weakest
    if not len(weakest):
        return ""
    names = found.solution.model.names
    led = dict.fromkeys(names[int(k)] for _, k in weakest)
    more = f" and {len(led) - MOST} more" if len(led) > MOST else ""
    return (
        f"nearly free: combinations led by {', '.join(list(led)[:MOST])}{more}, up to "
        f"{weakest[:, 0].max():.2g} pix at the edge"
    )
