"""Checks of a fit, of its frames and matching, and of the residuals and held-out stars.

More general frames are recommended if they reduce the scatter of the exposures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import isclose

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.data.repeated import repeated_detections, tight_groups
from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.diagnose.correlated.deviations import CURVATURE
from bayesdist.diagnose.holdout.validation import HoldoutValidation
from bayesdist.diagnose.residuals.binned import Coverage
from bayesdist.diagnose.residuals.misfit import Misfit, worst_misfit
from bayesdist.diagnose.residuals.stars import ExposureScatter
from bayesdist.diagnose.score.result import DISPLACED_GROUP, ScoreTest
from bayesdist.errors import InputError
from bayesdist.infer import LinearFit
from bayesdist.infer.posterior.checks import fit_checks, pixel_doubt
from bayesdist.infer.solution.linear import Rejection, fit_linear, residuals
from bayesdist.model import DistortionModel
from bayesdist.model.frames import FRAME_KINDS
from bayesdist.utils.checks import (
    CHI2_TOO_LARGE,
    EITHER,
    EXPOSURE_CHI2,
    HELD_OUT_DOUBTFUL,
    LARGER,
    MATCH_RADIUS,
    STRUCTURE,
    STRUCTURE_IN_BUDGET,
    STRUCTURE_SEEN,
    Check,
)
from bayesdist.utils.checks import SCORE_TESTS as SCORE_LIMIT
from bayesdist.utils.text import count, number, percent, probability, size_of

FIT, HELD_OUT, SCORE_TESTS = "Fit", "Held-out truth", "Score tests"
MATCHING, ASSUMPTIONS = "Matching", "Assumptions"
DISPLACING = ("shape", "matching")  # groups of score tests that indicate a displaced solution


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
        The fit to check.
    table : Matches
        Stars of the fit, or an evenly spread sample of them.
    reference_sigma : float
        Median quoted error per axis, in the unit of u and v.
    match_radius : float or None
        Radius within which the stars were matched, in the unit of u and v.
    in_circle : bool
        True if the likelihood includes the match circles of the stars.
    majority : str
        Sentence saying that most pairs are false; empty if they are not.
    error_scale : str
        Sentence saying that quoted errors were multiplied; empty if they were not.
    matched_before : bool
        True if the user matched the stars, so that frames and nominal positions may be wrong or
        missing.
    rows, chooser : str
        See `things` and `chooser` of `bayesdist.infer.posterior.checks.fit_checks`.

    Yields
    ------
    Check
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
    """Checks for stars with several detections in one exposure, and for tight groups of stars."""
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
    `suspicious` for another reason.  `table` contains stars of the fit, or a sample of them.
    """
    if not suspicious and fit.chi2 <= CHI2_TOO_LARGE.value * fit.dof:
        return ""
    better = frames_that_help(table, fit.model)
    return "" if better is None else f"the exposures lie differently: {better.sentence}"


def matching_checks(
    match_radius: float | None, sigma: float, *, in_circle: bool
) -> Iterator[Check]:
    """Check for residuals truncated by a match circle that the likelihood does not include.

    `match_radius` is in the unit of u and v, `sigma` is the typical error of a star, and
    `in_circle` is True if the likelihood includes the circles.
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

    There is one misfit per chip, or none.  The `correlated` errors of the solution include some of
    the structure.  Significant score `tests` may indicate its origin.  Structure is not warned of
    where `score_checks` warns of a displaced group of stars, which may cause it.
    """
    if not misfits:
        return
    entry = worst_misfit(misfits)
    chip = "" if entry.chip is None else f" of {entry.chip.name}"
    size = size_of(entry.structure, entry.unit, 2)
    value = f"{size} rms in {entry.partition}{chip}" if entry.structure > 0 else "none"
    if entry.power < 1:
        value += (
            f" ({percent(entry.power, 2)} of all patterns can be separated from positions of stars)"
        )
    held = None if correlated is None else correlated.structure_rms
    sentence = doubt = ""
    if entry.significant:
        included = "nothing" if held is None else f"{held:.2g} {entry.unit} rms"
        sentence = f"{entry.finding}, and the budget holds {included} of it"
        if correlated is None:
            sentence = entry.sentence
            if not tests:
                sentence += "; stars that are displaced as a whole, for which a run tests, may "
                sentence += "also cause it"
        if displacing(tests):
            sentence += "; it may come from residuals that are lopsided or cut, of which score "
            sentence += "tests have found some"
        if (held or 0.0) < STRUCTURE_IN_BUDGET.value * entry.structure:
            doubt = LARGER
        if displaced_group(tests):
            sentence = doubt = ""
    yield Check(
        FIT,
        "Structure in the residuals, beyond noise",
        f"{value}, {probability(entry.p_value)}",
        f"p at least {number(STRUCTURE.value, 1)}",
        "warn" if entry.significant or entry.underpowered else "pass",
        sentence,
        doubt,
    )
    for entry in misfits:
        if entry.underpowered:
            sentence = (
                f"{100 * (1 - entry.power):.0f} % of the structure that the model might leave is "
                "hidden: positions of stars take it up where dithers are small"
            )
            yield Check(
                FIT,
                "Structure that positions of stars hide"
                + ("" if entry.chip is None else f" on {entry.chip.name}"),
                percent(1 - entry.power, 2),
                f"at most {percent(1 - STRUCTURE_SEEN.value, 2)}",
                "warn",
                sentence,
            )


