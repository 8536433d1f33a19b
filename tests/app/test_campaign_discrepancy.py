"""What a campaign's model leaves out is in its errors; where nothing is, they are hardly wider."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

from bayesdist.app.run import Run
from bayesdist.assess.terms.correlated import DEVIATIONS, STRUCTURE, STRUCTURE_IN_FIT
from bayesdist.diagnose.correlated.information import Information, cell_sums
from bayesdist.infer.solution.solution import likelihood_of
from tests.adversarial import KINDS
from tests.adversarial.campaign_measure import actual_error, assessed, stated_sigma
from tests.adversarial.campaign_truth import CampaignTruth
from tests.app.support import summary_of
from tests.reduced import only_in_full

pytestmark = [pytest.mark.slow, only_in_full("tests/diagnose/correlated has patterns")]

SIZE = 0.01  # px: of the pattern, either way along x


@dataclass(frozen=True)
class Patterned:
    truth: CampaignTruth
    run: Run


def run_of(kind: str, folder: Path) -> Iterator[Patterned]:
    truth = KINDS[kind].truth(1)
    with closing(assessed(truth, folder, 1)) as run:
        yield Patterned(truth, run)


@pytest.fixture(scope="module")
def patterned(tmp_path_factory):
    """Columns in stripes of 34 pixels that are displaced, and no tables for them."""
    yield from run_of("campaign_lithography", tmp_path_factory.mktemp("patterned"))


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    yield from run_of("campaign_inside", tmp_path_factory.mktemp("plain"))


def rows(patterned: Patterned) -> dict[str, dict]:
    return {row["name"]: row for row in summary_of(patterned.run.directory.path)["budget"]}


def test_a_pattern_is_measured_and_in_the_budget(patterned):
    found = summary_of(patterned.run.directory.path)["discrepancy"]["structure"]
    by_axis = {row["axis"]: row["rms"] for row in found}
    # the polynomials lie along the pixels but for a small rotation
    assert by_axis["u"] == pytest.approx(SIZE, rel=0.4)
    assert by_axis["v"] < SIZE / 2
    budget = rows(patterned)
    assert budget[STRUCTURE]["kind"] == "local"
    assert budget[STRUCTURE]["radial"] == pytest.approx(SIZE, rel=0.5)


def test_errors_with_a_pattern_cover(patterned):
    error, stated = (
        actual_error(patterned.run, patterned.truth),
        stated_sigma(patterned.run),
    )
    pull = np.abs(error) / stated
    assert 0.55 < np.mean(pull < 1.0) < 0.9
    assert np.mean(pull < 1.96) > 0.9


def test_draws_are_spread_by_what_the_pattern_does_to_the_fit(patterned):
    run = patterned.run
    posterior, n = run.posterior, run.posterior.model.n_distortion
    more = np.sqrt(np.diag(run.solution.cov)[:n] / np.diag(posterior.cov)[:n])
    assert np.median(more) > 1.02 and more.min() > 0.9
    table = Table.read(run.directory / "coefficients.ecsv")
    assert np.isfinite(table["sd"]).all()


def test_where_nothing_is_left_out_errors_are_hardly_wider(plain):
    budget = rows(plain)
    beside = [budget[name]["radial"] for name in (STRUCTURE, STRUCTURE_IN_FIT, DEVIATIONS)]
    assert 0 < np.hypot.reduce(beside) < 0.6 * budget["total"]["radial"]
    without = np.sqrt(budget["total"]["radial"] ** 2 - np.sum(np.square(beside)))
    assert budget["total"]["radial"] < 1.2 * without


def test_at_the_mode_the_priors_pull_as_hard_as_the_stars(plain):
    """Or the structure would be that of deviations which their priors have shrunk."""
    run = plain.run
    likelihood = likelihood_of(run.posterior)
    sums = run.shards.sum(cell_sums, likelihood, 32)
    information = Information(run.fit.model, likelihood.theta, sums, run.priors)
    of_stars = Information(
        run.fit.model,
        likelihood.theta,
        sums,
        type(run.priors).none(run.fit.model),
    )
    D = run.fit.model.n_distortion

    def distance(score: np.ndarray) -> float:
        """In standard deviations of the posterior, over the deviations of all exposures."""
        step = information.covariance @ score
        return float(np.sqrt(np.mean(step[D:] ** 2 / np.diag(information.covariance)[D:])))

    # gradients of cells are those of their middles, and the mean is not quite the mode
    assert distance(information.score) < 0.3
    assert distance(of_stars.score) > 2 * distance(information.score)
