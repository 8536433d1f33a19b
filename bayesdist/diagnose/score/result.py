"""Results of tests for what a model may lack: multiple testing, and precedence among findings.

P-values are corrected for the number of tests.

One fault of the data affects several tests.  The remedy of a symptom does not help while the cause
persists: a higher order does not help if a ghost displaces stars, and errors that depend on
position do not help if exposures differ.  A symptom is therefore reported with the remedy of its
cause, and is tested again in the run after the cause has been removed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from scipy import special

from bayesdist.diagnose.statistics import combined_p, holm
from bayesdist.utils.checks import LARGER, SCORE_TESTS
from bayesdist.utils.distributions import chi2_isf, chi2_sf, f_isf, f_sf
from bayesdist.utils.text import p_words

HeldBy = Literal[
    "", "noise", "structure", "exposures", "curvature", "second order", "exposure fields", "time"
]
LOOK_UP_TABLE = "fit a look-up table in a campaign"  # remedy that is available to campaigns only
MISSING_ORDERS = "missing orders"  # name of the test for all further orders
POWER = 0.9  # probability of detecting an effect of the stated smallest size
# p-value below which a few of many functions are regarded as the common cause
LEADING_CHANCE = 0.01
# combined p-value of the shape tests below which displaced stars explain other findings
HINT_OF_SHAPE = 0.02
LEAST_LEFT = 0.2  # of what a few functions explain: less than that is left by their inaccuracy
OF_FIELD = ("orders", "edges", "jumps", "rings", "repeating pattern")
# polynomials of missing orders resemble these, and follow them in part
STEEP = ("jumps", "rings", "repeating pattern")
DISPLACED_GROUP = "displaced group of stars"
SKEWED = ("displaced stars", "skewness by position", "skewness of a patch")
OF_NOISE = ("noise by position", "noise by axis")
OF_EXPOSURES = ("noise by exposure", *OF_NOISE)


@dataclass(frozen=True)
class Family:
    """Words for one kind of effect that a model may lack, and its relation to other findings."""

    name: str
    remedy: str  # what to do about it, as a clause
    # clauses for a significant and an insignificant result; the test fills them in if they depend
    # on the data
    present: str
    absent: str
    group: str = ""  # name of a group of related families
    # component of the correlated errors that includes the effect, so that the verdict stays valid
    held_by: HeldBy = ""
    explained_by: str = ""  # name or group of a finding that this one may be caused by
    denial: str = ""  # clause that excludes this family as the cause of another finding
    doubt: str = LARGER  # effect of the finding on verdicts, see `Check`


@dataclass(frozen=True)
class ScoreTest:
    """Result of a test for one kind of effect that the model may lack.

    Parameters
    ----------
    name : str
        Name of the test.
    statistic : float
        Test statistic; about `dof` on average if the model is complete.
    dof : float
        Number of tested directions.
    dof_residual : float or None
        Number of stars, beyond the tested directions, from which the noise is estimated; None if
        the statistic has a chi-square distribution.
    p_value : float
        Probability of a larger statistic by chance, for this test alone.
    size : float
        Size of the effect, in `unit` and not negative: rms over the detector, both axes together,
        with the contribution of noise subtracted.  For tests of the noise, the rms difference of
        its standard deviation per axis.
    smallest : float
        Size that would have been detected with probability `POWER`, given the number of tests.
    unit : str
        Unit of `size` and `smallest`: that of u and v, or per year.
    remedy : str
        What to do about the effect, as a clause.
    finding : str
        Interpretation of the result, as a sentence.
    significant : bool
        True if the result is significant after correction for the number of tests (Holm 1979, at
        the level `limits.SCORE_TESTS`).
    held_by : str
        Component of the correlated errors that includes the effect: 'noise', 'structure',
        'exposures', 'curvature', 'second order' or 'exposure fields' (of single exposures), 'time'
        (deviations of exposures that are correlated in time); empty if none does.
    group : str
        Name of the group of related tests; empty if the test belongs to none.
    doubt : str
        Effect of the finding on verdicts, see `Check`.
    cause : str
        Name or group of another finding that the finding may come from, and whose remedy it has;
        empty if there is none.
    """

    name: str
    statistic: float
    dof: float
    dof_residual: float | None
    p_value: float
    size: float
    smallest: float
    unit: str
    remedy: str
    finding: str
    significant: bool
    held_by: HeldBy = ""
    group: str = ""
    doubt: str = LARGER
    cause: str = ""

    @property
    def warned(self) -> bool:
        """True if the result is significant and not accounted for by a displaced group of stars."""
        return self.significant and self.cause != DISPLACED_GROUP


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of one test before the correction for the number of tests."""

    family: Family
    # statistic, dof, dof_residual, p_value, size, unit: see `ScoreTest`
    statistic: float
    dof: float
    dof_residual: float | None
    p_value: float
    size: float
    # size that is detected with probability `POWER`, as a function of the significance level
    smallest: Callable[[float], float]
    unit: str

    @property
    def name(self) -> str:
        """Name of the test."""
        return self.family.name


