"""What summary.json says of a fit."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from bayesdist.app.added_errors import added_errors_rows
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.infer import LinearFit
from bayesdist.infer.skew import Skew, skew_of
from bayesdist.infer.stars.shards import Matches

__all__ = ["fit_sections", "log_fit"]

log = logging.getLogger("bayesdist")


def fit_sections(fitted: Fitted, stars: Matches, *, skew: bool = False) -> dict[str, Any]:
    """Sections of summary.json: 'data', 'fit', and those that only the making of the fit knows.

    Parameters
    ----------
    fitted : Fitted
    stars : MatchTable or PartitionedMatches
        As `Fitted.placed` gives them.
    skew : bool
        The skew of the axes is asked for.
    """
    fit, errors = fitted.linear, fitted.errors
    optional: dict[str, Any] = {}
    if errors.factor != 1.0:
        optional["error_scale"] = errors.factor
    if fitted.grouped is not None:
        optional["added_errors"] = added_errors_rows(fitted.grouped)
    if skew:
        optional["skew"] = _skew(fit)
    return {
        "data": {
            "n_rows": stars.n_rows,
            "n_used": fit.n_used,
            "n_rejected": stars.n_rows - fit.n_used,
            "rejected": {**stars.rejected, **fit.rejected},
            "n_exposures": len(stars.exposure_names),
            "sources": list(stars.sources),
            "tangent_point": stars.tangent_point,
        },
        "fit": {
            "order": fit.model.order,
            "chi2": fit.chi2,
            "dof": fit.dof,
            "rms_u": fit.rms_u,
            "rms_v": fit.rms_v,
            "unit": fit.unit,
            "condition": fit.condition,
            "n_parameters": fit.model.n_params,
            **optional,
        },
        **fitted.facts,
    }


def log_fit(fit: LinearFit, rows: str) -> None:
    """A line of the log; `rows` is what a row of the data is, in words."""
    log.info(
        "fit: %d %s, %d rejected, rms %.4g and %.4g %s, chi2/dof %.3f",
        fit.n_rows,
        rows,
        fit.n_rejected,
        fit.rms_u,
        fit.rms_v,
        fit.unit,
        fit.chi2 / max(fit.dof, 1),
    )


def _skew(fit: LinearFit) -> Mapping[str, Any]:
    """Skew of the first chip and, where there are several, of each."""
    rows = [
        {"chip": chip.number, **_skew_row(skew_of(fit, chip=chip.number))}
        for chip in fit.model.chips
    ]
    first = {key: value for key, value in rows[0].items() if key != "chip"}
    return first | ({"chips": rows} if len(rows) > 1 else {})


def _skew_row(skew: Skew) -> dict[str, float]:
    return {
        "value_rad": skew.value,
        "sigma_rad": skew.sigma,
        "significance": skew.significance,
    }
