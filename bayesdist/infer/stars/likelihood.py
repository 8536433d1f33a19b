"""Outlier mixture: a model of false matches and of errors that exceed the quoted errors.

    p(r) = (1 - f) N(r_u; 0, s_u^2 + j^2) N(r_v; 0, s_v^2 + j^2) + f p_out(r)

f is the fraction of false matches and j the jitter, an additional error of all stars.  A star is a
false match in both axes or in neither.  p_out is an isotropic Gaussian of scale s_out, or uniform
on the match circle.  The Gaussian is always wider than the core: s_out^2 = s^2 + j^2 + w^2, with s
the median quoted error, and w is sampled.  Otherwise, with quoted errors that are far too small,
the two components could be exchanged, and most stars would be "outliers" of the narrow one.

If stars were matched within a circle about known nominal positions, both densities are normalised
on this circle, and f is the fraction of false matches within it.  The sampled coordinates are
log j, logit f and log w.  The priors are proper:

    f      Beta(a, b)
    j      half-Student-t with four degrees of freedom; the scale is by default the median quoted
           error
    w      inverse gamma on w^2 with shape 1; by default the mode of log w is at five times the
           core's sqrt(s^2 + j^2), which keeps an undetermined second component separate

The tails of all three priors fall at least exponentially in the sampled coordinates.  The posterior
is therefore proper even if the data are uninformative: on j if the quoted errors are correct, on w
if there are no outliers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit, gammaln, log_expit, logit

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError, required
from bayesdist.infer import kernel
from bayesdist.infer.kernel import GAUSSIAN, Constants
from bayesdist.infer.stars.stars import Stars, in_table_order, prepare
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.quantities import value_in

HYPER_NAMES = {"j": "log j", "f": "logit f", "s_out": "log s_out"}
KINDS = {"none": kernel.NO_OUTLIERS, "gaussian": kernel.GAUSSIAN, "uniform": kernel.UNIFORM}
T_DOF = 4.0  # degrees of freedom of the prior on j
OUTLIER_SHAPE = 1.0  # shape of the inverse-gamma prior on w^2
OUTLIER_MODE = 5.0  # default mode of log w: this multiple of the core's standard deviation
LEAST_EXCESS = 1e-9  # lower limit of w^2 over the core's variance, for values rounded in files
# smallest a of Beta(a, b); for a <= 1/3 the posterior of f^(1/3) may have no mode
LEAST_SHAPE = 0.5
# side of the axis (log j, log w) on which data may be uninformative, and the prior's slope there
TAILS = {"j": ("left", 1.0), "s_out": ("right", -2.0 * OUTLIER_SHAPE)}


@dataclass(frozen=True)
class OutlierMixture:
    """Model of false matches, and priors of its parameters.

    Parameters
    ----------
    model : str
        Distribution of the false matches: 'gaussian', 'uniform' on the match circle, or 'none' for
        no false matches.
    match_radius : float or Quantity, optional
        Radius of the match circle in the unit of u, v; required for 'uniform'. For matches with
        nominal positions, the likelihood accounts for the selection of stars within the circle.
    jitter : float, Quantity or None
        Additional error j of all stars in the unit of u, v; None to fit it.
    fraction_prior : tuple of float
        Parameters (a, b) of the Beta prior of the fraction f of false matches.
    jitter_scale : float or Quantity, optional
        Scale of the prior of j in the unit of u, v; by default the median quoted error.
    outlier_scale : float or Quantity, optional
        Prior mode of w for 'gaussian' outliers, in the unit of u, v, where w^2 is the variance of
        the outliers minus that of the core; by default five times the scale of the core.

    Raises
    ------
    InputError
        If the model is unknown, the radius is missing, the jitter is negative, a prior is improper,
        or a prior is given for a parameter that is not fitted.

    Examples
    --------
    >>> mixture = bd.OutlierMixture(jitter=0.0)  # quoted errors are right
    >>> mixture.model
    'gaussian'
    """

    model: str = "gaussian"
    match_radius: float | None = None
    jitter: float | None = None
    fraction_prior: tuple[float, float] = (1.0, 9.0)
    jitter_scale: float | None = None
    outlier_scale: float | None = None

    def __post_init__(self) -> None:
        if self.model not in ("gaussian", "uniform", "none"):
            raise InputError(
                f"unknown outlier model {self.model!r}",
                where="outliers.model",
                do="choose gaussian, uniform or none",
            )
        radius = _number(self.match_radius)
        if self.model == "uniform" and not (radius and 0 < radius < np.inf):
            raise InputError(
                "uniform outliers need the radius of the match circle",
                where="outliers.match_radius",
                do="give it in the unit of u, v",
            )
        if self.jitter is not None and not 0 <= _number(self.jitter) < np.inf:
            raise InputError(
                f"jitter is {self.jitter}", where="outliers.jitter", do="give 0 or more"
            )
        if self.fraction_prior[0] < LEAST_SHAPE:
            raise InputError(
                f"Beta{self.fraction_prior} puts too much weight on tiny fractions",
                where="outliers.fraction_prior",
                do=f"give a first parameter of {LEAST_SHAPE} or more",
            )
        if not all(0 < p < np.inf for p in self.fraction_prior):
            raise InputError(
                f"Beta{self.fraction_prior} is not a proper prior",
                where="outliers.fraction_prior",
                do="give two positive numbers",
            )
        sampled = {"jitter_scale": "j", "outlier_scale": "s_out"}
        for key, name in sampled.items():
            value = _number(getattr(self, key))
            if value is None:
                continue
            if not 0 < value < np.inf:
                raise InputError(
                    f"{key} is {value}", where=f"outliers.{key}", do="give a positive number"
                )
            if name not in self.hyper:
                raise InputError(
                    f"{key} is the prior of {name}, which is not fitted",
                    where=f"outliers.{key}",
                    do="leave it out",
                )

    @property
    def hyper(self) -> tuple[str, ...]:
        """Names of the hyperparameters that are fitted, in the order 'j', 'f', 's_out'."""
        out: tuple[str, ...] = () if self.jitter is not None else ("j",)
        if self.model != "none":
            out += ("f",)
        if self.model == "gaussian":
            out += ("s_out",)
        return out

    def in_unit(self, unit: str) -> OutlierMixture:
        """Convert all Quantities to plain numbers.

        Parameters
        ----------
        unit : str
            Unit of u and v.

        Returns
        -------
        OutlierMixture

        Raises
        ------
        InputError
            If a Quantity cannot be converted to this unit.
        """
        lengths: dict[str, Any] = {
            name: value_in(length, unit, name, where=f"outliers.{name}")
            for name in ("match_radius", "jitter", "jitter_scale", "outlier_scale")
            if hasattr(length := getattr(self, name), "to_value")
        }
        return replace(self, **lengths) if lengths else self

    def bind(self, scale: float) -> Hyper:
        """Scale the priors to the data.

        Parameters
        ----------
        scale : float
            Median quoted error in the unit of u, v.

        Returns
        -------
        Hyper
        """
        return Hyper(self, scale)


def _number(length: Any) -> Any:
    """Value of a Quantity or number; units are checked later by `OutlierMixture.in_unit`."""
    number = getattr(length, "value", length)
    if number is not None and not isinstance(number, Real):
        raise InputError(
            f"{length!r} is not a length", where="outliers", do="give a number or a Quantity"
        )
    return number


@dataclass(frozen=True)
class Hyper:
    """Likelihood terms and priors of an `OutlierMixture` whose priors are scaled to the data.

    Points h are in sampled coordinates (log j, logit f, log w), in the order of `mixture.hyper`.
    At points where numbers overflow, the density is zero or NaN.
    """

    mixture: OutlierMixture
    scale: float  # median quoted error, which is the default scale of the priors

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sampled coordinates."""
        return tuple(HYPER_NAMES[k] for k in self.mixture.hyper)

    @np.errstate(over="ignore", invalid="ignore")
    def values(self, h: Float) -> dict[str, Float]:
        """Values (...) by name of those of j, f and s_out that are sampled.

        `h` (..., n_hyper) are points in sampled coordinates.
        """
        out = {}
        for k, name in enumerate(self.mixture.hyper):
            t = h[..., k]
            if name == "s_out":
                out[name] = np.sqrt(self.core(h) + np.exp(2 * t))
            else:
                out[name] = expit(t) if name == "f" else np.exp(t)
        return out

    def point(self, values: Mapping[str, ArrayLike]) -> Float:
        """Convert values (...) of j, f and s_out to sampled coordinates (..., n_hyper)."""
        natural = {k: np.asarray(values[k], float) for k in self.mixture.hyper}
        core = self.scale**2 + natural.get("j", np.asarray(self.mixture.jitter or 0.0)) ** 2
        columns = []
        for name, value in natural.items():
            if name == "s_out":
                columns.append(0.5 * np.log(np.maximum(value**2 - core, LEAST_EXCESS * core)))
            else:
                columns.append(logit(value) if name == "f" else np.log(value))
        return np.stack(columns, axis=-1) if columns else np.zeros(0)

    @np.errstate(over="ignore", invalid="ignore")
    def core(self, h: Float) -> Float:
        """Variance (...) per axis of true matches with the median quoted error.

        `h` (..., n_hyper) are the hyperparameters.
        """
        if self.mixture.jitter is None:
            return np.asarray(self.scale**2 + np.exp(2 * h[..., 0]))
        return np.full(h.shape[:-1], self.scale**2 + self.mixture.jitter**2)

    def chained(self, h: Float, gradient: Float, curvature: Float) -> tuple[Float, Float, Float]:
        """Transform derivatives from (log j, logit f, log s_out) to h by the chain rule.

        `gradient` (n_hyper,) and `curvature` (n_hyper, n_hyper), which is minus the Hessian, are
        given with respect to log j, logit f and log s_out.  Returns both with respect to h, and the
        derivatives (n_hyper, n_hyper) of log j, logit f and log s_out (rows) with respect to h.
        """
        names = self.mixture.hyper
        by = np.eye(len(h))
        if "s_out" not in names:
            return gradient, curvature, by
        s = names.index("s_out")
        core, excess = float(self.core(h)), float(np.exp(2 * h[s]))
        bend = np.zeros((len(h), len(h)))
        of_excess = excess / (core + excess)
        by[s, s], bend[s, s] = of_excess, 2 * of_excess * (1 - of_excess)
        if "j" in names:
            j = names.index("j")
            of_jitter = float(np.exp(2 * h[j])) / (core + excess)
            by[s, j], bend[j, j] = of_jitter, 2 * of_jitter * (1 - of_jitter)
            bend[s, j] = bend[j, s] = -2 * of_excess * of_jitter
        return by.T @ gradient, by.T @ curvature @ by - gradient[s] * bend, by

    @np.errstate(over="ignore", invalid="ignore")
    def constants(self, h: Float) -> Constants:
        """Constants of the likelihood for points h (n, n_hyper)."""
        n = len(h)
        fixed = self.mixture.jitter
        j2 = np.full(n, 0.0 if fixed is None else fixed**2)
        log_f, log_1_f, out = np.full(n, -np.inf), np.zeros(n), np.ones(n)
        if self.mixture.model == "uniform":
            radius = required(self.mixture.match_radius, "a uniform mixture needs a match radius")
            out = np.full(n, np.pi * radius**2)
        for k, name in enumerate(self.mixture.hyper):
            if name == "j":
                j2 = np.exp(2 * h[:, k])
            elif name == "f":
                log_f, log_1_f = log_expit(h[:, k]), log_expit(-h[:, k])
            else:
                out = self.core(h) + np.exp(2 * h[:, k])
        kind, radius = KINDS[self.mixture.model], self.mixture.match_radius or 0.0
        return Constants(j2, log_f, log_1_f, out, kind, self.scale**2, radius)

    # -- priors -----------------------------------------------------------------------------------

    @np.errstate(over="ignore", invalid="ignore")
    def log_prior(self, h: Float) -> Float:
        """Normalised log prior density (...) of points h (..., n_hyper)."""
        out = np.zeros(h.shape[:-1])
        for k, name in enumerate(self.mixture.hyper):
            t = h[..., k]
            if name == "f":
                a, b = self.mixture.fraction_prior
                norm = gammaln(a + b) - gammaln(a) - gammaln(b)
                out = out + a * log_expit(t) + b * log_expit(-t) + norm
            elif name == "j":
                z2 = np.exp(2 * (t - np.log(self._jitter_scale)))
                norm = gammaln((T_DOF + 1) / 2) - gammaln(T_DOF / 2)
                norm += np.log(2 / self._jitter_scale) - 0.5 * np.log(np.pi * T_DOF)
                out = out + t + norm - (T_DOF + 1) / 2 * np.log1p(z2 / T_DOF)
            else:
                a, rate = OUTLIER_SHAPE, self._outlier_rate(h)
                norm = np.log(2.0) + a * np.log(rate) - gammaln(a)
                out = out + norm - 2 * a * t - rate * np.exp(-2 * t)
        return out

    @property
    def _jitter_scale(self) -> float:
        return self.mixture.jitter_scale or self.scale

    def _outlier_rate(self, h: Float) -> Float:
        """Rate (...) of the inverse-gamma prior of w^2."""
        outlier_scale = self.mixture.outlier_scale
        square = (
            np.full(h.shape[:-1], outlier_scale**2)
            if outlier_scale
            else OUTLIER_MODE**2 * self.core(h)
        )
        return np.asarray(OUTLIER_SHAPE * square)

    def prior_terms(self, h: Float) -> tuple[Float, Float]:
        """Gradient (n_hyper,) and minus the Hessian (n_hyper, n_hyper) of the log prior at h."""
        gradient, curvature = np.zeros(len(h)), np.zeros((len(h), len(h)))
        for k, name in enumerate(self.mixture.hyper):
            if name == "f":
                a, b = self.mixture.fraction_prior
                f = expit(h[k])
                gradient[k] += a * (1 - f) - b * f
                curvature[k, k] += (a + b) * f * (1 - f)
            elif name == "j":
                z2 = np.exp(2 * (h[k] - np.log(self._jitter_scale)))
                gradient[k] += 1 - (T_DOF + 1) * z2 / (T_DOF + z2)
                curvature[k, k] += (T_DOF + 1) * 2 * T_DOF * z2 / (T_DOF + z2) ** 2
            else:
                e = float(self._outlier_rate(h)) * np.exp(-2 * h[k])
                gradient[k] += -2 * OUTLIER_SHAPE + 2 * e
                curvature[k, k] += 4 * e
                if "j" in self.mixture.hyper and not self.mixture.outlier_scale:
                    # the rate is proportional to the core's variance, which depends on j
                    j = self.mixture.hyper.index("j")
                    by_j = 2 * np.exp(2 * h[j]) / float(self.core(h))
                    gradient[j] += by_j * (OUTLIER_SHAPE - e)
                    curvature[j, j] += by_j**2 * e - by_j * (2 - by_j) * (OUTLIER_SHAPE - e)
                    curvature[[j, k], [k, j]] -= 2 * e * by_j
        return gradient, curvature


