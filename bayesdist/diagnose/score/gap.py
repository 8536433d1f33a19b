"""Test of the gap: do the chips move relative to each other with time, in a way that is not fitted?

For every exposure, the shift of each chip relative to the first chip, and its rotation about its
own reference pixel, are fitted together with terms common to all chips: shift, rotation, scale and
shears.  Scale and shears act about each chip's reference pixel, like the drifting terms of a model,
so that they do not change the gap; those of a frame that all chips share act about the origin of
the frame.  A linear trend is fitted to these values,

    d_e = d_0 + rate (t_e - t_0) + noise        F = rate^2 / var(rate)

The noise is the scatter of whole visits about the trend, so that chips which move to and fro do not
count as drifting.  Errors of catalogue stars, which follow a chip through all exposures if the roll
angles are similar, are added to var(rate).  The largest F is tested, and its p-value is corrected
for the number of trends (Sidak 1967).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bayesdist.diagnose.clusters import squares_over
from bayesdist.diagnose.score.projection import Projection
from bayesdist.diagnose.score.result import Family, Outcome, outcome, smallest_pattern
from bayesdist.diagnose.score.sample import Block
from bayesdist.model.frames import DEVIATIONS, LINEAR_MATRICES, RIGID, frame_names
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import f_sf

GAP = Family("gap", "", "", "no drift of the gap between the chips is left in the residuals")
MIN_FREE = 3  # number of visits beyond the parameters of the line
MIN_STARS = 12  # per exposure and chip: six linear terms on both axes, and as many again
SHORTEST = 0.1  # years; shortest time span in which a drift is tested
VISIT = 1 / 365.25  # years; exposures closer than this form a visit and may deviate together

_WAYS = ("along x", "along y", "in rotation")


@dataclass(frozen=True, eq=False)
class _Exposure:
    """Positions of the chips of one exposure relative to the first chip."""

    epoch: float
    chips: tuple[int, ...]  # codes of all chips but the first
    # (len(chips), 3) shifts along the axes of the polynomials, and rotation times half the side of
    # the chip, in the unit of u and v
    value: Float
    variance: Float  # (len(chips), 3)
    star: Int  # (n,) stars of the detections
    by_star: Float  # (n, len(chips), 3) contribution of each detection to `value`


@dataclass(frozen=True)
class _Line:
    """Drift of one chip in one of the `_WAYS`, in the unit of u and v per year."""

    chip: int
    way: int
    rate: float
    variance: float
    free: int

    @property
    def statistic(self) -> float:
        """F statistic with 1 and `free` degrees of freedom."""
        return self.rate**2 / self.variance

    @property
    def p_value(self) -> float:
        """Probability of a larger statistic, for this trend alone."""
        return float(f_sf(self.statistic, 1, self.free))


def gap_test(projection: Projection) -> Outcome | None:
    """Test for chips that drift relative to each other.

    Returns None for a single chip, without dates, and with too few visits for a trend.
    """
    sample = projection.sample
    model = sample.model
    if len(model.chips) == 1 or sample.epoch is None or np.ptp(sample.epoch) < SHORTEST:
        return None
    exposures = list(_exposures(projection, sample.epoch))
    lines = [
        line
        for chip in range(1, len(model.chips))
        for way in range(len(_WAYS))
        if not _drifts(projection, chip, way) and (line := _line(projection, exposures, chip, way))
    ]
    if not lines:
        return None
    best = min(lines, key=lambda trend: trend.p_value)
    name = model.chips[best.chip].name
    terms = "['u', 0, 0] and ['v', 0, 0]" if best.way < 2 else "['u', 0, 1] and ['v', 1, 0]"
    return outcome(
        replace(
            GAP,
            remedy=f"add {terms} to model.tdd.terms",
            present=f"chip {name} drifts {_WAYS[best.way]} against chip {model.chips[0].name}, and "
            "the gap between them is taken to be constant",
        ),
        best.statistic,
        1,
        float(best.free),
        float(-np.expm1(len(lines) * np.log1p(-best.p_value))),
        square=best.rate**2,
        noise=best.variance,
        unit=f"{model.unit}/yr",
        smallest=partial(_smallest, lines),
    )


def _smallest(lines: list[_Line], level: float) -> float:
    """Rate that would be detected for every chip and direction."""
    line_level = -np.expm1(np.log1p(-level) / len(lines))
    return max(smallest_pattern(float(np.sqrt(a.variance)), 1, a.free, line_level) for a in lines)


def _drifts(projection: Projection, chip: int, way: int) -> bool:
    """True if the model contains this drift as a rate without a prior."""
    model = projection.sample.model
    if model.time is None or way == 2:
        return False
    term = ("uv"[way], 0, 0)
    if term not in model.time.terms:
        return False
    first = model.tdd_slice(model.chips[chip].number).start
    first += model.time.terms.index(term) * model.time.n_values
    return bool(projection.precision[first, first] == 0)


def visit_codes(epoch: Float) -> Int:
    """Visit number of each exposure, in the order of the dates `epoch` (years)."""
    order = np.argsort(epoch, kind="stable")
    out = np.empty(len(epoch), np.int64)
    out[order] = np.cumsum(np.append(0, np.diff(epoch[order]) > VISIT))
    return out


def _line(projection: Projection, exposures: list[_Exposure], chip: int, way: int) -> _Line | None:
    """Drift of one chip in one direction; None if there are too few visits."""
    with_chip = [exposure for exposure in exposures if chip in exposure.chips]
    if not with_chip:
        return None
    epoch = np.array([exposure.epoch for exposure in with_chip])
    at = [(exposure.chips.index(chip), way) for exposure in with_chip]
    value, variances = (
        np.array([getattr(exposure, name)[k] for exposure, k in zip(with_chip, at, strict=True)])
        for name in ("value", "variance")
    )
    # weighted means of the exposures of each visit
    code = visit_codes(epoch)
    total = np.asarray(np.bincount(code, 1 / variances), float)
    part = 1 / variances / total[code]
    t, d = (np.asarray(np.bincount(code, part * z), float) for z in (epoch, value))
    time = projection.sample.model.time
    segment = np.searchsorted(() if time is None else time.breaks, t, side="right")
    design = (segment[:, None] == np.unique(segment)).astype(float)
    design = np.column_stack([design, t - t.mean()])
    free = len(t) - np.linalg.matrix_rank(design)
    if free < MIN_FREE or np.linalg.matrix_rank(design[:, :-1]) == np.linalg.matrix_rank(design):
        return None
    weight = _weights(design, d, 1 / total)
    root = np.sqrt(weight)[:, None]
    # derivative of the rate with respect to the values
    gain = np.linalg.pinv(root * design)[-1] * root[:, 0]
    residual = d - design @ (np.linalg.pinv(root * design) @ (root[:, 0] * d))
    scale = float(weight @ residual**2) / free
    variance = scale * float(gain**2 @ (1 / weight))
    pull = gain[code] * part
    variance += _of_stars(with_chip, at, pull)
    return _Line(chip, way, float(gain @ d), variance, int(free))


def _weights(design: Float, values: Float, own: Float) -> Float:
    """Inverse variances of visits, including a common scatter estimated by moments.

    The estimator is that of DerSimonian and Laird (1986).  `own` are the variances of the visits
    without that scatter.
    """
    w = 1 / own
    root = np.sqrt(w)[:, None]
    hat = root * design @ np.linalg.pinv(root * design)
    residual = values - design @ (np.linalg.pinv(root * design) @ (root[:, 0] * values))
    free = len(values) - np.trace(hat)
    c = float(w.sum() - np.diag(hat) @ w)
    scatter = max(0.0, (float(w @ residual**2) - free) / c)
    return 1 / (own + scatter)


def _of_stars(some: list[_Exposure], at: list[tuple[int, int]], pull: Float) -> float:
    """Variance of a rate from errors that the detections of a star share.

    Only the excess over independent errors is returned.
    """
    star = np.concatenate([exposure.star for exposure in some])
    psi = np.concatenate(
        [
            p * exposure.by_star[:, k, way]
            for p, exposure, (k, way) in zip(pull, some, at, strict=True)
        ]
    )
    return max(float(squares_over(star, psi)[0] - (psi**2).sum()), 0.0)


def _exposures(projection: Projection, epoch: Float) -> Iterator[_Exposure]:
    """Iterate over the exposures with enough stars on the first chip and on another chip."""
    for blocks in projection.sample.blocks_by("exposure"):
        if exposure := _exposure(projection, epoch, blocks):
            yield exposure


def _exposure(projection: Projection, epoch: Float, blocks: list[Block]) -> _Exposure | None:
    sample = projection.sample
    number: dict[int, int] = {}
    for block in blocks:
        n = int(sample.used[block.rows].sum())
        number[block.chip] = number.get(block.chip, 0) + n
    enough = sorted(chip for chip, n in number.items() if n >= MIN_STARS)
    if len(enough) < 2 or enough[0] != 0:
        return None
    chips = enough[1:]
    blocks = [block for block in blocks if block.chip in enough]
    rows = [np.arange(block.rows.start, block.rows.stop) for block in blocks]
    F = np.concatenate([_columns(projection, block, chips) for block in blocks], axis=1)
    at = np.concatenate(rows)
    uu, uv, vv = sample.curvature[:, at]
    HF = np.stack(
        [uu[:, None] * F[0] + uv[:, None] * F[1], uv[:, None] * F[0] + vv[:, None] * F[1]]
    )
    A = F[0].T @ HF[0] + F[1].T @ HF[1]
    scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
    A = A / np.outer(scale, scale)
    if not (np.diag(A) > 0).all() or np.linalg.eigvalsh(A).min() < 1e-8:
        return None
    inverse = np.linalg.inv(A) / np.outer(scale, scale)
    g, tail = sample.score[:, at], slice(-3 * len(chips), None)
    step = inverse @ (F[0].T @ g[0] + F[1].T @ g[1])
    value = step[tail].reshape(len(chips), 3)
    value = value + _fitted(projection, blocks[0].frame_exposure, chips)
    # scores after the fit to the exposure, for the errors that detections of a star share
    psi = sum(F[axis] * (g[axis] - HF[axis] @ step)[:, None] for axis in (0, 1))
    by_star = (psi @ inverse[:, tail]).reshape(len(at), len(chips), 3)
    return _Exposure(
        float(epoch[at[0]]),
        tuple(chips),
        value,
        np.diag(inverse)[tail].reshape(len(chips), 3) * projection.score_ratio,
        sample.star[at],
        by_star,
    )


def _half(projection: Projection, chip: int) -> float:
    """Half the longest side of a chip, in the unit of u and v."""
    model = projection.sample.model
    return model.pixel_size(projection.theta) * max(model.chips[chip].size) / 2


def _columns(projection: Projection, block: Block, chips: list[int]) -> Float:
    """Derivatives (2, n, unknowns) of the positions of a block.

    They are with respect to the unknowns of the block's exposure.
    """
    model = projection.sample.model
    polynomials = projection.functions.polynomials(block.rows)
    at_centre = block.effective @ model.basis(model.chips[block.chip].number).monomial_matrix[0]
    about = (block.effective @ polynomials).T - at_centre
    n = len(about)
    shared = () if model.chip_deviations else frame_names(model.frames)
    origin = np.zeros(2) + model.origin
    columns = [np.tile(axis_unit, (n, 1)) for axis_unit in np.eye(2)]
    columns.append((about + at_centre - origin) @ LINEAR_MATRICES["rotation"].T)
    for name in DEVIATIONS:
        at = about + at_centre - origin if name in shared else about
        columns.append(at @ LINEAR_MATRICES[name].T)
    for chip in chips:
        on_chip = float(chip == block.chip)
        columns += [np.tile(on_chip * block.frame[:, axis], (n, 1)) for axis in (0, 1)]
        columns.append(on_chip / _half(projection, chip) * about @ LINEAR_MATRICES["rotation"].T)
    return np.moveaxis(np.stack(columns), (0, 1, 2), (2, 1, 0))


def _fitted(projection: Projection, exposure: int, chips: list[int]) -> Float:
    """Shifts and rotation (chips, 3) of the chips in the model of an exposure."""
    model, out = projection.sample.model, np.zeros((len(chips), 3))
    if not model.chip_deviations:
        return out
    names = {name: k for k, name in enumerate(model.names)}
    for row, chip in enumerate(chips):
        for way, kind in enumerate(RIGID):
            at = names.get(f"{model.exposures[exposure]}.{model.chips[chip].name}.{kind}")
            if at is not None:
                out[row, way] = projection.theta[at]
        out[row, 2] *= _half(projection, chip)
    return out