def score_checks(
    tests: Sequence[ScoreTest], correlated: Discrepancy | None = None
) -> Iterator[Check]:
    """Checks of the score tests: one for each remedy of a finding, or one if there are no findings.

    Verdicts stay valid if the correlated errors include what the tests have found.  Noise is
    included in the sandwich covariance, unless the residuals are lopsided or truncated by the match
    radius: that covariance includes the scatter of a solution, but not its displacement.

    What a displaced group of stars accounts for is named in the check of the group.
    """
    limit = f"p at least {number(SCORE_LIMIT.value, 1)}"
    by_remedy: dict[str, list[ScoreTest]] = {}
    for test in tests:
        if test.warned:
            by_remedy.setdefault(test.remedy, []).append(test)
    of_group = [test for test in tests if test.significant and not test.warned]
    displaced = displacing(tests)
    for remedy, several in by_remedy.items():
        clauses, related = [test.finding for test in several], several
        if of_group and displaced_group(several):
            others = ", ".join(test.name for test in of_group)
            clauses.append(f"what other tests found may come from it ({others})")
            related = [*several, *of_group]
        sentence = f"{'; '.join(clauses)}: {remedy}"
        doubts = {test.doubt for test in related if not _held(correlated, test, tests, displaced)}
        doubt = EITHER if EITHER in doubts else LARGER if doubts else ""
        names = ", ".join(test.name for test in several)
        value = "; ".join(
            f"{size_of(test.size, test.unit, 2)} rms, {probability(test.p_value)}"
            for test in several
        )
        yield Check(SCORE_TESTS, f"Residuals: {names}", value, limit, "warn", sentence, doubt)
    if tests and not by_remedy:
        name = f"Tests of the residuals ({len(tests)})"
        yield Check(SCORE_TESTS, name, "nothing found", limit, "pass")


def displaced_group(tests: Sequence[ScoreTest]) -> bool:
    """True if tests have found a displaced group of stars that accounts for other findings."""
    return any(test.name == DISPLACED_GROUP and test.warned and not test.cause for test in tests)


def displacing(tests: Sequence[ScoreTest]) -> bool:
    """True if tests have found residuals that displace the solution, which noise does not."""
    return any(test.significant and test.group in DISPLACING for test in tests)


def _held(
    correlated: Discrepancy | None, test: ScoreTest, tests: Sequence[ScoreTest], displaced: bool
) -> bool:
    """True if the correlated errors include what one of the tests has found.

    `displaced` is True if the residuals displace the solution.
    """
    if correlated is None:
        return False
    of_exposures = correlated.facts.get("exposure_fields", {})
    enough = STRUCTURE_IN_BUDGET.value * test.size
    linear = correlated.linear
    scatter = set() if linear is None else set(linear.scatter)
    bend = 0.0 if linear is None else linear.bend
    in_time = linear is not None and linear.correlation_time > 0
    wandering = any(result.significant and result.held_by == "time" for result in tests)
    held = {
        "": False,
        "noise": not displaced,
        "structure": bool(correlated.structure),
        "exposures": bool(scatter - {CURVATURE}),
        # a parabola does not include deviations that vary irregularly
        "curvature": in_time or (bend >= enough and not wandering),
        "second order": of_exposures.get("second_order", 0.0) >= enough > 0,
        "exposure fields": of_exposures.get("field", 0.0) >= enough > 0,
        "time": in_time,
    }
    return held[test.held_by]


