"""One campaign in two filters, simulated and calibrated once for the files of this folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from bayesdist.kinds.campaign import linear_terms
from tests.app.support import edit, good

# coarse nodes and few draws: quick.  Wider cells than the pattern's leave the linear terms alone;
# 100 draws' worth moves a mean by a tenth of its sigma.  How long requirements are met is the
# subject of test_budget_and_validity
QUICK = {
    'method = "field"': 'step = [256.0, 256.0]\nmethod = "field"',
    "[assess]": "[sampler]\nensembles = 2\ntarget_ess = 100\ntarget_rhat = 1.05\n\n[assess]",
    "grid = [33, 17]": "grid = [17, 9]\ndraws = 400\nyears_ahead = 0",
}


@pytest.fixture(scope="package")
def folder(tmp_path_factory) -> Path:
    """16 exposures in F606W, 8 in F814W, and a configuration of each filter."""
    folder = tmp_path_factory.mktemp("campaign") / "acs"
    options = ("--exposures", 16, "--secondary-exposures", 8, "--stars", 8000, "--seed", 5, "-q")
    good("simulate", "acs", "-o", folder, "--filters", "F606W,F814W", *options)
    for config in folder.glob("campaign_*.toml"):
        edit(config, QUICK)
    return folder


@pytest.fixture(scope="package")
def run(folder, full) -> Path:
    """The run of F606W.

    In full the course over time is told of the first term, and reported.  That of all would take
    long; tests/kinds/campaign/series shows what is said of it, tests/report what campaigns show.
    """
    out, of_term = folder / "run_f606w", linear_terms._verdict

    def first(exposures, k, *options):
        unsaid = {"term": exposures.coefficients[k], "claim": "not asked", "text": "Not asked."}
        return of_term(exposures, k, *options) if full and k == 0 else unsaid

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(linear_terms, "_verdict", first)
        if not full:
            patch.setattr("bayesdist.app.stages.report", lambda run, pdf: [])
        good("run", folder / "campaign_f606w.toml", "-o", out, "-q")
    return out
