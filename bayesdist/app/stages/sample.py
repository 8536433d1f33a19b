"""Stage 2: the posterior."""

from __future__ import annotations

import logging
from dataclasses import asdict

from bayesdist.app.session import Session
from bayesdist.app.star_files import FOLDER, write_star_files
from bayesdist.data import MatchTable
from bayesdist.infer import (
    Posterior,
    sample,
    save_posterior,
)

__all__ = ["keep_posterior", "run_sample"]

log = logging.getLogger("bayesdist")


def run_sample(session: Session) -> None:
    config, run = session.config, session.run
    s = config.sampler
    posterior = sample(
        session.fit,
        session.shards,
        outliers=config.mixture(),
        priors=session.priors,
        seed=s.seed,
        ensembles=s.ensembles,
        walkers=s.walkers,
        target_ess=s.target_ess,
        target_rhat=s.target_rhat,
        max_steps=s.max_steps,
        checkpoint_every=s.checkpoint_every,
        folder=run.path,
        progress=session.progress,
        method=s.method,
        second_stage=s.second_stage,
    )
    keep_posterior(session, session.settled(posterior))


def keep_posterior(session: Session, posterior: Posterior) -> None:
    """Write a posterior, what it says of each star, and its part of summary.json."""
    run = session.run
    session.__dict__["posterior"] = posterior
    record = run.record
    provenance = {k: record[k] for k in ("inputs", "seed", "versions", "created")}
    provenance |= {"gauge": session.gauge_words} if session.gauge_words else {}
    matches = session.matches
    table = matches if isinstance(matches, MatchTable) else None
    save_posterior(posterior, table, run / "posterior.nc", provenance=provenance)
    write_star_files(matches, session.fit, posterior, run / FOLDER)
    c, i = posterior.convergence, posterior.sampler
    run.summarise(
        outliers=_outliers(posterior, session.in_circle),
        sampler={
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
    )
    if posterior.approximation:
        log.warning("sample: %s", posterior.approximation)
    elif c.converged:
        log.info("sample: converged after %d steps, %d passes", i.steps, i.passes)
    else:
        log.warning("sample: NOT CONVERGED after %d steps: %s", i.steps, "; ".join(c.reasons))


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
    """What vouches for draws that were not made from the posterior itself."""
    c = posterior.certificate
    if c is None:
        return {}
    return {"certificate": asdict(c) | {"granted": c.granted, "statement": c.statement}}
