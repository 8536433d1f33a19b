"""What the status on top of the report says of structure in the residuals."""

from __future__ import annotations

from collections.abc import Sequence

from bayesdist.assess.misfit import SIGNIFICANT, Misfit, worst_misfit
from bayesdist.report.context import Check
from bayesdist.report.numbers import display_scale, number, percent, probability

__all__ = ["structure_check"]


def structure_check(misfits: Sequence[Misfit], *, fit: str) -> Check:
    """Whether a fit leaves structure in the residuals: what the banner warns of.

    Parameters
    ----------
    misfits : sequence of Misfit
        One for each chip.
    fit : str
        Which fit, in words.

    Returns
    -------
    Check
    """
    worst = worst_misfit(misfits)
    chip = "" if worst.chip is None else f" of {worst.chip.name}"
    size = display_scale(worst.unit, worst.structure).text(worst.structure, 2)
    found = f"{size} rms in {worst.partition}{chip}" if worst.structure > 0 else "none"
    if worst.told < 1:
        found += f" ({percent(worst.told, 2)} of all patterns can be told from places of stars)"
    return Check(
        f"Structure in the residuals of {fit}, beyond noise",
        f"{found}, {probability(worst.p_value)}",
        f"p at least {number(SIGNIFICANT, 1)}",
        "warn" if worst.significant or worst.hidden else "pass",
    )
