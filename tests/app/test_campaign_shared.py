"""A campaign whose model leaves a pattern out: found in its residuals, used in all that follows."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from astropy.table import Table
from bayesdist.app.campaign.shared import measured_shared_errors
from bayesdist.app.correlated import UNMODELLED

from bayesdist.app.campaign.stages import CAMPAIGN_STAGES
from bayesdist.app.config import load_config
from bayesdist.app.rundir import RunDirectory
from bayesdist.app.sessions import session_of
from bayesdist.app.stages import run_stage
from tests.app.support import good, summary_of

pytestmark = pytest.mark.slow

EXPOSURES = 14


@pytest.fixture(scope="module")
def run(tmp_path_factory, full):
    """The simulation's pattern of 64 pixels, and no tables for it; stages until 'assess'."""
    if not full:
        pytest.skip("minutes of processor time: set BAYESDIST_FULL=1")
    folder = tmp_path_factory.mktemp("shared")
    good("simulate", "acs", "-o", folder / "in", "--exposures", EXPOSURES, "--stars", 5000, "-q")
    config = folder / "in" / "campaign_f606w.toml"
    text = config.read_text(encoding="utf-8").replace('method = "field"', 'method = "none"')
    text = text.replace("order = 5", "order = 4")
    config.write_text(text[: text.index("[products.release]")], encoding="utf-8")
    settings, text = load_config(config)
    planned = RunDirectory.plan(folder / "run", settings, text, config.parent)
    planned.begin()
    with closing(session_of(planned)) as session:
        for stage in ("match", "fit", "sample", "assess"):
            run_stage(session, stage, CAMPAIGN_STAGES.get(stage))
    return folder / "run"


def test_the_pattern_is_found_beyond_what_is_known(run):
    said = summary_of(run)
    found = said["shared_errors"]
    assert found["exceeds"] and found["ratio"]["value"] > 3
    assert {row["chip"] for row in found["unmodelled"]} == {1, 2}
    assert any(text.startswith("Stars err together") for text in said["warnings"])
    rows = {row["name"]: row for row in said["budget"]}
    assert rows[UNMODELLED]["kind"] == "local"
    # beside what the wider coefficients have of it already
    beside = [row["beside"] for row in found["unmodelled"]]
    expected = np.sqrt(np.mean([one["square_u"] + one["square_v"] for one in beside]))
    assert rows[UNMODELLED]["radial"] == pytest.approx(expected, rel=0.02)


def test_the_draws_are_spread_by_what_is_beyond_and_no_more(run):
    with closing(session_of(RunDirectory.open(run))) as session:
        shared, posterior = session.shared_errors, session.posterior
        n = posterior.model.n_distortion
        more = np.diag(shared.cov)[:n] / np.diag(shared.formal)[:n]
        assert (more > 1 - 1e-9).all() and np.median(more) > 2
        # spread by one linear map: what the draws were too wide by chance they stay
        drawn = np.diag(session.solution.cov)[:n] / np.diag(posterior.cov)[:n]
        assert np.median(drawn / more) == pytest.approx(1, abs=0.1)
        again = measured_shared_errors(session)
        assert again.facts == summary_of(run)["shared_errors"]
    table = Table.read(run / "coefficients.ecsv")
    high = [f == "legendre" and i + j > 1 for i, j, f in table["i", "j", "form"]]
    ratio = table["sd"][high] / table["sigma"][high]
    assert np.median(ratio) > 1.5
