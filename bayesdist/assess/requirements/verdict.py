"""The verdict on a requirement: a probability counted from draws, and what it rests on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesdist.assess.checks import visits_of
from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.significance import clopper_pearson
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import LARGER, Check, doubts_of
from bayesdist.utils.distributions import beta_std
from bayesdist.utils.limits import CONFIDENCE
from bayesdist.utils.numbers import count


def counting_error(fraction: float, n: float) -> float:
    """Standard deviation of a probability counted in n draws, under Jeffreys' prior: never zero."""
    k = fraction * n
    return beta_std(k + 0.5, n - k + 0.5)


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


def rests_on(
    model: DistortionModel,
    diagnostics: Diagnostics,
    epoch: float | None,
    *,
    given: Sequence[str],
    aligned: bool,
    single: bool,
    dates: Float,
) -> tuple[str, ...]:
    """Clauses on what a verdict at an epoch assumes, or has measured.

    `epoch`: decimal years. `given`: names of the errors that the user gives. `aligned`, `single`:
    as of `error_model`. `dates`: of the matches, decimal years.
    """
    out, correlated = [f"a polynomial of order {model.order}"], diagnostics.correlated
    if correlated is not None:
        out.append(_structure(correlated, model.unit))
    out.append(f"errors given by the user: {', '.join(given) or 'none'}")
    out.append(_exposures(model, correlated, aligned=aligned, single=single))
    if correlated is not None and correlated.facts.get("exposures_measured") is False:
        out.append("no variation between exposures, which is not measured")
    visits = visits_of(dates)
    if epoch is not None and visits.size:
        first, last = float(visits.min()), float(visits.max())
        beyond = max(first - epoch, epoch - last)
        text = f"{visits.size} dates from {first:.2f} to {last:.2f}"
        if visits.size == 1:
            text = f"one date, {first:.2f}"
        out.append(text + (f", judged {beyond:.1f} years beyond" if beyond > 0 else ""))
    tests = diagnostics.score_tests
    passed = [t for t in tests if not t.significant]
    if tests:
        sizes = (t.smallest for t in passed if np.isfinite(t.smallest) and t.unit == model.unit)
        least = max(sizes, default=None)
        text = f"{len(passed)} of {len(tests)} tests of the residuals found nothing"
        if least is not None:
            text += f"; each would have found {least:.2g} {model.unit} rms"
        out.append(text)
    held = diagnostics.holdout
    out.append("no held-out stars" if held is None else held.verdict)
    return tuple(out)


def _structure(correlated: Discrepancy, unit: str) -> str:
    """Clause on the structure beyond the polynomial that counts."""
    rows = correlated.facts.get("structure", [])
    if not rows:
        return "look-up tables, with their errors"
    median, most = (
        float(np.sqrt(np.mean([row[key] ** 2 for row in rows]))) for key in ("median", "most")
    )
    return (
        f"structure beyond it of {median:.2g} {unit} rms on an axis, at most {most:.2g} with 95 % "
        "probability, from residuals and prior"
    )


def _exposures(
    model: DistortionModel, correlated: Discrepancy | None, *, aligned: bool, single: bool
) -> str:
    """Of which exposures the position is one."""
    n = len(model.exposures)
    if aligned:
        return f"a position in a new exposure, which deviates as {n} exposures do"
    linear = None if correlated is None else correlated.linear
    if linear is None or "shape" not in linear.scatter:
        return f"{n} exposures" if n > 1 else "one exposure, or the mean of several"
    size = float(np.median(linear.scatter["shape"]))
    what = f"whose {'scale and shears' if 'scale' in linear.kinds else 'shears'}"
    what += f" scatter by {size:.1g}"
    if single:
        return f"a position in a single exposure, as {linear.n_exposures} exposures, {what}"
    return f"a position in the mean of {linear.n_exposures} exposures, {what}"
