"""The proposal of a self-calibration: Laplace approximations at several jitters.

The same proposal as for matched stars (`GridProposal`), with nodes that are found in few passes:
with the stars eliminated a pass is dear, and many detections leave the jitter little room.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import DegenerateError
from bayesdist.infer.arrow import Arrow
from bayesdist.infer.coordinates import Split, from_cube_root, to_cube_root
from bayesdist.infer.laplace import Node
from bayesdist.infer.proposal import GridProposal
from bayesdist.infer.selfcal.normal import Mixture, expand
from bayesdist.infer.selfcal.target import SelfTarget

__all__ = ["propose"]

Float = NDArray[np.float64]

DROP = 18.0  # how far below the top (in log density) the nodes reach
MOST_NODES = 25
CLOSE = 1e-4  # decrement at which a node is found
MOST_STEPS = 12
FLAT = 0.02  # change of the log density beyond which the jitter is felt
LEAST = 1e-3  # of the median error: no jitter
SPACING = 1.5  # standard deviations between nodes


def propose(target: SelfTarget) -> GridProposal:
    """Nodes over all but 1e-8 of the posterior of the jitter.

    Raises
    ------
    DegenerateError
        When a node has no mode.
    """
    solution, n = target.solution, target.n_theta
    split = Split(n, target.mixture.hyper, tuple(k for k in target.mixture.hyper if k == "j"))
    z = float(np.cbrt(solution.mixture.fraction))
    if not split.held:
        return GridProposal(split, (_node(target, split, np.zeros(0), z),))
    at = _nodes_at(target)
    return GridProposal(split, tuple(_node(target, split, np.array([x]), z) for x in at))


def _nodes_at(target: SelfTarget) -> Float:
    """Where on log j the nodes go, from the density along it, all else held."""
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
    for _ in range(4):
        value = along(mesh)
        top = int(np.argmax(value))
        inside = np.flatnonzero(value > value[top] - DROP)
        begin, end = max(inside[0] - 1, 0), min(inside[-1] + 1, len(mesh) - 1)
        if inside[-1] - inside[0] > 6:
            break
        mesh = np.linspace(mesh[begin], mesh[end], 16)
    fine = np.linspace(mesh[begin], mesh[end], 400)
    smooth = np.interp(fine, mesh, value)
    if begin == 0 and mesh[0] <= low + 1e-9:
        # at the left end is nothing but the prior's tail: one node in it is enough
        likelihood = value - value[0] - (mesh - mesh[0])
        felt = np.flatnonzero(np.abs(likelihood) > FLAT)
        if len(felt):
            fine = fine[fine >= mesh[max(felt[0] - 2, 0)]]
            smooth = np.interp(fine, mesh, value)
    weight = np.exp(smooth - smooth.max())
    mean = weight @ fine / weight.sum()
    sd = float(np.sqrt(weight @ (fine - mean) ** 2 / weight.sum()))
    count = int(np.clip((fine[-1] - fine[0]) / (SPACING * sd) + 1, 7, MOST_NODES))
    return np.linspace(fine[0], fine[-1], count)


def _node(target: SelfTarget, split: Split, at: Float, z: float) -> Node:
    """Mode and curvature of everything else at one jitter."""
    solution, problem, free = target.solution, target.problem, target.solution.free
    theta, stars = solution.theta.copy(), solution.stars
    held = float(np.exp(at[0])) if len(at) else float(target.jitter or 0.0)
    middles = problem.middles(theta)
    for _ in range(MOST_STEPS):
        found = expand(problem, theta, Mixture(held, z**3), stars)
        h, h1, h2, g1, g2 = (float(part[0]) for part in from_cube_root(("f",), np.array([z])))
        hyper = np.array([at[0], h]) if len(at) else np.array([h])
        prior_gradient, prior_curvature = target.hyper.prior_terms(hyper)
        n, f = len(problem), z**3
        by_f = (n - found.n_members) - n * f + prior_gradient[-1]
        bend = n * f * (1 - f) - found.n_doubtful + prior_curvature[-1]
        gradient = np.append(
            (found.gradient + target.information.pull(theta))[free], by_f * h1 + g1
        )
        H = np.zeros((len(free) + 1,) * 2)
        H[:-1, :-1] = (found.curvature + target.information.precision)[np.ix_(free, free)]
        H[-1, -1] = max(bend * h1**2 - by_f * h2 - g2, 1.0)
        try:
            factor = Arrow(H, np.zeros((0, len(H), 0)), np.zeros((0, 0, 0)), n_tail=1).factor()
        except np.linalg.LinAlgError as error:
            raise DegenerateError(
                "the detections do not determine the parameters that are free",
                where="self-calibration",
                do="look at the gauge: dither more, add roll angles, or give priors",
            ) from error
        step = factor.solve(gradient)
        if gradient @ step < CLOSE:
            break
        theta[free] += step[:-1]
        z = float(np.clip(z + step[-1], z / 2, 1 - (1 - z) / 2))
        after = problem.middles(theta)
        stars = found.stars.copy()
        stars[:, :2] += after - middles
        middles = after
    value = found.value + float(target.information.log_density(theta))
    value += float(target.hyper.log_prior(hyper))
    y = np.append(theta[free], to_cube_root(("f",), np.array([h])))
    log_marginal = value + float(split.log_jacobian(y)) - 0.5 * factor.logdet
    return Node(at, y, factor, log_marginal)
