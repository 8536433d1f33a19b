"""Placement of the nodes of the proposal's grid.

The grid covers one or two hyperparameters (log j, log s_out) over the range where the posterior is
not negligible.  At each node all other parameters are at their conditional mode.
"""

from __future__ import annotations

import numpy as np

from bayesdist.errors import DegenerateError
from bayesdist.infer.density.laplace import (
    Conditional,
    Node,
    Split,
    conditional_mode,
    expected_mode,
    starting_point,
)
from bayesdist.infer.density.proposal import GridProposal, quality_of
from bayesdist.infer.density.target import Target
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.stars.likelihood import TAILS
from bayesdist.utils.arrays import Float

Line = dict[float, Conditional]  # nodes along an axis of the grid, by their coordinate

N_NODES = 25  # nodes of a one-dimensional grid
N_SCALES, STRIDE = 17, 2  # 2-D grid: nodes of log s_out, and every STRIDE-th node of log j
DROP = 18.0  # the grid ends this far (log density) below the maximum; 1e-8 of the mass is outside
NOTHING = 40.0  # log density below the maximum assigned to nodes that are not searched
NEAR = 1e-4  # Newton decrement at which the search for a node's mode stops
# with fewer outliers, or a smaller ratio of their scale to the core's, the data may not determine
# the outlier scale
FEW, CLOSE = 30.0, 2.0
TRIAL = 128  # draws used to compare the one- and two-dimensional grids
# efficiency of a 1-D grid above which no second axis is tried; smallest acceptable ratio of the
# 2-D grid's efficiency to that of the 1-D grid
GOOD, WORSE = 0.98, 0.8
VAGUE = 0.2  # standard deviation of log s_out above which a single Gaussian is not enough
# multiple of the median quoted error beyond which the marginal may be the tail of the prior
FAR = {"j": 0.3, "s_out": 30.0}
MEANING = {
    "j": "the additional scatter of true matches (jitter)",
    "s_out": "the scatter of false matches",
}


def build_proposal(target: Target, fit: LinearFit) -> GridProposal:
    """Build the grid proposal; the grid covers all but 1e-8 of the posterior.

    The search for the mode starts from `fit`.  Raises DegenerateError if no mode is found, or if
    the marginal posterior of a grid coordinate does not fall off.
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
    # the second axis is preferred unless clearly worse: it covers tails that few draws do not show
    return wide if _trial(target, wide) > WORSE * worth else narrow


def _is_vague(target: Target, split: Split, node: Node) -> bool:
    """True if the data may not determine the scale of the outliers.

    This is assumed if the curvature implies a large uncertainty, if there are few outliers, or if
    they are hardly wider than the core (the posterior may then have several modes).
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
    """Importance efficiency of the proposal, estimated from `TRIAL` draws."""
    psi = proposal.draw(TRIAL, np.random.default_rng(0))
    out = np.full(TRIAL, np.nan)
    inside = np.isfinite(psi).all(axis=1)
    if inside.any():
        out[inside] = target.log_density(psi[inside]) - proposal.log_density(psi[inside])
    return quality_of(out).efficiency


def _with_scales(
    target: Target, narrow: GridProposal, line: Line, best: Conditional
) -> GridProposal:
    """Proposal with log s_out as an additional axis of the grid."""
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
    """Coordinates of about half the nodes of a line, including the best node and both ends."""
    grid = sorted(line)
    k = grid.index(float(best.at[0]))
    return sorted({grid[0], *grid[k % STRIDE :: STRIDE], grid[-1]})


def _column(
    target: Target, split: Split, middle: Conditional, log_j: list[float], top: float
) -> list[Node]:
    """Nodes at the values `log_j`, all with the s_out of the node `middle`.

    The search proceeds from `middle` in both directions.  Where the marginal density has become
    negligible, the last node is repeated with a negligible density instead of searching on.
    """
    start = float(middle.at[0])
    nodes: dict[float, Node] = {start: middle}
    above, below = [x for x in log_j if x > start], [x for x in log_j if x < start]
    for side in (above, below[::-1]):
        neighbour: Conditional | None = middle
        last: Node = middle
        for x in side:
            at = np.array([x, middle.at[1]])
            if neighbour is not None:
                neighbour = _reached(target, split, neighbour, at)
            if neighbour is None or neighbour.log_marginal < top - DROP:
                neighbour = None
                nodes[x] = Node(at, last.mode, last.factor, top - NOTHING)
            else:
                nodes[x] = last = neighbour
    return [nodes[x] for x in log_j]


