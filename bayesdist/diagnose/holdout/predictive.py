"""Prediction of a star that a solution has not seen: mean, covariance, and false matches.

    p(r) = (1 - f) N(r; 0, S) + f p_out(r)      S = diag(s_u^2 + j^2, s_v^2 + j^2) + J C J^T

with the star's quoted errors s, the jitter j, and the solution's own covariance C at its place.
Of a campaign S has, beside these, what the errors of the look-up tables leave at the place; and
more is known: how exposures scatter, and which part of s is an error of the star in the catalogue.
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
AT_ONCE = 2**14  # stars
SCALES = np.geomspace(0.5, 4.0, 13)  # of the errors, at which scores are taken


@dataclass(frozen=True, eq=False)
class ExposureDeviations:
    """Scatter of the exposures of a campaign about what they have in common."""

    kinds: tuple[str, ...]  # as an exposure's parameters are named
    tau: Float  # (m, k) draws of the scatter of each

    def precision(self, names: tuple[str, ...]) -> Float:
        """Inverse variances (q,) of an exposure's parameters; zero for those that are free."""
        variance = dict(zip(self.kinds, (self.tau**2).mean(axis=0), strict=True))
        return np.array([1 / variance[name] if name in variance else 0.0 for name in names])


@dataclass(frozen=True, eq=False)
class Predictive:
    """A solution as it predicts."""

    model: DistortionModel
    mean: Float  # (D,)
    cov: Float  # (D, D)
    outliers: str = "none"  # 'none', 'gaussian' or 'uniform'
    fraction: float = 0.0  # of false matches
    jitter2: float = 0.0  # squared jitter
    # standard deviation of false matches on each axis, or the radius of the match circle
    scale: float = 1.0
    free: tuple[str, ...] = ()  # those of 'j', 'f', 's_out' that are not known exactly
    # (h, h) their covariance, as squared jitter, fraction and log scale
    free_cov: Float = field(default_factory=lambda: np.zeros((0, 0)))
    # None where exposures that were held out whole have frames of which nothing is known
    deviations: ExposureDeviations | None = None
    # errors of the catalogue, which the quoted errors contain; None where each match has an error
    # of its own
    stars: StarInfluence | None = None
    # standard errors of positions that belong to places on the detector, in the unit of u and v: of
    # look-up tables, or what the model leaves out
    local: tuple[LookupTable, ...] = ()
    # pixels along x and y over which stars share these errors
    cell: tuple[float, float] | None = None
    local_in_noise: bool = False  # True where quoted errors and jitter hold them

    def local_variance(self, x: Float, y: Float, chip: Int) -> Float:
        """Variance (n,) on each axis of positions by errors that belong to places."""
        out = np.zeros(len(x))
        for table in self.local:
            here = chip == table.chip
            # frames turn the axes, and the errors on both are nearly equal
            out[here] = (table.evaluate(x[here], y[here]) ** 2).mean(axis=1)
        return out

    def outlier_density(self, r2: Float, scale: float) -> Float:
        """Density of false matches at squared distances."""
        if self.outliers == "gaussian":
            return np.exp(-0.5 * r2 / scale**2) / (2 * np.pi * scale**2)
        if self.outliers == "uniform":
            # without an edge, as in the likelihood: a pair at the rim, seen from a prediction
            # that is a little off, is no true match
            return np.full_like(r2, 1 / (np.pi * scale**2))
        return np.zeros_like(r2)


def predictive_of(posterior: Posterior) -> Predictive:
    """Prediction by means and covariances of the draws of a posterior."""
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
    """Derivatives of the log predictive density of some stars."""

    place: Float  # (n, 2) by the predicted position
    # (n, SCALES) by the logarithm of a factor on the errors of true matches, at each of several
    # factors
    spread: Float
    one: Float  # (n,) at the factor 1
    axes: Float  # (n, 2) by the logarithm of a factor on the errors along one axis alone
    axes_spread: Float  # (n, 2, SCALES) at each of several factors
    free: Float  # (n, h) by what is not known exactly of the mixture


