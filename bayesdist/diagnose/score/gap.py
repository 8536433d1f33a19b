"""Test of the gap: do the chips move against each other with time, in a way that is not fitted?

Of every exposure the shift of each chip against the first one, and its rotation about its own
reference pixel, are solved for beside what all chips have in common: shift, rotation, scale and
shears.  Scale and shears act about each chip's reference pixel, as the terms do that drift in a
model, so that they leave the gap as it is; those of a frame that the chips share act about its own
origin.  A line in time through these is compared with their scatter about it,

    d_e = d_0 + rate (t_e - t_0) + noise        F = rate^2 / var(rate)

with the scatter of whole visits for noise: chips that move to and fro by themselves do not drift.
What the errors of catalogue stars do, which follow a chip through all exposures where roll angles
are alike, is added to var(rate).  The largest of all F is tested, corrected for their number
(Sidak 1967).
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
MIN_FREE = 3  # visits beyond those that the line takes
MIN_STARS = 12  # of an exposure on a chip: six linear terms of both axes, and as many beside
SHORTEST = 0.1  # years over which a drift is looked for
VISIT = 1 / 365.25  # years between exposures that deviate together

_WAYS = ("along x", "along y", "in rotation")


@dataclass(frozen=True, eq=False)
class _Exposure:
    """Positions of the chips of one exposure against the first one."""

    epoch: float
    chips: tuple[int, ...]  # codes of all but the first
    # (len(chips), 3) shifts along the axes of the polynomials, and rotation times half a side: unit
    # of u, v
    value: Float
    variance: Float  # (len(chips), 3)
    star: Int  # (n,) stars of the detections
    by_star: Float  # (n, len(chips), 3) what each detection has added to `value`


@dataclass(frozen=True)
class _Line:
    """The drift of one chip in one way: unit of u, v, per year."""

    chip: int
    way: int
    rate: float
    variance: float
    free: int

    @property
    def statistic(self) -> float:
        """F of one and `free` degrees of freedom."""
        return self.rate**2 / self.variance

    @property
    def p_value(self) -> float:
        """Probability of a larger statistic, of this line by itself."""
        return float(f_sf(self.statistic, 1, self.free))


def gap_test(projection: Projection) -> Outcome | None:
    """Test for chips that drift against each other.

    None for one chip, without dates, and with too few visits for a line.
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
    best = min(lines, key=lambda one: one.p_value)
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
    """The rate that would be found whichever way the chips drift."""
    own = -np.expm1(np.log1p(-level) / len(lines))
    return max(smallest_pattern(float(np.sqrt(a.variance)), 1, a.free, own) for a in lines)


def _drifts(projection: Projection, chip: int, way: int) -> bool:
    """True where the model has this drift: a rate that no prior holds."""
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
    """Code of the visit of each of some exposures, by rising dates."""
    order = np.argsort(epoch, kind="stable")
    out = np.empty(len(epoch), np.int64)
    out[order] = np.cumsum(np.append(0, np.diff(epoch[order]) > VISIT))
    return out


def _line(projection: Projection, exposures: list[_Exposure], chip: int, way: int) -> _Line | None:
    """The drift of one chip in one way; None where there are too few visits."""
    some = [one for one in exposures if chip in one.chips]
    if not some:
        return None
    epoch = np.array([one.epoch for one in some])
    at = [(one.chips.index(chip), way) for one in some]
    value, own = (
        np.array([getattr(one, name)[k] for one, k in zip(some, at, strict=True)])
        for name in ("value", "variance")
    )
    # exposures to visits, as weighted means
    code = visit_codes(epoch)
    total = np.asarray(np.bincount(code, 1 / own), float)
    part = 1 / own / total[code]
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
    gain = np.linalg.pinv(root * design)[-1] * root[:, 0]  # of the rate
    left = d - design @ (np.linalg.pinv(root * design) @ (root[:, 0] * d))
    scale = float(weight @ left**2) / free
    variance = scale * float(gain**2 @ (1 / weight))
    pull = gain[code] * part
    variance += _of_stars(some, at, pull)
    return _Line(chip, way, float(gain @ d), variance, int(free))


