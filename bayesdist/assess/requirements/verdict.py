"""Verdict on a requirement from a probability counted in draws, and its assumptions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesdist.assess.checks import visits_of
from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.statistics import clopper_pearson
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float
from bayesdist.utils.checks import LARGER, Check, doubts_of
from bayesdist.utils.distributions import beta_std
from bayesdist.utils.limits import CONFIDENCE, COUNTING_ERROR, EXCEEDS
from bayesdist.utils.numbers import count, probability_words

# level of a check for each verdict, from best to worst
VERDICT_LEVELS = {"met": "pass", "not shown": "warn", "undecided": "warn", "missed": "fail"}
MISSED_BELOW = round(1.0 - EXCEEDS.value, 12)  # largest probability of meeting a missed limit


def counting_error(fraction: float, n: float) -> float:
    """Standard deviation of a probability counted in n draws, with Jeffreys' prior; never zero."""
    k = fraction * n
    return beta_std(k + 0.5, n - k + 0.5)


def undecided_by_draws(fraction: float, n: float, bounds: Sequence[float]) -> bool:
    """True if the 99 % Clopper-Pearson interval of a probability contains one of the bounds.

    `fraction`: fraction of draws that meet the limit. `n`: effective number of draws.
    """
    low, high = clopper_pearson(fraction, n, CONFIDENCE.value)
    return any(low < bound <= high for bound in bounds)


def verdict_of(
    fraction: float, n: float, asked: float, checks: Sequence[Check] = ()
) -> tuple[str, str]:
    """Verdict on the probability of meeting a limit, and its reason.

    Parameters
    ----------
    fraction : float
        Fraction of draws that meet the limit.
    n : float
        Effective number of draws.
    asked : float
        Required probability.
    checks : sequence of Check
        Checks; doubts that they raise make the verdict undecided.

    Returns
    -------
    verdict : str
        'met' if the probability of meeting the limit is at least the required one; 'missed' if the
        limit is exceeded with a probability of at least 0.95; else 'not shown'. The estimate is
        decisive if its 99 % Clopper-Pearson interval is on one side of the bound, or if its
        standard error is at most 0.005; otherwise the verdict is 'not shown'. With doubts it is
        'undecided', but 'missed' remains if all doubts can only make errors larger.
    reason : str
        Reason for the verdict; with doubts also the verdict of the draws alone.
    """
    error = counting_error(fraction, n)
    exact = COUNTING_ERROR.met_by(error)
    near = f"{probability_words(fraction, error, n)}, within its Monte-Carlo error of"
    n_draws = f"{count(n)} effective draws"
    on_asked, on_missed = (
        undecided_by_draws(fraction, n, [bound]) for bound in (asked, MISSED_BELOW)
    )
    if fraction >= asked and (exact or not on_asked):
        verdict, reason = "met", f"the probability is at least the {asked:g} asked for"
        if on_asked:
            reason = f"{near} the {asked:g} asked for ({n_draws})"
    elif fraction <= MISSED_BELOW and (exact or not on_missed):
        verdict = "missed"
        reason = f"the limit is exceeded with a probability of at least {EXCEEDS.value:g}"
        if on_missed:
            reason = f"{near} {MISSED_BELOW:g} ({n_draws})"
    else:
        verdict = "not shown"
        reason = (
            f"the probability is below the {asked:g} asked for, and that of exceeding the limit is "
            f"below {EXCEEDS.value:g}: errors have to be smaller, by more stars or exposures, or "
            "by better knowledge of the largest term"
        )
        if on_asked or on_missed:
            bound = asked if on_asked else MISSED_BELOW
            reason = f"{near} {bound:g} ({n_draws}): "
            reason += "more draws (sampler.target_ess, assess.draws) decide it"
    doubts = doubts_of(checks)
    if not doubts or (verdict == "missed" and all(doubt.doubt == LARGER for doubt in doubts)):
        return verdict, reason
    texts = "; ".join(doubt.sentence for doubt in doubts)
    alone = {
        "met": f"the stated errors alone would meet it ({reason})",
        "missed": f"the stated errors alone would miss it ({reason})",
        "not shown": f"the stated errors alone would show neither ({reason})",
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
    """Clauses on what a verdict at an epoch assumes or is based on.

    `epoch`: decimal years. `given`: names of the errors that the user states. `aligned`, `single`:
    see `error_model`. `dates`: dates of the matches, decimal years.
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
        detectable = max(sizes, default=None)
        text = f"{len(passed)} of {len(tests)} tests of the residuals found nothing"
        if detectable is not None:
            text += f"; each would have found {detectable:.2g} {model.unit} rms"
        out.append(text)
    held = diagnostics.holdout
    out.append("no held-out stars" if held is None else held.verdict)
    return tuple(out)


def _structure(correlated: Discrepancy, unit: str) -> str:
    """Clause on the structure beyond the polynomial that is included."""
    rows = correlated.facts.get("structure", [])
    if not rows:
        return "look-up tables, with their errors"
    median, upper = (
        float(np.sqrt(np.mean([row[key] ** 2 for row in rows]))) for key in ("median", "most")
    )
    return (
        f"structure beyond it of {median:.2g} {unit} rms on an axis, at most {upper:.2g} with 95 % "
        "probability, from residuals and prior"
    )


def _exposures(
    model: DistortionModel, correlated: Discrepancy | None, *, aligned: bool, single: bool
) -> str:
    """Clause on the exposures for which the position is valid."""
    n = len(model.exposures)
    if aligned:
        return f"a position in a new exposure, which deviates as {n} exposures do"
    linear = None if correlated is None else correlated.linear
    if linear is None or "shape" not in linear.scatter:
        return f"{n} exposures" if n > 1 else "one exposure, or the mean of several"
    size = float(np.median(linear.scatter["shape"]))
    variation = f"whose {'scale and shears' if 'scale' in linear.kinds else 'shears'}"
    variation += f" scatter by {size:.1g}"
    if single:
        return f"a position in a single exposure, as {linear.n_exposures} exposures, {variation}"
    return f"a position in the mean of {linear.n_exposures} exposures, {variation}"
