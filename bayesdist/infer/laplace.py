"""Mode and curvature of the posterior at a given jitter.

Newton's method on the mixture, with the EM weights wherever the full Hessian is not positive: far
from the mode steps are EM steps, near it convergence is quadratic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import DegenerateError
from bayesdist.infer.arrow import Arrow, ArrowFactor
from bayesdist.infer.coordinates import from_cube_root, inside, to_cube_root
from bayesdist.infer.linear import LinearFit
from bayesdist.infer.target import Target

__all__ = ["Conditional", "conditional_mode", "expected_mode", "starting_point"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Conditional:
    """Laplace approximation of everything else at one value of log j.

    Coordinates are y = (theta, cube-root hyperparameters): see `coordinates`.

    Parameters
    ----------
    log_j : float or None
        None where the jitter is not sampled.
    mode : ndarray, shape (D',)
    factor : ArrowFactor
        Of minus the Hessian at the mode.
    log_marginal : float
        Laplace estimate of the log posterior density of log j, up to a constant.
    tangent : ndarray, shape (D',), optional
        Derivative of the mode by log j: where the search at a neighbour begins.
    slope, curvature : float
        First derivative by log j of the log posterior along the modes, and minus the second.
    """

    log_j: float | None
    mode: Float
    factor: ArrowFactor
    log_marginal: float
    tangent: Float | None = None
    slope: float = 0.0
    curvature: float = 0.0

    def ahead(self, step: float) -> Float:
        """Where the mode lies, to first order, when log j is larger by `step`."""
        return self.mode if self.tangent is None else self.mode + step * self.tangent


def split_hyper(target: Target) -> tuple[bool, tuple[str, ...]]:
    """Whether log j is sampled, and the other hyperparameters."""
    names = target.mixture.hyper
    return names[:1] == ("j",), tuple(n for n in names if n != "j")


def to_psi(target: Target, y: Float, log_j: Float | float | None) -> Float:
    """Sampled coordinates psi (..., D) from y (..., D') and log j."""
    has_j, rest = split_hyper(target)
    n = target.n_theta
    h = from_cube_root(rest, y[..., n:])[0]
    parts = [y[..., :n]]
    if has_j:
        parts.append(np.broadcast_to(np.asarray(log_j, float), y.shape[:-1])[..., None])
    return np.concatenate([*parts, h], axis=-1)


def starting_point(target: Target, fit: LinearFit) -> tuple[Float, float | None]:
    """Where to begin: the linear fit, and hyperparameters from what it rejected.

    Parameters
    ----------
    target : Target
    fit : LinearFit

    Returns
    -------
    y : ndarray
        (theta, cube-root hyperparameters).
    log_j : float or None
    """
    has_j, rest = split_hyper(target)
    scale = target.hyper.scale
    excess = max(fit.chi2 / max(fit.dof, 1) - 1.0, 0.0)
    f = np.clip(fit.n_rejected / fit.n_rows, 0.5 / fit.n_rows, 0.9)
    s_out = 5 * scale
    if fit.n_rejected > 2:
        s_out = max(s_out, fit.rms_rejected)
    natural = {"f": f, "s_out": s_out}
    h = np.array([np.log(v / (1 - v)) if k == "f" else np.log(v) for k, v in natural.items()])
    h = h[[list(natural).index(k) for k in rest]] if rest else np.zeros(0)
    log_j = float(np.log(scale * np.sqrt(max(excess, 0.1)))) if has_j else None
    return np.concatenate([fit.mean, to_cube_root(rest, h)]), log_j


def conditional_mode(
    target: Target,
    y: Float,
    log_j: float | None,
    *,
    tolerance: float = 1e-9,
    max_steps: int = 60,
) -> Conditional:
    """Mode of the posterior of everything but log j.

    Parameters
    ----------
    target : Target
    y : ndarray, shape (D',)
        Starting point.
    log_j : float or None
    tolerance : float
        The Newton decrement (expected gain in log density) at which to stop.
    max_steps : int

    Returns
    -------
    Conditional

    Raises
    ------
    DegenerateError
        When no maximum is found, or the curvature there is not positive.
    """
    here = _expand(target, y, log_j)
    for _ in range(max_steps):
        factor = _positive(target, here.matrix, y, log_j)
        step = factor.solve(here.gradient)
        decrement = 0.5 * float(here.gradient @ step)
        if decrement < tolerance:
            y = y + step if _valid(target, y + step) else y
            break
        length, moved = 1.0, False
        for _ in range(40):
            trial = y + length * step
            if _valid(target, trial):
                there = _expand(target, trial, log_j)
                if there.value - here.value > 1e-4 * length * decrement:
                    y, here, moved = trial, there, True
                    break
            length /= 2
        if not moved:
            if decrement < 1e-3:
                break  # rounding limits the gain: this is the mode
            raise DegenerateError(
                "the search for the posterior mode stalled",
                where="posterior",
                do="check the match, the errors and the outlier model",
            )
    else:
        raise DegenerateError(
            f"no posterior mode was found in {max_steps} Newton steps",
            where="posterior",
            do="check the match, the errors and the outlier model",
        )
    log_marginal = here.value - 0.5 * factor.logdet
    if log_j is None:
        return Conditional(None, y, factor, log_marginal)
    tangent = -factor.solve(here.coupling)
    curvature = here.curvature + float(here.coupling @ tangent)
    slope = here.slope - float(here.coupling @ (y - here.y))
    return Conditional(log_j, y, factor, log_marginal, tangent, slope, curvature)


def expected_mode(target: Target, node: Conditional, step: float) -> Float:
    """Where to begin the search at a log j that is larger by `step` than a node's.

    The tangent may lead out of the support, to a fraction above one or below none: then it is the
    node's own mode.
    """
    y = node.ahead(step)
    return y if _valid(target, y) else node.mode


@dataclass(frozen=True, eq=False)
class _Expansion:
    """Second-order expansion in the coordinates y at fixed log j, and what couples it to log j.

    `slope` and `curvature` are the first derivative by log j and minus the second; `coupling` (D',)
    is minus the mixed one.
    """

    y: Float
    value: float
    gradient: Float
    matrix: Arrow
    slope: float
    curvature: float
    coupling: Float


def _positive(target: Target, full: Arrow, y: Float, log_j: float | None) -> ArrowFactor:
    """Factor of the Hessian, made positive where it is not.

    The distortion part falls back to the EM weights.  The hyperparameters' Schur complement gets
    eigenvalues of at least one, in units of half their own value: where outliers cannot be told
    from the core, the posterior is flat in f and s_out, or even curved upwards.
    """
    for em in (False, True):
        matrix = _expand(target, y, log_j, em=True).matrix if em else full
        try:
            inner = matrix.without_tail().factor()
        except np.linalg.LinAlgError:
            continue
        t, g = matrix.n_tail, matrix.n_global
        if not t:
            return inner
        coupling = np.array(
            [inner.matrix.join(matrix.border[:g, g + k], matrix.edge[:, g + k]) for k in range(t)]
        )
        explained = coupling @ inner.solve(coupling).T
        unit = np.abs(y[-t:]) / 2
        schur = (matrix.border[g:, g:] - explained) * np.outer(unit, unit)
        values, vectors = np.linalg.eigh((schur + schur.T) / 2)
        if values[0] >= 1.0:
            return matrix.factor()
        mended = (vectors * np.maximum(np.abs(values), 1.0)) @ vectors.T / np.outer(unit, unit)
        border = matrix.border.copy()
        border[g:, g:] = mended + explained
        return Arrow(border, matrix.edge, matrix.blocks, t).factor()
    raise DegenerateError(
        "the stars with weight do not determine the model",
        where="posterior",
        do="lower model.order, or check how many stars are false matches",
    )


def _valid(target: Target, y: Float) -> bool:
    _, rest = split_hyper(target)
    return bool(np.isfinite(y).all() and inside(rest, y[target.n_theta :]))


def _log_jacobian(target: Target, y: Float) -> float:
    _, rest = split_hyper(target)
    return float(np.log(np.abs(from_cube_root(rest, y[..., target.n_theta :])[1])).sum())


def _expand(target: Target, y: Float, log_j: float | None, *, em: bool = False) -> _Expansion:
    """`Target.expand` in the coordinates y, at fixed log j."""
    has_j, rest = split_hyper(target)
    n, skip = target.n_theta, int(has_j)
    value, gradient, matrix = target.expand(to_psi(target, y, log_j), em=em)
    _, h1, h2, g1, g2 = from_cube_root(rest, y[n:])
    by_h = gradient[n + skip :]
    out = np.concatenate([gradient[:n], by_h * h1 + g1])
    bend = -by_h * h2 - g2
    inner = _change_tail(matrix, skip, h1, np.maximum(bend, 0.0) if em else bend)
    slope, curvature, coupling = 0.0, 0.0, np.zeros(len(y))
    if has_j:
        g = matrix.n_global
        row = np.concatenate([matrix.border[g, :g], matrix.border[g, g + 1 :] * h1])
        coupling = inner.join(row, matrix.edge[:, g])
        slope, curvature = float(gradient[n]), float(matrix.border[g, g])
    value += _log_jacobian(target, y)
    return _Expansion(y, value, out, inner, slope, curvature, coupling)


def _change_tail(matrix: Arrow, skip: int, h1: Float, bend: Float) -> Arrow:
    g = matrix.n_global
    keep = np.r_[np.arange(g), np.arange(g + skip, len(matrix.border))]
    scale = np.concatenate([np.ones(g), h1])
    border = matrix.border[np.ix_(keep, keep)] * np.outer(scale, scale)
    tail = np.arange(g, len(keep))
    border[tail, tail] += bend
    edge = matrix.edge[:, keep] * scale[:, None]
    return Arrow(border, edge, matrix.blocks, n_tail=len(h1))
