"""Structure in binned residuals over the detector: partition into blocks, two-point correlation.

Binned residuals are fields of known noise, without the part that a fitted polynomial absorbs.  If
the point-source templates differ between blocks of the detector, the blocks appear in the
residuals (WSDC D-T033, section 5: 5 x 5 blocks in W1 and W2).  For each k, independent planes in
k x k blocks are fitted to the binned residuals.  The k with the largest gain in likelihood, given
its degrees of freedom, is selected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre
from scipy import fft

from bayesdist.diagnose.residuals.binned import BinnedResiduals
from bayesdist.errors import DegenerateError, InputError
from bayesdist.model.basis import n_terms, polynomial_terms
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.checks import STRUCTURE
from bayesdist.utils.distributions import f_sf

Base = tuple[Float, Float]

PARTITIONS = tuple(range(2, 13))

DRAWS = 500  # number of noise fields for mean and sigma, and of further ones for the p-value

CORRELATION_DRAWS = 999

# required gain in log likelihood over a polynomial with as many terms: odds of 1000 to 1
_EDGES = float(np.log(1000.0))
# minimum number of bins along the side of a block, whose plane has three parameters
_FEWEST_BINS = 3
# singular values below this fraction of the largest are rounding errors
_RANK = 1e-8

_AT_ONCE = 50  # noise fields that are processed together
_PAIRS = (("uu", 0, 0), ("vv", 1, 1), ("uv", 0, 1))

_FEWEST_STARS = 5


@dataclass(frozen=True, eq=False)
class ResidualPartition:
    """Partition into k x k blocks that describes binned residuals best."""

    k: int  # number of blocks per axis
    p_value: float  # probability that the best of all k gains as much for pure noise
    # gain in log likelihood due to the blocks, by k; negative if they vary less than the rest
    gain: Mapping[int, float]
    gain_smooth: float  # the same for a polynomial with as many free terms as the blocks
    # rms of the blocks in u and v, with their noise subtracted, in the unit of the residuals
    rms: tuple[float, float]
    pattern: Float  # (2, ny, nx), fitted blocks in the bins; NaN in bins that are not used

    @property
    def significant(self) -> bool:
        """True if the structure is statistically significant."""
        return not STRUCTURE.met_by(self.p_value)

    @property
    def edges_seen(self) -> bool:
        """True if blocks describe the structure better than a polynomial with as many terms."""
        return self.significant and self.gain[self.k] - self.gain_smooth > _EDGES

    @property
    def sentence(self) -> str:
        """Result in one sentence."""
        if not self.significant:
            return f"No partition of the detector stands out in residuals (p = {self.p_value:.2g})."
        size = float(np.hypot(*self.rms))
        if self.edges_seen:
            return (
                f"The residuals show a pattern of {self.k} x {self.k} blocks, {size:.2g} rms "
                f"(p = {self.p_value:.1g})."
            )
        return (
            f"The residuals show structure of {size:.2g} rms (p = {self.p_value:.1g}) without the "
            f"edges of a partition: a polynomial describes it as well as {self.k} x {self.k} "
            "blocks."
        )


def residual_partition(
    bins: BinnedResiduals,
    *,
    order: int = 0,
    tried: Sequence[int] = PARTITIONS,
    rng: np.random.Generator,
) -> ResidualPartition:
    """Search for a partition of the detector into blocks in binned residuals.

    Let D be the number of degrees of freedom of the whitened means after the polynomial fit, T
    their sum of squares, d the degrees of freedom of the blocks, and Q the sum of squares that they
    describe.  If the blocks and the rest have different variances, the log likelihood gains

        (D log(T / D) - d log(Q / d) - (D - d) log((T - Q) / (D - d))) / 2.

    The variance of the rest is estimated from the data instead of the quoted noise.  Otherwise, for
    very accurate means, finer partitions would always gain by describing other structure.  Bins
    that are cut by an edge are divided between the blocks in proportion to the areas, so that 31
    bins can be used for 5 blocks.  The p-value is the fraction of noise fields for which the best k
    gains more.  If there are none, it is the Bonferroni bound from the F test if that is smaller.
    The noise is assumed to be independent between bins and axes.

    Parameters
    ----------
    bins : BinnedResiduals
        31 bins per axis are sufficient for up to 10 blocks, 45 for all 12 numbers.
    order : int
        Order of the polynomial that was fitted to these stars.
    tried : sequence of int
        Numbers of blocks per axis, at least 2; numbers above a third of the bins are ignored.
    rng : numpy.random.Generator

    Returns
    -------
    ResidualPartition

    Raises
    ------
    InputError
        If a number of blocks is below 2, all are too large for the bins, or see `residual_field`.
    DegenerateError
        If the blocks cannot be distinguished from the polynomial, or see `residual_field`.
    """
    field = residual_field(bins, order=order)
    if any(k < 2 or int(k) != k for k in tried):
        raise InputError(
            f"the numbers of blocks are {list(tried)}", do="give integers of at least 2"
        )
    possible = [int(k) for k in tried if _FEWEST_BINS * k <= min(field.used.shape)]
    if not possible:
        raise InputError(
            f"{min(field.used.shape)} bins per axis are too few for {list(tried)} blocks",
            where="bins",
            do=f"take at least {_FEWEST_BINS} bins per block",
        )
    bases = {k: _free(field, _blocks(field, k)) for k in possible}
    gain = {k: float(_gain(field, field.white, base)) for k, base in bases.items()}
    k = max(gain, key=lambda number: gain[number])
    noise = field.noise(CORRELATION_DRAWS, rng)
    by_chance = np.max([_gain(field, noise, base) for base in bases.values()], axis=0)
    above = int((by_chance >= gain[k]).sum())
    p_value = (1 + above) / (CORRELATION_DRAWS + 1)
    if not above:
        p_value = min(p_value, len(possible) * min(_tail(field, b) for b in bases.values()))
    higher = _order_with(_freedom(bases[k]), order)
    smooth = _free(field, polynomials(field.x, field.y, field.used, higher))
    rms, pattern = _described(field, bases[k])
    return ResidualPartition(
        k, float(p_value), gain, float(_gain(field, field.white, smooth)), rms, pattern
    )


def _blocks(field: ResidualField, k: int) -> Float:
    """Design matrix (M, 3 k^2) for the offset and the tilts along x and y of each block."""
    (sy, ty), (sx, tx) = (_shares(n, k) for n in field.used.shape)
    pairs = (sy, sx), (sy, tx), (ty, sx)
    columns = [np.einsum("yi,xj->yxij", a, b)[field.used] for a, b in pairs]
    return np.concatenate([c.reshape(field.n_used, -1) for c in columns], axis=1)


def _shares(n: int, k: int) -> tuple[Float, Float]:
    """Overlap (n, k) of each of n bins with each of k blocks, and its first moment (n, k).

    The overlap is a fraction of the bin.  The moment is the overlap times its position in the
    block, from -1 to 1.
    """
    low, edge = np.arange(n)[:, None] / n, np.arange(k) / k
    start, end = np.maximum(low, edge), np.minimum(low + 1 / n, edge + 1 / k)
    overlap = n * np.maximum(end - start, 0.0)
    return overlap, overlap * (k * (start + end - 2 * edge) - 1)


def _order_with(freedom: int, order: int) -> int:
    """Lowest polynomial order that has at least `freedom` more terms than `order`."""
    had = n_terms(order)
    while n_terms(order) - had < freedom:
        order += 1
    return order


def _free(field: ResidualField, columns: Float) -> Base:
    """Orthonormal bases (M, d) in u and v of columns (M, n), orthogonal to the polynomials."""
    out = []
    for absorbed, sem in zip(field.absorbed, field.sem, strict=True):
        white = columns / sem[:, None]
        size = np.linalg.norm(white, axis=0).max()
        left, values, _ = np.linalg.svd(white - absorbed @ (absorbed.T @ white), False)
        out.append(left[:, values > _RANK * size])
    base = out[0], out[1]
    if not _freedom(base) or _freedom(base) >= _freedom_of_all(field):
        raise DegenerateError(
            f"{field.n_used} bins cannot distinguish blocks from the fitted polynomial",
            where="bins",
            do="take more bins or a lower order",
        )
    return base


def _freedom(base: Base) -> int:
    """Degrees of freedom per axis, the mean of u and v."""
    return round(sum(b.shape[1] for b in base) / 2)


def _freedom_of_all(field: ResidualField) -> int:
    return field.n_used - field.absorbed.shape[2]


def _squares(field: ResidualField, white: Float, base: Base) -> tuple[Float, int, Float, int]:
    """Q, d, T - Q and D - d of whitened means (..., 2, M); see `residual_partition`."""
    along = [white[..., axis, :] @ columns for axis, columns in enumerate(base)]
    q, d = sum((a**2).sum(-1) for a in along), sum(a.shape[-1] for a in along)
    remainder = np.maximum((white**2).sum((-2, -1)) - q, np.finfo(float).tiny)
    return np.maximum(q, np.finfo(float).tiny), d, remainder, 2 * _freedom_of_all(field) - d


def _gain(field: ResidualField, white: Float, base: Base) -> Float:
    q, d, remainder, free = _squares(field, white, base)
    total = (q + remainder) / (d + free)
    gain = d * np.log(total * d / q) + free * np.log(total * free / remainder)
    return np.sign(q / d - remainder / free) * gain / 2


def _tail(field: ResidualField, base: Base) -> float:
    q, d, remainder, free = _squares(field, field.white, base)
    return float(f_sf((q / d) / (remainder / free), d, free))


def _described(field: ResidualField, base: Base) -> tuple[tuple[float, float], Float]:
    """Rms of the fitted blocks with their noise subtracted, and their values (2, ny, nx)."""
    rms, fitted = [], []
    for axis, columns in enumerate(base):
        sem = field.sem[axis]
        block_values = sem * (columns @ (columns.T @ field.white[axis]))
        noise = sem**2 * (columns**2).sum(axis=1)
        rms.append(float(np.sqrt(max(np.mean(block_values**2 - noise), 0.0))))
        fitted.append(block_values)
    pattern = np.where(field.used, field.image(np.stack(fitted)), np.nan)
    return (rms[0], rms[1]), pattern


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
    rings = _SeparationRings.of(field)
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
class _SeparationRings:
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
    def of(cls, field: ResidualField) -> _SeparationRings:
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
