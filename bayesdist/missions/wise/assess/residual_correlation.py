"""Two-point correlation of residuals over the detector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from bayesdist.diagnose.residuals.binned import BinnedResiduals
from bayesdist.missions.wise.assess.residual_field import ResidualField, residual_field
from bayesdist.utils.arrays import Float, Int

DRAWS = 500  # number of noise fields for mean and sigma, and of further ones for the p-value
_AT_ONCE = 50  # noise fields that are processed together
_PAIRS = (("uu", 0, 0), ("vv", 1, 1), ("uv", 0, 1))


@dataclass(frozen=True, eq=False)
class ResidualCorrelation:
    """Mean products of the residuals of two bins in R rings of separation."""

    separation: Float  # (R,), mean distance of the pairs of bins in a ring, pixels
    # (R,), mean products in the squared unit of the residuals, minus their expectation for noise,
    # which is slightly negative after the fit of a polynomial
    uu: Float
    vv: Float  # (R,)
    uv: Float  # (R,)
    sigma_uu: Float  # (R,), standard deviations for pure noise
    sigma_vv: Float  # (R,)
    sigma_uv: Float  # (R,)
    n_pairs: Int  # (R,), pairs of bins in the ring
    chi2: float  # sum over all three functions of the squares of value / sigma
    p_value: float  # fraction of noise fields with a chi2 as large; at least 1 / 501

    @property
    def reach(self) -> float:
        """Separation in pixels up to which uu + vv exceeds three sigma; 0 if nowhere."""
        above = self.uu + self.vv > 3 * np.hypot(self.sigma_uu, self.sigma_vv)
        n = above.size if above.all() else int(np.argmin(above))
        return float(self.separation[n - 1]) if n else 0.0


def residual_correlation(
    bins: BinnedResiduals, *, order: int = 0, rng: np.random.Generator
) -> ResidualCorrelation:
    """Two-point correlation of binned residuals, with its significance.

    All pairs of different bins are used, by Fourier transforms that are padded to twice the size.
    Rings are one bin wide and extend to half of the shorter side.  Noise is independent between
    bins, apart from a slight dependence due to the fitted polynomial.  Mean and sigma are therefore
    those of noise fields from which the same polynomial was removed.

    Parameters
    ----------
    bins : BinnedResiduals
    order : int
        Order of the polynomial that was fitted to these stars.
    rng : numpy.random.Generator

    Returns
    -------
    ResidualCorrelation

    Raises
    ------
    InputError, DegenerateError
        See `bayesdist.missions.wise.assess.residual_field.residual_field`.
    """
    field = residual_field(bins, order=order)
    rings = _Rings.of(field)
    products = rings.products(field.image(field.sem * field.white)[None])[0]
    by_chance = np.concatenate(
        [
            rings.products(field.image(field.sem * field.noise(_AT_ONCE, rng)))
            for _ in range(2 * DRAWS // _AT_ONCE)
        ]
    )
    # mean and sigma come from the first half; the data are compared with the second half, which is
    # independent of them
    mean, sigma = by_chance[:DRAWS].mean(axis=0), by_chance[:DRAWS].std(axis=0, ddof=1)
    chi2 = float((((products - mean) / sigma) ** 2).sum())
    chi2_by_chance = (((by_chance[DRAWS:] - mean) / sigma) ** 2).sum(axis=(1, 2))
    p_value = (1 + int((chi2_by_chance >= chi2).sum())) / (len(chi2_by_chance) + 1)
    (uu, vv, uv), (sigma_uu, sigma_vv, sigma_uv) = products - mean, sigma
    return ResidualCorrelation(
        rings.separation,
        uu,
        vv,
        uv,
        sigma_uu,
        sigma_vv,
        sigma_uv,
        rings.n_pairs,
        chi2,
        p_value,
    )


@dataclass(frozen=True, eq=False)
class _Rings:
    """Lags between bins, grouped into rings of separation."""

    shape: tuple[int, int]
    ring: Int
    counts: Float
    separation: Float

    @property
    def n_pairs(self) -> Int:
        # every pair was counted twice
        return np.rint(self.counts / 2).astype(np.int64)

    @classmethod
    def of(cls, field: ResidualField) -> _Rings:
        ny, nx = field.used.shape
        shape = (fft.next_fast_len(2 * ny), fft.next_fast_len(2 * nx))
        dx = fft.fftfreq(shape[1], 1 / shape[1]) * field.pitch[0]
        dy = fft.fftfreq(shape[0], 1 / shape[0]) * field.pitch[1]
        distance = np.hypot(dx, dy[:, None])
        width = max(field.pitch)
        ring = np.rint(distance / width).astype(np.int64) - 1
        ring[0, 0] = -1
        n_rings = max(int(min(nx * field.pitch[0], ny * field.pitch[1]) / (2 * width)), 1)
        ring[ring >= n_rings] = -1
        pairs = np.rint(_lagged(field.used[None].astype(float), None, shape)[0])
        inside = ring >= 0
        counts = np.bincount(ring[inside], pairs[inside], n_rings).astype(float)
        total = np.bincount(ring[inside], (pairs * distance)[inside], n_rings)
        held = counts > 0
        # rings without pairs are dropped
        number = np.where(held, np.cumsum(held) - 1, -1)
        ring = np.where(inside, number[np.maximum(ring, 0)], -1)
        return cls(shape, ring, counts[held], total[held] / counts[held])

    def products(self, images: Float) -> Float:
        """Mean products (n, 3, R) in the rings of images (n, 2, ny, nx)."""
        inside = self.ring >= 0
        ring = self.ring[inside]
        out = np.empty((len(images), len(_PAIRS), self.counts.size))
        for k, (_, a, b) in enumerate(_PAIRS):
            lagged = _lagged(images[:, a], images[:, b], self.shape)[:, inside]
            for i, values in enumerate(lagged):
                out[i, k] = np.bincount(ring, values, self.counts.size) / self.counts
        return out


def _lagged(a: Float, b: Float | None, shape: tuple[int, int]) -> Float:
    """Sums over the grid of a(r) b(r + lag) for all lags; b is a by default."""
    first = fft.rfft2(a, shape)
    second = first if b is None or b is a else fft.rfft2(b, shape)
    return fft.irfft2(first.conj() * second, shape)
