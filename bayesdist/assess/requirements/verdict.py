"""Verdicts on requirements, the probabilities that they rest on, and their assumptions.

The probability of meeting a limit is the fraction of draws that meet it. Its error depends on the
effective number of independent draws (`Tally`), since draws may share members of a finite set of
draws. A verdict is also subject to assumptions about residuals, catalogue and dates: checks test
these as far as possible, and clauses state them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from bayesdist.assess.terms.forms import Pool
from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.diagnose.diagnostics import Diagnostics
from bayesdist.diagnose.statistics import clopper_pearson
from bayesdist.infer import Posterior
from bayesdist.infer.posterior.checks import sampling_checks
from bayesdist.model import DistortionModel
from bayesdist.model.timedep import TimeDependence
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.checks import (
    CONFIDENCE,
    COUNTING_ERROR,
    EITHER,
    EXCEEDS,
    LARGER,
    Check,
    doubts_of,
)
from bayesdist.utils.distributions import beta_std
from bayesdist.utils.text import count, probability_words

# level of a check for each verdict, from best to worst
VERDICT_LEVELS = {"met": "pass", "not shown": "warn", "undecided": "warn", "missed": "fail"}
MISSED_BELOW = round(1.0 - EXCEEDS.value, 12)  # largest probability of meeting a missed limit
GROUP = "Assumptions"
UNEXAMINED = Check(
    "Fit",
    "Residuals",
    "not examined",
    "bd.diagnose",
    "warn",
    "the residuals were not examined; give diagnostics=bd.diagnose(posterior, matches)",
    # structure would make errors larger; overestimated quoted errors would make them smaller
    EITHER,
)


def counting_error(fraction: float, n: float) -> float:
    """Standard deviation of a probability counted in n draws, with Jeffreys' prior; never zero.

    `fraction` is the fraction of draws that were counted.
    """
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
    """Clauses that state the assumptions and measurements on which a verdict at an epoch is based.

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
        return (
            f"a position in a new exposure, which deviates as {n} exposures do and whose shift and "
            "rotation are fitted, so that errors common to the whole field vanish"
        )
    linear = None if correlated is None else correlated.linear
    if linear is None or "shape" not in linear.scatter:
        return f"{n} exposures" if n > 1 else "one exposure, or the mean of several"
    size = float(np.median(linear.scatter["shape"]))
    variation = f"whose {'scale and shears' if 'scale' in linear.kinds else 'shears'}"
    variation += f" scatter by {size:.1g}"
    if single:
        return f"a position in a single exposure, as {linear.n_exposures} exposures, {variation}"
    return f"a position in the mean of {linear.n_exposures} exposures, {variation}"


@dataclass(eq=False)
class Tally:
    """Draws of a statistic compared with its limit, in one or several sets of draws.

    Parameters
    ----------
    limit : float
        Limit in the unit of the values.
    values : list of ndarray
        The statistic of each draw, for each set of draws.
    pools : list of tuple of Pool
        Finite sets from which the draws of the errors were taken, for each set of draws; with the
        same terms in the same order.
    """

    limit: float
    values: list[Float] = field(default_factory=list)
    pools: list[tuple[Pool, ...]] = field(default_factory=list)

    def add(self, values: Float, pools: tuple[Pool, ...]) -> None:
        """Add the values (n,) of further draws, and the sets from which they were taken."""
        self.values.append(values)
        self.pools.append(pools)

    @property
    def all_values(self) -> Float:
        """The statistic of every draw, shape (n,)."""
        return np.concatenate(self.values)

    @property
    def n(self) -> int:
        """Number of draws."""
        return sum(len(values) for values in self.values)

    @property
    def fraction(self) -> float:
        """Fraction of draws that do not exceed the limit."""
        return float(np.mean(self.all_values <= self.limit))

    def effective(self) -> tuple[float, float]:
        """Effective number of independent draws, and its limit for an infinite number of draws.

        Let n draws contain terms that are taken from finite sets of m independent draws each. The
        variance of the fraction p of the draws that meet the limit is at most

            p (1 - p) / n + sum(s / m)

        where s is the covariance of two draws that use the same draw of the set (Hoeffding's
        decomposition; the sum of s is at most p (1 - p)). It is estimated from such pairs, and two
        standard errors are added; without pairs it is p (1 - p).

        Returns
        -------
        now, limit : float
            At least 1; the second is infinite without finite sets.
        """
        met = self.all_values <= self.limit
        n, p = len(met), float(np.mean(met))
        variance = p * (1.0 - p)
        sizes, shares = [], []
        for k in range(len(self.pools[0])):
            term_pools = [pools[k] for pools in self.pools]
            sizes.append(
                sum(pool.size for pool in term_pools)
                if term_pools[0].renewed
                else term_pools[0].size
            )
            shares.append(_share(met, p, term_pools) if variance > 0 else 1.0)
        if not sizes:
            return float(n), np.inf
        worst = 1.0 / min(sizes)
        fixed = min(float(np.dot(shares, 1.0 / np.array(sizes))), worst)
        return max(1.0 / (1.0 / n + fixed), 1.0), max(1.0 / fixed, 1.0) if fixed > 0 else np.inf