def coverage_checks(chips: Sequence[Coverage]) -> Iterator[Check]:
    """Checks of the area of each chip that stars cover: those with too large a gap, or the worst.

    Chips on which an earlier calibration covers the remaining area are not checked.
    """
    asked = [coverage for coverage in chips if not coverage.known]
    if not asked:
        return
    bad = [coverage for coverage in asked if coverage.significant]
    for coverage in bad or [max(asked, key=lambda coverage: coverage.gap / coverage.most)]:
        yield Check(
            FIT,
            "Area beyond the stars" + (f" of {coverage.chip.name}" if coverage.several else ""),
            percent(coverage.gap, 2),
            f"at most {percent(coverage.most, 2)}",
            "warn" if coverage.significant else "pass",
            coverage.sentence if coverage.significant else "",
        )


def exposure_checks(found: ExposureScatter | None) -> Iterator[Check]:
    """Check for exposures with larger or smaller errors than all; nothing for one exposure."""
    if found is None:
        return
    low, high, limit = found.relative.min(), found.relative.max(), EXPOSURE_CHI2.value
    sentence = ""
    if found.deviating.any():
        names = [name for name, off in zip(found.names, found.deviating, strict=True) if off]
        shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        sentence = (
            f"{len(names)} of {len(found.names)} exposures have other errors than all together "
            f"({shown}): give each exposure its own errors, or leave out what went wrong"
        )
    yield Check(
        FIT,
        "Chi-square of single exposures, relative to that of all",
        f"{number(low)} to {number(high)} in {count(len(found.names))} exposures",
        f"{number(1 / limit, 2)} to {number(limit, 2)}",
        "warn" if sentence else "pass",
        sentence,
    )


def outlying_checks(correlated: Discrepancy | None) -> Iterator[Check]:
    """Check that names exposures with linear terms far beyond the scatter of the others."""
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
    """Check of held-out stars; nothing if there are none."""
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


# Recommendation of frames
GAIN = 2.0  # factor by which the scatter must decrease
FITS = 3  # number of fits, each with the scatter of the previous one
MEDIAN_LENGTH = 1.1774  # median of the Rayleigh distribution, in sigma
ALIKE = 1.1  # largest scatter of the recommended frames, relative to the smallest


@dataclass(frozen=True)
class FrameChoice:
    """Recommended frames, and the scatter of the residuals with them and with the model's frames.

    The scatter is the median length of the residuals, corrected for degrees of freedom.
    """

    frames: str  # recommended kind of frames
    scatter: float  # with the recommended frames
    before: float  # with the frames of the model
    unit: str  # unit of u, v
    instead_of: str  # kind of frames of the model

    @property
    def sentence(self) -> str:
        """Recommendation with its reason."""
        return (
            f"set model.frames = '{self.frames}', with which the residuals of the exposures scatter"
            f" by {self.scatter:.2g} {self.unit} instead of {self.before:.2g} with "
            f"'{self.instead_of}'"
        )


def frames_that_help(matches: Matches, model: DistortionModel) -> FrameChoice | None:
    """Find the simplest frames that give about the smallest scatter of the residuals.

    All stars have the same weight; errors are not used.  Returns None for a single exposure, or if
    no more general frames than those of the model reduce the scatter by at least a factor of 2.
    """
    names = matches.exposure_names
    richer = FRAME_KINDS[FRAME_KINDS.index(model.frames) + 1 :]
    if len(names) < 2 or not richer:
        return None
    scatters = {}
    for frames in (model.frames, *richer):
        candidate = replace(model, frames=frames, exposures=names)
        if candidate.n_params > len(matches):  # a good fit would be meaningless
            continue
        try:
            scatters[frames] = _scatter(matches, candidate)
        except InputError:  # the frames absorb the drift, or there are too few stars
            continue
    before = scatters.pop(model.frames, np.inf)
    if not scatters or before < GAIN * min(scatters.values()):
        return None
    best = next(name for name, size in scatters.items() if size <= ALIKE * min(scatters.values()))
    return FrameChoice(best, scatters[best], before, model.unit, model.frames)


def _scatter(matches: Matches, model: DistortionModel) -> float:
    """Median length of the residuals, corrected for the model's degrees of freedom.

    The first fit rejects no matches; later ones reject them according to the previous scatter.
    """
    median = 1.0
    for _ in range(FITS):
        sigma = np.full(len(matches), max(median / MEDIAN_LENGTH, np.finfo(float).tiny))
        table = matches.with_errors((sigma, sigma))
        fit = fit_linear(table, model, rejection=Rejection(clip_abs=None))
        median = float(np.median(np.hypot(*residuals(fit, table).T)))
    return median * float(np.sqrt(2 * len(matches) / (2 * len(matches) - model.n_params)))
