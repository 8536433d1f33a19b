"""`bayesdist inspect`: content of a file, and its faults."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from bayesdist.app.screen import number, table_text
from bayesdist.errors import FormatError

if TYPE_CHECKING:
    from bayesdist.infer import LinearFit
    from bayesdist.infer.posterior import Posterior


def inspect(path: str | Path) -> str:
    """Describe a calibration file, a WCS in FITS, a fit, a posterior, or the posterior of a run."""
    path = Path(path)
    if path.is_dir() or path.suffix == ".nc":
        from bayesdist.infer.posterior.files import load_fit, load_posterior

        try:
            return _posterior_text(load_posterior(path))
        except FormatError:
            if path.is_file():
                with suppress(FormatError):
                    return _fit_text(load_fit(path))
            raise
    from bayesdist.products.registry import describe  # imports only what the format needs

    return describe(path)


def _fit_text(fit: LinearFit) -> str:
    m = fit.model
    rows = [
        {"parameter": name, "mean": number(mean, 8), "formal sigma": number(sigma, 3), "unit": unit}
        for name, mean, sigma, unit in zip(m.names, fit.mean, fit.sigma, m.units, strict=False)
    ]
    lines = [
        "linear fit of a distortion, by which sampling starts",
        f"model      order {m.order}, {len(m.chips)} chip(s), frames '{m.frames}', "
        f"{len(m.exposures)} exposure(s), {m.n_params} parameters, u and v in {m.unit}",
        f"fit        {fit.n_used} stars, {fit.n_rejected} rejected, rms {number(fit.rms_u)} and "
        f"{number(fit.rms_v)} {fit.unit}, chi2/dof {number(fit.chi2 / max(fit.dof, 1))}",
        "",
        table_text(rows),
    ]
    return "\n".join(lines)


def _posterior_text(p: Posterior) -> str:
    c, s, m = p.convergence, p.sampler, p.model
    rows = [
        {"parameter": name, "mean": number(mean, 8), "sd": number(sd, 3), "unit": unit}
        | {"R-hat": number(rhat, 5), "ESS": number(float(ess), 4)}
        for name, mean, sd, unit, rhat, ess in zip(
            m.names, p.mean, p.sigma, m.units, c.rhat, c.ess_bulk, strict=False
        )
    ]
    rows += [
        {"parameter": k, "mean": number(v.mean(), 8), "sd": number(v.std(ddof=1), 3), "unit": ""}
        | {"R-hat": number(float(r), 5), "ESS": number(float(e), 4)}
        for (k, v), r, e in zip(
            p.hyper.items(), c.rhat[m.n_params :], c.ess_bulk[m.n_params :], strict=True
        )
    ]
    state = "converged" if c.converged else f"NOT CONVERGED: {'; '.join(c.reasons)}"
    lines = [
        "posterior of a distortion",
        f"model      order {m.order}, {len(m.chips)} chip(s), frames '{m.frames}', "
        f"{len(m.exposures)} exposure(s), {m.n_params} parameters, u and v in {m.unit}",
        f"outliers   {p.mixture.model}; {p.n_flagged} of {p.n_stars} stars flagged",
        f"sampler    {s.method}, {s.ensembles} ensembles of {s.walkers} walkers, {s.steps} steps, "
        f"acceptance {number(s.acceptance, 3)}",
        f"state      {state}",
        f"           R-hat <= {number(c.rhat_max, 5)}, ESS bulk >= {number(c.ess_bulk_min)}, "
        f"tail >= {number(c.ess_tail_min)}, Pareto k {number(c.pareto_k, 2)}",
        "",
        table_text(rows),
    ]
    return "\n".join(lines)
