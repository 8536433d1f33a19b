"""Errors by magnitude, estimated from the residuals of a fit, and errors added to quoted ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int

_MIN_STARS_IN_BIN = 40
_MAX_BINS = 25
_MIN_STARS = 10  # smallest number of stars from which the scatter is estimated
_CLIP = 4.0  # sigmas beyond which a star is excluded from the scatter
MAD_TO_SIGMA = 1.4826022185056018  # 1 / (median of |z|, z standard normal)
_SMALL_SAMPLE = 0.31  # relative bias of the median of |z| over n stars is +0.31 / n
_LOG_VARIANCE = 1.36  # variance of ln(scatter) times n: the median of |z| is 37 % efficient
_LEAST_LEFT = 0.25  # smallest fraction of an error that remains after others are subtracted
_TURN = 9.0  # smallest gain in chi-square for which a rise towards the bright end is accepted


@dataclass(frozen=True, eq=False)
class MagnitudeErrors:
    """Standard errors as a function of magnitude.

    Parameters
    ----------
    mag : ndarray, shape (B,)
        Median magnitude of each bin, ascending.
    sigma_u, sigma_v : ndarray, shape (B,)
        Smoothed standard errors, in the unit of the residuals.
    n : ndarray of int, shape (B,)
        Number of stars in each bin.
    scatter_u, scatter_v : ndarray, shape (B,)
        Scatter in each bin before smoothing.
    """

    mag: Float
    sigma_u: Float
    sigma_v: Float
    n: Int
    scatter_u: Float
    scatter_v: Float

    def at(self, mag: ArrayLike) -> tuple[Float, Float]:
        """Standard errors at given magnitudes.

        Parameters
        ----------
        mag : array_like, shape (N,)
            Magnitudes.

        Returns
        -------
        sigma_u, sigma_v : ndarray, shape (N,)
            Standard errors by monotone cubic interpolation of their logarithm, constant beyond the
            first and last bin.
        """
        inside = np.clip(np.asarray(mag, float), self.mag[0], self.mag[-1])
        if len(self.mag) == 1:
            return np.full(inside.shape, self.sigma_u[0]), np.full(inside.shape, self.sigma_v[0])
        from scipy.interpolate import PchipInterpolator  # takes a fifth of a second to import

        u, v = (
            np.exp(PchipInterpolator(self.mag, np.log(sigma))(inside))
            for sigma in (self.sigma_u, self.sigma_v)
        )
        return u, v

    def less(self, sigma_u: ArrayLike, sigma_v: ArrayLike) -> MagnitudeErrors:
        """Subtract other errors in quadrature.

        `sigma_u` and `sigma_v` are common to all magnitudes, or one per bin (B,).  At least a
        quarter of each error remains, because the other errors are not known precisely.
        """
        remaining_u, remaining_v = (
            np.sqrt(np.maximum(sigma**2 - np.square(other_sigma), (_LEAST_LEFT * sigma) ** 2))
            for sigma, other_sigma in ((self.sigma_u, sigma_u), (self.sigma_v, sigma_v))
        )
        return replace(self, sigma_u=remaining_u, sigma_v=remaining_v)


def no_magnitudes(where: str) -> InputError:
    """Error for stars without magnitudes when errors are to be estimated by magnitude."""
    return InputError(
        "holds no magnitudes, which errors by magnitude require",
        where=where,
        do="name the column mag, or give errors as columns or as a number",
    )


def estimate(
    mag: ArrayLike, residual_u: ArrayLike, residual_v: ArrayLike, *, n_params: int = 0
) -> MagnitudeErrors:
    """Standard errors by magnitude: smoothed robust scatter of residuals (N,) in magnitude bins.

    The errors have the unit of the residuals. The scatter of a bin is 1.4826 times the median
    absolute residual of the stars within 4 sigma on both axes. It is taken about zero, because an
    offset common to the stars of one magnitude is also an error. It is corrected for the size of
    the bin and for the degrees of freedom used by the fit: `n_params` is the number of parameters,
    for both axes together, of a fit with weights 1 / sigma^2. Bins hold nearly equal numbers of
    stars. The smoothed curve increases towards faint stars, and towards the brightest (saturated)
    stars if the data require it.

    Raises InputError if values are not finite, if there are fewer than 10 stars, if there are not
    more residuals than parameters, or if a bin has no scatter.
    """
    mag = np.asarray(mag, float)
    residuals = np.stack([np.asarray(residual_u, float), np.asarray(residual_v, float)])
    source = "errors by magnitude"
    if not (np.isfinite(mag).all() and np.isfinite(residuals).all()):
        raise InputError(
            "a magnitude or a residual is not finite", where=source, do="drop such stars"
        )
    if mag.size < _MIN_STARS:
        raise InputError(
            f"{mag.size} stars are too few", where=source, do=f"give {_MIN_STARS}, or give errors"
        )
    if 2 * mag.size <= n_params:
        raise InputError(
            f"{mag.size} stars are too few to leave residuals after fitting {n_params} parameters",
            where=source,
            do="lower the order of the model or give errors",
        )
    bins = _bins(mag)
    n = np.array([len(b) for b in bins])
    scatter = np.array([_scatter(residuals[:, b]) for b in bins]).T
    if not (scatter > 0).all():
        bad = int(np.argmin((scatter > 0).all(axis=0)))
        raise InputError(
            f"residuals near magnitude {np.median(mag[bins[bad]]):.2f} have no scatter",
            where=source,
            do="give errors; positions that were computed have none",
        )
    scatter = _with_lost_freedom(scatter, n, n_params)
    smooth = [np.exp(_smoothed(np.log(s), n)) for s in scatter]
    return MagnitudeErrors(
        mag=np.array([np.median(mag[b]) for b in bins]),
        sigma_u=smooth[0],
        sigma_v=smooth[1],
        n=n,
        scatter_u=scatter[0],
        scatter_v=scatter[1],
    )


def _bins(mag: Float) -> list[Int]:
    """Indices of the stars of each bin; stars of equal magnitude are in the same bin."""
    order = np.argsort(mag, kind="stable")
    count = int(np.clip(len(mag) // _MIN_STARS_IN_BIN, 1, _MAX_BINS))
    edges = np.linspace(0, len(mag), count + 1).astype(int)[1:-1]
    edges = np.unique(np.searchsorted(mag[order], mag[order][edges], side="left"))
    parts = [part for part in np.split(order, edges) if len(part)]
    out: list[Int] = []
    for part in parts:  # ties may leave a bin with too few stars
        if out and min(len(part), len(out[-1])) < min(_MIN_STARS_IN_BIN, len(mag) // count):
            out[-1] = np.concatenate([out[-1], part])
        else:
            out.append(part)
    return out


def _scatter(residuals: Float) -> Float:
    """Robust scatter (2,) of residuals (2, n)."""
    size = np.abs(residuals)
    scale = MAD_TO_SIGMA * np.median(size, axis=1)
    for _ in range(20):
        # stars are rejected on both axes together, as in the outlier model
        near = (size <= _CLIP * scale[:, None]).all(axis=0)
        if not near.any():
            break
        new = MAD_TO_SIGMA * np.median(size[:, near], axis=1)
        if np.allclose(new, scale, rtol=1e-12, atol=0.0):
            break
        scale = new
    return scale / (1.0 + _SMALL_SAMPLE / max(int(near.sum()), 1))


def _with_lost_freedom(scatter: Float, n: Int, n_params: int) -> Float:
    """Scatter of the errors, computed from that of the residuals.

    A weighted fit absorbs a fraction h_i = (p / 2) w_i / sum(w) of the variance of star i, averaged
    over the detector, with w = 1 / sigma^2: the best stars lose most.
    """
    sigma = scatter.copy()
    for _ in range(50):
        leverage = n_params / 2 / sigma**2 / (n / sigma**2).sum(axis=1, keepdims=True)
        new = scatter / np.sqrt(1.0 - np.minimum(leverage, 0.9))
        if np.allclose(new, sigma, rtol=1e-10, atol=0.0):
            break
        sigma = new
    return sigma


def _smoothed(log_sigma: Float, n: Int) -> Float:
    """Isotonic regression, or a decrease and then an increase if chi-square is clearly better."""
    from scipy.optimize import isotonic_regression

    weights = n / _LOG_VARIANCE

    def chi2(curve: Float) -> float:
        return float((weights * (log_sigma - curve) ** 2).sum())

    def isotonic(part: slice, increasing: bool) -> Float:
        fitted = isotonic_regression(log_sigma[part], weights=weights[part], increasing=increasing)
        return np.asarray(fitted.x, float)

    rising = isotonic(slice(None), True)
    turned = [
        np.concatenate([isotonic(slice(k), False), isotonic(slice(k, None), True)])
        for k in range(1, len(n))
    ]
    best = min([rising, *turned], key=chi2)
    return best if chi2(rising) - chi2(best) > _TURN else rising


@dataclass(frozen=True, eq=False)
class AddedErrors:
    """Errors to be added in quadrature, by group; `other` is for stars in none of the groups.

    A group is an axis, or an axis of the stars of one chip, exposure or filter.
    """

    by: str  # 'chip', 'exposure' or 'filter'; empty if all stars are in one group
    labels: tuple[str, ...]  # length G: chip numbers or names; a single empty string for one group
    sigma: Float  # (G, 2), along u and v in the unit of u and v
    other: Float  # (2,), for stars with another label, such as a held-out exposure

    def at(self, labels: Sequence[str], codes: Int) -> tuple[Float, Float]:
        """Errors (N,) of u and of v, to be added in quadrature to those of stars.

        `codes` (N,) are the indices into `labels` of the stars' groups; `Matches.grouped` returns
        both.
        """
        row = {label: k for k, label in enumerate(self.labels)}
        of_label = np.array([row.get(label, len(row)) for label in labels], np.int64)
        added = np.vstack([self.sigma, self.other])[of_label[codes]]
        return added[:, 0], added[:, 1]