def outcome(
    family: Family,
    statistic: float,
    dof: float,
    dof_residual: float | None,
    p_value: float,
    *,
    square: float,
    noise: float,
    unit: str,
    smallest: Callable[[float], float] | None = None,
) -> Outcome:
    """Outcome of a test from the mean square of the pattern that it measured.

    `square` is the mean square of the pattern, noise included, and `noise` that of the noise alone.
    `smallest` defaults to the detectable rms of a pattern with the same distribution over
    directions as the noise. For the other arguments see `ScoreTest`.
    """
    if smallest is None:
        smallest = partial(smallest_pattern, float(np.sqrt(max(noise, 0.0))), dof, dof_residual)
    size = float(np.sqrt(max(square - noise, 0.0)))
    return Outcome(family, statistic, dof, dof_residual, p_value, size, smallest, unit)


def corrected(outcomes: Sequence[Outcome]) -> tuple[ScoreTest, ...]:
    """Tests with their verdicts, corrected for multiple testing (Holm 1979).

    A finding that another finding may explain mentions it.
    """
    significant = holm([result.p_value for result in outcomes]) <= SCORE_TESTS.value
    # the last finding of a group has the remedy for all: a higher order includes the lower ones
    by_name = {
        name: result.family
        for result, is_significant in zip(outcomes, significant, strict=True)
        if is_significant
        for name in (result.name, result.family.group)
        if name
    }
    suspect = _suspect(by_name, outcomes)
    if suspect is not None:
        by_name |= {suspect.name: suspect, suspect.group: suspect}
    causes = _causes(by_name, outcomes)
    out = []
    for result, is_significant in zip(outcomes, significant, strict=True):
        family, remedy, cause = result.family, result.family.remedy, ""
        # a single effect must pass the first step of Holm's procedure
        smallest = result.smallest(SCORE_TESTS.value / len(outcomes))
        finding = f"{family.absent} ({smallest:.2g} {result.unit} rms would have been found)"
        if is_significant:
            cause = cause_of((family.name, family.group), causes)
            remedy, explanation = _remedy(family, causes), _explanation(result, outcomes)
            if cause:
                explanation = f", which may come from {CAUSES[cause].words}"
            size = f"{result.size:.2g} {result.unit} rms, {p_words(result.p_value)}"
            finding = f"{family.present}{explanation} ({size})"
        out.append(
            ScoreTest(
                result.name,
                result.statistic,
                result.dof,
                result.dof_residual,
                result.p_value,
                result.size,
                smallest,
                result.unit,
                remedy,
                finding,
                bool(is_significant),
                family.held_by,
                family.group,
                family.doubt,
                cause,
            )
        )
    return tuple(out)


def _suspect(significant: Mapping[str, Family], outcomes: Sequence[Outcome]) -> Family | None:
    """Family of an insignificant shape test that probably explains other findings, if any.

    Stars that are displaced widen the residuals where they displace their mean.  A missing order
    hardly widens them, and errors of another size do not displace them, so that skewness is likely
    if both are significant.  A hint of it then suffices: the combined p-value of the shape tests is
    below `HINT_OF_SHAPE`.  The family is that of the test with the smallest p-value.
    """
    if "shape" in significant or "noise by position" not in significant:
        return None
    if not {"orders", *STEEP} & set(significant):
        return None
    tests = [result for result in outcomes if result.name in (*SKEWED, "shape by position")]
    if not tests:
        return None
    p_values = [result.p_value for result in tests]
    if combined_p(p_values, np.full(len(tests), 1 / len(tests))) >= HINT_OF_SHAPE:
        return None
    return tests[int(np.argmin(p_values))].family


