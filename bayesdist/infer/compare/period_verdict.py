"""One sentence on the change of the distortion with time, and on its importance."""

from __future__ import annotations

from collections.abc import Mapping

from bayesdist.infer.compare.periods import PeriodComparison
from bayesdist.infer.compare.positions import PositionChange
from bayesdist.limits import DIFFERENCE

__all__ = ["all_below", "period_verdict"]


def all_below(changes: Mapping[str, PositionChange], tolerance: float) -> bool:
    """True if no period differs by more than a tolerance, with two sigma allowed for errors."""
    # the largest value of a noisy field is biased high
    return all(one.largest + 2 * one.sigma <= tolerance for one in changes.values())


def period_verdict(
    comparison: PeriodComparison,
    changes: Mapping[str, PositionChange],
    tolerance: float | None = None,
) -> str:
    """Sentence on the size, significance and importance of the change with time.

    `changes` has every period against the combined model; differences of positions up to
    `tolerance`, in the unit of u, v, do not matter.
    """
    chi2, dof, p = comparison.homogeneity
    # the most significant, not the largest: the shortest period has the largest noise
    name, most = max(changes.items(), key=lambda one: one[1].chi2)
    unit = comparison.model.unit
    head = "The distortion changes" if p < DIFFERENCE.value else "No change is seen"
    out = (
        f"{head} (chi-square {chi2:.4g} for {dof} degrees of freedom, {_probability(p)}): "
        f"{name} differs most from the combined model, by up to {most.largest:.2g} +- "
        f"{most.sigma:.1g} {unit} at ({most.at[0]:.0f}, {most.at[1]:.0f}), where noise alone "
        f"makes {most.noise_median:.2g} (95 %: {most.noise_95:.2g})"
    )
    if tolerance is None:
        return out + "."
    limit = f"the tolerance of {tolerance:g} {unit}"
    if all_below(changes, tolerance):
        return f"{out}; all periods are below {limit}."
    beyond = [
        name
        for name, one in changes.items()
        if one.p_value < DIFFERENCE.value and one.largest - 2 * one.sigma > tolerance
    ]
    if beyond:
        return f"{out}; beyond {limit}: {', '.join(beyond)}."
    return f"{out}; the data do not decide whether a period exceeds {limit}."


def _probability(p: float) -> str:
    return "p < 1e-12" if p < 1e-12 else f"p = {p:.2g}"
