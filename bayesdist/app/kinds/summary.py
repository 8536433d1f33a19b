"""Sections of summary.json that follow from the values of stages."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.matches.added_errors import added_errors_rows
from bayesdist.data import Matches
from bayesdist.infer import LinearFit, Posterior
from bayesdist.infer.skew import Skew, skew_of

__all__ = ["fit_sections", "log_fit", "sample_sections"]

log = logging.getLogger("bayesdist")


def fit_sections(fitted: Fitted, stars: Matches, *, skew: bool = False) -> dict[str, Any]:
    """Sections of summary.json: 'data', 'fit', and those that only the making of the fit knows.

    Parameters
    ----------
    fitted : Fitted
    stars : Matches
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


def sample_sections(posterior: Posterior, *, in_circle: bool) -> dict[str, Any]:
    """Sections 'outliers' and 'sampler' of summary.json.

    Parameters
    ----------
    posterior : Posterior
    in_circle : bool
        Stars were matched in circles about nominal positions.
    """
    c, i = posterior.convergence, posterior.sampler
    return {
        "outliers": _outliers(posterior, in_circle),
        "sampler": {
            "method": i.method,
            "exact": i.exact,
            "converged": c.converged,
            "reasons": list(c.reasons),
            "rhat_max": c.rhat_max,
            "ess_bulk_min": c.ess_bulk_min,
            "ess_tail_min": c.ess_tail_min,
            "pareto_k": c.pareto_k,
            "importance_efficiency": c.importance_efficiency,
            "ensembles": i.ensembles,
            "walkers": i.walkers,
            "steps": i.steps,
            "passes": i.passes,
            "acceptance": i.acceptance,
            "wall_s": i.wall_s,
            **_certificate(posterior),
        },
    }


def _outliers(posterior: Posterior, in_circle: bool) -> dict[str, object]:
    out: dict[str, object] = {"model": posterior.mixture.model, "unit": posterior.unit}
    names = {"f": "fraction", "j": "jitter", "s_out": "scale"}
    for key, name in names.items():
        values = posterior.hyper.get(key)
        if values is not None:
            out[name] = {"mean": float(values.mean()), "sd": float(values.std(ddof=1))}
        elif key == "j":
            out[name] = {"mean": posterior.mixture.jitter, "sd": 0.0}
        elif key == "f":
            out[name] = {"mean": 0.0, "sd": 0.0}
    out["n_flagged"] = posterior.n_flagged
    if in_circle:
        out["match_circle"] = posterior.mixture.match_radius
    return out


def _certificate(posterior: Posterior) -> dict[str, object]:
    """Evidence for draws that were not made from the posterior itself."""
    c = posterior.certificate
    if c is None:
        return {}
    return {"certificate": asdict(c) | {"granted": c.granted, "statement": c.statement}}