def _reached(target: Target, split: Split, here: Conditional, at: Float) -> Conditional | None:
    """Node at grid coordinates `at`, searched from the adjacent node `here`; None if it fails."""
    y = expected_mode(split, here, at - here.at)
    try:
        return conditional_mode(target, split, y, at, tolerance=NEAR)
    except DegenerateError:
        return None


# -- along one axis -------------------------------------------------------------------------------


def _line(target: Target, split: Split, node: Conditional, axis: int, n: int) -> Line:
    """At least `n` nodes along an axis, placed where the marginal density is not negligible.

    `node` is the first node, near the maximum.
    """
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
    """Node near the maximum of the marginal density of log j."""
    for _ in range(30):
        # without the curvature of a maximum, take a step that is large enough to leave a plateau
        slope = float(node.slope[0])
        curvature = max(float(node.curvature[0, 0]), abs(slope), 1e-3)
        step = float(np.clip(slope / curvature, -1.0, 1.0))
        if step**2 * curvature < 0.1:
            break
        y = _ahead(split, node, 0, step)
        node = _neighbour(target, split, node, 0, float(node.at[0]) + step, y)
    return node


def _walk(target: Target, split: Split, nodes: Line, axis: int, direction: int) -> None:
    """Add nodes along an axis until the marginal is negligible or follows the tail of the prior."""
    outermost = max if direction > 0 else min
    curvature = float(nodes[outermost(nodes)].curvature[axis, axis])
    step = 1.0 / np.sqrt(np.clip(curvature, 1.0, 1e12))
    for _ in range(200):
        edge = outermost(nodes)
        edge_node = nodes[edge]
        stride = direction * step
        y = _ahead(split, edge_node, axis, stride)
        new_node = _neighbour(target, split, edge_node, axis, edge + stride, y)
        nodes[edge + stride] = new_node
        top = max(node.log_marginal for node in nodes.values())
        change = new_node.log_marginal - edge_node.log_marginal
        if new_node.log_marginal < top - DROP:
            return
        if _is_tail(target, split.held[axis], edge, direction, change / stride):
            return
        # aim at steps that change the log density by about 2
        step = float(
            np.clip(step * np.clip((2.0 / max(abs(change), 0.25)) ** 0.7, 0.2, 4.0), 1e-7, 1.0)
        )
    raise DegenerateError(
        f"the data do not bound {MEANING[split.held[axis]]}: its posterior is not negligible at "
        f"{np.exp(outermost(nodes)):.2g}, with typical errors of {target.hyper.scale:.2g}, in the "
        "unit of u and v",
        where="outliers",
        do="check the unit of u, v and their errors, and that the order of the model and the match "
        "radius suit the matches",
    )


def _is_tail(target: Target, name: str, x: float, direction: int, slope: float) -> bool:
    """True if the marginal follows the prior: the likelihood is independent of the parameter."""
    end, prior_slope = TAILS[name]
    outward = -1 if end == "left" else 1
    distance = outward * (x - np.log(FAR[name] * target.hyper.scale))
    return direction == outward and distance > 0 and bool(abs(slope / prior_slope - 1.0) < 2e-3)


def _worth_keeping(nodes: Line) -> Line:
    """Drop the nodes far below the maximum, except one on either side."""
    top = max(node.log_marginal for node in nodes.values())
    grid = sorted(nodes)
    good = [k for k, x in enumerate(grid) if nodes[x].log_marginal > top - DROP]
    keep = grid[max(good[0] - 1, 0) : good[-1] + 2]
    return {x: nodes[x] for x in keep}


def _refine(target: Target, split: Split, nodes: Line, axis: int) -> None:
    """Add a node halfway in the interval that matters most for the interpolation.

    Intervals are ranked by squared width times the square root of the density, which gives weight
    to the tails.
    """
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
