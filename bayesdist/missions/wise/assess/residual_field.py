"""Binned residuals as fields of known noise, without the part that a fitted polynomial absorbs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre

from bayesdist.diagnose.residuals.binned import BinnedResiduals
from bayesdist.errors import DegenerateError, InputError
from bayesdist.model.basis import polynomial_terms
from bayesdist.utils.arrays import Bool, Float

_FEWEST_STARS = 5


@dataclass(frozen=True, eq=False)
class ResidualField:
    """Mean residuals of both axes in M bins with enough stars, and their noise."""

    x: Float  # (nx,), centres of the bins, FITS 1-based pixels
    y: Float  # (ny,)
    used: Bool  # (ny, nx), True for bins with at least five stars
    sem: Float  # (2, M), standard errors of the means in u and v
    white: Float  # (2, M), whitened means (divided by their errors) without the polynomial
    absorbed: Float  # (2, M, K), orthonormal basis of whitened polynomials

    @property
    def n_used(self) -> int:
        """Number of used bins."""
        return self.sem.shape[1]

    @cached_property
    def pitch(self) -> tuple[float, float]:
        """Width and height of a bin in pixels."""
        return float(self.x[1] - self.x[0]), float(self.y[1] - self.y[0])

    def without_polynomial(self, white: Float) -> Float:
        """Whitened means (..., 2, M), projected orthogonally to the polynomials."""
        part = np.einsum("amk,...am->...ak", self.absorbed, white)
        return white - np.einsum("amk,...ak->...am", self.absorbed, part)

    def noise(self, n: int, rng: np.random.Generator) -> Float:
        """Random whitened means (n, 2, M) for pure noise."""
        return self.without_polynomial(rng.standard_normal((n, 2, self.n_used)))

    def image(self, values: Float) -> Float:
        """Values (..., M) of the used bins as images (..., ny, nx); 0 in all other bins."""
        out = np.zeros((*values.shape[:-1], *self.used.shape))
        out[..., self.used] = values
        return out


def residual_field(bins: BinnedResiduals, *, order: int = 0) -> ResidualField:
    """Prepare binned residuals for tests of structure.

    Parameters
    ----------
    bins : BinnedResiduals
    order : int
        Total order of the polynomial that was fitted to these stars.  Polynomials of this order are
        removed from the means and from the noise with which they are compared.  If it is lower than
        that of the fit, effects of the fit may be taken for structure.

    Returns
    -------
    ResidualField

    Raises
    ------
    InputError
        If the order is negative, or there are fewer than four bins per axis.
    DegenerateError
        If the number of bins with at least five stars is less than twice the number of terms.
    """
    if order < 0:
        raise InputError(f"the order is {order}", where="order", do="give 0 or higher")
    if min(bins.count.shape) < 4:
        raise InputError(
            f"{bins.count.shape[1]} x {bins.count.shape[0]} bins are too few to detect structure",
            where="bins",
            do="take at least four per axis",
        )
    sems = np.stack([bins.sem_u, bins.sem_v])
    used = (bins.count >= _FEWEST_STARS) & (sems > 0).all(axis=0)
    terms = polynomial_terms(order)
    if used.sum() < max(2 * len(terms), 9):
        raise DegenerateError(
            f"only {int(used.sum())} bins have at least {_FEWEST_STARS} stars",
            where=f"{bins.count.shape[1]} x {bins.count.shape[0]} bins",
            do="take fewer bins or more stars",
        )
    n = bins.count[used]
    # correct for the larger variance of Student's t distribution
    sem = sems[:, used] * np.sqrt((n - 1) / (n - 3))
    design = polynomials(bins.x, bins.y, used, order)
    absorbed = np.stack([np.linalg.qr(design / s[:, None])[0] for s in sem])
    means = np.stack([bins.mean_u[used], bins.mean_v[used]])
    raw = ResidualField(bins.x, bins.y, used, sem, means / sem, absorbed)
    return ResidualField(bins.x, bins.y, used, sem, raw.without_polynomial(raw.white), absorbed)


def polynomials(x: Float, y: Float, used: Bool, order: int) -> Float:
    """Legendre products (M, K) up to an order at the used bins (ny, nx)."""
    by_x, by_y = (legendre.legvander(_scaled(c), order) for c in (x, y))
    return np.stack(
        [(by_y[:, j, None] * by_x[:, i])[used] for i, j in polynomial_terms(order)], axis=1
    )


def _scaled(centres: Float) -> Float:
    """Centres of bins, scaled to [-1, 1]."""
    middle = (centres[0] + centres[-1]) / 2
    return (centres - middle) / (centres[-1] - middle)