def _share(met: Bool, p: float, pools: list[Pool]) -> float:
    """Covariance of two draws with the same draw of a set, relative to their variance.

    `met`: True for each draw that meets the limit, shape (n,). `p`: mean of `met`. `pools`: the set
    for each set of draws.
    """
    rows: list[Int] = []
    first = 0
    for pool in pools:
        if pool.rows is None:
            return 1.0
        rows.append(pool.rows + first)
        if pool.renewed:
            first += int(pool.rows.max()) + 1
    number = np.concatenate(rows)
    n_draws = np.bincount(number).astype(float)
    n_met = np.bincount(number, met)
    n_pairs = float(np.sum(n_draws * (n_draws - 1.0)))
    if n_pairs == 0:
        return 1.0
    products = (n_met - p * n_draws) ** 2 - (n_met * (1.0 - 2.0 * p) + p**2 * n_draws)
    share = float(products.sum()) / n_pairs / (p * (1.0 - p))
    # each of the n_pairs / 2 distinct pairs has a product with variance (p (1 - p))^2
    return float(np.clip(share + 2.0 * np.sqrt(2.0 / n_pairs), 0.0, 1.0))


def assumption_checks(
    posterior: Posterior | None,
    diagnostics: Diagnostics,
    time: TimeDependence | None,
    *,
    catalogue_stated: bool | None,
    motions_stated: bool | None,
) -> tuple[Check, ...]:
    """Checks of the sampling, the fit, the matching, the catalogue and the dates.

    A verdict relies on all of these, in addition to `Diagnostics.checks`.

    Parameters
    ----------
    posterior : Posterior or None
        None for a fit that was not sampled.
    diagnostics : Diagnostics
        Diagnostics of the posterior or of the fit.
    time : TimeDependence or None
        Time dependence of the model.
    catalogue_stated, motions_stated : bool or None
        True if errors of the reference catalogue's positions, and of its proper motions, are
        stated; None without a catalogue.

    Returns
    -------
    tuple of Check
    """
    return (
        *sampling_checks(posterior),
        *diagnostics.checks_of_input,
        *catalogue_checks(catalogue_stated),
        *time_checks(time, diagnostics.dates, motions_stated),
    )


def catalogue_checks(catalogue_stated: bool | None) -> Iterator[Check]:
    """Check that errors of the reference catalogue are stated; no check without a catalogue."""
    if catalogue_stated is None:
        return
    name, limit = "Error of the reference catalogue", "[catalogue], a row of [[budget]] or table"
    if catalogue_stated:
        yield Check(GROUP, name, "stated", limit, "pass")
        return
    sentence = (
        "no error of the reference catalogue is stated: name a catalogue with published errors, as "
        "[catalogue] name = 'Gaia DR3' or in Python catalogue=bd.Catalogue('Gaia DR3'), or give a "
        "[[budget]] row that is named after the catalogue; an error of 0 needs a source"
    )
    yield Check(GROUP, name, "not stated", limit, "warn", sentence, LARGER)


def time_checks(
    time: TimeDependence | None, dates: Float, motions_stated: bool | None
) -> Iterator[Check]:
    """Checks that the data constrain a drift and that errors of the proper motions are stated.

    `time`: time dependence of the model; nothing is checked if it is None. `dates`: dates of the
    matches, decimal years. `motions_stated`: None without a catalogue.
    """
    if time is None:
        return
    segment = np.searchsorted(time.breaks, dates, side="right")
    counts = [visits_of(dates[segment == k], whole=dates).size for k in np.unique(segment)]
    if counts and min(counts) <= 2:
        yield Check(
            GROUP,
            "Dates that the drift is fitted to",
            level="warn",
            sentence=f"a drift is fitted to {('one date', 'two dates')[min(counts) - 1]}, so that "
            "neither the variation between exposures nor the curvature of the drift is measured",
            doubt=EITHER,
        )
    if motions_stated is False:
        yield Check(
            GROUP,
            "Error of the proper motions",
            "not stated",
            "a row of [[budget]] or of the table",
            "warn",
            "no error of the catalogue's proper motions is stated, and the drift is "
            "measured against them: give a [[budget]] row that names the motions, of size 0 with "
            "its source where they have none",
            LARGER,
        )


def visits_of(dates: Float, *, whole: Float | None = None) -> Float:
    """Start dates of the visits, ascending; consecutive exposures form one visit.

    `dates` has shape (E,) and is in decimal years. A visit spans at most one day or 2 % of the
    baseline, defined by the dates `whole`; `dates` by default.
    """
    if not dates.size:
        return dates
    span = max(1 / 365.25, float(np.ptp(dates if whole is None else whole)) / 50)
    ordered = np.unique(dates)
    first = [ordered[0]]
    while (i := np.searchsorted(ordered, first[-1] + span, side="right")) < ordered.size:
        first.append(ordered[i])
    return np.array(first)
