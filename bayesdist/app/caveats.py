"""What a verdict of a run rests on, and what keeps one from being given."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.app.holdout import held_out_of
from bayesdist.app.session import Session
from bayesdist.assess.verdict import Caveat

__all__ = ["caveats_of", "rests_on"]

LEAST_CHI2 = 0.8  # per degree of freedom
WIDE = 5.0  # errors of a star, within which true matches are lost when nominal positions are off

# tests whose findings the error model holds, by the part of it
OF_STRUCTURE = ("order ",)
OF_NOISE = ("noise by ",)
OF_DEVIATIONS = ("exposures", "curvature in time")


def caveats_of(session: Session) -> tuple[Caveat, ...]:
    """Reasons why the errors of a run may not be as stated; none where all is measured or given."""
    return tuple(_caveats(session))


def _caveats(session: Session) -> Iterator[Caveat]:
    if session.majority:
        yield Caveat(session.majority, larger=False)
    found = session.discrepancy
    if found is None and session.misfit.significant:
        yield Caveat(session.misfit.sentence)
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
    linear = found.linear is not None and bool(found.linear.scatter)
    return (
        test.startswith(OF_NOISE)
        or (bool(found.structure) and test.startswith(OF_STRUCTURE))
        or (linear and test.startswith(OF_DEVIATIONS))
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
    ratio = session.fit.chi2 / max(session.fit.dof, 1)
    if ratio < LEAST_CHI2:
        yield Caveat(
            f"the residuals scatter less than the quoted errors say (chi-square {ratio:.2g} per "
            "degree of freedom): the match radius has cut them, or the errors are too large"
        )


def _of_time(session: Session) -> Iterator[Caveat]:
    time, dates = session.posterior.model.time, session.dates
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


def _exposures(session: Session, n: int) -> str:
    """Of which exposures the position is one."""
    if session.systematics.aligned:
        return f"a position in a new exposure, which deviates as {n} exposures do"
    found = session.discrepancy
    linear = None if found is None else found.found.linear
    if linear is None or "shape" not in linear.scatter:
        return f"{n} exposures" if n > 1 else "one exposure, or the mean of several"
    size = float(np.median(linear.scatter["shape"]))
    what = f"whose scale and shears scatter by {size:.1g}"
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
            rms = float(np.sqrt(np.mean([row["rms"] ** 2 for row in rows])))
            out.append(
                f"structure beyond it of {rms:.2g} {model.unit} rms on an axis, from residuals and "
                "prior"
            )
        else:
            out.append("look-up tables, with their errors")
    given = [b.name for b in session.config.budget]
    out.append(f"errors given by the user: {', '.join(given) or 'none'}")
    n = len(session.fit.model.exposures)
    out.append(_exposures(session, n))
    if found is not None and found.found.facts.get("exposures_measured") is False:
        out.append("no variation between exposures, which is not measured")
    dates = session.dates
    if epoch is not None and dates.size:
        first, last = float(dates.min()), float(dates.max())
        beyond = max(first - epoch, epoch - last)
        text = f"{dates.size} dates from {first:.2f} to {last:.2f}"
        out.append(text + (f", judged {beyond:.1f} years beyond" if beyond > 0 else ""))
    tests = session.score_tests
    passed = [t for t in tests if not t.significant]
    if tests:
        least = max((t.smallest for t in passed if np.isfinite(t.smallest)), default=None)
        text = f"{len(passed)} of {len(tests)} tests of the residuals that found nothing"
        if least is not None:
            text += f", and would have seen {least:.2g} {model.unit} rms"
        out.append(text)
    held = held_out_of(session)
    out.append("no held-out stars" if held is None else held.verdict)
    return tuple(out)
