"""Results of tests for what a model may lack, and which of many are more than chance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from scipy import special

from bayesdist.diagnose.score.causes import CAUSES, cause_of, explains_more
from bayesdist.diagnose.significance import holm
from bayesdist.utils.checks import LARGER
from bayesdist.utils.distributions import chi2_isf, f_isf
from bayesdist.utils.limits import SCORE_TESTS
from bayesdist.utils.numbers import p_words

HeldBy = Literal[
    "", "noise", "structure", "exposures", "curvature", "second order", "exposure fields", "time"
]

LOOK_UP_TABLE = "fit a look-up table in a campaign"  # remedy: other runs have none
POWER = 0.9  # with which the smallest effect that is stated would have been found


@dataclass(frozen=True)
class Family:
    """One thing that a model may lack, in words, and what else accounts for it."""

    name: str
    remedy: str  # what to do about it, as a clause
    # subject and verb of the finding, where there is something and where there is not; where they
    # depend on what was found, the test fills them in
    present: str
    absent: str
    group: str = ""  # of families that others name together
    # kind of correlated errors that hold what is found, so that the verdict stands
    held_by: HeldBy = ""
    explained_by: str = ""  # name or group of a finding that this one may come from
    denial: str = ""  # clause that denies it, for findings that it may explain
    doubt: str = LARGER  # what the finding does to verdicts, as of `Check`


@dataclass(frozen=True)
class ScoreTest:
    """One thing that a model may lack, and what the data say of it.

    Parameters
    ----------
    name : str
    statistic : float
        About `dof` on average where the model lacks nothing.
    dof : float
        Directions that are tested.
    dof_residual : float or None
        Stars beyond them that the noise is known from; None where that is of no concern.
    p_value : float
        Probability of as much by chance, of this test by itself.
    size : float
        What was found: rms over the detector, of both axes together, without the part of noise; of
        tests of the noise, the rms difference of its standard deviation along each axis.  0 or
        more, in `unit`.
    smallest : float
        Size that would have been found with probability `POWER`, in all these tests together.
    unit : str
        Of u and v.
    remedy : str
        What to do about it, as a clause.
    finding : str
        What it means, as a sentence.
    significant : bool
        More than chance, corrected for the number of tests (Holm 1979, at `limits.SCORE_TESTS`).
    held_by : str
        Kind of correlated errors that hold what was found: 'noise', 'structure', 'exposures',
        'curvature', 'second order' or 'exposure fields' (of single exposures), 'time'
        (deviations of exposures that are correlated in time); empty where none do.
    group : str
        Group of related tests, which others name together; empty for a test by itself.
    doubt : str
        What the finding does to verdicts, as of `Check`.
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


@dataclass(frozen=True, eq=False)
class Outcome:
    """One test by itself, before it is known how many there are."""

    family: Family
    # statistic, dof, dof_residual, p_value, size, unit: as of `ScoreTest`
    statistic: float
    dof: float
    dof_residual: float | None
    p_value: float
    size: float
    # size that is found with probability `POWER`, by the level of the test
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
    """Outcome of a test that has found a pattern of some mean square.

    `square` and `noise` are the mean square of the pattern, noise included, and that of the noise;
    `smallest` is by default that of a pattern that lies in any direction as noise does. Others as
    of `ScoreTest`.
    """
    if smallest is None:
        smallest = partial(smallest_pattern, float(np.sqrt(max(noise, 0.0))), dof, dof_residual)
    size = float(np.sqrt(max(square - noise, 0.0)))
    return Outcome(family, statistic, dof, dof_residual, p_value, size, smallest, unit)


def corrected(outcomes: Sequence[Outcome]) -> tuple[ScoreTest, ...]:
    """Tests with their verdicts, corrected for how many there are (Holm 1979).

    Findings that others explain as well say so.
    """
    significant = holm([one.p_value for one in outcomes]) <= SCORE_TESTS.value
    # of a group the last finding has the remedy of all: a higher order holds the lower ones
    by_name = {
        name: one.family
        for one, found in zip(outcomes, significant, strict=True)
        if found
        for name in (one.name, one.family.group)
        if name
    }
    causes = _causes(by_name, outcomes)
    out = []
    for one, found in zip(outcomes, significant, strict=True):
        family, remedy = one.family, one.family.remedy
        # what is alone has to pass the first step
        smallest = one.smallest(SCORE_TESTS.value / len(outcomes))
        finding = f"{family.absent} ({smallest:.2g} {one.unit} rms would have been found)"
        if found:
            cause = cause_of((family.name, family.group), causes)
            remedy, explanation = _remedy(family, causes), _explanation(one, outcomes)
            if cause:
                explanation = f", which may come from {CAUSES[cause].words}"
            size = f"{one.size:.2g} {one.unit} rms, {p_words(one.p_value)}"
            finding = f"{family.present}{explanation} ({size})"
        out.append(
            ScoreTest(
                one.name,
                one.statistic,
                one.dof,
                one.dof_residual,
                one.p_value,
                one.size,
                smallest,
                one.unit,
                remedy,
                finding,
                bool(found),
                family.held_by,
                family.group,
                family.doubt,
            )
        )
    return tuple(out)


def _causes(significant: Mapping[str, Family], outcomes: Sequence[Outcome]) -> dict[str, Family]:
    """Families that have found something and may be causes, by their names and groups.

    `significant`: all that have found something.
    """
    by_name = {one.name: (one.statistic, one.dof) for one in outcomes}
    singles = ("second order of exposures", "exposures")
    single = [by_name[name] for name in singles if name in significant]
    orders = [by_name[one.name] for one in outcomes if one.family.group == "orders"]
    total = sum(statistic for statistic, _ in orders), sum(dof for _, dof in orders)
    rivals = {"pointing": single, "edges": [total] if orders else []}
    weaker = {
        name
        for name, others in rivals.items()
        if name in significant and not all(explains_more(by_name[name], one) for one in others)
    }
    return {name: family for name, family in significant.items() if name not in weaker}


def _remedy(family: Family, causes: Mapping[str, Family]) -> str:
    """Remedy of a finding: that of its cause if there is one, else that of its group.

    `causes`: families of other findings by their names, and the last one of each group by that of
    the group.
    """
    cause = cause_of((family.name, family.group), causes)
    if cause:
        return _remedy(causes[cause], causes)
    return causes.get(family.group or family.name, family).remedy


def _explanation(one: Outcome, outcomes: Sequence[Outcome]) -> str:
    """Clause that denies the finding of another test that may explain this one; may be empty."""
    if one.family.explained_by:
        for other in outcomes:
            names = (other.family.name, other.family.group)
            if one.family.explained_by in names and other.p_value < SCORE_TESTS.value:
                return f", if {other.family.denial}"
    return ""


def noncentrality(level: float, dof: float, dof_residual: float | None = None) -> float:
    """Noncentrality at which a chi-square or F test has the power `POWER`.

    `dof_residual` is that of an F test.
    """
    if dof_residual is None or dof_residual > 1e5:  # where F and chi-square are alike
        return float(special.chndtrinc(chi2_isf(level, dof), dof, 1 - POWER))
    limit = f_isf(level, dof, dof_residual)
    return float(special.ncfdtrinc(dof, dof_residual, 1 - POWER, limit))


def smallest_pattern(noise: float, dof: float, dof_residual: float | None, level: float) -> float:
    """Rms of a pattern that is found with the power `POWER`.

    `noise` is the rms of the pattern that noise makes; the pattern lies in any direction as noise
    does.
    """
    return float(noise * np.sqrt(noncentrality(level, dof, dof_residual) / dof))
