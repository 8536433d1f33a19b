"""Proposal of a self-calibration: Laplace approximations at several jitters.

As for matched stars (`GridProposal`), but with nodes that are found in few passes: with the stars
eliminated a pass is expensive, and many detections leave the jitter little room.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import DegenerateError
from bayesdist.infer.density.coordinates import Split
from bayesdist.infer.density.laplace import Node
from bayesdist.infer.density.proposal import GridProposal
from bayesdist.infer.equations.arrow import Arrow
from bayesdist.infer.selfcal.normal import Mixture, expand
from bayesdist.infer.selfcal.target import SelfTarget

__all__ = ["propose"]

Float = NDArray[np.float64]

DROP = 18.0  # distance (in log density) below the top to which the nodes extend
MOST_NODES, FEWEST_NODES = 25, 9
CLOSE = 1e-4  # decrement at which a node is found
MOST_STEPS = 12
MOST_TURNS = 10  # in each of which the mesh of log j is narrowed by seven: to 1e-8
FLAT = 0.02  # change of the log density beyond which the jitter has an effect
LEAST = 1e-3  # of the median error: no jitter


def propose(target: SelfTarget) -> GridProposal:
    """Proposal with nodes over all but 1e-8 of the posterior of the jitter.

    DegenerateError when a node has no mode.
    """
    split = Split(
        target.n_theta, target.mixture.hyper, tuple(k for k in target.mixture.hyper if k == "j")
    )
    if not split.held:
        z, bend = _share(target, split, np.zeros(0))
        return GridProposal(split, (_node(target, split, np.zeros(0), z, bend),))
    at, top = _nodes_at(target)
    z, bend = _share(target, split, np.array([top]))
    return GridProposal(split, tuple(_node(target, split, np.array([x]), z, bend) for x in at))


def _share(target: SelfTarget, split: Split, at: Float) -> tuple[float, float]:
    """Cube root of the most probable fraction of false detections, and its curvature.

    From the density with the stars integrated out: at their modes the fraction would be biased low,
    for a detection that may be false leaves its star more room.  It hardly depends on the jitter.
    """
    solution = target.solution
    n = len(target.problem)
    z = float(np.cbrt(max(solution.mixture.fraction, 0.3 / n)))
    step = z / (3 * max(np.sqrt(n * z**3), 1.0))  # about a standard deviation
    for _ in range(4):
        mesh = np.clip(z + step * np.linspace(-2.0, 2.0, 5), z / 5, 0.98)
        y = np.column_stack([np.tile(solution.theta[solution.free], (5, 1)), mesh])
        psi = split.to_psi(y, np.tile(at, (5, 1)))
        value = target.log_density(psi) + split.log_jacobian(y)
        a, b, _ = np.polyfit(mesh - z, value - value[2], 2)
        if a >= 0:  # still on the slope
            z = float(mesh[int(np.argmax(value))])
            continue
        move = float(np.clip(-b / (2 * a), -2 * step, 2 * step))
        z, step = float(np.clip(z + move, z / 5, 0.98)), float(1 / np.sqrt(-2 * a))
        if abs(move) < 0.2 * step:
            break
    return z, step**-2


def _nodes_at(target: SelfTarget) -> tuple[Float, float]:
    """Nodes in log j, and the most probable one, from the density along it, all else fixed."""
    solution = target.solution
    rest = solution.theta[solution.free]
    f = solution.mixture.fraction
    logit = np.log(f) - np.log1p(-f)

    def along(log_j: Float) -> Float:
        psi = np.column_stack([np.tile(rest, (len(log_j), 1)), log_j, np.full(len(log_j), logit)])
        return target.log_density(psi)

    sigma = target.problem.sigma
    low, high = np.log(LEAST * sigma), np.log(30 * max(sigma, solution.mixture.jitter))
    mesh = np.linspace(low, high, 16)
    for turn in range(MOST_TURNS):
        value = along(mesh)
        top = int(np.argmax(value))
        inside = np.flatnonzero(value > value[top] - DROP)
        begin, end = max(inside[0] - 1, 0), min(inside[-1] + 1, len(mesh) - 1)
        if inside[-1] - inside[0] > 6 or turn == MOST_TURNS - 1:
            break
        mesh = np.linspace(mesh[begin], mesh[end], 16)
    fine = np.linspace(mesh[begin], mesh[end], 400)
    open_end = begin == 0 and mesh[0] <= low + 1e-9
    if open_end:
        # at the left end is only the prior's tail: one node in it is enough
        likelihood = value - value[0] - (mesh - mesh[0])
        felt = np.flatnonzero(np.abs(likelihood) > FLAT)
        if len(felt):
            fine = fine[fine >= mesh[max(felt[0] - 2, 0)]]
    # a peak is nearly Gaussian; a shoulder that falls off from a plateau is not
    count = MOST_NODES if open_end else FEWEST_NODES
    return np.linspace(fine[0], fine[-1], count), float(mesh[np.argmax(value)])


def _node(target: SelfTarget, split: Split, at: Float, z: float, bend: float) -> Node:
    """Node with mode and curvature of everything else at one jitter, for a given fraction."""
    solution, problem, free = target.solution, target.problem, target.solution.free
    theta, stars = solution.theta.copy(), solution.stars
    held = float(np.exp(at[0])) if len(at) else float(target.jitter or 0.0)
    middles = problem.middles(theta)
    observed = True
    for _ in range(MOST_STEPS):
        found = expand(problem, theta, Mixture(held, z**3), stars, observed=observed)
        gradient = (found.gradient + target.information.pull(theta))[free]
        H = np.zeros((len(free) + 1,) * 2)
        H[:-1, :-1] = (found.curvature + target.information.precision)[np.ix_(free, free)]
        H[-1, -1] = bend
        try:
            factor = Arrow(H, np.zeros((0, len(H), 0)), np.zeros((0, 0, 0)), n_tail=1).factor()
        except np.linalg.LinAlgError as error:
            if observed:  # a star between two modes: with EM weights the curvature is positive
                observed = False
                continue
            raise DegenerateError(
                "the detections do not determine the parameters that are free",
                where="self-calibration",
                do="look at the gauge: dither more, add roll angles, or give priors",
            ) from error
        step = factor.solve(np.append(gradient, 0.0))[:-1]
        if gradient @ step < CLOSE:
            break
        theta[free] += step
        after = problem.middles(theta)
        stars = found.stars.copy()
        stars[:, :2] += after - middles
        middles = after
    y = np.append(theta[free], z)
    # of the density itself: that of the expansion has one choice of members
    value = float(target.log_density(split.to_psi(y, at)[None])[0])
    log_marginal = value + float(split.log_jacobian(y)) - 0.5 * factor.logdet
    return Node(at, y, factor, log_marginal)
