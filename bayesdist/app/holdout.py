"""Stars set aside before the fit: what they say afterwards, and what is written of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import Table

from bayesdist.app.kept import kept
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.terms.local import table_of
from bayesdist.diagnose.holdout.predictive import Predictive, predictive_of
from bayesdist.diagnose.holdout.validation import HeldOutTruth, held_out_truth
from bayesdist.model import LookupTable

if TYPE_CHECKING:
    from bayesdist.app.session import Session

__all__ = [
    "held_out_of",
    "holdout_summary",
    "holdout_table",
    "local_errors",
    "predictive_of_run",
]


def held_out_of(session: Session, *, anew: bool = False) -> HeldOutTruth | None:
    """What held-out stars say of the posterior, once in a session.

    Parameters
    ----------
    session : Session
    anew : bool
        Also where it has been done: the posterior may be another one.

    Returns
    -------
    HeldOutTruth or None
        None where no stars were set aside.

    Raises
    ------
    InputError
        For too few stars.
    """
    held = session.held_matches
    if held is None:
        return None

    def judged() -> HeldOutTruth:
        return held_out_truth(session.predictive, held, whole=session.matched.whole)

    return kept(session, "held_out_truth", judged, anew=anew)


def predictive_of_run(session: Session) -> Predictive:
    """The solution as it is assessed, as it predicts.

    Quoted errors and jitter hold what the model leaves out at a position, as each star errs by it;
    neighbours err by it together.
    """
    found, discrepancy = predictive_of(session.solution), session.discrepancy
    rows = None if discrepancy is None else discrepancy.found.facts.get("structure")
    if not rows:
        return found
    side = max(row["length_pix"] for row in rows)
    return replace(found, local=local_errors(session), cell=(side, side), local_in_noise=True)


def local_errors(session: Session) -> tuple[LookupTable, ...]:
    """Errors of positions that belong to places on the detector, as tables of their own."""
    grid, out = session.config.assess.grid, []
    for chip in session.posterior.model.chips:
        where = {"grid": grid, "epoch": session.epoch, "chip": chip.number}
        domain = EvaluationDomain.of_chips(
            session.posterior.model, grid, chips=(chip.number,), epoch=session.epoch
        )
        structure = session.structure_sigma(**where)
        parts = [term.sigma(domain) for term in session.local_terms]
        parts += [] if structure is None else [structure]
        if parts:
            sigma = np.sqrt(sum(part**2 for part in parts)).reshape(grid[1], grid[0], 2)
            out.append(table_of(chip.number, chip.size, sigma))
    return tuple(out)


def holdout_table(found: HeldOutTruth) -> Table:
    """All tests, the most telling first."""
    names = (
        "name",
        "part",
        "together",
        "where",
        "n",
        "value",
        "expected",
        "p_value",
        "p_corrected",
        "limit",
    )
    table = Table({name: [getattr(t, name) for t in found.tests] for name in names})
    table["lo95"], table["hi95"] = np.array([t.interval for t in found.tests]).T
    table["limit"].description = "of tails, in sigma; scatter of deviations"
    table["value"].description = (
        f"offset: {found.unit}; spread: factor on the predicted errors; distribution: largest "
        "difference of distribution functions; tails: fraction of stars; deviation: in its own unit"
    )
    table.meta = {
        "verdict": found.verdict,
        "n": found.n,
        "n_left_out": found.n_left_out,
        "exposures": list(found.exposures),
        "p_corrected": "Holm 1979, over all tests of this table",
    }
    return table


def holdout_summary(found: HeldOutTruth) -> dict[str, Any]:
    """Section 'holdout' of summary.json."""
    return {
        "n": found.n,
        "n_left_out": found.n_left_out,
        "exposures": list(found.exposures),
        "p_value": found.p_value,
        "verdict": found.verdict,
        "level": found.level,
        "coverage": [
            {
                "axis": c.axis,
                "sigma": c.level,
                "n": c.n,
                "value": c.value,
                "expected": c.expected,
                "interval": list(c.interval),
            }
            for c in found.coverage
        ],
        "tests": [
            {
                "name": t.name,
                "part": t.part,
                "together": t.together,
                "where": t.where,
                "n": t.n,
                "value": t.value,
                "expected": t.expected,
                "p_value": t.p_value,
                "p_corrected": t.p_corrected,
            }
            for t in found.tests
        ],
    }
