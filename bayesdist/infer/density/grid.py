"""Nodes of the proposal's grid, along the modes as far as the posterior extends."""

from __future__ import annotations

import numpy as np

from bayesdist.errors import DegenerateError
from bayesdist.infer.density.coordinates import Split
from bayesdist.infer.density.importance import quality_of
from bayesdist.infer.density.laplace import (
    Conditional,
    Node,
    conditional_mode,
    expected_mode,
    starting_point,
)
from bayesdist.infer.density.proposal import GridProposal
from bayesdist.infer.density.target import Target
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.stars.mixture import TAILS
from bayesdist.utils.arrays import Float

Line = dict[float, Conditional]  # nodes by their value on one axis

N_NODES = 25
N_SCALES, STRIDE = 17, 2  # nodes of log s_out; then every other one of log j is enough
DROP = 18.0  # distance (in log density) below the top to which the grid extends: 1e-8 lies beyond
NOTHING = 40.0  # distance below the top that is assigned to nodes that were not searched for
NEAR = 1e-4  # Newton decrement at which a node's search stops
# number of outliers, and their scale over the core's, below which the scale may be open
FEW, CLOSE = 30.0, 2.0
TRIAL = 128  # proposals that compare both grids
# efficiency that needs no second axis; fraction of it that may be lost by one
GOOD, WORSE = 0.98, 0.8
VAGUE = 0.2  # standard deviation of log s_out beyond which one Gaussian is not enough
# distance from the median quoted error at which the end of an axis may begin to be its prior's tail
FAR = {"j": 0.3, "s_out": 30.0}


def build_proposal(target: Target, fit: LinearFit) -> GridProposal:
    """Proposal from conditional modes over a grid that carries all but 1e-8 of the posterior.

    The search starts from `fit`.  DegenerateError when no mode is found, or the posterior of the
    grid's coordinates has no end.
    """
    hyper = target.mixture.hyper
    split = Split(target.n_theta, hyper, tuple(name for name in hyper if name == "j"))
    y, at = split.from_psi(starting_point(target, fit))
    first = conditional_mode(target, split, y, at)
    line = _line(target, split, _climb(target, split, first), 0, N_NODES) if split.held else {}
    best = max(line.values(), key=lambda node: node.log_marginal, default=first)
    nodes: list[Node] = [line[x] for x in sorted(line)] or [first]
    narrow = GridProposal(split, tuple(nodes))
    if not _is_vague(target, split, best):
        return narrow
    worth = _trial(target, narrow)
    if worth > GOOD:
        return narrow
    try:
        wide = _with_scales(target, narrow, line, best)
    except DegenerateError:
        return narrow
    # a few draws do not show the tails, for which the second axis is needed
    return wide if _trial(target, wide) > WORSE * worth else narrow


def _is_vague(target: Target, split: Split, node: Node) -> bool:
    """True if the data may not determine the scale of the outliers.

    That is so where the curvature shows it, where the outliers are few, and where they are hardly
    wider than the core: the mode that was found may then be one of several.
    """
    if "s_out" not in split.rest:
        return False
    k = split.n_theta + split.rest.index("s_out")
    sd, z = np.sqrt(node.factor.variances()[k]), node.mode[k]
    if 1.5 * sd > VAGUE * z:  # log s_out = -3/2 log z
        return True
    psi = split.to_psi(node.mode, node.at)
    value = {name: float(x) for name, x in target.hyper.values(psi[split.n_theta :]).items()}
    core = np.hypot(target.hyper.scale, value.get("j", target.mixture.jitter or 0.0))
    return value["f"] * len(target.shards) < FEW or value["s_out"] < CLOSE * core


def _trial(target: Target, proposal: GridProposal) -> float:
    """Importance efficiency of the proposal from a few draws."""
    psi = proposal.draw(TRIAL, np.random.default_rng(0))
    out = np.full(TRIAL, np.nan)
    inside = np.isfinite(psi).all(axis=1)
    if inside.any():
        out[inside] = target.log_density(psi[inside]) - proposal.log_density(psi[inside])
    return quality_of(out).efficiency


def _with_scales(
    target: Target, narrow: GridProposal, line: Line, best: Conditional
) -> GridProposal:
    """Proposal with log s_out as a further axis of the grid."""
    split = narrow.split
    wide = Split(split.n_theta, split.hyper, (*split.held, "s_out"))
    y, at = wide.from_psi(split.to_psi(best.mode, best.at))
    middle = conditional_mode(target, wide, y, at)
    axis = len(split.held)
    along = _line(target, wide, middle, axis, N_SCALES if line else N_NODES)
    if not line:
        return GridProposal(wide, tuple(along[x] for x in sorted(along)))
    top = max(node.log_marginal for node in along.values())
    log_j = _thinned(line, best)
    columns = [_column(target, wide, along[x], log_j, top) for x in sorted(along)]
    return GridProposal(wide, tuple(node for row in zip(*columns, strict=True) for node in row))


def _thinned(line: Line, best: Conditional) -> list[float]:
    """About half the nodes of a line, the best one and the ends among them."""
    grid = sorted(line)
    k = grid.index(float(best.at[0]))
    return sorted({grid[0], *grid[k % STRIDE :: STRIDE], grid[-1]})


