"""Prediction of stars that were not fitted, and comparison of held-out stars with it.

The predictive density of the residual r of a star is

    p(r) = (1 - f) N(r; 0, S) + f p_out(r)      S = diag(s_u^2 + j^2, s_v^2 + j^2) + J C J^T

with the fraction f and the density p_out of false matches.  Here s are the star's quoted errors, j
is the jitter, J are the derivatives of the position with respect to the parameters, and C is the
covariance of the parameters.  For a campaign, S also includes the errors of the look-up tables at
the position.  In addition, a prediction knows the scatter of the exposures, and the part of s that
is due to the catalogue.

Held-out stars are compared with their prediction group by group.  A star of an exposure that was
fitted is predicted directly.  An exposure that was held out entirely has no frame yet: a frame is
fitted to its stars, and what the stars lose to it is subtracted from the covariance of their
residuals.  If the polynomials belong to no exposure, they and the residuals are along the detector
axes: errors that are fixed on the detector would otherwise average out over exposures of many roll
angles.

**Frames of exposures that were held out entirely.**  The prior on a campaign's exposures, their
scatter, enters the fit.  Let F be the information of the stars, P the precision of the scatter, A
the derivatives of positions with respect to the frame, and Sigma the errors of the stars without
those of the solution.  The error of the fitted frame then has the covariance (F + P)^-1, and the
residuals have the covariance Sigma - A (F + P)^-1 A^T instead of Sigma + A P^-1 A^T.  P is zero
without a prior.  The result holds if the weights are the inverse of Sigma.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import ndtr, ndtri

from bayesdist.data.matches import Matches
from bayesdist.infer.catalogue.star_covariance import StarInfluence
from bayesdist.infer.equations.scaled import determined
from bayesdist.infer.posterior import Posterior
from bayesdist.infer.stars.stars import errors_of
from bayesdist.model import DistortionModel, Groups, LookupTable
from bayesdist.model.frames import RIGID, frame_names, nearest_frame
from bayesdist.utils.arrays import Float, Int

NEVER = 1e-300
AT_ONCE = 2**14  # stars evaluated together
SCALES = np.geomspace(0.5, 4.0, 13)  # factors on the errors at which scores are evaluated
SOFT, EXACT = 10, 6  # number of steps with long-tailed weights, and with those of the mixture
REACH = 4.0  # chi-square at which the long-tailed weight is one half
STARS_PER_FRAME = 20


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
class StarPrediction:
    """Data minus prediction for stars of one group, or a part of them."""

    index: Int  # rows (n,) in their table
    residual: Float  # data minus prediction (n, 2)
    columns: Int  # indices (m,) of the parameters that the prediction depends on
    jacobian: Float  # derivatives (n, 2, m) of the prediction with respect to these
    frame: Float  # linear part (2, 2) of the frame of the exposure


def predictions(
    model: DistortionModel, theta: Float, table: Matches, rows: Int, exposure: Int | int | None
) -> Iterator[StarPrediction]:
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
            yield StarPrediction(
                index, data[index] - phi @ effective[g].T, columns, jacobian, frame
            )


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
    sigma = np.stack(errors_of(table), axis=1)[index]
    var = sigma**2 + predictive.jitter2
    if predictive.local and not predictive.local_in_noise:
        place = (table.x[index], table.y[index], table.chip_number[index])
        var = var + predictive.local_variance(*place)[:, None]
    mixed = np.zeros(len(var)) if table.rho_uv is None else table.rho_uv[index] * sigma.prod(axis=1)
    return np.column_stack([var, mixed])


@dataclass(frozen=True, eq=False)
class HeldRows:
    """Held-out stars of one group, or a part of them, and their prediction."""

    index: Int  # rows (n,) in their table
    residual: Float  # data minus prediction (n, 2)
    cov: Float  # elements uu, vv, uv (n, 3) of the residuals' covariance
    columns: Int  # indices (m,) of the solution's parameters that the prediction depends on
    jacobian: Float  # derivatives (n, 2, m) of the prediction with respect to these
    exposure: str = ""  # name, if its frame was fitted to these stars
    frame: Frame | None = None
    by_frame: Float | None = None  # derivatives (n, 2, q) with respect to the frame's parameters
    # covariance (n, 2, m) of the catalogue's errors of these stars with the parameters
    with_solution: Float | None = None

    def turned_back(self, matrix: Float) -> HeldRows:
        """Rows rotated to the axes before a frame with the linear part `matrix` (2, 2)."""
        angle = np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])
        c, s = np.cos(angle), np.sin(angle)
        R = np.array([[c, s], [-s, c]])  # inverse of the frame's rotation
        cov = R @ self.cov[:, [0, 2, 2, 1]].reshape(-1, 2, 2) @ R.T
        return replace(
            self,
            residual=self.residual @ R.T,
            cov=cov.reshape(-1, 4)[:, [0, 3, 1]],
            jacobian=R @ self.jacobian,
            by_frame=None if self.by_frame is None else R @ self.by_frame,
            with_solution=None if self.with_solution is None else R @ self.with_solution,
        )


def predicted_rows(
    predictive: Predictive, table: Matches, frames: Mapping[str, Frame]
) -> Iterator[HeldRows]:
    """Iterate over the stars of a table that can be predicted.

    Stars of exposures that are neither in the solution nor in `frames` are left out.
    """
    model = predictive.model
    if not model.n_frame:
        yield from _known(predictive, table, np.arange(len(table)), None)
        return
    code = {name: k for k, name in enumerate(model.exposures)}
    codes = np.array([code.get(name, -1) for name in table.exposure_names], np.int64)
    is_fitted = codes[table.exposure] >= 0
    rows = np.flatnonzero(is_fitted)
    yield from _known(predictive, table, rows, codes[table.exposure[rows]])
    for k in np.unique(table.exposure[~is_fitted]):
        name = table.exposure_names[k]
        if name in frames:
            yield from _framed(
                predictive, table, np.flatnonzero(table.exposure == k), name, frames[name]
            )


def _known(
    predictive: Predictive, table: Matches, rows: Int, exposure: Int | None
) -> Iterator[HeldRows]:
    """Iterate over rows (n,) with a frame, if any, that belongs to the solution."""
    if not len(rows):
        return
    for prediction in predictions(predictive.model, predictive.mean, table, rows, exposure):
        C = predictive.cov[np.ix_(prediction.columns, prediction.columns)]
        cov = noise_of(predictive, table, prediction.index) + _squares(prediction.jacobian, C)
        held_rows = HeldRows(
            prediction.index, prediction.residual, cov, prediction.columns, prediction.jacobian
        )
        yield (
            held_rows.turned_back(prediction.frame)
            if predictive.model.gauge == "held"
            else held_rows
        )


def _framed(
    predictive: Predictive, table: Matches, rows: Int, name: str, frame: Frame
) -> Iterator[HeldRows]:
    """Iterate over rows (n,) of an exposure with a separately fitted frame."""
    n = predictive.model.n_distortion
    C = predictive.cov[:n, :n]
    for prediction, by_solution, by_frame in framed(predictive, table, rows, frame.values):
        index = prediction.index
        # errors of the solution that the frame absorbs are no errors of the prediction
        jacobian = by_solution - by_frame @ (frame.spent @ frame.shared)
        noise = noise_of(predictive, table, index)
        cov = noise + _squares(jacobian, C) - _squares(by_frame, frame.spent)
        common = None
        if predictive.stars is not None and table.star is not None:
            epoch = None if table.epoch is None else table.epoch[index]
            common = predictive.stars.with_solution(table.star[index], epoch)
            shared = np.einsum("nam,nbm->nab", common, jacobian)
            shared = (shared + np.swapaxes(shared, 1, 2)).reshape(-1, 4)
            cov -= shared[:, [0, 3, 1]]
        cov[:, :2] = np.maximum(cov[:, :2], 0.05 * noise[:, :2])
        residual, columns = prediction.residual, np.arange(n)
        held_rows = HeldRows(index, residual, cov, columns, jacobian, name, frame, by_frame, common)
        yield (
            held_rows.turned_back(prediction.frame)
            if predictive.model.gauge == "held"
            else held_rows
        )


def _squares(J: Float, C: Float) -> Float:
    """Elements uu, vv and uv (n, 3) of J C J^T."""
    JC = J @ C
    return np.stack([(JC[:, i] * J[:, k]).sum(axis=1) for i, k in ((0, 0), (1, 1), (0, 1))], axis=1)


@dataclass(frozen=True, eq=False)
class Frame:
    """Frame of an exposure that was held out entirely."""

    names: tuple[str, ...]  # names of its parameters, including deviations of single chips
    values: Float  # (q,)
    # (q, q) covariance of their errors: inverse of the information from the stars and the prior
    spent: Float
    # (q, n) information between the frame and the solution's polynomials and drift
    shared: Float
    precision: Float  # (q,) prior precision of each parameter from the scatter
    n: int  # number of stars


def _alone(model: DistortionModel) -> DistortionModel:
    """Model of one exposure, after a dummy exposure that defines the gauge and has no stars."""
    return replace(model, exposures=("(release)", "(held out)"))


def framed(
    predictive: Predictive, table: Matches, index: Int, values: Float
) -> Iterator[tuple[StarPrediction, Float, Float]]:
    """Iterate over rows (n,) of one exposure, predicted with a frame of given parameters (q,).

    Each item contains the prediction and the derivatives (n, 2, n_distortion) with respect to
    polynomials and drift, and (n, 2, q) with respect to the frame.
    """
    model, n = _alone(predictive.model), predictive.model.n_distortion
    theta = np.zeros(model.n_params)
    theta[:n] = predictive.mean[:n]
    frame_columns = model.frame_slice(1)
    theta[frame_columns] = values
    for prediction in predictions(model, theta, table, index, 1):
        derivative = np.zeros((len(prediction.index), 2, model.n_params))
        derivative[:, :, prediction.columns] = prediction.jacobian
        yield prediction, derivative[:, :, :n], derivative[:, :, frame_columns]


def frames_for(predictive: Predictive, held: Matches, names: Sequence[str]) -> dict[str, Frame]:
    """Fit frames to exposures that the solution does not include, using their stars.

    The held-out stars are read once per step.  Exposures with too few stars are left out.
    """
    unknown = [name for name in names if name not in set(predictive.model.exposures)]
    if not predictive.model.n_frame or not unknown:
        return {}
    model = _alone(predictive.model)
    kinds = model.free_frame_names(1)
    precision = np.zeros(len(kinds))
    if predictive.deviations is not None:
        precision = predictive.deviations.precision(kinds)
    values = _first_guess(predictive, held, unknown, precision)
    for step in range(SOFT + EXACT):
        sums = _frame_sums(predictive, held, values, soft=step < SOFT)
        for name, (gradient, curvature, *_) in sums.items():
            pull = gradient - precision * values[name]
            root = determined(curvature + np.diag(precision))
            values[name] = values[name] + root @ (root.T @ pull)
    final = _frame_sums(predictive, held, values, soft=False)
    out = {}
    for name, (_, _, information, shared, n) in final.items():
        root = determined(information + np.diag(precision))
        out[name] = Frame(kinds, values[name], root @ root.T, shared, precision, n)
    return out


def _of_exposures(held: Matches, names: Sequence[str]) -> Iterator[tuple[str, Matches, Int]]:
    """Iterate over name, table and rows of the given exposures."""
    for table in held.batches():
        for k, name in enumerate(table.exposure_names):
            if name in names:
                rows = np.flatnonzero(table.exposure == k)
                if len(rows):
                    yield name, table, rows


def _first_guess(
    predictive: Predictive, held: Matches, names: Sequence[str], precision: Float
) -> dict[str, Float]:
    """Frames nearest to the linear maps from a least-squares fit."""
    model = predictive.model
    kind, o = model.frames, np.asarray(model.origin)
    normal = {name: np.zeros((3, 3)) for name in names}
    right = {name: np.zeros((3, 2)) for name in names}
    for name, table, rows in _of_exposures(held, names):
        groups = groups_of(model, table, rows, None)
        effective = model.effective(predictive.mean, groups)
        for g, members in enumerate(groups.members()):
            index = rows[members]
            basis = model.basis(model.chips[groups.chip[g]].number)
            w = basis.evaluate(table.x[index], table.y[index]) @ effective[g].T
            A = np.column_stack([np.ones(len(w)), w - o])
            normal[name] += A.T @ A
            right[name] += A.T @ (np.stack([table.u, table.v], axis=1)[index] - o)
    out = {}
    for name, N in normal.items():
        if N[0, 0] < STARS_PER_FRAME:
            continue
        coefficients = np.linalg.lstsq(N, right[name])[0]
        frame = nearest_frame(kind, coefficients[1:].T, coefficients[0])
        if kind == "shift":
            frame = (right[name][0] - N[0, 1:]) / N[0, 0]
        values = np.zeros(len(precision))
        for k, part in enumerate(frame_names(kind)):
            # start parameters with a prior at its mean; the pointing has none
            values[k] = frame[k] if part in RIGID or not precision[k] else 0.0
        out[name] = values
    return out


def _frame_sums(
    predictive: Predictive, held: Matches, values: Mapping[str, Float], *, soft: bool
) -> dict[str, tuple[Float, Float, Float, Float, int]]:
    """Gradient, curvature, information, cross-information with the solution and number of stars.

    Returns them by the name of the exposure.  `soft` selects the long-tailed weights.
    """
    q, D = _alone(predictive.model).n_frame, predictive.model.n_distortion
    shapes = ((q,), (q, q), (q, q), (q, D))
    out = {name: [np.zeros(shape) for shape in shapes] for name in values}
    count = dict.fromkeys(values, 0)
    for name, table, index in _of_exposures(held, list(values)):
        for prediction, by_solution, A in framed(predictive, table, index, values[name]):
            residual, noise = prediction.residual, noise_of(predictive, table, prediction.index)
            # covariances from their elements uu, vv, uv
            weight = np.linalg.inv(noise[:, [[0, 2], [2, 1]]])
            pull = np.einsum("nab,nb->na", weight, residual)
            chi2 = (residual * pull).sum(axis=1)
            if soft:
                score = pull / (1 + chi2 / REACH)[:, None]
            else:
                score = scores_of(predictive, residual, noise).place
            # curvature of a Gaussian with the same weights, so that steps never overshoot
            share = (score * residual).sum(axis=1) / np.maximum(chi2, 1e-300)
            share = np.clip(share, 0.0, 1.0)
            along = np.einsum("na,nam->nm", score, A)
            gradient, curvature, information, shared = out[name]
            gradient += along.sum(axis=0)
            curvature += np.einsum("n,nab,nam,nbk->mk", share, weight, A, A, optimize=True)
            information += along.T @ along
            shared += along.T @ np.einsum("na,nam->nm", score, by_solution)
            count[name] += len(residual)
    return {name: (a, b, c, d, count[name]) for name, (a, b, c, d) in out.items()}