# -- likelihood of single stars at a solution: Gaussian with rejection, or outlier mixture ---------


class Likelihood(Protocol):
    """Likelihood of single stars at one parameter vector."""

    @property
    def theta(self) -> Float:
        """The parameter vector (D,)."""

    def scores(self, stars: Stars) -> Float:
        """Derivatives of the log-likelihood with respect to the model position, shape (5, N).

        The rows are the first derivatives in u and v, and minus the second derivatives uu, uv, vv.
        """

    def inliers(self, stars: Stars) -> Float:
        """Probability (N,) that each star is a true match."""

    def covariances(self, stars: Stars) -> Float:
        """Covariances uu, uv, vv (3, N) of true matches."""


@dataclass(frozen=True, eq=False)
class Clip:
    """Rejection limits for the residuals from the first pass of a fit."""

    theta: Float  # parameters (D,) of the first pass
    chi2_limit: float  # largest chi-square of a star (sum over both axes)
    abs_limit: float  # largest radial residual, in the unit of u, v
    # chi-square up to which a star is kept whatever its residual: large errors explain this one
    spared_chi2: float = 0.0

    def keeps(self, model: DistortionModel, matches: Matches) -> Bool:
        """Boolean mask (N,) that is True for matches within both limits, in table order."""
        stars, order = prepare(model, matches)
        return in_table_order(self.keeps_of(stars), order).astype(bool)

    def keeps_of(self, stars: Stars) -> Bool:
        """Boolean mask (N,) that is True for prepared stars within both limits."""
        residual = stars.residuals_along_axes(self.theta)
        r2, chi2 = (residual**2).sum(axis=1), stars.chi2(residual)
        near = (r2 <= self.abs_limit**2) | (chi2 <= self.spared_chi2)
        return np.asarray((chi2 <= self.chi2_limit) & near)


