"""Test for jumps: residuals that differ between both sides of a column or row of the detector.

The boundaries of amplifiers, stitched masks, strips of the field from another epoch or list, and
plates of a catalogue are lines.  A polynomial bends to follow such a step, and a smooth field
rounds it off; neither includes the remaining residuals, which extend over much of the detector.

At each of `EDGES` columns and rows of a chip, the score of a step is tested using its sandwich
covariance.  The step is orthogonal to polynomials along its axis up to `HIGHER` orders above the
model's.  The p-value of the most significant edge is multiplied by the number of edges
(Bonferroni).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre

from bayesdist.diagnose.clusters import sums_over
from bayesdist.diagnose.score.result import (
    LOOK_UP_TABLE,
    Family,
    Outcome,
    outcome,
    smallest_pattern,
)
from bayesdist.diagnose.score.sample import ScoredSample
from bayesdist.diagnose.significance import chi_square_of, hotelling_p
from bayesdist.utils.arrays import Float, Int

JUMPS = Family(
    "jumps",
    "fit the parts on both sides separately, correct the offset between them, or "
    f"{LOOK_UP_TABLE}; a higher order does not help",
    "",
    "the residuals do not jump at any column or row",
)
EDGES = 31  # number of columns, and also of rows, that are tested on each chip
HIGHER = 2  # orders above the model's to which the steps are orthogonal
MIN_STARS_ON_A_SIDE = 60
LARGEST_LEVERAGE = 0.5


@dataclass(frozen=True, eq=False)
class _Jump:
    """Step at one column or row."""

    p_value: float
    chip: int  # index into the model's chips
    axis: int  # 0 for a column (an edge at constant x), 1 for a row
    pixel: float  # position of the edge, in FITS pixels
    step: Float  # (2,) along the detector's directions of u and v, in the unit of u and v
    variance: Float  # (2,) variance of `step`


def jump_test(sample: ScoredSample) -> Outcome | None:
    """Test for jumps; None if no column or row has enough stars on both sides."""
    jumps = list(_jumps(sample))
    if not jumps:
        return None
    worst = min(jumps, key=lambda jump: jump.p_value)
    p_value = min(1.0, worst.p_value * len(jumps))
    chips = sample.model.chips
    place = f"{'column' if worst.axis == 0 else 'row'} {worst.pixel:.0f}"
    if len(chips) > 1:
        place += f" of {chips[worst.chip].name}"
    present = (
        f"the residuals jump near {place} by {np.hypot(*worst.step):.2g} {sample.model.unit}, "
        "as where amplifiers, stitched parts, or strips of another epoch or list meet"
    )
    noise = float(worst.variance.sum()) / 4
    return outcome(
        replace(JUMPS, present=present),
        chi_square_of(p_value, 2),
        2,
        None,
        p_value,
        # half a step on each side
        square=float((worst.step**2).sum()) / 4,
        noise=noise,
        unit=sample.model.unit,
        smallest=lambda level: smallest_pattern(np.sqrt(noise), 2, None, level / len(jumps)),
    )


def _jumps(sample: ScoredSample) -> Iterator[_Jump]:
    """Iterate over the steps at all columns and rows with enough stars on both sides."""
    leverage = np.broadcast_to(sample.leverage, sample.score.shape)
    usable = sample.used & (leverage.max(axis=0) < LARGEST_LEVERAGE)
    for code, chip in enumerate(sample.model.chips):
        rows = np.flatnonzero(usable & (sample.chip == code))
        if len(rows) < 2 * MIN_STARS_ON_A_SIDE:
            continue
        star = np.unique(sample.star[rows], return_inverse=True)[1]
        gradient, curvature = (values[rows] for values in sample.on_detector)
        curvature = curvature.mean(axis=1)
        order = sample.model.order + HIGHER
        for axis, scaled in enumerate((sample.X[rows], sample.Y[rows])):
            smooth = legendre.legvander(scaled, order).T
            inverse = np.linalg.inv((smooth * curvature) @ smooth.T)
            for edge in np.linspace(-1.0, 1.0, EDGES + 2)[1:-1]:
                beyond = scaled > edge
                n = np.count_nonzero(beyond)
                if min(n, len(rows) - n) < MIN_STARS_ON_A_SIDE:
                    continue
                step = beyond - ((beyond * curvature) @ smooth.T) @ inverse @ smooth
                result = _jump(step, gradient, curvature, star)
                if result is not None:
                    pixel = 0.5 + (edge + 1) / 2 * chip.size[axis]
                    yield _Jump(result[0], code, axis, pixel, *result[1:])


def _jump(
    step: Float, gradient: Float, curvature: Float, star: Int
) -> tuple[float, Float, Float] | None:
    """P-value of a step (n,), its size (2,) along both axes, and the variances (2,) of the size.

    `gradient` (n, 2) and `curvature` (n,) are those of the log-likelihood.  Returns None if the
    data do not constrain the step.
    """
    by_star = sums_over(star, step[:, None] * gradient)
    total, covariance = by_star.sum(axis=0), by_star.T @ by_star
    information = float(curvature @ step**2)
    if information <= 0 or np.linalg.det(covariance) <= 0:
        return None
    statistic = float(total @ np.linalg.solve(covariance, total))
    p_value = hotelling_p(statistic, 2, len(by_star))
    return p_value, total / information, np.diag(covariance) / information**2
