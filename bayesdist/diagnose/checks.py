"""Checks of what residuals and held-out stars say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.diagnose.correlated.deviations import CURVATURE
from bayesdist.diagnose.holdout.validation import HoldoutValidation
from bayesdist.diagnose.residuals.coverage import Coverage
from bayesdist.diagnose.residuals.misfit import Misfit, worst_misfit
from bayesdist.diagnose.residuals.sample import ExposureScatter
from bayesdist.diagnose.score.result import ScoreTest
from bayesdist.utils.checks import LARGER, Check
from bayesdist.utils.limits import (
    EXPOSURE_CHI2,
    HELD_OUT_DOUBTFUL,
    STRUCTURE,
    STRUCTURE_IN_BUDGET,
    STRUCTURE_SEEN,
)
from bayesdist.utils.limits import SCORE_TESTS as SCORE_LIMIT
from bayesdist.utils.numbers import count, number, percent, probability, size_of

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
        "Structure in the residuals, beyond noise",
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
            yield Check(
                FIT,
                "Structure that positions of stars hide"
                + ("" if one.chip is None else f" on {one.chip.name}"),
                percent(1 - one.power, 2),
                f"at most {percent(1 - STRUCTURE_SEEN.value, 2)}",
                "warn",
                sentence,
            )


def score_checks(
    tests: Sequence[ScoreTest], correlated: Discrepancy | None = None
) -> Iterator[Check]:
    """Checks of what targeted tests have found, one for each remedy, or that they found nothing.

    Verdicts stand where correlated errors hold what the tests have found.
    """
    limit = f"p at least {number(SCORE_LIMIT.value, 1)}"
    found: dict[str, list[ScoreTest]] = {}
    for test in tests:
        if test.significant:
            found.setdefault(test.remedy, []).append(test)
    for remedy, several in found.items():
        sentence = f"{'; '.join(test.finding for test in several)}: {remedy}"
        doubt = "" if all(_held(correlated, test) for test in several) else LARGER
        names = ", ".join(test.name for test in several)
        value = "; ".join(
            f"{size_of(test.size, test.unit, 2)} rms, {probability(test.p_value)}"
            for test in several
        )
        yield Check(SCORE_TESTS, f"Residuals: {names}", value, limit, "warn", sentence, doubt)
    if tests and not found:
        name = f"Tests of the residuals ({len(tests)})"
        yield Check(SCORE_TESTS, name, "nothing found", limit, "pass")


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


def coverage_checks(chips: Sequence[Coverage]) -> Iterator[Check]:
    """Checks of the area of each chip that stars cover: of those that lack too much, or the worst.

    Nothing is checked where an earlier calibration knows the rest.
    """
    asked = [one for one in chips if not one.known]
    if not asked:
        return
    bad = [one for one in asked if one.significant]
    for one in bad or [max(asked, key=lambda one: one.gap / one.most)]:
        yield Check(
            FIT,
            "Area beyond the stars" + (f" of {one.chip.name}" if one.several else ""),
            percent(one.gap, 2),
            f"at most {percent(one.most, 2)}",
            "warn" if one.significant else "pass",
            one.sentence if one.significant else "",
        )


def exposure_checks(found: ExposureScatter | None) -> Iterator[Check]:
    """Check that no exposure has larger or smaller errors than all; nothing for one exposure."""
    if found is None:
        return
    low, high, most = found.relative.min(), found.relative.max(), EXPOSURE_CHI2.value
    sentence = ""
    if found.deviating.any():
        names = [name for name, off in zip(found.names, found.deviating, strict=True) if off]
        shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        sentence = (
            f"{len(names)} of {len(found.names)} exposures have other errors than all together "
            f"({shown}): give errors of each exposure, or leave out what went wrong"
        )
    yield Check(
        FIT,
        "Chi-square of single exposures, relative to that of all",
        f"{number(low)} to {number(high)} in {count(len(found.names))} exposures",
        f"{number(1 / most, 2)} to {number(most, 2)}",
        "warn" if sentence else "pass",
        sentence,
    )


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
