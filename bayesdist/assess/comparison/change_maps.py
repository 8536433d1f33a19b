"""Changes of a released solution as maps over the detector, and in sentences."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.assess.comparison.compare import Comparison, compare
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.diagnose.residuals.misfit import Misfit
from bayesdist.infer.compare.change_date import ChangeDate
from bayesdist.infer.compare.monitoring import SolutionChange
from bayesdist.utils.checks import DIFFERENCE
from bayesdist.utils.distributions import f_sf
from bayesdist.utils.text import p_words


@dataclass(frozen=True, eq=False)
class Monitored:
    """Change of a released solution as measured from new matches."""

    change: SolutionChange
    # new minus released, one per chip, in pixels: the mean change, or the change since `date`
    maps: tuple[Comparison, ...]
    date: ChangeDate | None  # None for matches without epochs
    misfit: Misfit  # structure that remains after the fit of the new matches
    pixel_mas: float | None = None

    @property
    def scatters(self) -> bool:
        """True if periods scatter more than their errors, so that errors are not independent."""
        return self.date is not None and self.date.p_scatter < DIFFERENCE.value

    @property
    def p_value(self) -> float:
        """Probability that chance alone gives a mean change at least as large.

        If the scatter of the periods is significantly larger than their errors, it is used instead
        of them.
        """
        test = self.change.test
        return self._judged(test.chi2, test.dof, test.p_value)

    @property
    def p_since(self) -> float | None:
        """Probability that chance alone gives a change at least as large at any of the dates.

        The result is None if the new matches have no epochs, or a single period.
        """
        if self.date is None or len(self.date.gain) == 1:
            return None
        gain, n = float(self.date.gain.max()), len(self.date.gain)
        alone = self.date.p_value / n
        return min(1.0, n * self._judged(gain, self.date.dof, alone))

    def _judged(self, chi2: float, dof: int, p: float) -> float:
        if not self.scatters or self.date is None:
            return p
        return float(f_sf(chi2 / dof / self.date.scatter, dof, self.date.scatter_dof))

    @property
    def p_either(self) -> float:
        """p-value of both tests combined: twice the smaller one of `p_value` and `p_since`."""
        return (
            self.p_value if self.p_since is None else min(1.0, 2 * min(self.p_value, self.p_since))
        )

    @property
    def changed(self) -> bool:
        """True if the released solution no longer describes the new matches."""
        return self.p_either < DIFFERENCE.value

    @property
    def since_a_date(self) -> bool:
        """True if the change starts at a date and is then more significant than the mean change."""
        return is_late(self.change, self.date)

    @property
    def worst(self) -> Comparison:
        """Comparison for the chip with the largest change."""
        return max(self.maps, key=lambda m: m.largest)

    @property
    def verdict(self) -> str:
        """Sentence that says whether the released solution still describes the new matches."""
        m, late = self.worst, self.since_a_date
        test = self.date.change.test if late and self.date is not None else self.change.test
        x, y = m.position_of_largest
        chip = f" of chip {m.a.chip}" if len(self.maps) > 1 else ""
        mas = "" if self.pixel_mas is None else f" ({m.largest * self.pixel_mas:.3g} mas)"
        size = (
            f"{m.rms:.3g} pix rms where errors alone make {m.noise_rms:.2g}, at most "
            f"{m.largest:.3g} +- {m.sigma_of_largest:.2g} pix{mas} at ({x:.0f}, {y:.0f}){chip}"
        )
        stated = (
            f"chi-square {test.chi2:.4g} for {test.dof} degrees of freedom, "
            f"{p_words(self.p_either, 2, 1e-12)}"
        )
        if self.date is not None and len(self.date.gain) > 1:
            stated += " with the search over dates"
        if not self.changed:
            return (
                f"The released solution still describes the new matches: change {size} ({stated})."
            )
        return (
            f"The released solution no longer describes the new matches: change {size} ({stated})"
            f"{self._since}."
        )

    @property
    def _since(self) -> str:
        date = self.date
        if date is None:
            return "; since when is not known without epochs"
        if not np.isfinite(date.after):
            when = "from the first new exposure on or before"
        else:
            when = f"since a date between {date.after:.3f} and {date.before:.3f}"
        low, high = date.interval
        if np.isfinite(low):
            return f"; {when} (95 %: {low:.3f} to {high:.3f})"
        return f"; {when} (95 %: not after {high:.3f})"

    @property
    def doubts(self) -> list[str]:
        """Reasons to doubt the verdict, as sentences."""
        out = []
        if self.scatters and self.date is not None:
            out.append(
                f"periods scatter {np.sqrt(self.date.scatter):.2g} times their errors: errors are "
                "correlated or too small, and the probabilities rest on the scatter instead"
            )
        if self.misfit.significant:
            out.append(self.misfit.sentence)
        return out


def is_late(change: SolutionChange, date: ChangeDate | None) -> bool:
    """True if a change within the new matches is significant, and more so than the mean change.

    `date` is the most likely date of a change within the new matches, if it was searched for.
    """
    if date is None or not np.isfinite(date.after):
        return False
    return date.p_value < min(DIFFERENCE.value / 2, change.test.p_value)


def change_maps(
    change: SolutionChange,
    *,
    rng: np.random.Generator,
    names: tuple[str, str],
    grid: tuple[int, int],
) -> tuple[Comparison, ...]:
    """Maps of the change of each chip over its grid.

    `names`: names of the new matches and of the released solution. Returns new minus released; the
    errors of both are in the covariance of the new one.
    """
    model, out = change.model, []
    size = 2 * model.n_terms
    for c, chip in enumerate(model.chips):
        basis = model.basis(chip.number)
        rows = slice(c * size, (c + 1) * size)
        cov = change.cov[rows, rows]
        coefficients = change.released[c]
        old = ChipMap(
            names[1], basis, model.unit, coefficients, chip=chip.number, epoch=change.epoch
        )
        new = replace(old, name=names[0], coefficients=coefficients + change.difference[c], cov=cov)
        out.append(compare(new, old, rng=rng, grid=grid, keep=True))
    return tuple(out)
