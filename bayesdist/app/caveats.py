"""What a verdict of a run rests on, and what keeps one from being given."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.holdout import held_out_of
from bayesdist.app.session import Session
from bayesdist.assess.requirements.verdict import Caveat, scatter_too_small
from bayesdist.infer.discrepancy.linear import CURVATURE

__all__ = ["caveats_of", "rests_on", "visits_of"]

Float = NDArray[np.float64]

LEAST_HELD = 0.5  # of the structure that is found in residuals, for the budget to hold it
WIDE = 5.0  # errors of a star, within which true matches are lost when nominal positions are off

# tests whose findings the error model holds, by the part of it
OF_STRUCTURE = ("order ",)
OF_NOISE = ("noise by ",)
OF_EXPOSURES, OF_CURVATURE = "exposures", "curvature in time"


def caveats_of(session: Session) -> tuple[Caveat, ...]:
    """Reasons why the errors of a run may not be as stated; none where all is measured or given."""
    return tuple(_caveats(session))


def _caveats(session: Session) -> Iterator[Caveat]:
    if session.majority:
        yield Caveat(session.majority, larger=False)
    found = session.discrepancy
    held = None if found is None else found.structure_rms
    if session.misfit.significant and (held or 0.0) < LEAST_HELD * session.misfit.structure:
        what = "nothing" if held is None else f"{held:.2g} {session.misfit.unit} rms"
        yield Caveat(f"{session.misfit.finding}, and the budget holds {what} of it")
    for test in session.score_tests:
        if test.significant and not _held(session, test.name):
            yield Caveat(f"{test.finding}: {test.remedy}")
    for text in session.further_caveats:
        yield Caveat(text)
    yield from _of_matching(session)
    if session.error_scale_sentence:
        yield Caveat(session.error_scale_sentence)
    held = held_out_of(session)
    if held is not None and held.doubtful:
        yield Caveat(held.verdict)
    if session.catalogue_stated is False:
        yield Caveat(
            "no error of the reference catalogue is stated: give a [[budget]] row that names the "
            "catalogue, of size 0 with its source where it has none"
        )
    if session.posterior.model.time is not None:
        yield from _of_time(session)


def _held(session: Session, test: str) -> bool:
    """Whether the error model holds what a test has found."""
    if session.discrepancy is None:
        return False
    found = session.discrepancy.found
    scatter = set() if found.linear is None else set(found.linear.scatter)
    return (
        test.startswith(OF_NOISE)
        or (bool(found.structure) and test.startswith(OF_STRUCTURE))
        or (test.startswith(OF_EXPOSURES) and bool(scatter - {CURVATURE}))
        or (test.startswith(OF_CURVATURE) and CURVATURE in scatter)
    )


def _of_matching(session: Session) -> Iterator[Caveat]:
    """What the matching may have cut off, where the likelihood does not hold it."""
    if session.in_circle:
        return
    radius, sigma = session.config.outliers.match_radius, session.posterior.reference_sigma
    if radius is not None and radius < WIDE * sigma:
        yield Caveat(
            f"stars were matched within {radius / sigma:.1f} of their errors of nominal positions "
            "that are not given, which cuts the scatter and draws the fit: match again with a "
            "wider match radius, or give the columns u_nominal and v_nominal"
        )
    fit = session.fit
    if scatter_too_small(fit.chi2, fit.dof):
        yield Caveat(
            f"the residuals scatter less than the quoted errors say (chi-square "
            f"{fit.chi2 / fit.dof:.2g} per degree of freedom): the match radius has cut them, or "
            "the errors are too large",
            larger=False,
        )


def _of_time(session: Session) -> Iterator[Caveat]:
    time, dates = session.posterior.model.time, visits_of(session.dates)
    assert time is not None
    edges = [-np.inf, *time.breaks, np.inf]
    counts, _ = np.histogram(dates, edges)
    if dates.size and counts[counts > 0].min() <= 2:
        yield Caveat(
            f"a drift is fitted to {counts[counts > 0].min()} dates, so that neither the variation "
            "between exposures nor the curvature of the drift is measured",
            larger=False,
        )
    if session.motions_stated is False:
        yield Caveat(
            "no error of the catalogue's proper motions is stated, and the drift is measured "
            "against them: give a [[budget]] row that names the motions, of size 0 with its source "
            "where they have none"
        )


def visits_of(dates: Float) -> Float:
    """Dates of which none are next to the same, in rising order: exposures of a visit are one.

    Those within a day, or a fiftieth of the whole time.
    """
    if not dates.size:
        return dates
    apart = max(1 / 365.25, (dates.max() - dates.min()) / 50)
    ordered = np.sort(dates)
    return np.asarray(ordered[np.append(True, np.diff(ordered) > apart)])


def _exposures(session: Session, n: int) -> str:
    """Of which exposures the position is one."""
    if session.systematics.aligned:
        return f"a position in a new exposure, which deviates as {n} exposures do"
    found = session.discrepancy
    linear = None if found is None else found.found.linear
    if linear is None or "shape" not in linear.scatter:
        return f"{n} exposures" if n > 1 else "one exposure, or the mean of several"
    size = float(np.median(linear.scatter["shape"]))
    what = f"whose {'scale and shears' if 'scale' in linear.kinds else 'shears'}"
    what += f" scatter by {size:.1g}"
    if session.config.assess.exposure == "single":
        return f"a position in a single exposure, as {linear.n_exposures} exposures, {what}"
    return f"a position in the mean of {linear.n_exposures} exposures, {what}"


def rests_on(session: Session, epoch: float | None) -> tuple[str, ...]:
    """What a verdict at an epoch takes for granted, or has measured."""
    model, out = session.posterior.model, list[str]()
    out.append(f"a polynomial of order {model.order}")
    found = session.discrepancy
    if found is not None:
        rows = found.found.facts.get("structure", [])
        if rows:
            median, most = (
                float(np.sqrt(np.mean([row[key] ** 2 for row in rows])))
                for key in ("median", "most")
            )
            out.append(
                f"structure beyond it of {median:.2g} {model.unit} rms on an axis, at most "
                f"{most:.2g} with 95 % probability, from residuals and prior"
            )
        else:
            out.append("look-up tables, with their errors")
    given = [b.name for b in session.config.budget]
    out.append(f"errors given by the user: {', '.join(given) or 'none'}")
    n = len(session.fit.model.exposures)
    out.append(_exposures(session, n))
    if found is not None and found.found.facts.get("exposures_measured") is False:
        out.append("no variation between exposures, which is not measured")
    dates = visits_of(session.dates)
    if epoch is not None and dates.size:
        first, last = float(dates.min()), float(dates.max())
        beyond = max(first - epoch, epoch - last)
        text = f"{dates.size} dates from {first:.2f} to {last:.2f}"
        out.append(text + (f", judged {beyond:.1f} years beyond" if beyond > 0 else ""))
    tests = session.score_tests
    passed = [t for t in tests if not t.significant]
    if tests:
        sizes = (t.smallest for t in passed if np.isfinite(t.smallest) and t.unit == model.unit)
        least = max(sizes, default=None)
        text = f"{len(passed)} of {len(tests)} tests of the residuals that found nothing"
        if least is not None:
            text += f", and would have seen {least:.2g} {model.unit} rms"
        out.append(text)
    held = held_out_of(session)
    out.append("no held-out stars" if held is None else held.verdict)
    return tuple(out)
