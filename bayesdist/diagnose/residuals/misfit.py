"""Does the model describe the stars?  Structure left in the residuals, and errors that do not fit.

The posterior is that of the model: where the model leaves structure behind, its uncertainty says
nothing of it, and no requirement can be called met.
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

    # probability of as much structure by chance, of the most telling of three partitions: cells,
    # columns, rows; multiplied by three, and by the number of chips where the worst of several is
    # named
    p_value: float
    partition: str  # which one that is
    # rms over that partition of the mean residual, its noise subtracted (both axes together);
    # weighted by precision where the noisiest cells would hide what is significant
    structure: float
    unit: str
    chip: Chip | None = None  # the chip, where the detector has several
    # share of the patterns over the partitions that would have been seen: below 1 where fitted
    # stars hide some
    power: float = 1.0

    @property
    def significant(self) -> bool:
        """True where the structure is more than chance."""
        return not STRUCTURE.met_by(self.p_value)

    @property
    def underpowered(self) -> bool:
        """True where most structure would not have been seen."""
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
    """The partitions of the detector that `misfit_of` looks at.

    `n`: stars. Result: bins on x and on y, by name.
    """
    side = int(np.clip(np.sqrt(n / STARS_PER_BIN), 3, MAX_BINS))
    strips = int(np.clip(n / STARS_PER_BIN, 3, 2 * MAX_BINS))
    return {"cells": (side, side), "columns": (strips, 1), "rows": (1, strips)}


def misfit_of(sums: Mapping[str, BinnedSums], *, order: int | None = None, unit: str) -> Misfit:
    """Test residuals for structure over the detector.

    `sums`: of the residuals of the stars that were not rejected, in each of `partitions_for` so
    many. `order`: of the polynomial that the fit has taken out of the residuals of both axes.
    `unit`: of the residuals.
    """
    found = []
    for name, one in sums.items():
        p, structure = _test(one.residuals(), _absorbed(one, order))
        found.append(Misfit(p, name, structure, unit))
    return worst_misfit(found)


def worst_misfit(found: Sequence[Misfit]) -> Misfit:
    """The most telling of several chips or partitions, its probability corrected for their number.

    `found`: one for each.
    """
    # many p-values are zero in double precision: then the larger structure is the worse
    worst = min(found, key=lambda m: (m.p_value, -m.structure))
    return replace(worst, p_value=min(1.0, len(found) * worst.p_value))


def _absorbed(sums: BinnedSums, order: int | None) -> float:
    """Degrees of freedom, of both axes, that means over these bins have lost to the polynomial.

    A term takes from the bins what it keeps when it is averaged over them: nothing where it
    oscillates within a bin, as all that vary along a column do in columns.
    """
    if order is None:
        return 0.0
    passed_y, passed_x = (_passed(n, order) for n in sums.count.shape)
    return 2.0 * sum(passed_x[i] * passed_y[j] for i, j in polynomial_terms(order))


def _passed(n: int, order: int) -> Float:
    """Mean square of each Legendre polynomial, averaged over n equal bins, over its mean square."""
    means = bin_means(n, order)
    return (2 * np.arange(order + 1) + 1) * np.mean(means**2, axis=1)


def bin_means(n: int, order: int) -> Float:
    """Means of each Legendre polynomial over n equal bins, (order + 1, n)."""
    edges = np.linspace(-1.0, 1.0, n + 1)
    integrals = [legendre.Legendre.basis(k).integ()(edges) for k in range(order + 1)]
    return np.asarray(np.diff(integrals, axis=1) * n / 2)


def _test(cells: BinnedResiduals, absorbed: float) -> tuple[float, float]:
    good = cells.count >= 5
    n = cells.count[good]
    # the square of a t variable is larger than that of a normal one
    shrink = np.sqrt((n - 3) / (n - 1))
    mean = np.stack([cells.mean_u[good], cells.mean_v[good]])
    sem = np.stack([cells.sem_u[good], cells.sem_v[good]]) / shrink
    sem = np.maximum(sem, np.finfo(float).tiny ** 0.25)  # residuals may be equal to the last bit
    total = float(((mean / sem) ** 2).sum())
    dof = max(mean.size - absorbed * n.size / cells.count.size, 1.0)
    p = float(chi2_sf(total, dof))
    excess = (mean**2 - sem**2).sum(axis=0).mean() if n.size else 0.0
    if excess <= 0 and not STRUCTURE.met_by(p):  # hidden by the noisiest cells: by its precision
        excess = 2 * (total - dof) / (1 / sem**2).sum()
    return p, float(np.sqrt(max(excess, 0.0)))