@dataclass(frozen=True, eq=False)
class ClippedGaussian:
    """Gaussian likelihood of the stars within the rejection limits of a two-pass fit."""

    theta: Float
    clip: Clip

    def scores(self, stars: Stars) -> Float:
        """Derivatives of the log-likelihood (see `Likelihood.scores`); zero for rejected stars."""
        r = stars.residuals_along_axes(self.theta).T
        used = self.clip.keeps_of(stars)
        w = np.stack([used / stars.var_u, used / stars.var_v])
        return np.concatenate([stars.off_axes(w * r), stars.matrices_off_axes(w[0], 0.0, w[1])])

    def inliers(self, stars: Stars) -> Float:
        """1 for stars within the limits, 0 for rejected stars; shape (N,)."""
        return self.clip.keeps_of(stars).astype(float)

    def covariances(self, stars: Stars) -> Float:
        """Covariances uu, uv, vv (3, N) of the quoted errors, in the unit of u and v squared."""
        return stars.covariances()


@dataclass(frozen=True, eq=False)
class MixtureAt:
    """Outlier mixture with one set of hyperparameters."""

    theta: Float
    constants: Constants

    def scores(self, stars: Stars) -> Float:
        """Derivatives of the log-likelihood; see `Likelihood.scores`."""
        if circle := stars.circle(self.constants):
            scores = kernel.truncated_scores(
                stars.blocks,
                stars.columns,
                circle,
                stars.powers(self.theta),
                stars.model.order,
                self.constants,
            )
            return np.concatenate(
                [stars.off_axes(scores[:2]), stars.matrices_off_axes(*scores[2:])]
            )
        r = stars.residuals_along_axes(self.theta).T
        p = star_averages(stars, self.theta[None], self.constants)[0]
        j2, out = self.constants.j2[0], self.constants.out[0]
        outlier = 1 / out if self.constants.kind == GAUSSIAN else 0.0
        w = np.stack([1 / (stars.var_u + j2), 1 / (stars.var_v + j2)])
        mean = (1 - p) * w + p * outlier
        # derivative of log(core / outlier) with respect to the residual
        turn = (outlier - w) * r
        first, second = mean - p * (1 - p) * turn**2
        mixed = -p * (1 - p) * turn[0] * turn[1]
        curvature = stars.matrices_off_axes(first, mixed, second)
        return np.concatenate([stars.off_axes(mean * r), curvature])

    def inliers(self, stars: Stars) -> Float:
        """Probability (N,) that each star belongs to the core of the mixture."""
        return 1.0 - star_averages(stars, self.theta[None], self.constants)[0]

    def covariances(self, stars: Stars) -> Float:
        """Covariances uu, uv, vv (3, N) of quoted errors and jitter, in that unit squared."""
        return stars.covariances(float(self.constants.j2[0]))