def scores_of(predictive: Predictive, residual: Float, cov: Float) -> Scores:
    """Scores of stars.

    `residual` (n, 2) is data minus prediction, `cov` (n, 3) the uu, vv and uv of S.
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
    """Scores (n, 2, SCALES) of factors on the errors of true matches along one axis alone."""
    q = of_axis[:, :, None] * SCALES**-2.0
    here = np.exp(log_core[:, None, None] + 0.5 * (of_axis[:, :, None] - q)) / SCALES
    far = far[:, None, None]
    w = np.where(far > 0, here / np.maximum(here + far, NEVER), 1.0)
    return np.asarray(w * (q - 1))


def marginals_of(predictive: Predictive, residual: Float, cov: Float) -> Float:
    """Predictive probabilities (2, n) of less in u and in v, whatever the other is.

    `residual` and `cov` as of `scores_of`.
    """
    f, out = predictive.fraction, []
    for r, var in zip(residual.T, cov[:, :2].T, strict=True):
        out.append((1 - f) * ndtr(r / np.sqrt(var)) + f * _false_along(predictive, r)[1])
    return np.stack(out)


def uniforms_of(predictive: Predictive, residual: Float, cov: Float) -> Float:
    """Predictive probabilities (3, n) of less, uniform where the prediction is right.

    Of u; of v where u is what it is (Rosenblatt 1952), which is independent of the first; and of
    the distance that both make once they are brought to normal variables.  `predictive`, `residual`
    and `cov` as of `scores_of`.
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
    rest = np.sqrt(b - c * c / a)
    second = w * ndtr((v - c / a * u) / rest) + (1 - w) * below_v
    return np.stack([first, second, _radial(first, second)])


def _false_along(predictive: Predictive, x: Float) -> tuple[Float, Float]:
    """Density (n,) of false matches along one axis, and probability of less."""
    s = predictive.scale
    if predictive.outliers == "gaussian":
        return np.exp(-0.5 * (x / s) ** 2) / (np.sqrt(2 * np.pi) * s), ndtr(x / s)
    if predictive.outliers == "uniform":
        z = np.clip(x / s, -1.0, 1.0)
        half = np.sqrt(1 - z * z)
        return 2 * half / (np.pi * s), 0.5 + (z * half + np.arcsin(z)) / np.pi
    return np.zeros_like(x), np.zeros_like(x)


def _radial(first: Float, second: Float) -> Float:
    """Probability of a smaller sum of squares of the normal variables of two uniform ones."""
    z = ndtri(np.clip(np.stack([first, second]), 1e-300, 1 - 1e-16))
    return np.asarray(-np.expm1(-0.5 * (z**2).sum(axis=0)))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Stars of one group, or some of them, against a model."""

    index: Int  # rows (n,) of their table
    residual: Float  # data minus prediction (n, 2)
    columns: Int  # parameters (m,) that the prediction depends on
    jacobian: Float  # derivatives (n, 2, m) of the prediction by these
    frame: Float  # linear part (2, 2) of the exposure's frame


def predictions(
    model: DistortionModel, theta: Float, table: Matches, rows: Int, exposure: Int | int | None
) -> Iterator[Prediction]:
    """Iterator over some rows (n,) of a table, by chip, date and code of the exposure."""
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
    """Groups of some rows (n,) of a table, of exposures with these codes."""
    return model.groups(
        len(rows),
        epoch=None if table.epoch is None else table.epoch[rows],
        exposure=exposure,
        chip=table.chip_number[rows],
    )


def noise_of(predictive: Predictive, table: Matches, index: Int) -> Float:
    """uu, vv and uv (n, 3) of the errors of stars without those of the solution's parameters."""
    var = np.stack(errors_of(table), axis=1)[index] ** 2 + predictive.jitter2
    if predictive.local and not predictive.local_in_noise:
        place = (table.x[index], table.y[index], table.chip_number[index])
        var = var + predictive.local_variance(*place)[:, None]
    return np.column_stack([var, np.zeros(len(var))])
