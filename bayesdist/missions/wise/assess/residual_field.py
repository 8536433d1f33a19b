"""Binned residuals as fields of known noise, what a fitted polynomial carries away removed."""

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
    """Mean residuals of both axes over the used bins, and the noise they hold."""

    x: Float  # (nx,)
    y: Float  # (ny,), centres of the bins, FITS 1-based pixels
    used: Bool  # (ny, nx), bins of five stars or more
    sem: Float  # (2, M), noise of the means in u and v of the M used bins
    white: Float  # (2, M), means over their noise, the polynomial removed
    absorbed: Float  # (2, M, K), orthonormal columns: what polynomials can do to the whitened means

    @property
    def n_used(self) -> int:
        """Number of used bins."""
        return self.sem.shape[1]

    @cached_property
    def pitch(self) -> tuple[float, float]:
        """Width and height of a bin in pixels."""
        return float(self.x[1] - self.x[0]), float(self.y[1] - self.y[0])

    def without_polynomial(self, white: Float) -> Float:
        """Whitened means (..., 2, M) with what polynomials can do to them removed."""
        part = np.einsum("amk,...am->...ak", self.absorbed, white)
        return white - np.einsum("amk,...ak->...am", self.absorbed, part)

    def noise(self, n: int, rng: np.random.Generator) -> Float:
        """Whitened means (n, 2, M) as they are where the noise is all there is."""
        return self.without_polynomial(rng.standard_normal((n, 2, self.n_used)))

    def image(self, values: Float) -> Float:
        """Values (..., M) of the used bins on the grid, (..., ny, nx); 0 in the others."""
        out = np.zeros((*values.shape[:-1], *self.used.shape))
        out[..., self.used] = values
        return out


def residual_field(bins: BinnedResiduals, *, order: int = 0) -> ResidualField:
    """Prepare binned residuals for tests of structure.

    `order`: total order of the polynomial that was fitted to these stars.  Its freedom is removed
    from the means and from the noise they are compared with; a lower order than the fit's lets the
    fit's own work look like structure. InputError for a negative order, or fewer than four bins on
    an axis. DegenerateError when the bins that hold five stars are not twice as many as the
    polynomial's terms.
    """
    if order < 0:
        raise InputError(f"the order is {order}", where="order", do="give 0 or more")
    if min(bins.count.shape) < 4:
        raise InputError(
            f"{bins.count.shape[1]} x {bins.count.shape[0]} bins show no structure",
            where="bins",
            do="take four or more on each axis",
        )
    sems = np.stack([bins.sem_u, bins.sem_v])
    used = (bins.count >= _FEWEST_STARS) & (sems > 0).all(axis=0)
    terms = polynomial_terms(order)
    if used.sum() < max(2 * len(terms), 9):
        raise DegenerateError(
            f"only {int(used.sum())} bins hold {_FEWEST_STARS} stars or more",
            where=f"{bins.count.shape[1]} x {bins.count.shape[0]} bins",
            do="take fewer bins or more stars",
        )
    n = bins.count[used]
    # the square of a t variable is larger than that of a normal one
    sem = sems[:, used] * np.sqrt((n - 1) / (n - 3))
    design = polynomials(bins.x, bins.y, used, order)
    absorbed = np.stack([np.linalg.qr(design / s[:, None])[0] for s in sem])
    means = np.stack([bins.mean_u[used], bins.mean_v[used]])
    raw = ResidualField(bins.x, bins.y, used, sem, means / sem, absorbed)
    return ResidualField(bins.x, bins.y, used, sem, raw.without_polynomial(raw.white), absorbed)


def polynomials(x: Float, y: Float, used: Bool, order: int) -> Float:
    """Columns (M, K) of Legendre products up to an order, at the used bins (ny, nx)."""
    by_x, by_y = (legendre.legvander(_scaled(c), order) for c in (x, y))
    return np.stack(
        [(by_y[:, j, None] * by_x[:, i])[used] for i, j in polynomial_terms(order)], axis=1
    )


def _scaled(centres: Float) -> Float:
    """Centres of bins on -1 to 1."""
    middle = (centres[0] + centres[-1]) / 2
    return (centres - middle) / (centres[-1] - middle)