def star_averages(stars: Stars, theta: Float, constants: Constants) -> Float:
    """Outlier probability, log-likelihood and its square per star (3, N), averaged over n draws.

    `theta` is (n, D), and `constants` belong to the n draws.
    """
    return np.asarray(_by_star(stars, theta, constants, len(theta))[0])


def star_log_likelihoods(stars: Stars, theta: Float, constants: Constants) -> Float:
    """Log-likelihood (n, N) of each star for draws theta (n, D) with the given constants."""
    return np.asarray(_by_star(stars, theta, constants, 1)[:, 1])


def _by_star(stars: Stars, theta: Float, constants: Constants, each: int) -> Float:
    powers, order = stars.powers(theta), stars.model.order
    if circle := stars.circle(constants):
        return kernel.truncated_memberships(
            stars.blocks, stars.columns, circle, powers, order, constants, each
        )
    return kernel.memberships(stars.blocks, stars.columns, powers, order, constants, each)


def log_densities(square: Float, var: Float, f: float, wide: float) -> tuple[Float, Float]:
    """Log densities (N,) of the stars as true matches and as false matches, up to a constant.

    `square` (2, N) are squared residuals and `var` (2, N) the variances of true matches.  A
    fraction `f` of the matches is false, with the variance `wide` on each axis.
    """
    log_good = np.log1p(-f) - 0.5 * (square / var + np.log(var)).sum(axis=0)
    return log_good, np.log(f) - 0.5 * (square / wide).sum(axis=0) - np.log(wide)


def good_probability(square: Float, var: Float, f: float, wide: float) -> Float:
    """Probability (N,) that each star is a true match; see `log_densities` for the arguments."""
    log_good, log_bad = log_densities(square, var, f, wide)
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * (log_good - log_bad))))
