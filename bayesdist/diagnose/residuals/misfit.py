"""Does the model describe the stars?  Structure in the residuals, and inconsistent errors.

The posterior is conditional on the model.  If the model lacks structure, its uncertainty does not
include that structure, and no requirement can be called met.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre

from bayesdist.diagnose.residuals.binned import BinnedResiduals, BinnedSums
from bayesdist.model import Chip
from bayesdist.model.basis import polynomial_terms
from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import chi2_sf
from bayesdist.utils.limits import STRUCTURE, STRUCTURE_SEEN
from bayesdist.utils.numbers import p_words, size_of

STARS_PER_BIN = 25
MAX_BINS = 32  # along each side


@dataclass(frozen=True)
class Misfit:
    """Structure in binned residuals."""

    # probability of so much structure by chance, for the most significant of three partitions
    # (cells, columns, rows), multiplied by three, and by the number of chips for the worst of
    # several chips
    p_value: float
    partition: str  # name of that partition
    # rms of the mean residual over that partition, with the noise subtracted (both axes together);
    # weighted by precision if the noisiest cells would hide significant structure
    structure: float
    unit: str
    chip: Chip | None = None  # None if the detector has a single chip
    # fraction of the patterns over the partitions that can be detected; below 1 if fitted stars
    # absorb some
    power: float = 1.0

    @property
    def significant(self) -> bool:
        """True if the structure is significant."""
        return not STRUCTURE.met_by(self.p_value)

    @property
    def underpowered(self) -> bool:
        """True if most structure would not have been detected."""
        return not STRUCTURE_SEEN.met_by(self.power)

    @property
    def sentence(self) -> str:
        """Meaning and consequence of the structure, as a clause."""
        return f"{self.finding}, so that errors are larger than the posterior says"

    @property
    def finding(self) -> str:
        """Meaning of the structure, as a clause."""
        part = "the detector" if self.chip is None else f"chip {self.chip.name}"
        size = size_of(self.structure, self.unit, 2).replace("\u202f", " ")
        return (
            f"the residuals hold structure that the model does not describe ({size} rms in "
            f"{self.partition} of {part}, {p_words(self.p_value)})"
        )


def partitions_for(n: int) -> dict[str, tuple[int, int]]:
    """Partitions of the detector that `misfit_of` tests, for `n` stars.

    Returns the number of bins in x and y by name.
    """
    side = int(np.clip(np.sqrt(n / STARS_PER_BIN), 3, MAX_BINS))
    strips = int(np.clip(n / STARS_PER_BIN, 3, 2 * MAX_BINS))
    return {"cells": (side, side), "columns": (strips, 1), "rows": (1, strips)}


def misfit_of(sums: Mapping[str, BinnedSums], *, order: int | None = None, unit: str) -> Misfit:
    """Test residuals for structure over the detector.

    `sums` are those of the residuals of stars that were not rejected, for each of `partitions_for`.
    `order` is the order of the polynomial that was fitted to the residuals on both axes; `unit` is
    the unit of the residuals.
    """
    misfits = []
    for name, partition_sums in sums.items():
        p, structure = _test(partition_sums.residuals(), _absorbed(partition_sums, order))
        misfits.append(Misfit(p, name, structure, unit))
    return worst_misfit(misfits)


def worst_misfit(found: Sequence[Misfit]) -> Misfit:
    """Most significant of several chips or partitions, corrected for their number."""
    # many p-values underflow to zero: then the larger structure is the worse one
    worst = min(found, key=lambda m: (m.p_value, -m.structure))
    return replace(worst, p_value=min(1.0, len(found) * worst.p_value))


def _absorbed(sums: BinnedSums, order: int | None) -> float:
    """Degrees of freedom, on both axes, that the polynomial removes from means over these bins.

    A term removes from the bins what remains of it after averaging over them: nothing if it
    oscillates within a bin, like all terms that vary along a column in the partition into columns.
    """
    if order is None:
        return 0.0
    passed_y, passed_x = (_passed(n, order) for n in sums.count.shape)
    return 2.0 * sum(passed_x[i] * passed_y[j] for i, j in polynomial_terms(order))


def _passed(n: int, order: int) -> Float:
    """Mean square of each Legendre polynomial averaged over n equal bins, relative to its own."""
    means = bin_means(n, order)
    return (2 * np.arange(order + 1) + 1) * np.mean(means**2, axis=1)


def bin_means(n: int, order: int) -> Float:
    """Means (order + 1, n) of each Legendre polynomial over n equal bins."""
    edges = np.linspace(-1.0, 1.0, n + 1)
    integrals = [legendre.Legendre.basis(k).integ()(edges) for k in range(order + 1)]
    return np.asarray(np.diff(integrals, axis=1) * n / 2)


def _test(cells: BinnedResiduals, absorbed: float) -> tuple[float, float]:
    good = cells.count >= 5
    n = cells.count[good]
    # the square of a t variable is larger than that of a normal variable
    shrink = np.sqrt((n - 3) / (n - 1))
    mean = np.stack([cells.mean_u[good], cells.mean_v[good]])
    sem = np.stack([cells.sem_u[good], cells.sem_v[good]]) / shrink
    sem = np.maximum(sem, np.finfo(float).tiny ** 0.25)  # residuals may be equal to the last bit
    total = float(((mean / sem) ** 2).sum())
    dof = max(mean.size - absorbed * n.size / cells.count.size, 1.0)
    p = float(chi2_sf(total, dof))
    excess = (mean**2 - sem**2).sum(axis=0).mean() if n.size else 0.0
    if excess <= 0 and not STRUCTURE.met_by(p):  # hidden by the noisiest cells: weight by precision
        excess = 2 * (total - dof) / (1 / sem**2).sum()
    return p, float(np.sqrt(max(excess, 0.0)))
