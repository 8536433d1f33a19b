"""The verdict on a requirement: a probability counted from draws, and what it rests on."""

from __future__ import annotations

from collections.abc import Sequence

from scipy.stats import beta

from bayesdist.checks import LARGER, Check, doubts_of
from bayesdist.diagnose.significance import clopper_pearson
from bayesdist.limits import CONFIDENCE
from bayesdist.numbers import count

__all__ = ["counting_error", "verdict_of"]


def counting_error(fraction: float, n: float) -> float:
    """Standard deviation of a probability counted in n draws, under Jeffreys' prior: never zero."""
    k = fraction * n
    return float(beta.std(k + 0.5, n - k + 0.5))


def verdict_of(
    fraction: float, n: float, asked: float, checks: Sequence[Check] = ()
) -> tuple[str, str]:
    """Verdict on the probability of meeting a limit, and its reason.

    `fraction`: of draws that meet the limit. `n`: effective number of draws. `asked`: the
    probability asked for. `checks`: nothing is met while one of them is a doubt. Returns `verdict`:
    'met' or 'missed' where the 99 % Clopper-Pearson interval lies wholly above or below the
    probability asked for, else 'undecided'.  With doubts 'missed' where the interval says so and
    all of them make errors larger, else 'undecided'. `reason`: what decided, and with doubts what
    the draws alone point to.
    """
    low, high = clopper_pearson(fraction, n, CONFIDENCE.value)
    interval = f"the probability is {low:.4f} to {high:.4f} (99 % Monte-Carlo interval)"
    if low >= asked:
        verdict, reason = "met", f"{interval}, at or above the {asked:g} asked for"
    elif high < asked:
        verdict, reason = "missed", f"{interval}, below the {asked:g} asked for"
    else:
        verdict = "undecided"
        reason = f"{interval}, on both sides of the {asked:g} asked for: too few effective draws"
        reason += f" ({count(n)})"
    doubts = doubts_of(checks)
    if not doubts or (verdict == "missed" and all(one.doubt == LARGER for one in doubts)):
        return verdict, reason
    texts = "; ".join(one.sentence for one in doubts)
    alone = {
        "met": f"the stated errors alone would meet it ({reason})",
        "missed": f"the stated errors alone would miss it ({reason})",
        "undecided": reason,
    }[verdict]
    return "undecided", f"{texts}; {alone}"
