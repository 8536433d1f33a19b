"""Stage 'sample': the posterior."""

from __future__ import annotations

import logging

from bayesdist.app.assessment.checks import in_circle
from bayesdist.app.kinds.summary import sample_sections
from bayesdist.app.results import Results
from bayesdist.app.screen import progress_bar
from bayesdist.app.tables.star_files import FOLDER, write_star_files
from bayesdist.infer import Posterior, save_posterior

__all__ = ["run_sample", "save_sampled"]

log = logging.getLogger("bayesdist")


def run_sample(results: Results) -> Results:
    """Sample the posterior of the fit, and write it."""
    data, config, folder = results.data, results.config, results.run.path
    with progress_bar("sample") as progress:
        posterior = results.kind.sample(data, config, folder=folder, progress=progress)
    return save_sampled(results, posterior)


def save_sampled(results: Results, posterior: Posterior) -> Results:
    """Take another posterior, and write it, its memberships and its part of summary.json."""
    run, data, gauge = results.run, results.data, results.gauge_words
    record = run.record
    provenance = {k: record[k] for k in ("inputs", "seed", "versions", "created")}
    provenance |= {"gauge": gauge} if gauge else {}
    table = data.stars if data.stars.in_memory else None
    save_posterior(posterior, table, run / "posterior.nc", provenance=provenance)
    write_star_files(data.stars, data.fit, posterior, run / FOLDER)
    run.summarise(**sample_sections(posterior, in_circle=in_circle(data, results.config)))
    c, n = posterior.convergence, posterior.sampler
    if posterior.approximation:
        log.warning("sample: %s", posterior.approximation)
    elif c.converged:
        log.info("sample: converged after %d steps, %d passes", n.steps, n.passes)
    else:
        log.warning("sample: NOT CONVERGED after %d steps: %s", n.steps, "; ".join(c.reasons))
    return results.having(posterior=posterior)
