"""Checks of a fit, of its matching, and of what residuals and held-out stars say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isclose

from bayesdist.data.matches import Matches
from bayesdist.data.repeated_stars import repeated_detections, tight_groups
from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.diagnose.correlated.deviations import CURVATURE
from bayesdist.diagnose.holdout.validation import HoldoutValidation
from bayesdist.diagnose.residuals.coverage import Coverage
from bayesdist.diagnose.residuals.misfit import Misfit, worst_misfit
from bayesdist.diagnose.residuals.sample import ExposureScatter
from bayesdist.diagnose.score.result import ScoreTest
from bayesdist.infer import LinearFit
from bayesdist.infer.exposures.frame_choice import frames_that_help
from bayesdist.infer.posterior.checks import fit_checks, pixel_doubt
from bayesdist.utils.checks import EITHER, LARGER, Check
from bayesdist.utils.limits import (
    CHI2_TOO_LARGE,
    EXPOSURE_CHI2,
    HELD_OUT_DOUBTFUL,
    MATCH_RADIUS,
    STRUCTURE,
    STRUCTURE_IN_BUDGET,
    STRUCTURE_SEEN,
)
from bayesdist.utils.limits import SCORE_TESTS as SCORE_LIMIT
from bayesdist.utils.numbers import count, number, percent, probability, size_of

FIT, HELD_OUT, SCORE_TESTS = "Fit", "Held-out truth", "Score tests"
MATCHING, ASSUMPTIONS = "Matching", "Assumptions"
DISPLACING = ("shape", "matching")  # groups of score tests


def input_checks(
    fit: LinearFit,
    table: Matches,
    *,
    reference_sigma: float,
    match_radius: float | None,
    in_circle: bool,
    majority: str,
    error_scale: str,
    matched_before: bool,
    rows: str,
    chooser: str,
) -> Iterator[Check]:
    """Checks of a fit, of the frames and errors of its stars, and of how they were matched.

    Parameters
    ----------
    fit : LinearFit
    table : Matches
        Stars of the fit, or an evenly spread sample of them.
    reference_sigma : float
        Median quoted error of one axis, in the unit of u and v.
    match_radius : float or None
        Radius within which the stars were matched, in the unit of u and v.
    in_circle : bool
        True if the likelihood accounts for the circles that the stars were matched in.
    majority : str
        Sentence on most pairs being false; empty if they are not.
    error_scale : str
        Sentence on quoted errors that were multiplied; empty if they were not.
    matched_before : bool
        True if the stars were matched by the user, so that frames and nominal positions can be
        wrong or missing.
    rows, chooser : str
        As `things` and `chooser` of `bayesdist.infer.posterior.checks.fit_checks`.
    """
    yield from fit_checks(fit, things=rows, chooser=chooser)
    if doubt := pixel_doubt(fit):
        yield Check(FIT, "Size of a pixel", level="warn", sentence=doubt)
    suspicious = bool(majority or error_scale)
    if matched_before and (text := frames_doubt(fit, table, suspicious=suspicious)):
        yield Check(FIT, "Frames of the exposures", level="warn", sentence=text)
    if error_scale:
        name = "Scale of the quoted errors"
        yield Check(FIT, name, level="warn", sentence=error_scale, doubt=LARGER)
    if matched_before and not in_circle and table.has_nominal:
        yield Check(
            MATCHING,
            "Match radius",
            level="warn",
            sentence="the matches have nominal positions, and outliers.match_radius is not given: "
            "the likelihood does not know that they were selected",
        )
    stated = table.match_radius
    if stated is not None and match_radius is not None and not isclose(stated, match_radius):
        yield Check(
            MATCHING,
            "Match radius of the settings",
            level="warn",
            sentence=f"the match radius is {match_radius:g} {fit.unit} by the settings, "
            f"which was used, and {stated:g} {fit.unit} by the matches",
        )
    yield from matching_checks(match_radius, reference_sigma, in_circle=in_circle)
    if matched_before:
        yield from repeated_star_checks(table)


def repeated_star_checks(table: Matches) -> Iterator[Check]:
    """Checks of stars with several detections in one exposure, and of tight groups of stars."""
    repeated = repeated_detections(table.u, table.v, table.exposure, table.star)
    if repeated is not None:
        name = "Stars with several detections in one exposure"
        value = f"{count(repeated.stars)} of {count(repeated.n_stars)}"
        yield Check(MATCHING, name, value, "none", "warn", repeated.sentence)
    groups = tight_groups(table.u, table.v, table.star)
    if groups is not None:
        value = f"{count(groups.groups)} of {groups.size} stars"
        sentence = groups.sentence(table.unit)
        yield Check(MATCHING, "Tight groups of stars", value, "none", "warn", sentence)


def frames_doubt(fit: LinearFit, table: Matches, *, suspicious: bool) -> str:
    """Clause on frames that would make the residuals far smaller; empty if there are none.

    Other frames are tried only if the residuals are larger than their errors, or if the fit is
    `suspicious` for another reason. `table`: stars of the fit, or a sample of them.
    """
    if not suspicious and fit.chi2 <= CHI2_TOO_LARGE.value * fit.dof:
        return ""
    better = frames_that_help(table, fit.model)
    return "" if better is None else f"the exposures lie differently: {better.sentence}"


def matching_checks(
    match_radius: float | None, sigma: float, *, in_circle: bool
) -> Iterator[Check]:
    """Check of residuals that the match circle may have cut off, unknown to the likelihood.

    `match_radius`: in the unit of u and v. `sigma`: usual error of a star. `in_circle`: True if the
    likelihood knows of the circles.
    """
    if in_circle or match_radius is None or MATCH_RADIUS.met_by(match_radius / sigma):
        return
    yield Check(
        ASSUMPTIONS,
        "Match radius, in errors of a star",
        match_radius / sigma,
        MATCH_RADIUS.words,
        "warn",
        f"stars were matched within {match_radius / sigma:.1f} of their errors of nominal "
        "positions that are not given, which cuts the scatter and draws the fit: match again with "
        "a wider match radius, or give the columns u_nominal and v_nominal",
        LARGER,
    )


def structure_checks(
    misfits: Sequence[Misfit],
    correlated: Discrepancy | None = None,
    tests: Sequence[ScoreTest] = (),
) -> Iterator[Check]:
    """Checks of the structure that a fit leaves in the residuals.

    There is one misfit for each chip, or none; `correlated` errors of the solution hold some of the
    structure. Score `tests` may have found where it comes from.
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
        if displacing(tests):
            sentence += "; it may come from residuals that are lopsided or cut, of which score "
            sentence += "tests have found some"
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

    Verdicts stand where correlated errors hold what the tests have found.  Noise is held by the
    sandwich covariance, unless the residuals are lopsided or the match radius has cut them: that
    covariance holds the scatter of a solution, and not its displacement.
    """
    limit = f"p at least {number(SCORE_LIMIT.value, 1)}"
    found: dict[str, list[ScoreTest]] = {}
    for test in tests:
        if test.significant:
            found.setdefault(test.remedy, []).append(test)
    displaced = displacing(tests)
    for remedy, several in found.items():
        sentence = f"{'; '.join(test.finding for test in several)}: {remedy}"
        doubts = {test.doubt for test in several if not _held(correlated, test, tests, displaced)}
        doubt = EITHER if EITHER in doubts else LARGER if doubts else ""
        names = ", ".join(test.name for test in several)
        value = "; ".join(
            f"{size_of(test.size, test.unit, 2)} rms, {probability(test.p_value)}"
            for test in several
        )
        yield Check(SCORE_TESTS, f"Residuals: {names}", value, limit, "warn", sentence, doubt)
    if tests and not found:
        name = f"Tests of the residuals ({len(tests)})"
        yield Check(SCORE_TESTS, name, "nothing found", limit, "pass")


def displacing(tests: Sequence[ScoreTest]) -> bool:
    """True where tests have found residuals that displace the solution, as noise does not."""
    return any(test.significant and test.group in DISPLACING for test in tests)


def _held(
    correlated: Discrepancy | None, test: ScoreTest, tests: Sequence[ScoreTest], displaced: bool
) -> bool:
    """True where correlated errors hold what one of the tests has found.

    `displaced`: whether the residuals displace the solution.
    """
    if correlated is None:
        return False
    of_exposures = correlated.facts.get("exposure_fields", {})
    enough = STRUCTURE_IN_BUDGET.value * test.size
    linear = correlated.linear
    scatter = set() if linear is None else set(linear.scatter)
    bend = 0.0 if linear is None else linear.bend
    in_time = linear is not None and linear.correlation_time > 0
    wandering = any(one.significant and one.held_by == "time" for one in tests)
    held = {
        "": False,
        "noise": not displaced,
        "structure": bool(correlated.structure),
        "exposures": bool(scatter - {CURVATURE}),
        # a parabola does not hold deviations that wander
        "curvature": in_time or (bend >= enough and not wandering),
        "second order": of_exposures.get("second_order", 0.0) >= enough > 0,
        "exposure fields": of_exposures.get("field", 0.0) >= enough > 0,
        "time": in_time,
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


def outlying_checks(correlated: Discrepancy | None) -> Iterator[Check]:
    """Check that names exposures whose linear terms are far beyond the scatter of the others."""
    names = [] if correlated is None else correlated.facts.get("exposures_outlying", [])
    if names:
        yield Check(
            FIT,
            "Exposures that deviate far more than the others",
            count(len(names)),
            "none",
            "warn",
            f"{', '.join(names[:3])}{f' and {len(names) - 3} more' if len(names) > 3 else ''} "
            "lie shifted, turned or stretched against the other exposures, far beyond their "
            "scatter, which is stated without them: leave out what went wrong, or set model.frames",
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
