"""Laplace approximation of the posterior at a point of the proposal's grid.

The grid fixes the jitter, or the jitter and the outlier scale.  The mode is found by Newton's
method on the mixture.  Where the full Hessian is not positive definite, it is replaced by the one
with EM weights.  Steps far from the mode are thus EM steps; near it, convergence is quadratic.

With few outliers logit f and log s_out are skewed, with exponential tails that a Gaussian proposal
does not cover.  The cube root of a gamma variable is nearly Gaussian (Wilson and Hilferty 1931), so
the approximation is made in

    f^(1/3)     and     s_out^(-2/3)  (the cube root of the outliers' precision)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.errors import DegenerateError
from bayesdist.infer.density.target import Target
from bayesdist.infer.equations.arrow import Arrow, ArrowFactor
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.utils.arrays import Bool, Float

MAX_STEPS = 60
UNSEEN = 1e-8  # below this decrement rounding may hide the gain: the step is taken unchecked
ON_A_RIDGE = 1e-2  # decrement at which a search stops if the curvature had to be made positive


@dataclass(frozen=True, eq=False)
class Node:
    """Laplace approximation of the parameters y, conditional on a point of the grid.

    y = (theta, cube-root hyperparameters); see `Split`.
    """

    at: Float  # coordinates of the grid point (g,)
    mode: Float  # y (D',) at the conditional mode
    # factor of minus the Hessian at the last step of the search, made positive if necessary
    factor: ArrowFactor
    # Laplace estimate of the log marginal posterior density at the grid point, up to a constant
    log_marginal: float


@dataclass(frozen=True, eq=False)
class Conditional(Node):
    """A `Node` with the derivatives needed to search for adjacent nodes.

    All derivatives are with respect to the grid coordinates.
    """

    tangent: Float  # derivative (g, D') of the mode; predicts the mode of an adjacent node
    slope: Float  # gradient (g,) of the log posterior along the conditional modes
    curvature: Float  # minus the Hessian (g, g) of the log posterior along the conditional modes


def starting_point(target: Target, fit: LinearFit) -> Float:
    """Starting point psi (D,) of the search for the mode.

    Theta is that of the linear fit; the hyperparameters are estimated from its rejected stars.
    """
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
    """Find the conditional mode at the grid coordinates `at` (g,), starting from y (D',).

    The search ends when the Newton decrement (expected gain in log density) is below `tolerance`.
    Along a ridge, where the curvature is not positive, it ends at `ON_A_RIDGE`, since many more
    steps would gain little.  Raises DegenerateError if no maximum is found, or if its curvature is
    not positive.
    """
    current = _expand(target, split, y, at)
    for _ in range(MAX_STEPS):
        factor, mended = _positive(target, split, current, at)
        step = factor.solve(current.gradient)
        decrement = 0.5 * float(current.gradient @ step)
        if decrement < (max(tolerance, ON_A_RIDGE) if mended else tolerance):
            y = y + step if split.contains(y + step) else y
            break
        length, moved = 1.0, False
        for _ in range(40):
            trial = y + length * step
            if split.contains(trial):
                candidate = _expand(target, split, trial, at)
                if candidate.value - current.value > 1e-4 * length * decrement:
                    y, current, moved = trial, candidate, True
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
    # no further pass over the data: to second order the gain of the last step is its decrement
    gain = float(current.gradient @ (y - current.y)) / 2
    tangent = -factor.solve(current.coupling) if len(at) else current.coupling
    return Conditional(
        at=at,
        mode=y,
        factor=factor,
        log_marginal=current.value + gain - 0.5 * factor.logdet,
        tangent=tangent,
        slope=current.slope - current.coupling @ (y - current.y),
        curvature=current.curvature + current.coupling @ tangent.T,
    )


def expected_mode(split: Split, node: Conditional, step: Float) -> Float:
    """Predicted mode (D',) at a grid point displaced by `step` (g,) from a node.

    The mode of the node is extrapolated along its tangent.  If this leaves the support (an outlier
    fraction below zero or above one), the mode of the node is returned.
    """
    y = node.mode + step @ node.tangent
    return y if split.contains(y) else node.mode


@dataclass(frozen=True, eq=False)
class _Expansion:
    """Second-order expansion of the log posterior about y (D',) at a point of the grid.

    `value`, `gradient` and `matrix` (minus the Hessian) belong to y.  `slope` (g,) and `curvature`
    (g, g) are the gradient and minus the Hessian with respect to the grid coordinates; `coupling`
    (g, D') is minus the mixed second derivatives.
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
    """Factor of minus the Hessian, made positive definite, and True if it had to be modified.

    The distortion part falls back to the EM weights.  The eigenvalues of the hyperparameters' Schur
    complement are raised to at least one, in units of half the hyperparameters' values: where
    outliers cannot be separated from the core, the posterior is flat or even convex in f and s_out.
    """
    for em in (False, True):
        matrix = _expand(target, split, here.y, at, em=True).matrix if em else here.matrix
        without_tail = matrix.without_tail()
        try:
            inner = without_tail.factor()
        except np.linalg.LinAlgError:
            continue
        t, g = matrix.n_tail, matrix.n_global
        if not t:
            return inner, em
        coupling = np.array(
            [without_tail.join(matrix.border[:g, g + k], matrix.edge[:, g + k]) for k in range(t)]
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
        return replace(matrix, border=border).factor(), True
    raise DegenerateError(
        "the stars with weight do not determine the model",
        where="posterior",
        do="lower model.order, or check how many stars are false matches",
    )


def _expand(target: Target, split: Split, y: Float, at: Float, *, em: bool = False) -> _Expansion:
    """Expansion of the log posterior in the coordinates y: `Target.expand`, transformed."""
    n, (held, off_grid) = target.n_theta, split.columns
    value, gradient, matrix = target.expand(split.to_psi(y, at), em=em)
    _, h1, h2, g1, g2 = from_cube_root(split.rest, y[n:])
    by_h = gradient[n:][off_grid]
    bend = -by_h * h2 - g2

    g = matrix.n_global
    fixed = [g + k for k in held]
    free = [*range(g), *(g + k for k in off_grid)]
    scale = np.concatenate([np.ones(g), h1])
    border = matrix.border[np.ix_(free, free)] * np.outer(scale, scale)
    tail = np.arange(g, len(free))
    border[tail, tail] += np.maximum(bend, 0.0) if em else bend
    inner = Arrow(
        border, matrix.edge[:, free] * scale[:, None], matrix.blocks, len(off_grid), matrix.parts
    )
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


# -- coordinates of the nodes ----------------------------------------------------------------------


def to_cube_root(names: tuple[str, ...], h: Float) -> Float:
    """Convert sampled coordinates h (..., k) to cube-root coordinates (..., k).

    `names` are the hyperparameters along the last axis of h: 'f' (logit f), 's_out' (log s_out).
    """
    out = np.empty_like(h)
    for k, name in enumerate(names):
        t = h[..., k]
        out[..., k] = (1 + np.exp(-t)) ** (-1 / 3) if name == "f" else np.exp(-2 * t / 3)
    return out


def inside(names: tuple[str, ...], z: Float) -> Bool:
    """Boolean mask (...) that is True for cube-root coordinates z (..., k) in the support."""
    ok = np.all(z > 0, axis=-1)
    if "f" in names:
        ok &= z[..., names.index("f")] < 1
    return np.asarray(ok)


def from_cube_root(names: tuple[str, ...], z: Float) -> tuple[Float, Float, Float, Float, Float]:
    """Convert cube-root coordinates to sampled coordinates, with derivatives.

    `z` (..., k) are points in the support, `names` the hyperparameter ('f' or 's_out') of each
    coordinate.  Returns h (logit f or log s_out), its first and second derivatives h1 and h2 with
    respect to z, and the first and second derivatives of log |h1|, each of shape (..., k).
    """
    h, h1, h2 = np.empty_like(z), np.empty_like(z), np.empty_like(z)
    g1, g2 = np.empty_like(z), np.empty_like(z)
    for k, name in enumerate(names):
        t = z[..., k]
        if name == "f":
            a, b = 1 - 4 * t**3, t - t**4
            h[..., k] = 3 * np.log(t) - np.log1p(-(t**3))
            h1[..., k], h2[..., k] = 3 / b, -3 * a / b**2
            g1[..., k], g2[..., k] = -a / b, (12 * t**2 * b + a**2) / b**2
        else:
            h[..., k] = -1.5 * np.log(t)
            h1[..., k], h2[..., k] = -1.5 / t, 1.5 / t**2
            g1[..., k], g2[..., k] = -1 / t, 1 / t**2
    return h, h1, h2, g1, g2


@dataclass(frozen=True)
class Split:
    """Division of the sampled coordinates into those on a grid and those that are Gaussian.

    Points psi (..., D) are split into the coordinates `at` (..., g) on the grid, such as log j and
    log s_out, and y (..., D'): theta and the other hyperparameters in cube-root coordinates.
    """

    n_theta: int
    hyper: tuple[str, ...]  # hyperparameters that are sampled, in the order 'j', 'f', 's_out'
    held: tuple[str, ...]  # hyperparameters on the grid; includes 'j' if it is sampled

    @property
    def rest(self) -> tuple[str, ...]:
        """Hyperparameters that are not on the grid."""
        return tuple(name for name in self.hyper if name not in self.held)

    @property
    def columns(self) -> tuple[list[int], list[int]]:
        """Indices in `hyper` of the hyperparameters on the grid, and of the remaining ones."""
        held = [self.hyper.index(name) for name in self.held]
        return held, [self.hyper.index(name) for name in self.rest]

    def contains(self, y: Float) -> Bool:
        """Boolean mask (...) that is True for points y (..., D') in the support."""
        return np.isfinite(y).all(axis=-1) & inside(self.rest, y[..., self.n_theta :])

    def to_psi(self, y: Float, at: Float) -> Float:
        """Sampled coordinates psi (..., D) from y (..., D') and grid coordinates (..., g)."""
        n, (held, off_grid) = self.n_theta, self.columns
        out = np.empty((*y.shape[:-1], n + len(self.hyper)))
        out[..., :n] = y[..., :n]
        out[..., [n + k for k in held]] = at
        out[..., [n + k for k in off_grid]] = from_cube_root(self.rest, y[..., n:])[0]
        return out

    def from_psi(self, psi: Float) -> tuple[Float, Float]:
        """Split psi (..., D) into y (..., D') and the grid coordinates (..., g)."""
        n, (held, off_grid) = self.n_theta, self.columns
        z = to_cube_root(self.rest, psi[..., [n + k for k in off_grid]])
        return np.concatenate([psi[..., :n], z], axis=-1), psi[..., [n + k for k in held]]

    def log_jacobian(self, y: Float) -> Float:
        """Log of the determinant of d psi / d y, of shape (...), for y (..., D')."""
        h1 = from_cube_root(self.rest, y[..., self.n_theta :])[1]
        return np.asarray(np.log(np.abs(h1)).sum(axis=-1))
