"""Stars set aside before the fit: which ones, what they say afterwards, what is written of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import Table

from bayesdist.app.kept import kept
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.terms.local import table_of
from bayesdist.data.holdout import SetAside, Split, exposures_drawn, split_matches
from bayesdist.diagnose.holdout.predictive import Predictive, predictive_of
from bayesdist.diagnose.holdout.validation import LEAST_HELD, HeldOutTruth, held_out_truth
from bayesdist.errors import InputError
from bayesdist.model import LookupTable

if TYPE_CHECKING:
    from bayesdist.app.session import Session
    from bayesdist.infer import Matches

__all__ = [
    "held_out_of",
    "holdout_summary",
    "holdout_table",
    "local_errors",
    "predictive_of_run",
    "split_of",
    "whole_exposures",
]


def whole_exposures(session: Session, names: tuple[str, ...]) -> tuple[str, ...]:
    """Exposures that are set aside whole: the named ones, or so many drawn by the seed."""
    block, seed = session.config.holdout, session.config.sampler.seed
    if block is None:
        return ()
    needed = names[: session.needed_exposures]
    if isinstance(block.exposures, int):
        return exposures_drawn(names[len(needed) :], block.exposures, seed)
    for name in block.exposures:
        if name in needed:
            raise InputError(
                f"exposure {name!r} is to be held out, and defines the gauge",
                where="holdout.exposures",
                do="name another one",
            )
    return tuple(dict.fromkeys(block.exposures))


def split_of(session: Session, matches: Matches) -> Split | None:
    """Matches that are fitted, and those that are set aside; None where none are.

    Raises
    ------
    InputError
        For an unknown exposure, and when nothing would be left, or too little set aside.
    """
    block = session.config.holdout
    if block is None:
        return None
    whole = whole_exposures(session, matches.exposure_names)
    split = split_matches(matches, SetAside(block.fraction, whole, session.config.sampler.seed))
    if len(split.held) < LEAST_HELD:
        raise InputError(
            f"{len(split.held)} of {len(matches)} stars are held out, which say too little",
            where=", ".join(matches.sources),
            do=f"hold out at least {LEAST_HELD}: raise holdout.fraction",
        )
    return split


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
        whole = whole_exposures(session, held.exposure_names)
        return held_out_truth(session.predictive, held, whole=whole)

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
        "is_omnibus",
        "where",
        "n",
        "value",
        "expected",
        "p_value",
        "p_corrected",
        "limit",
    )
    columns = {name: name for name in names} | {"is_omnibus": "together"}
    table = Table({name: [getattr(t, columns[name]) for t in found.tests] for name in names})
    table["lo95"], table["hi95"] = np.array([t.interval for t in found.tests]).T
    table["limit"].description = "of tails, in sigma; scatter of deviations"
    table["value"].description = (
        f"offset: {found.unit}; spread: factor on the predicted errors; distribution: largest "
        "difference of distribution functions; tails: fraction of stars; deviation: in its own unit"
    )
    table.meta = {
        "verdict": found.verdict,
        "n": found.n,
        "n_excluded": found.n_left_out,
        "exposures": list(found.exposures),
        "p_corrected": "Holm 1979, over all tests of this table",
    }
    return table


def holdout_summary(found: HeldOutTruth) -> dict[str, Any]:
    """Section 'holdout' of summary.json."""
    return {
        "n": found.n,
        "n_excluded": found.n_left_out,
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
                "is_omnibus": t.together,
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
