"""Outlier mixture: probabilities of false matches, and the error of the quoted errors.

    p(r) = (1 - f) N(r_u; 0, s_u^2 + j^2) N(r_v; 0, s_v^2 + j^2) + f p_out(r)

One membership for each star, shared by both axes.  p_out is a round Gaussian of scale s_out, or
uniform on the match circle.  The Gaussian is never narrower than the core: with s the median quoted
error, s_out^2 = s^2 + j^2 + w^2, and w is sampled.  Otherwise quoted errors that are far too small
let the components change places, and most stars be "outliers" of the narrow one.

Where stars were matched within a circle about nominal positions that are known, both parts are
normalised on it, and f is the fraction of false matches in it.  Sampled are log j, logit f and log
w; the priors are proper:

    f      Beta(a, b)
    j      half-Student-t, four degrees of freedom, scale: the median quoted error by default
    w      inverse gamma on w^2, shape 1; log w is most probable at five times the core's
           sqrt(s^2 + j^2) by default: an undetermined second component stays apart from it

All three leave tails in the sampled coordinates that fall at least exponentially, so that the
posterior stays proper where the data are uninformative: on j when the quoted errors are right, on w
when there are no outliers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit, gammaln, log_expit, logit

from bayesdist.errors import InputError, required
from bayesdist.infer import kernel
from bayesdist.infer.kernel import Constants
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import value_in

HYPER_NAMES = {"j": "log j", "f": "logit f", "s_out": "log s_out"}
KINDS = {"none": kernel.NO_OUTLIERS, "gaussian": kernel.GAUSSIAN, "uniform": kernel.UNIFORM}
T_DOF = 4.0
OUTLIER_SHAPE = 1.0
OUTLIER_MODE = 5.0
LEAST_EXCESS = 1e-9  # of w^2 over the core's variance: files round
# smallest a of Beta(a, b): at 1/3 and below the posterior of f^(1/3) may have no mode
LEAST_SHAPE = 0.5
# limit for uninformative data on log j or log w, and the slope of the log prior there
TAILS = {"j": ("left", 1.0), "s_out": ("right", -2.0 * OUTLIER_SHAPE)}


@dataclass(frozen=True)
class OutlierMixture:
    """Likelihood of one star and the priors of its parameters.

    Parameters
    ----------
    model : str
        'gaussian', 'uniform' or 'none'.
    match_radius : float or Quantity, optional
        Radius of the match circle in the unit of u, v; needed by 'uniform'.  With matches that have
        nominal positions, the likelihood is that of stars selected within it.
    jitter : float, Quantity or None
        Extra error j in the unit of u, v; None samples it.
    fraction_prior : tuple of float
        Parameters (a, b) of the Beta prior of f.
    jitter_scale : float or Quantity, optional
        Scale of the prior of j in the unit of u, v; by default the median quoted error.
    outlier_scale : float or Quantity, optional
        Most probable w of 'gaussian' outliers beforehand, in the unit of u, v: their scale s_out
        beyond that of the core; by default five times the core's.

    Raises
    ------
    InputError
        For an unknown model, a missing radius, a negative jitter, an improper prior, or the prior
        of a parameter that is not sampled.

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
                f"Beta{self.fraction_prior} puts too much weight on fractions of next to nothing",
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
        """Sampled ones of 'j', 'f', 's_out', in this order."""
        out: tuple[str, ...] = () if self.jitter is not None else ("j",)
        if self.model != "none":
            out += ("f",)
        if self.model == "gaussian":
            out += ("s_out",)
        return out

    def in_unit(self, unit: str) -> OutlierMixture:
        """Mixture whose lengths are plain numbers.

        Parameters
        ----------
        unit : str
            Unit of u and v, to which Quantities are converted.

        Raises
        ------
        InputError
            If a Quantity cannot be converted.
        """
        lengths: dict[str, Any] = {
            name: value_in(length, unit, name, where=f"outliers.{name}")
            for name in ("match_radius", "jitter", "jitter_scale", "outlier_scale")
            if hasattr(length := getattr(self, name), "to_value")
        }
        return replace(self, **lengths) if lengths else self

    def bind(self, scale: float) -> Hyper:
        """Mixture with its priors scaled to the data.

        Parameters
        ----------
        scale : float
            Median quoted error.
        """
        return Hyper(self, scale)


def _number(length: Any) -> Any:
    """Number of a Quantity, whose unit is compared with that of u and v later."""
    number = getattr(length, "value", length)
    if number is not None and not isinstance(number, Real):
        raise InputError(
            f"{length!r} is no length", where="outliers", do="give a number or a Quantity"
        )
    return number


@dataclass(frozen=True)
class Hyper:
    """An `OutlierMixture` with the scale of the data: likelihood terms and priors.

    A point is a vector h in the order of `mixture.hyper`: log j, logit f, log w.  Proposals may lie
    where numbers overflow: there the density is zero or NaN.
    """

    mixture: OutlierMixture
    scale: float  # median quoted error, of the priors where the mixture gives none

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sampled coordinates."""
        return tuple(HYPER_NAMES[k] for k in self.mixture.hyper)

    @np.errstate(over="ignore", invalid="ignore")
    def values(self, h: Float) -> dict[str, Float]:
        """j, f and s_out of points (..., n_hyper), in natural form."""
        out = {}
        for k, name in enumerate(self.mixture.hyper):
            t = h[..., k]
            if name == "s_out":
                out[name] = np.sqrt(self.core(h) + np.exp(2 * t))
            else:
                out[name] = expit(t) if name == "f" else np.exp(t)
        return out

    def point(self, values: Mapping[str, ArrayLike]) -> Float:
        """Sampled coordinates (..., n_hyper) of natural values (...)."""
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
        """Variance (...) of true matches on an axis, with the median quoted error."""
        if self.mixture.jitter is None:
            return np.asarray(self.scale**2 + np.exp(2 * h[..., 0]))
        return np.full(h.shape[:-1], self.scale**2 + self.mixture.jitter**2)

    def chained(self, h: Float, gradient: Float, curvature: Float) -> tuple[Float, Float, Float]:
        """Gradient (n_hyper,) and minus Hessian by h, from those by log j, logit f and log s_out.

        The third result (n_hyper, n_hyper) are the derivatives of log j, logit f and log s_out
        (rows) by h.
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
        """Constants of the likelihood at points (n, n_hyper)."""
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
        """Log prior density of points (..., n_hyper) in sampled coordinates, normalised."""
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
        """Rate (...) of the inverse gamma of w^2."""
        given = self.mixture.outlier_scale
        square = np.full(h.shape[:-1], given**2) if given else OUTLIER_MODE**2 * self.core(h)
        return np.asarray(OUTLIER_SHAPE * square)

    def prior_terms(self, h: Float) -> tuple[Float, Float]:
        """Gradient (n_hyper,) and minus the Hessian (n_hyper, n_hyper) of the log prior."""
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
                    # the rate is proportional to the core, which depends on j: log rate by log j
                    j = self.mixture.hyper.index("j")
                    by_j = 2 * np.exp(2 * h[j]) / float(self.core(h))
                    gradient[j] += by_j * (OUTLIER_SHAPE - e)
                    curvature[j, j] += by_j**2 * e - by_j * (2 - by_j) * (OUTLIER_SHAPE - e)
                    curvature[[j, k], [k, j]] -= 2 * e * by_j
        return gradient, curvature
