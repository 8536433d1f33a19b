"""Errors by magnitude, from the residuals of a fit; and errors added to those that are quoted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int

_MIN_STARS_IN_BIN = 40
_MAX_BINS = 25
_MIN_STARS = 10  # stars in all, below which the scatter is unknown
_CLIP = 4.0  # sigmas beyond which a star has no part in the scatter
MAD_TO_SIGMA = 1.4826022185056018  # 1 / (median of |z|, z standard normal)
_SMALL_SAMPLE = 0.31  # relative bias of the median of |z| over n stars is +0.31 / n
_LOG_VARIANCE = 1.36  # variance of ln(scatter) times n: the median of |z| is 37 % efficient
_LEAST_LEFT = 0.25  # of errors from which others are taken off
_TURN = 9.0  # gain in chi-square that a rise towards the bright end must bring to be believed


@dataclass(frozen=True, eq=False)
class MagnitudeErrors:
    """Standard errors as a function of magnitude.

    Parameters
    ----------
    mag : ndarray, shape (B,)
        Median magnitude of each bin, rising.
    sigma_u, sigma_v : ndarray, shape (B,)
        Smoothed, in the unit of the residuals.
    n : ndarray of int, shape (B,)
        Stars in each bin.
    scatter_u, scatter_v : ndarray, shape (B,)
        The bins' own scatter, before smoothing.
    """

    mag: Float
    sigma_u: Float
    sigma_v: Float
    n: Int
    scatter_u: Float
    scatter_v: Float

    def at(self, mag: ArrayLike) -> tuple[Float, Float]:
        """Errors at magnitudes.

        Parameters
        ----------
        mag : array_like, shape (N,)

        Returns
        -------
        sigma_u, sigma_v : ndarray, shape (N,)
            Monotone cubic interpolation of the logarithm; constant beyond the first and last bin.
        """
        inside = np.clip(np.asarray(mag, float), self.mag[0], self.mag[-1])
        if len(self.mag) == 1:
            return np.full(inside.shape, self.sigma_u[0]), np.full(inside.shape, self.sigma_v[0])
        from scipy.interpolate import PchipInterpolator  # a fifth of a second

        u, v = (
            np.exp(PchipInterpolator(self.mag, np.log(sigma))(inside))
            for sigma in (self.sigma_u, self.sigma_v)
        )
        return u, v

    def less(self, sigma_u: ArrayLike, sigma_v: ArrayLike) -> MagnitudeErrors:
        """Errors less others that are in them, one for all magnitudes or those of each bin (B,).

        A quarter stays at least: the other errors are not that well known.
        """
        left_u, left_v = (
            np.sqrt(np.maximum(sigma**2 - np.square(known), (_LEAST_LEFT * sigma) ** 2))
            for sigma, known in ((self.sigma_u, sigma_u), (self.sigma_v, sigma_v))
        )
        return replace(self, sigma_u=left_u, sigma_v=left_v)


def no_magnitudes(where: str) -> InputError:
    """Error of stars without magnitudes whose errors are to be estimated by magnitude."""
    return InputError(
        "holds no magnitudes, and errors by magnitude need them",
        where=where,
        do="name the column mag, or give errors as columns or as a number",
    )


def estimate(
    mag: ArrayLike, residual_u: ArrayLike, residual_v: ArrayLike, *, n_params: int = 0
) -> MagnitudeErrors:
    """Robust scatter of residuals (N,) in bins of magnitude, smoothed.

    The scatter of a bin is 1.4826 times the median absolute residual (about zero: an offset common
    to the stars of one magnitude is an error, too), over the stars within 4 sigma on both axes.
    It is corrected for the size of the bin and for the freedom that the fit has used: `n_params` is
    the number of parameters, both axes together, of a fit with weights 1 / sigma^2.  Bins hold
    about equal numbers.  The smoothed curve rises towards faint stars, and towards the brightest
    (saturated) ones where the data demand it.

    Refused are values that are not finite, fewer than 10 stars, no more residuals than parameters,
    and a bin without scatter.
    """
    mag = np.asarray(mag, float)
    residuals = np.stack([np.asarray(residual_u, float), np.asarray(residual_v, float)])
    where = "errors by magnitude"
    if not (np.isfinite(mag).all() and np.isfinite(residuals).all()):
        raise InputError(
            "a magnitude or a residual is not finite", where=where, do="drop such stars"
        )
    if mag.size < _MIN_STARS:
        raise InputError(
            f"{mag.size} stars are too few", where=where, do=f"give {_MIN_STARS}, or give errors"
        )
    if 2 * mag.size <= n_params:
        raise InputError(
            f"{mag.size} stars leave no residuals beside {n_params} parameters",
            where=where,
            do="lower the order of the model or give errors",
        )
    bins = _bins(mag)
    n = np.array([len(b) for b in bins])
    scatter = np.array([_scatter(residuals[:, b]) for b in bins]).T
    if not (scatter > 0).all():
        bad = int(np.argmin((scatter > 0).all(axis=0)))
        raise InputError(
            f"residuals near magnitude {np.median(mag[bins[bad]]):.2f} have no scatter",
            where=where,
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
    """Indices of the stars of each bin; stars of one magnitude stay together."""
    order = np.argsort(mag, kind="stable")
    count = int(np.clip(len(mag) // _MIN_STARS_IN_BIN, 1, _MAX_BINS))
    edges = np.linspace(0, len(mag), count + 1).astype(int)[1:-1]
    edges = np.unique(np.searchsorted(mag[order], mag[order][edges], side="left"))
    parts = [part for part in np.split(order, edges) if len(part)]
    out: list[Int] = []
    for part in parts:  # ties may have left a bin too small to stand alone
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
        # one membership for both axes, as in the outlier model
        near = (size <= _CLIP * scale[:, None]).all(axis=0)
        if not near.any():
            break
        new = MAD_TO_SIGMA * np.median(size[:, near], axis=1)
        if np.allclose(new, scale, rtol=1e-12, atol=0.0):
            break
        scale = new
    return scale / (1.0 + _SMALL_SAMPLE / max(int(near.sum()), 1))


def _with_lost_freedom(scatter: Float, n: Int, n_params: int) -> Float:
    """Scatter of the errors, from that of the residuals.

    A weighted fit takes up h_i = (p / 2) w_i / sum(w) of the variance of star i on average over the
    detector, w = 1 / sigma^2: most from the best stars.
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
    """Isotonic regression, or falling then rising where chi-square is clearly better."""
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
    """Errors to be added in quadrature, by group; `other` is for stars of none of these groups.

    A group is an axis, or an axis of the stars of one chip, exposure or filter.
    """

    by: str  # 'chip', 'exposure' or 'filter'; empty where all stars are of one group
    labels: tuple[str, ...]  # length G: chip numbers or names; one empty text for one group
    sigma: Float  # (G, 2), along u and v in their unit
    other: Float  # (2,), of stars with another label, as of an exposure that was held out

    def at(self, labels: Sequence[str], codes: Int) -> tuple[Float, Float]:
        """Errors (N,) on u and v of stars, by the labels of their groups and codes (N,) into them.

        `Matches.grouped` gives both.
        """
        row = {label: k for k, label in enumerate(self.labels)}
        of_label = np.array([row.get(label, len(row)) for label in labels], np.int64)
        added = np.vstack([self.sigma, self.other])[of_label[codes]]
        return added[:, 0], added[:, 1]
