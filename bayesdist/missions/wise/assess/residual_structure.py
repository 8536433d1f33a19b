"""A partition left in residuals: blocks of the detector that stand apart.

Point-source templates that change from block to block print their blocks on the residuals (WSDC
D-T033, section 5: 5 x 5 in W1 and W2).  For each k, planes in k x k blocks that need not meet at
the edges are fitted to the binned residuals, and the k that explains most for its freedom is named.
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
from bayesdist.model.basis import polynomial_terms
from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import f_sf
from bayesdist.utils.limits import STRUCTURE

Base = tuple[Float, Float]

PARTITIONS = tuple(range(2, 13))
DRAWS = 999
# log likelihood that blocks must gain over a polynomial of as many terms: odds of 1000 to 1
_EDGES = float(np.log(1000.0))
# bins on a side of the smallest block: its plane has three numbers
_FEWEST_BINS = 3
# directions below this part of the largest are rounding
_RANK = 1e-8


@dataclass(frozen=True, eq=False)
class ResidualPartition:
    """The k x k partition that explains most of binned residuals."""

    k: int  # blocks on each axis
    p_value: float  # probability that noise alone explains as much under the best of all k tried
    # by k: gain in log likelihood by the blocks; negative where they differ less than the rest
    gain: Mapping[int, float]
    # the same for a polynomial over the detector of as many free terms as the blocks have
    gain_smooth: float
    # of the blocks over the detector in u and v, their noise subtracted, in the unit of the
    # residuals
    rms: tuple[float, float]
    pattern: Float  # (2, ny, nx), the blocks as fitted, in the bins; NaN in bins not used

    @property
    def significant(self) -> bool:
        """True if there is more than chance."""
        return not STRUCTURE.met_by(self.p_value)

    @property
    def edges_seen(self) -> bool:
        """True if it is blocks: a polynomial of as many terms explains smooth structure better."""
        return self.significant and self.gain[self.k] - self.gain_smooth > _EDGES

    @property
    def sentence(self) -> str:
        """Sentence on what was found."""
        if not self.significant:
            return f"No partition of the detector stands out in residuals (p = {self.p_value:.2g})."
        size = float(np.hypot(*self.rms))
        if self.edges_seen:
            return (
                f"The residuals hold a pattern of {self.k} x {self.k} blocks, {size:.2g} rms "
                f"(p = {self.p_value:.1g})."
            )
        return (
            f"The residuals hold structure of {size:.2g} rms (p = {self.p_value:.1g}) without the "
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
    """Look for a partition of the detector in binned residuals.

    Blocks have d directions that the fitted polynomial leaves free, out of D in all; Q is the sum
    of squares along them, T that of all.  With a variance of its own for the blocks, and another
    for the rest, the log likelihood gains

        (D log(T / D) - d log(Q / d) - (D - d) log((T - Q) / (D - d))) / 2.

    The rest is measured, not taken from the quoted noise: where means are so exact that every finer
    partition explains more of what blocks do not describe, only one that describes it well gains.
    Bins that an edge cuts belong to both blocks by their areas, so that 31 bins serve 5 blocks.

    The p-value counts noise fields under which the best of all k gains more; where none does,
    Bonferroni's bound on the F test is given if that is smaller.  Noise counts as independent
    between bins and between axes.

    `bins`: 31 on an axis show up to 10 blocks, 45 all twelve. `order`: of the polynomial fitted to
    these stars. `tried`: numbers of blocks on an axis, at least 2; those above a third of the bins
    are left out. InputError for a number of blocks below 2, none that the bins can show, and as
    `residual_field`. DegenerateError as `residual_field`, and when blocks have no freedom beside
    the polynomial or leave none.
    """
    field = residual_field(bins, order=order)
    if any(k < 2 or int(k) != k for k in tried):
        raise InputError(f"the numbers of blocks are {list(tried)}", do="give whole numbers from 2")
    possible = [int(k) for k in tried if _FEWEST_BINS * k <= min(field.used.shape)]
    if not possible:
        raise InputError(
            f"{min(field.used.shape)} bins on an axis show none of {list(tried)} blocks",
            where="bins",
            do=f"take {_FEWEST_BINS} bins or more for a block",
        )
    bases = {k: _free(field, _blocks(field, k)) for k in possible}
    gain = {k: float(_gain(field, field.white, base)) for k, base in bases.items()}
    k = max(gain, key=lambda one: gain[one])
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
    """Columns (M, 3 k^2): each block's offset and its tilts along x and y."""
    (sy, ty), (sx, tx) = (_shares(n, k) for n in field.used.shape)
    pairs = (sy, sx), (sy, tx), (ty, sx)
    columns = [np.einsum("yi,xj->yxij", a, b)[field.used] for a, b in pairs]
    return np.concatenate([c.reshape(field.n_used, -1) for c in columns], axis=1)


