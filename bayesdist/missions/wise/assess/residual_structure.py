"""Detection of a partition of the detector into blocks in the residuals.

If the point-source templates differ between blocks of the detector, the blocks appear in the
residuals (WSDC D-T033, section 5: 5 x 5 blocks in W1 and W2).  For each k, independent planes in
k x k blocks are fitted to the binned residuals.  The k with the largest gain in likelihood, given
its degrees of freedom, is selected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayesdist.diagnose.residuals.binned import BinnedResiduals
from bayesdist.errors import DegenerateError, InputError
from bayesdist.missions.wise.assess.residual_field import (
    ResidualField,
    polynomials,
    residual_field,
)
from bayesdist.model.basis import n_terms
from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import f_sf
from bayesdist.utils.limits import STRUCTURE

Base = tuple[Float, Float]

PARTITIONS = tuple(range(2, 13))
DRAWS = 999
# required gain in log likelihood over a polynomial with as many terms: odds of 1000 to 1
_EDGES = float(np.log(1000.0))
# minimum number of bins along the side of a block, whose plane has three parameters
_FEWEST_BINS = 3
# singular values below this fraction of the largest are rounding errors
_RANK = 1e-8


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
    noise = field.noise(DRAWS, rng)
    by_chance = np.max([_gain(field, noise, base) for base in bases.values()], axis=0)
    above = int((by_chance >= gain[k]).sum())
    p_value = (1 + above) / (DRAWS + 1)
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
