"""Stage 2: the posterior."""

from __future__ import annotations

import logging

from bayesdist.app.kinds.stars import sample_stars
from bayesdist.app.kinds.summary import sample_sections
from bayesdist.app.session import Session
from bayesdist.app.star_files import FOLDER, write_star_files
from bayesdist.infer import Posterior, save_posterior

__all__ = ["run_sample", "save_sampled"]

log = logging.getLogger("bayesdist")


def run_sample(session: Session) -> None:
    """Sample the posterior of the fit, and write it."""
    posterior = sample_stars(
        session.fitted,
        session.shards,
        session.config,
        folder=session.run.path,
        progress=session.progress,
    )
    save_sampled(session, posterior)


def save_sampled(session: Session, posterior: Posterior) -> None:
    """Take another posterior, and write it, its memberships and its part of summary.json."""
    run = session.run
    session.renew("posterior", posterior)
    record = run.record
    provenance = {k: record[k] for k in ("inputs", "seed", "versions", "created")}
    provenance |= {"gauge": session.gauge_words} if session.gauge_words else {}
    matches = session.matches
    table = matches if matches.in_memory else None
    save_posterior(posterior, table, run / "posterior.nc", provenance=provenance)
    write_star_files(matches, session.fit, posterior, run / FOLDER)
    run.summarise(**sample_sections(posterior, in_circle=session.in_circle))
    c, n = posterior.convergence, posterior.sampler
    if posterior.approximation:
        log.warning("sample: %s", posterior.approximation)
    elif c.converged:
        log.info("sample: converged after %d steps, %d passes", n.steps, n.passes)
    else:
        log.warning("sample: NOT CONVERGED after %d steps: %s", n.steps, "; ".join(c.reasons))
