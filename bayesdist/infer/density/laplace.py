"""Mode and curvature of the posterior at a given jitter, or jitter and scale of the outliers.

Newton's method on the mixture, with the EM weights wherever the full Hessian is not positive: far
from the mode steps are EM steps, near it convergence is quadratic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.errors import DegenerateError
from bayesdist.infer.density.coordinates import Split, from_cube_root
from bayesdist.infer.density.target import Target
from bayesdist.infer.equations.arrow import Arrow, ArrowFactor
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.utils.arrays import Float

MAX_STEPS = 60
UNSEEN = 1e-8  # decrement that rounding of the log density may hide: the step is taken unseen
ON_A_RIDGE = 1e-2  # decrement at which a search stops where the curvature had to be made positive


@dataclass(frozen=True, eq=False)
class Node:
    """Laplace approximation of everything else at one point of the grid.

    Coordinates are y = (theta, cube-root hyperparameters) and those of the grid: see `Split`.
    """

    at: Float  # the grid's coordinates (g,)
    mode: Float  # y (D',) at the mode
    # of minus the Hessian in the last step of the search, made positive where it is not
    factor: ArrowFactor
    # Laplace estimate of the log posterior density of the grid's coordinates, up to a constant
    log_marginal: float


@dataclass(frozen=True, eq=False)
class Conditional(Node):
    """A `Node` with the derivatives that the search for its neighbours needs."""

    # derivative (g, D') of the mode by the grid's coordinates, for the start at a neighbour
    tangent: Float
    slope: Float  # gradient (g,), by the grid's coordinates, of the log posterior along the modes
    curvature: Float  # minus its Hessian (g, g)


def starting_point(target: Target, fit: LinearFit) -> Float:
    """Starting point (D,): the linear fit, and hyperparameters from its rejected stars."""
    scale = target.hyper.scale
    excess = max(fit.chi2 / max(fit.dof, 1) - 1.0, 0.0)
    f = np.clip(fit.n_rejected / fit.n_rows, 0.5 / fit.n_rows, 0.9)
    j = scale * np.sqrt(max(excess, 0.1))
    s_out = 5 * float(np.hypot(scale, j))
    if fit.n_rejected > 2:
        s_out = max(s_out, fit.rms_rejected)
    natural = {"j": j, "f": float(f), "s_out": s_out}
    return np.concatenate([fit.mean, target.hyper.point(natural)])


def conditional_mode(
    target: Target, split: Split, y: Float, at: Float, *, tolerance: float = 1e-9
) -> Conditional:
    """Mode of the posterior at the grid's coordinates `at` (g,), starting from y (D',).

    The search ends at a Newton decrement (expected gain in log density) of `tolerance`.  Where the
    curvature is not positive, along a ridge, `ON_A_RIDGE` is enough: steps would be many and gain
    little.  DegenerateError when no maximum is found, or the curvature there is not positive.
    """
    here = _expand(target, split, y, at)
    for _ in range(MAX_STEPS):
        factor, mended = _positive(target, split, here, at)
        step = factor.solve(here.gradient)
        decrement = 0.5 * float(here.gradient @ step)
        if decrement < (max(tolerance, ON_A_RIDGE) if mended else tolerance):
            y = y + step if split.contains(y + step) else y
            break
        length, moved = 1.0, False
        for _ in range(40):
            trial = y + length * step
            if split.contains(trial):
                there = _expand(target, split, trial, at)
                if there.value - here.value > 1e-4 * length * decrement:
                    y, here, moved = trial, there, True
                    break
            length /= 2
        if not moved:
            if decrement < UNSEEN and not mended and split.contains(y + step):
                y = y + step
                break
            if decrement < 1e-3:
                break  # rounding limits the gain: this is the mode
            raise DegenerateError(
                "the search for the posterior mode stalled",
                where="posterior",
                do="check the match, the errors and the outlier model",
            )
    else:
        raise DegenerateError(
            f"no posterior mode was found in {MAX_STEPS} Newton steps",
            where="posterior",
            do="check the match, the errors and the outlier model",
        )
    # the last step needs no pass of its own: to second order its gain is its decrement
    gain = float(here.gradient @ (y - here.y)) / 2
    tangent = -factor.solve(here.coupling) if len(at) else here.coupling
    return Conditional(
        at=at,
        mode=y,
        factor=factor,
        log_marginal=here.value + gain - 0.5 * factor.logdet,
        tangent=tangent,
        slope=here.slope - here.coupling @ (y - here.y),
        curvature=here.curvature + here.coupling @ tangent.T,
    )


def expected_mode(split: Split, node: Conditional, step: Float) -> Float:
    """Starting point for the search at a point of the grid that is a step (g,) away from a node.

    The tangent may lead out of the support, to a fraction above one or below zero: then it is the
    node's own mode.
    """
    y = node.mode + step @ node.tangent
    return y if split.contains(y) else node.mode


@dataclass(frozen=True, eq=False)
class _Expansion:
    """Second-order expansion in the coordinates y at a point of the grid, and mixed derivatives.

    `slope` (g,) and `curvature` (g, g) are the gradient by the grid's coordinates and minus the
    Hessian; `coupling` (g, D') is minus the mixed derivatives.
    """

    y: Float
    value: float
    gradient: Float
    matrix: Arrow
    slope: Float
    curvature: Float
    coupling: Float


def _positive(
    target: Target, split: Split, here: _Expansion, at: Float
) -> tuple[ArrowFactor, bool]:
    """Factor of the Hessian, made positive where it is not, and True if that was needed.

    The distortion part falls back to the EM weights.  The hyperparameters' Schur complement gets
    eigenvalues of at least one, in units of half their own value: where outliers cannot be
    separated from the core, the posterior is flat in f and s_out, or even curved upwards.
    """
    for em in (False, True):
        matrix = _expand(target, split, here.y, at, em=True).matrix if em else here.matrix
        try:
            inner = matrix.without_tail().factor()
        except np.linalg.LinAlgError:
            continue
        t, g = matrix.n_tail, matrix.n_global
        if not t:
            return inner, em
        coupling = np.array(
            [inner.matrix.join(matrix.border[:g, g + k], matrix.edge[:, g + k]) for k in range(t)]
        )
        explained = coupling @ inner.solve(coupling).T
        unit = np.abs(here.y[-t:]) / 2
        schur = (matrix.border[g:, g:] - explained) * np.outer(unit, unit)
        values, vectors = np.linalg.eigh((schur + schur.T) / 2)
        if values[0] >= 1.0:
            return matrix.factor(), em
        mended = (vectors * np.maximum(np.abs(values), 1.0)) @ vectors.T / np.outer(unit, unit)
        border = matrix.border.copy()
        border[g:, g:] = mended + explained
        return Arrow(border, matrix.edge, matrix.blocks, t).factor(), True
    raise DegenerateError(
        "the stars with weight do not determine the model",
        where="posterior",
        do="lower model.order, or check how many stars are false matches",
    )


def _expand(target: Target, split: Split, y: Float, at: Float, *, em: bool = False) -> _Expansion:
    """`Target.expand` in the coordinates y, at a point of the grid."""
    n, (held, rest) = target.n_theta, split.columns
    value, gradient, matrix = target.expand(split.to_psi(y, at), em=em)
    _, h1, h2, g1, g2 = from_cube_root(split.rest, y[n:])
    by_h = gradient[n:][rest]
    bend = -by_h * h2 - g2

    g = matrix.n_global
    fixed = [g + k for k in held]
    free = [*range(g), *(g + k for k in rest)]
    scale = np.concatenate([np.ones(g), h1])
    border = matrix.border[np.ix_(free, free)] * np.outer(scale, scale)
    tail = np.arange(g, len(free))
    border[tail, tail] += np.maximum(bend, 0.0) if em else bend
    inner = Arrow(border, matrix.edge[:, free] * scale[:, None], matrix.blocks, n_tail=len(rest))
    return _Expansion(
        y=y,
        value=value + float(split.log_jacobian(y)),
        gradient=np.concatenate([gradient[:n], by_h * h1 + g1]),
        matrix=inner,
        slope=gradient[n:][held],
        curvature=matrix.border[np.ix_(fixed, fixed)],
        coupling=inner.join(
            matrix.border[np.ix_(fixed, free)] * scale,
            np.swapaxes(matrix.edge[:, fixed], 0, 1),
        ),
    )
