"""Stage 1: the linear fit."""

from __future__ import annotations

import logging
from typing import Any

from astropy.table import Table

from bayesdist.app.added_errors import added_errors_rows, grouping_sentence
from bayesdist.app.checks import frames_doubt
from bayesdist.app.session import ERROR_COLUMNS, Session, write_table
from bayesdist.diagnose.residuals.epoch_shift import epoch_shift
from bayesdist.diagnose.residuals.majority import majority_sentence
from bayesdist.infer import LinearFit, save_fit
from bayesdist.infer.skew import Skew, skew_of

__all__ = ["run_fit", "summarise_fit"]

log = logging.getLogger("bayesdist")


def run_fit(session: Session) -> None:
    run = session.run
    fit, errors = session.linear
    if errors is not None:
        table = Table({name: getattr(errors, name) for name in ERROR_COLUMNS})
        write_table(table, run / "magnitude_errors.ecsv")
    save_fit(fit, run / "fit.nc")
    # this fit is what all goes by from now on
    if errors is not None:
        session.errors_changed()
    session.__dict__.pop("fit", None)
    summarise_fit(session, fit)
    for note in session.raw_matches.notes:
        log.info("fit: %s", note)
    for reason, count in session.raw_matches.rejected.items():
        log.info("fit: %d rows were left out in reading: %s", count, reason)
    shift = epoch_shift(session.sampled_matches, fit)
    if shift is not None and shift.significant:
        log.warning("fit: WARNING: %s", shift.sentence)
    majority = majority_sentence(fit)
    if session.error_scale_sentence:
        log.warning("fit: WARNING: %s", session.error_scale_sentence)
    if text := frames_doubt(session, majority):
        log.warning("fit: WARNING: %s", text)
    if session.grouped_errors is not None:
        log.info("fit: %s", grouping_sentence(session.grouped_errors, fit.unit))
    if majority:  # said before hours of sampling
        log.warning("fit: WARNING: %s", majority)


def summarise_fit(session: Session, fit: LinearFit) -> None:
    """Sections 'data' and 'fit' of summary.json, and a line of the log."""
    matches, grouped = session.raw_matches, session.grouped_errors
    session.run.summarise(
        data={
            "n_rows": matches.n_rows,
            "n_used": fit.n_used,
            "n_rejected": matches.n_rows - fit.n_used,
            "rejected": {**matches.rejected, **fit.rejected},
            "n_exposures": len(matches.exposure_names),
            "sources": list(matches.sources),
            "tangent_point": matches.tangent_point,
        },
        fit={
            "order": fit.model.order,
            "chi2": fit.chi2,
            "dof": fit.dof,
            "rms_u": fit.rms_u,
            "rms_v": fit.rms_v,
            "unit": fit.unit,
            "condition": fit.condition,
            "n_parameters": fit.model.n_params,
            **({} if session.error_scale == 1.0 else {"error_scale": session.error_scale}),
            **({} if grouped is None else {"added_errors": added_errors_rows(grouped)}),
            **(_skew(fit) if session.config.fit.skew else {}),
        },
    )
    log.info(
        "fit: %d %s, %d rejected, rms %.4g and %.4g %s, chi2/dof %.3f",
        fit.n_rows,
        session.things,
        fit.n_rejected,
        fit.rms_u,
        fit.rms_v,
        fit.unit,
        fit.chi2 / max(fit.dof, 1),
    )


def _skew(fit: LinearFit) -> dict[str, Any]:
    """Skew of the first chip and, where there are several, of each."""
    rows = [
        {"chip": chip.number, **_skew_row(skew_of(fit, chip=chip.number))}
        for chip in fit.model.chips
    ]
    first = {key: value for key, value in rows[0].items() if key != "chip"}
    return {"skew": first | ({"chips": rows} if len(rows) > 1 else {})}


def _skew_row(skew: Skew) -> dict[str, float]:
    return {
        "value_rad": skew.value,
        "sigma_rad": skew.sigma,
        "significance": skew.significance,
    }