def _weights(design: Float, values: Float, own: Float) -> Float:
    """Inverse variances of visits: their own, and a scatter by moments (DerSimonian and Laird)."""
    w = 1 / own
    root = np.sqrt(w)[:, None]
    hat = root * design @ np.linalg.pinv(root * design)
    left = values - design @ (np.linalg.pinv(root * design) @ (root[:, 0] * values))
    free = len(values) - np.trace(hat)
    c = float(w.sum() - np.diag(hat) @ w)
    scatter = max(0.0, (float(w @ left**2) - free) / c)
    return 1 / (own + scatter)


def _of_stars(some: list[_Exposure], at: list[tuple[int, int]], pull: Float) -> float:
    """Variance of a rate by what a star's detections have in common, beyond independent ones."""
    star = np.concatenate([one.star for one in some])
    psi = np.concatenate(
        [p * one.by_star[:, k, way] for p, one, (k, way) in zip(pull, some, at, strict=True)]
    )
    return max(float(squares_over(star, psi)[0] - (psi**2).sum()), 0.0)


def _exposures(projection: Projection, epoch: Float) -> Iterator[_Exposure]:
    """Iterator over the exposures with stars enough on the first chip and on another."""
    for blocks in projection.sample.blocks_by("exposure"):
        if one := _exposure(projection, epoch, blocks):
            yield one


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
    g, own = sample.score[:, at], slice(-3 * len(chips), None)
    step = inverse @ (F[0].T @ g[0] + F[1].T @ g[1])
    value = step[own].reshape(len(chips), 3)
    value = value + _fitted(projection, blocks[0].frame_exposure, chips)
    # what stars have in common beyond what the exposures have
    psi = sum(F[axis] * (g[axis] - HF[axis] @ step)[:, None] for axis in (0, 1))
    by_star = (psi @ inverse[:, own]).reshape(len(at), len(chips), 3)
    return _Exposure(
        float(epoch[at[0]]),
        tuple(chips),
        value,
        np.diag(inverse)[own].reshape(len(chips), 3) * projection.score_ratio,
        sample.star[at],
        by_star,
    )


def _half(projection: Projection, chip: int) -> float:
    """Half the longest side of a chip, in the unit of u, v."""
    model = projection.sample.model
    return model.pixel_size(projection.theta) * max(model.chips[chip].size) / 2


def _columns(projection: Projection, block: Block, chips: list[int]) -> Float:
    """Derivatives (2, n, unknowns) of the positions of a block by the unknowns of its exposure."""
    model = projection.sample.model
    polynomials = projection.functions.polynomials(block.rows)
    at_centre = block.effective @ model.basis(model.chips[block.chip].number).monomial_matrix[0]
    about = (block.effective @ polynomials).T - at_centre
    n = len(about)
    shared = () if model.chip_deviations else frame_names(model.frames)
    origin = np.zeros(2) + model.origin
    columns = [np.tile(one, (n, 1)) for one in np.eye(2)]
    columns.append((about + at_centre - origin) @ LINEAR_MATRICES["rotation"].T)
    for name in DEVIATIONS:
        at = about + at_centre - origin if name in shared else about
        columns.append(at @ LINEAR_MATRICES[name].T)
    for chip in chips:
        here = float(chip == block.chip)
        columns += [np.tile(here * block.frame[:, axis], (n, 1)) for axis in (0, 1)]
        columns.append(here / _half(projection, chip) * about @ LINEAR_MATRICES["rotation"].T)
    return np.moveaxis(np.stack(columns), (0, 1, 2), (2, 1, 0))


def _fitted(projection: Projection, exposure: int, chips: list[int]) -> Float:
    """Shifts and rotation of chips that the model has for an exposure, (chips, 3)."""
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