def _causes(significant: Mapping[str, Family], outcomes: Sequence[Outcome]) -> dict[str, Family]:
    """Significant families that may be causes of others, by their names and groups.

    `significant` contains all families with significant results.
    """
    by_name = {result.name: (result.statistic, result.dof) for result in outcomes}
    singles = ("second order of exposures", "exposures")
    single = [by_name[name] for name in singles if name in significant]
    of_orders = [result for result in outcomes if result.family.group == "orders"]
    next_orders = [result for result in of_orders if result.name != MISSING_ORDERS]
    further = [result for result in of_orders if result.name == MISSING_ORDERS]
    total = (
        sum(result.statistic for result in next_orders),
        sum(result.dof for result in next_orders),
    )
    orders = [total] if next_orders else []
    orders += [by_name[result.name] for result in further]
    rivals = {"pointing": single, "edges": orders}
    weaker = {
        name
        for name, competitors in rivals.items()
        if name in significant
        and not all(explains_more(by_name[name], result) for result in competitors)
    }
    if "pointing" in significant:
        weaker |= {"pointing" for result in single if leaves_much(by_name["pointing"], result)}
    # Terms of a missing order contain steps and rings that are smaller than the terms themselves,
    # whereas polynomials follow a true step or ring only in part.
    # The robust fit includes the next orders.
    orders_square = max(
        sum(result.size**2 for result in several if result.name in significant)
        for several in (next_orders, further)
    )
    steep = {
        result.name: result.statistic
        for result in outcomes
        if result.name in STEEP and result.name in significant and result.size**2 > orders_square
    }
    weaker |= set(STEEP) - {max(steep, key=steep.__getitem__, default="")}
    # Structure of the size of the errors correlates the residuals and gives them two cores, as
    # displaced stars do, but they are not lopsided. Half of the stars make them lopsided neither,
    # and are seen best in the distribution of the residuals, structure in their positions.
    if steep and not set(SKEWED) & set(significant):
        most = max(steep.values())
        weaker |= {
            name
            for name, family in significant.items()
            if family.group == "shape"
            and not (family.name == DISPLACED_GROUP and by_name[DISPLACED_GROUP][0] > most)
        }
    return {name: family for name, family in significant.items() if name not in weaker}


def _remedy(family: Family, causes: Mapping[str, Family]) -> str:
    """Remedy of a finding: that of its cause if there is one, otherwise that of its group.

    A finding that is itself a cause has its own.

    `causes` maps the names of significant families, and of their groups, to the families; a group
    is mapped to its last member.
    """
    cause = cause_of((family.name, family.group), causes)
    if cause:
        return _remedy(causes[cause], causes)
    name = family.name if family.name in CAUSES else family.group or family.name
    return causes.get(name, family).remedy


def _explanation(one: Outcome, outcomes: Sequence[Outcome]) -> str:
    """Clause that excludes another finding as the explanation of this one; may be empty."""
    if one.family.explained_by:
        for candidate in outcomes:
            names = (candidate.family.name, candidate.family.group)
            if one.family.explained_by in names and candidate.p_value < SCORE_TESTS.value:
                return f", if {candidate.family.denial}"
    return ""


def noncentrality(level: float, dof: float, dof_residual: float | None = None) -> float:
    """Noncentrality at which a chi-square or F test has the power `POWER`.

    `dof_residual` is the number of denominator degrees of freedom of an F test.
    """
    if (
        dof_residual is None or dof_residual > 1e5
    ):  # F and chi-square distributions are practically equal
        return float(special.chndtrinc(chi2_isf(level, dof), dof, 1 - POWER))
    limit = f_isf(level, dof, dof_residual)
    return float(special.ncfdtrinc(dof, dof_residual, 1 - POWER, limit))


def smallest_pattern(noise: float, dof: float, dof_residual: float | None, level: float) -> float:
    """Rms of a pattern that is detected with the power `POWER`.

    `noise` is the rms of the pattern that noise causes. The pattern is assumed to be distributed
    over the directions like the noise.
    """
    return float(noise * np.sqrt(noncentrality(level, dof, dof_residual) / dof))


