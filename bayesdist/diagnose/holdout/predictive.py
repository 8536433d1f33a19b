"""Prediction of a star that was not fitted: mean, covariance, and false matches.

    p(r) = (1 - f) N(r; 0, S) + f p_out(r)      S = diag(s_u^2 + j^2, s_v^2 + j^2) + J C J^T

Here s are the star's quoted errors, j is the jitter, and C is the covariance of the solution at the
star's position.  For a campaign, S also includes the errors of the look-up tables at the position.
In addition, the scatter of the exposures is known, and the part of s that is due to the catalogue.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtr, ndtri

from bayesdist.data.matches import Matches
from bayesdist.infer.catalogue.star_errors import StarInfluence
from bayesdist.infer.posterior import Posterior
from bayesdist.infer.stars.stars import errors_of
from bayesdist.model import DistortionModel, Groups, LookupTable
from bayesdist.utils.arrays import Float, Int

NEVER = 1e-300
AT_ONCE = 2**14  # stars evaluated together
SCALES = np.geomspace(0.5, 4.0, 13)  # factors on the errors at which scores are evaluated


@dataclass(frozen=True, eq=False)
class ExposureDeviations:
    """Scatter of the exposures of a campaign about their common parameters."""

    kinds: tuple[str, ...]  # names of the exposure parameters that scatter
    tau: Float  # (m, k) draws of the scatter of each parameter

    def precision(self, names: tuple[str, ...]) -> Float:
        """Prior inverse variances (q,) of the named exposure parameters; zero for free ones."""
        variance = dict(zip(self.kinds, (self.tau**2).mean(axis=0), strict=True))
        return np.array([1 / variance[name] if name in variance else 0.0 for name in names])


@dataclass(frozen=True, eq=False)
class Predictive:
    """Predictive distribution of a solution."""

    model: DistortionModel
    mean: Float  # (D,) parameters
    cov: Float  # (D, D) their covariance
    outliers: str = "none"  # 'none', 'gaussian' or 'uniform'
    fraction: float = 0.0  # fraction of false matches
    jitter2: float = 0.0  # squared jitter
    # standard deviation of false matches per axis, or the radius of the match circle
    scale: float = 1.0
    free: tuple[str, ...] = ()  # names of the uncertain mixture parameters, from 'j', 'f', 's_out'
    # (h, h) their covariance: of the squared jitter, the fraction and the log scale
    free_cov: Float = field(default_factory=lambda: np.zeros((0, 0)))
    # None if frames of exposures that were held out entirely have no prior
    deviations: ExposureDeviations | None = None
    # catalogue errors, which are part of the quoted errors; None if the errors of all matches are
    # independent
    stars: StarInfluence | None = None
    # standard errors that depend on the position on the detector, in the unit of u and v: those of
    # look-up tables, or of structure that the model lacks
    local: tuple[LookupTable, ...] = ()
    # pixels along x and y within which stars share these errors
    cell: tuple[float, float] | None = None
    local_in_noise: bool = False  # True if quoted errors and jitter include them

    def local_variance(self, x: Float, y: Float, chip: Int) -> Float:
        """Variance (n,) per axis due to errors that depend on the position on the detector."""
        out = np.zeros(len(x))
        for table in self.local:
            on_chip = chip == table.chip
            # rotation by the frame is ignored because the errors on both axes are nearly equal
            out[on_chip] = (table.evaluate(x[on_chip], y[on_chip]) ** 2).mean(axis=1)
        return out

    def outlier_density(self, r2: Float, scale: float) -> Float:
        """Density of false matches at squared distances `r2`, for the scale `scale`."""
        if self.outliers == "gaussian":
            return np.exp(-0.5 * r2 / scale**2) / (2 * np.pi * scale**2)
        if self.outliers == "uniform":
            # no edge, as in the likelihood: a pair near the edge of the circle must not become a
            # true match because the prediction is slightly off
            return np.full_like(r2, 1 / (np.pi * scale**2))
        return np.zeros_like(r2)


def predictive_of(posterior: Posterior) -> Predictive:
    """Predictive distribution from the means and covariances of the draws of a posterior."""
    mixture, hyper = posterior.mixture, posterior.hyper
    as_sampled: dict[str, Callable[[Float], Float]] = {
        "j": np.square,
        "f": np.asarray,
        "s_out": np.log,
    }
    values = {key: as_sampled[key](hyper[key].ravel()) for key in mixture.hyper}
    mean = {key: float(value.mean()) for key, value in values.items()}
    several = np.stack(list(values.values())) if values else np.zeros((0, 2))
    scale = np.exp(mean["s_out"]) if "s_out" in mean else mixture.match_radius or 1.0
    return Predictive(
        posterior.model,
        posterior.mean,
        posterior.cov,
        outliers=mixture.model,
        fraction=mean.get("f", 0.0),
        jitter2=mean.get("j", (mixture.jitter or 0.0) ** 2),
        scale=float(scale),
        free=tuple(values),
        free_cov=np.atleast_2d(np.cov(several)) if values else np.zeros((0, 0)),
    )


@dataclass(frozen=True, eq=False)
class Scores:
    """Derivatives of the log predictive density of stars."""

    place: Float  # (n, 2) with respect to the predicted position
    # (n, SCALES) with respect to the log of a factor on the errors of true matches, at each factor
    # of `SCALES`
    spread: Float
    one: Float  # (n,) the same at the factor 1
    axes: Float  # (n, 2) with respect to the log of a factor on the errors along one axis
    axes_spread: Float  # (n, 2, SCALES) the same at each factor of `SCALES`
    free: Float  # (n, h) with respect to the uncertain parameters of the mixture


def scores_of(predictive: Predictive, residual: Float, cov: Float) -> Scores:
    """Scores of stars.

    `residual` (n, 2) is data minus prediction, and `cov` (n, 3) contains the elements uu, vv and uv
    of the predictive covariance S.
    """
    a, b, c = cov.T
    det = a * b - c * c
    u, v = residual.T
    white = np.stack([(b * u - c * v) / det, (a * v - c * u) / det], axis=1)
    q = (residual * white).sum(axis=1)
    r2, f, scale = u * u + v * v, predictive.fraction, predictive.scale
    far = f * predictive.outlier_density(r2, scale)
    height = (1 - f) / (2 * np.pi * np.sqrt(det))

    def member(factor: float | Float) -> Float:
        core = np.outer(height, factor**-2.0) * np.exp(-0.5 * np.outer(q, factor**-2.0))
        return core / np.maximum(core + far[:, None], NEVER)

    w = member(np.ones(1))[:, 0]
    w = np.where(far > 0, w, 1.0)
    several = np.where(far[:, None] > 0, member(SCALES), 1.0)
    of_axis = residual**2 / cov[:, :2]
    gaussian = predictive.outliers == "gaussian"
    outer = (1 - w) / scale**2 if gaussian else np.zeros_like(w)
    by = {
        "j": 0.5 * w * ((white**2).sum(axis=1) - (a + b) / det),
        "f": (1 - w) / max(f, 1e-12) - w / (1 - f),
        "s_out": (1 - w) * (r2 / scale**2 - 2),
    }
    return Scores(
        place=w[:, None] * white + outer[:, None] * residual,
        spread=several * (np.outer(q, SCALES**-2.0) - 2),
        one=w * (q - 2),
        axes=w[:, None] * (of_axis - 1),
        axes_spread=_along_each(np.log(np.maximum(height, NEVER)) - 0.5 * q, of_axis, far),
        free=np.stack([by[k] for k in predictive.free], axis=1)
        if predictive.free
        else np.zeros((len(q), 0)),
    )


def _along_each(log_core: Float, of_axis: Float, far: Float) -> Float:
    """Scores (n, 2, SCALES) with respect to factors on the errors of true matches on one axis."""
    q = of_axis[:, :, None] * SCALES**-2.0
    core = np.exp(log_core[:, None, None] + 0.5 * (of_axis[:, :, None] - q)) / SCALES
    far = far[:, None, None]
    w = np.where(far > 0, core / np.maximum(core + far, NEVER), 1.0)
    return np.asarray(w * (q - 1))


def marginals_of(predictive: Predictive, residual: Float, cov: Float) -> Float:
    """Predictive distribution functions (2, n) of u and of v at the data, each marginal.

    For `residual` and `cov` see `scores_of`.
    """
    f, out = predictive.fraction, []
    for r, var in zip(residual.T, cov[:, :2].T, strict=True):
        out.append((1 - f) * ndtr(r / np.sqrt(var)) + f * _false_along(predictive, r)[1])
    return np.stack(out)


def uniforms_of(predictive: Predictive, residual: Float, cov: Float) -> Float:
    """Predictive probabilities (3, n) that are uniformly distributed if the prediction is correct.

    They are the distribution functions of u, of v given u (Rosenblatt 1952), which is independent
    of the first, and of the distance after both have been transformed to normal variables.  For the
    arguments see `scores_of`.
    """
    a, b, c = cov.T
    u, v = residual.T
    f, s = predictive.fraction, predictive.scale
    core = np.exp(-0.5 * u * u / a) / np.sqrt(2 * np.pi * a)
    far, below_u = _false_along(predictive, u)
    if predictive.outliers == "uniform":
        half = np.sqrt(1 - np.clip(u / s, -1.0, 1.0) ** 2)
        below_v = np.clip(0.5 + 0.5 * v / np.maximum(s * half, NEVER), 0.0, 1.0)
    else:
        below_v = _false_along(predictive, v)[1]
    w = (1 - f) * core
    w = np.where(f * far > 0, w / np.maximum(w + f * far, NEVER), 1.0)
    first = (1 - f) * ndtr(u / np.sqrt(a)) + f * below_u
    conditional_sigma = np.sqrt(b - c * c / a)
    second = w * ndtr((v - c / a * u) / conditional_sigma) + (1 - w) * below_v
    return np.stack([first, second, _radial(first, second)])


def _false_along(predictive: Predictive, x: Float) -> tuple[Float, Float]:
    """Density (n,) and distribution function (n,) of false matches along one axis."""
    s = predictive.scale
    if predictive.outliers == "gaussian":
        return np.exp(-0.5 * (x / s) ** 2) / (np.sqrt(2 * np.pi) * s), ndtr(x / s)
    if predictive.outliers == "uniform":
        z = np.clip(x / s, -1.0, 1.0)
        half = np.sqrt(1 - z * z)
        return 2 * half / (np.pi * s), 0.5 + (z * half + np.arcsin(z)) / np.pi
    return np.zeros_like(x), np.zeros_like(x)


def _radial(first: Float, second: Float) -> Float:
    """Distribution function of the radius of two normal variables, given those of each."""
    z = ndtri(np.clip(np.stack([first, second]), 1e-300, 1 - 1e-16))
    return np.asarray(-np.expm1(-0.5 * (z**2).sum(axis=0)))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Data minus prediction for stars of one group, or a part of them."""

    index: Int  # rows (n,) in their table
    residual: Float  # data minus prediction (n, 2)
    columns: Int  # indices (m,) of the parameters that the prediction depends on
    jacobian: Float  # derivatives (n, 2, m) of the prediction with respect to these
    frame: Float  # linear part (2, 2) of the frame of the exposure


