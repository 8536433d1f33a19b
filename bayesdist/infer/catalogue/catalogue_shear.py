"""What of a catalogue's own linear distortion can be told from the detector's.

A catalogue made from the same telescope may itself be sheared,

    (u, v) -> (u, v) + shear_plus (u, -v) + shear_cross (v, u),

which an exposure at roll angle a sees as a shear of its detector turned by 2a.  At one roll angle,
or at angles half a turn apart, it is exactly a shear of the detector; only other angles tell the
two apart, best those a quarter of a turn apart.  (A scale or a rotation of the catalogue is one of
the detector at any angle, and is nothing that its own exposures could ever tell.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.equations.normal import NormalEquations, least_squares
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.equations.rank import null_space
from bayesdist.infer.linear import LinearFit
from bayesdist.infer.stars.shards import Compute, Matches, Shards, opened
from bayesdist.model import DistortionModel

__all__ = ["SHEARS", "CatalogueShear", "catalogue_shear", "one_roll_angle", "roll_spread"]

Float = NDArray[np.float64]

SHEARS = ("catalogue.shear_plus", "catalogue.shear_cross")
_SHAPES = np.array([[[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])

# a shear that is known no better than this is not known: 20 pixels over half of an ACS chip
KNOWN = 1e-2
ONE_ROLL = 2.0  # degrees: roll angles that scatter by less are one


@dataclass(frozen=True, eq=False)
class CatalogueShear:
    """A shear of the catalogue, fitted together with everything else.

    Parameters
    ----------
    value : ndarray, shape (2,)
        shear_plus and shear_cross.
    cov : ndarray, shape (2, 2)
        With the detector's parameters and all frames free.
    roll_spread : float
        Of the exposures, see `roll_spread`.
    """

    value: Float
    cov: Float
    roll_spread: float

    @property
    def sigma(self) -> Float:
        """Standard deviations, shape (2,)."""
        return np.asarray(np.sqrt(np.diag(self.cov)))


def roll_spread(angles: ArrayLike) -> float:
    """How far roll angles differ, as far as shears can tell: 1 - |mean of exp(2 i angle)|.

    Parameters
    ----------
    angles : array_like, shape (E,)
        Radians.

    Returns
    -------
    float
        0 for one angle, or two half a turn apart; 2 s^2 for angles that scatter by a small s; 1 for
        angles all around, or two a quarter of a turn apart.
    """
    return float(1.0 - abs(np.exp(2j * np.asarray(angles, float)).mean()))


def one_roll_angle(angles: ArrayLike) -> bool:
    """Whether exposures at these angles (E,), in radians, see a shear of the catalogue alike."""
    return roll_spread(angles) < 2.0 * np.radians(ONE_ROLL) ** 2


# matrices here are small: more BLAS threads only get in each other's way
@threadpool_limits.wrap(limits=1, user_api="blas")
def catalogue_shear(
    fit: LinearFit,
    matches: Matches | Shards,
    *,
    priors: GaussianPriors | None = None,
    compute: Compute | None = None,
) -> CatalogueShear:
    """Fit a shear of the catalogue on top of a joint fit: one more pass over the data.

    Parameters
    ----------
    fit : LinearFit
        Of several exposures with frames that rotate.
    matches : MatchTable, PartitionedMatches or Shards
        Those of the fit.
    priors : GaussianPriors, optional
        Those of the fit.
    compute : Compute, optional

    Returns
    -------
    CatalogueShear

    Raises
    ------
    InputError
        For a model whose frames do not rotate.
    DegenerateError
        When the exposures cannot tell the catalogue's shear from the detector's, naming the
        parameters that are degenerate with it.
    """
    model = fit.model
    if "rotation" not in model.free_frame_names(1):
        raise InputError(
            f"frames '{model.frames}' hold no roll angle",
            where="model.frames",
            do="choose 'shift_rotation' or a more general kind",
        )
    priors = priors or GaussianPriors.none(model)
    with opened(model, matches, compute) as shards:
        rule = (fit.clip.theta, fit.clip.chi2_limit, fit.clip.abs_limit)
        equations = shards.sum(least_squares, fit.mean, *rule)
    derivative = _derivative(equations)
    weighted = _times(equations, derivative)
    matrix, right = replace(equations, cross=weighted).assemble(model, fit.mean)
    tail = slice(model.n_global, model.n_global + 2)
    matrix.border[tail, tail] += np.einsum("ghak,giak->hi", weighted, derivative)
    matrix = matrix + priors.matrix(model, 2)
    own = np.einsum("ghak,gak->h", derivative, equations.right)
    right = np.concatenate([right + priors.pull(fit.mean), own])

    rolls = np.array([np.arctan2(M[1, 0], M[0, 0]) for M in _frames(fit, equations)])
    space = null_space(matrix, (*model.names, *SHEARS))
    with_shear = [d for d in space.directions if any(name in SHEARS for name in d)]
    if with_shear:
        _refuse(with_shear[0], rolls, model)
    factor = matrix.factor()
    unit = np.zeros((2, matrix.size))
    unit[:, -2:] = np.eye(2)
    cov = factor.solve(unit)[:, -2:]
    cov = (cov + cov.T) / 2
    if np.sqrt(cov.diagonal().max()) > KNOWN:
        direction = factor.solve(unit[int(np.argmax(cov.diagonal()))])
        scale = np.sqrt(matrix.diagonal())
        largest = np.argsort(-np.abs(direction * scale))[:6]
        _refuse(tuple((*model.names, *SHEARS)[k] for k in largest), rolls, model)
    return CatalogueShear(factor.solve(right)[-2:], cov, roll_spread(rolls))


def _derivative(equations: NormalEquations) -> Float:
    """Change of the effective coefficients (G, 2, 2, K) with each shear."""
    return np.asarray(np.einsum("hab,gbk->ghak", _SHAPES, equations.about))


def _times(equations: NormalEquations, d: Float) -> Float:
    """Weight times changes of the effective coefficients (G, h, 2, K)."""
    uu, uv, vv = (equations.weight[:, k] for k in range(3))
    u = np.einsum("gkl,ghl->ghk", uu, d[:, :, 0]) + np.einsum("gkl,ghl->ghk", uv, d[:, :, 1])
    v = np.einsum("gkl,ghl->ghk", uv, d[:, :, 0]) + np.einsum("gkl,ghl->ghk", vv, d[:, :, 1])
    return np.stack([u, v], axis=2)


def _frames(fit: LinearFit, equations: NormalEquations) -> list[Float]:
    """Linear parts of the frames of the exposures that have stars."""
    return [fit.model.frame(fit.mean, int(e))[0] for e in np.unique(equations.groups.exposure)]


def _refuse(direction: tuple[str, ...], rolls: Float, model: DistortionModel) -> None:
    frames = {p.name for p in model.parameters if p.kind == "frame" and "shear" in p.name}
    do = "trust the catalogue's axes, or add exposures at another roll angle"
    if one_roll_angle(rolls):
        reason = "all exposures have one roll angle, or angles half a turn apart"
    elif frames & set(direction):
        reason = f"the frame '{model.frames}' of each exposure absorbs any shear"
        do = "choose model.frames = 'shift_rotation', or give the shears of exposures priors"
    else:
        reason = "the roll angles of the exposures are too much alike"
    named = sorted(set(SHEARS) & set(direction)) or [SHEARS[0]]
    others = [name for name in direction if name not in SHEARS]
    raise DegenerateError(
        f"{', '.join([*named, *others])} are degenerate: {reason}, so that a shear of the "
        "catalogue is one of the detector",
        where="model",
        do=do,
    )
