"""Checks of what residuals and held-out stars say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bayesdist.checks import LARGER, Check
from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.diagnose.correlated.deviations import CURVATURE
from bayesdist.diagnose.holdout.validation import HoldoutValidation
from bayesdist.diagnose.residuals.misfit import Misfit, worst_misfit
from bayesdist.diagnose.score.result import ScoreTest
from bayesdist.limits import HELD_OUT_DOUBTFUL, STRUCTURE, STRUCTURE_IN_BUDGET
from bayesdist.numbers import count, number, percent, probability, size_of

__all__ = ["SCORE_TESTS", "holdout_checks", "score_checks", "structure_checks"]

FIT, HELD_OUT, SCORE_TESTS = "Fit", "Held-out truth", "Score tests"


def structure_checks(
    misfits: Sequence[Misfit], correlated: Discrepancy | None = None
) -> Iterator[Check]:
    """Checks of the structure that a fit leaves in the residuals.

    There is one misfit for each chip, or none; `correlated` errors of the solution hold some of the
    structure.
    """
    if not misfits:
        return
    one = worst_misfit(misfits)
    chip = "" if one.chip is None else f" of {one.chip.name}"
    size = size_of(one.structure, one.unit, 2)
    found = f"{size} rms in {one.partition}{chip}" if one.structure > 0 else "none"
    if one.power < 1:
        found += (
            f" ({percent(one.power, 2)} of all patterns can be separated from positions of stars)"
        )
    held = None if correlated is None else correlated.structure_rms
    sentence = doubt = ""
    if one.significant:
        what = "nothing" if held is None else f"{held:.2g} {one.unit} rms"
        sentence = f"{one.finding}, and the budget holds {what} of it"
        if correlated is None:
            sentence = one.sentence
        if (held or 0.0) < STRUCTURE_IN_BUDGET.value * one.structure:
            doubt = LARGER
    yield Check(
        FIT,
        "Structure in the residuals of the fit, beyond noise",
        f"{found}, {probability(one.p_value)}",
        f"p at least {number(STRUCTURE.value, 1)}",
        "warn" if one.significant or one.underpowered else "pass",
        sentence,
        doubt,
    )
    for one in misfits:
        if one.underpowered:
            sentence = (
                f"{100 * (1 - one.power):.0f} % of the structure that the model might leave is "
                "hidden: positions of stars take it up where dithers are small"
            )
            yield Check(FIT, level="warn", sentence=sentence)


def score_checks(
    tests: Sequence[ScoreTest], correlated: Discrepancy | None = None
) -> Iterator[Check]:
    """Checks of what targeted tests have found, a remark for each remedy.

    Verdicts stand where correlated errors hold what the tests have found.
    """
    found: dict[str, list[ScoreTest]] = {}
    for test in tests:
        if test.significant:
            found.setdefault(test.remedy, []).append(test)
    for remedy, several in found.items():
        sentence = f"{'; '.join(test.finding for test in several)}: {remedy}"
        doubt = "" if all(_held(correlated, test) for test in several) else LARGER
        yield Check(SCORE_TESTS, level="warn", sentence=sentence, doubt=doubt)


def _held(correlated: Discrepancy | None, test: ScoreTest) -> bool:
    """True where correlated errors hold what a test has found."""
    if correlated is None:
        return False
    scatter = set() if correlated.linear is None else set(correlated.linear.scatter)
    held = {
        "": False,
        "noise": True,
        "structure": bool(correlated.structure),
        "exposures": bool(scatter - {CURVATURE}),
        "curvature": CURVATURE in scatter,
    }
    return held[test.held_by]


def holdout_checks(found: HoldoutValidation | None) -> Iterator[Check]:
    """Check of held-out stars; nothing where there are none."""
    if found is None:
        return
    agrees = found.level == "pass"
    yield Check(
        HELD_OUT,
        f"Held-out stars ({count(found.n)})",
        f"agree, {probability(found.p_value)}" if agrees else found.verdict,
        f"p at least {number(HELD_OUT_DOUBTFUL.value, 1)}",
        found.level,
        "" if agrees else found.verdict,
        LARGER if found.doubtful else "",
    )