def predictions(
    model: DistortionModel, theta: Float, table: Matches, rows: Int, exposure: Int | int | None
) -> Iterator[Prediction]:
    """Iterate over rows (n,) of a table, grouped by chip, date and code of the exposure."""
    groups = groups_of(model, table, rows, exposure)
    effective = model.effective(theta, groups)
    jacobians = model.effective_jacobian(theta, groups)
    data = np.stack([table.u, table.v], axis=1)
    for g, members in enumerate(groups.members()):
        columns, d = jacobians[g]
        basis = model.basis(model.chips[groups.chip[g]].number)
        frame = np.asarray(model.frame(theta, int(groups.exposure[g]))[0])
        for start in range(0, len(members), AT_ONCE):
            index = rows[members[start : start + AT_ONCE]]
            phi = basis.evaluate(table.x[index], table.y[index])
            jacobian = np.einsum("nk,akm->nam", phi, d)
            yield Prediction(index, data[index] - phi @ effective[g].T, columns, jacobian, frame)


def groups_of(
    model: DistortionModel, table: Matches, rows: Int, exposure: Int | int | None
) -> Groups:
    """Groups of rows (n,) of a table that belong to exposures with the given codes."""
    return model.groups(
        len(rows),
        epoch=None if table.epoch is None else table.epoch[rows],
        exposure=exposure,
        chip=table.chip_number[rows],
    )


def noise_of(predictive: Predictive, table: Matches, index: Int) -> Float:
    """Covariance elements uu, vv, uv (n, 3) of stars, without the solution's errors."""
    var = np.stack(errors_of(table), axis=1)[index] ** 2 + predictive.jitter2
    if predictive.local and not predictive.local_in_noise:
        place = (table.x[index], table.y[index], table.chip_number[index])
        var = var + predictive.local_variance(*place)[:, None]
    return np.column_stack([var, np.zeros(len(var))])