def _column(
    target: Target, split: Split, middle: Conditional, log_j: list[float], top: float
) -> list[Node]:
    """Nodes at some jitters and the s_out of one node, searched from there outwards.

    Beyond the end of the posterior there is no search: the last node is repeated with a negligible
    marginal density.
    """
    start = float(middle.at[0])
    found: dict[float, Node] = {start: middle}
    above, below = [x for x in log_j if x > start], [x for x in log_j if x < start]
    for side in (above, below[::-1]):
        here: Conditional | None = middle
        last: Node = middle
        for x in side:
            at = np.array([x, middle.at[1]])
            if here is not None:
                here = _reached(target, split, here, at)
            if here is None or here.log_marginal < top - DROP:
                here = None
                found[x] = Node(at, last.mode, last.factor, top - NOTHING)
            else:
                found[x] = last = here
    return [found[x] for x in log_j]


def _reached(target: Target, split: Split, here: Conditional, at: Float) -> Conditional | None:
    """Node at a point next to another node, or None where no mode is found."""
    y = expected_mode(split, here, at - here.at)
    try:
        return conditional_mode(target, split, y, at, tolerance=NEAR)
    except DegenerateError:
        return None


# -- along one axis -------------------------------------------------------------------------------


def _line(target: Target, split: Split, node: Conditional, axis: int, n: int) -> Line:
    """Nodes along an axis, from a first one near the top: `n` of them, where the density is."""
    nodes = {float(node.at[axis]): node}
    for direction in (1, -1):
        _walk(target, split, nodes, axis, direction)
    nodes = _worth_keeping(nodes)
    while len(nodes) < n:
        _refine(target, split, nodes, axis)
    return nodes


def _neighbour(
    target: Target, split: Split, node: Conditional, axis: int, x: float, y: Float
) -> Conditional:
    at = node.at.copy()
    at[axis] = x
    return conditional_mode(target, split, y, at, tolerance=NEAR)


def _ahead(split: Split, node: Conditional, axis: int, step: float) -> Float:
    return expected_mode(split, node, step * np.eye(len(node.at))[axis])


def _climb(target: Target, split: Split, node: Conditional) -> Conditional:
    """Node along the modes where log j is about most probable."""
    for _ in range(30):
        # where the curvature is not that of a peak, steps of a size that leaves the plateau
        slope = float(node.slope[0])
        curvature = max(float(node.curvature[0, 0]), abs(slope), 1e-3)
        step = float(np.clip(slope / curvature, -1.0, 1.0))
        if step**2 * curvature < 0.1:
            break
        y = _ahead(split, node, 0, step)
        node = _neighbour(target, split, node, 0, float(node.at[0]) + step, y)
    return node


def _walk(target: Target, split: Split, nodes: Line, axis: int, direction: int) -> None:
    """Step along an axis until the marginal has dropped, or is the pure tail of the prior."""
    outermost = max if direction > 0 else min
    curvature = float(nodes[outermost(nodes)].curvature[axis, axis])
    step = 1.0 / np.sqrt(np.clip(curvature, 1.0, 1e12))
    for _ in range(200):
        edge = outermost(nodes)
        here = nodes[edge]
        stride = direction * step
        y = _ahead(split, here, axis, stride)
        there = _neighbour(target, split, here, axis, edge + stride, y)
        nodes[edge + stride] = there
        top = max(node.log_marginal for node in nodes.values())
        change = there.log_marginal - here.log_marginal
        if there.log_marginal < top - DROP:
            return
        if _is_tail(target, split.held[axis], edge, direction, change / stride):
            return
        # steps that change the density by about 2: neither creeping nor leaping
        step = float(
            np.clip(step * np.clip((2.0 / max(abs(change), 0.25)) ** 0.7, 0.2, 4.0), 1e-7, 1.0)
        )
    raise DegenerateError(
        f"the posterior of {split.held[axis]} has no end",
        where="outliers",
        do="check the units of the errors",
    )


def _is_tail(target: Target, name: str, x: float, direction: int, slope: float) -> bool:
    """True if the likelihood no longer depends on the hyperparameter."""
    end, known = TAILS[name]
    outward = -1 if end == "left" else 1
    distance = outward * (x - np.log(FAR[name] * target.hyper.scale))
    return direction == outward and distance > 0 and bool(abs(slope / known - 1.0) < 2e-3)


def _worth_keeping(nodes: Line) -> Line:
    """Nodes without those far below the top, except one on either side."""
    top = max(node.log_marginal for node in nodes.values())
    grid = sorted(nodes)
    good = [k for k, x in enumerate(grid) if nodes[x].log_marginal > top - DROP]
    keep = grid[max(good[0] - 1, 0) : good[-1] + 2]
    return {x: nodes[x] for x in keep}


def _refine(target: Target, split: Split, nodes: Line, axis: int) -> None:
    """Halve the interval that carries most of the posterior, its tails given weight."""
    grid = np.array(sorted(nodes))
    values = np.array([nodes[x].log_marginal for x in grid])
    density = np.exp((values - values.max()) / 2)
    width = np.diff(grid)
    k = int(np.argmax(width**2 * np.maximum(density[1:], density[:-1]) + 1e-3 * width))
    low, high = nodes[grid[k]], nodes[grid[k + 1]]
    quarter = width[k] / 4
    ends = _ahead(split, low, axis, quarter), _ahead(split, high, axis, -quarter)
    y = (ends[0] + ends[1]) / 2  # cubic Hermite
    middle = float((grid[k] + grid[k + 1]) / 2)
    nodes[middle] = _neighbour(target, split, low, axis, middle, y)