@dataclass(frozen=True)
class Cause:
    """A finding that accounts for other findings."""

    words: str  # the cause, as the object of "may come from"
    symptoms: tuple[str, ...]  # names or groups of the findings that are given its remedy


# By the name or the group of the finding. If there are several causes, the first one has
# precedence.
CAUSES: dict[str, Cause] = {
    # residuals about two centres end more abruptly than those about a single one
    DISPLACED_GROUP: Cause(
        "the displaced group of stars",
        ("matching", "shape", *OF_FIELD, *OF_NOISE, "noise by magnitude"),
    ),
    "matching": Cause("the match radius", ("shape", *OF_FIELD, *OF_NOISE)),
    "shape": Cause("the shape of the residuals", (*OF_FIELD, *OF_NOISE, "noise by magnitude")),
    "cut-off positions": Cause("positions that were cut off", OF_FIELD),
    # a cause only if it explains more than deviations of single exposures do: see `explains_more`
    "pointing": Cause(
        "the curved sky",
        ("second order of exposures", "fields of exposures", "exposures", *OF_EXPOSURES),
    ),
    "second order of exposures": Cause(
        "second-order terms that differ between exposures", ("pointing", *OF_EXPOSURES)
    ),
    "fields of exposures": Cause(
        "fields that differ between exposures", ("pointing", *OF_EXPOSURES)
    ),
    # causes only if larger than missing orders, and the most significant one of them
    "jumps": Cause(
        "the jump", ("orders", "edges", "rings", "repeating pattern", "shape", *OF_NOISE)
    ),
    "repeating pattern": Cause(
        "the pattern", ("orders", "edges", "jumps", "rings", "shape", *OF_NOISE)
    ),
    "rings": Cause(
        "the rings", ("orders", "edges", "jumps", "repeating pattern", "shape", *OF_NOISE)
    ),
    # a cause only if it explains more than missing orders do
    "edges": Cause(
        "what rises towards the edges", ("orders", "jumps", "repeating pattern", *OF_NOISE)
    ),
    "exposures in time": Cause(
        "deviations of exposures that are correlated in time", ("curvature in time",)
    ),
    "exposures": Cause("deviations of exposures", ("pointing", *OF_EXPOSURES)),
    "orders": Cause("the missing orders", ("edges", *STEEP, *OF_NOISE)),
    "magnitude": Cause("the dependence on magnitude", ("noise by magnitude",)),
}


def cause_of(names: Collection[str], found: Collection[str]) -> str:
    """Name or group of the finding that accounts for another one; empty if there is none.

    Parameters
    ----------
    names : collection of str
        Name and group of the symptom.
    found : collection of str
        Names and groups of all significant findings that may be causes.

    Returns
    -------
    str
    """
    for name, cause in CAUSES.items():
        if name not in found:
            continue
        if name in names:
            return ""
        if not set(names).isdisjoint(cause.symptoms):
            return name
    return ""


def explains_more(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """True if a few functions explain more, for their number, than the many of another test.

    Terms that differ randomly between exposures correlate with the pointing to some extent, whereas
    a curved sky concentrates all deviations in the few functions of the pointing.  Missing orders
    rise towards the edges, whereas effects confined to the edges are spread over many orders.

    Parameters
    ----------
    one, other : tuple of float
        Statistic and degrees of freedom of the few functions, and of the many.

    Returns
    -------
    bool
    """
    ratio = (one[0] / one[1]) / (other[0] / other[1])
    return bool(f_sf(ratio, one[1], other[1]) < LEADING_CHANCE)


def leaves_much(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """True if many functions explain much that a few of their combinations do not.

    A curved sky deforms exposures by their pointing alone: what their own terms explain beyond that
    is noise.  The pointing explains a part of terms that differ at random, by chance.

    Parameters
    ----------
    one, other : tuple of float
        Statistic and degrees of freedom of the few functions, and of the many.

    Returns
    -------
    bool
    """
    left, dof = other[0] - one[0], other[1] - one[1]
    if dof <= 0:
        return False
    by_chance = chi2_sf(max(left, 0.0), dof)
    return bool(by_chance < LEADING_CHANCE and left - dof > LEAST_LEFT * (one[0] - one[1]))