def _shares(n: int, k: int) -> tuple[Float, Float]:
    """Share (n, k) of each of n bins in each of k blocks, and that times its place in the block.

    Places go from -1 to 1.
    """
    low, edge = np.arange(n)[:, None] / n, np.arange(k) / k
    start, end = np.maximum(low, edge), np.minimum(low + 1 / n, edge + 1 / k)
    share = n * np.maximum(end - start, 0.0)
    return share, share * (k * (start + end - 2 * edge) - 1)


def _order_with(freedom: int, order: int) -> int:
    """The lowest order above the fitted one with so many more terms."""
    had = len(polynomial_terms(order))
    while len(polynomial_terms(order)) - had < freedom:
        order += 1
    return order


def _free(field: ResidualField, columns: Float) -> Base:
    """Orthonormal columns (M, d) of u and of v: what given ones do that the fitted cannot."""
    out = []
    for absorbed, sem in zip(field.absorbed, field.sem, strict=True):
        white = columns / sem[:, None]
        size = np.linalg.norm(white, axis=0).max()
        left, values, _ = np.linalg.svd(white - absorbed @ (absorbed.T @ white), False)
        out.append(left[:, values > _RANK * size])
    base = out[0], out[1]
    if not _freedom(base) or _freedom(base) >= _freedom_of_all(field):
        raise DegenerateError(
            f"{field.n_used} bins do not tell blocks from the fitted polynomial",
            where="bins",
            do="take more bins or a lower order",
        )
    return base


def _freedom(base: Base) -> int:
    """Directions on one axis, the mean of u and v."""
    return round(sum(b.shape[1] for b in base) / 2)


def _freedom_of_all(field: ResidualField) -> int:
    return field.n_used - field.absorbed.shape[2]


def _squares(field: ResidualField, white: Float, base: Base) -> tuple[Float, int, Float, int]:
    """Q, d, T - Q and D - d of whitened means (..., 2, M)."""
    along = [white[..., axis, :] @ columns for axis, columns in enumerate(base)]
    q, d = sum((a**2).sum(-1) for a in along), sum(a.shape[-1] for a in along)
    rest = np.maximum((white**2).sum((-2, -1)) - q, np.finfo(float).tiny)
    return np.maximum(q, np.finfo(float).tiny), d, rest, 2 * _freedom_of_all(field) - d


def _gain(field: ResidualField, white: Float, base: Base) -> Float:
    q, d, rest, free = _squares(field, white, base)
    total = (q + rest) / (d + free)
    gain = d * np.log(total * d / q) + free * np.log(total * free / rest)
    return np.sign(q / d - rest / free) * gain / 2


def _tail(field: ResidualField, base: Base) -> float:
    q, d, rest, free = _squares(field, field.white, base)
    return float(f_sf((q / d) / (rest / free), d, free))


def _described(field: ResidualField, base: Base) -> tuple[tuple[float, float], Float]:
    """Rms of the fitted blocks without their noise, and the blocks in the bins."""
    rms, fitted = [], []
    for axis, columns in enumerate(base):
        sem = field.sem[axis]
        found = sem * (columns @ (columns.T @ field.white[axis]))
        noise = sem**2 * (columns**2).sum(axis=1)
        rms.append(float(np.sqrt(max(np.mean(found**2 - noise), 0.0))))
        fitted.append(found)
    pattern = np.where(field.used, field.image(np.stack(fitted)), np.nan)
    return (rms[0], rms[1]), pattern
