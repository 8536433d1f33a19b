"""`match`, `fit` and `sample` as functions: their values are those of a run, written or not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.app.config import load_config
from bayesdist.app.kinds.errors import ErrorLaw
from bayesdist.app.kinds.fit_data import FitData, StarReader
from bayesdist.app.kinds.kind import kind_of
from bayesdist.app.kinds.matches.stars import fit_stars, match_stars, read_stars
from bayesdist.app.kinds.sampling import sample_stars
from bayesdist.app.results import open_results
from bayesdist.app.saving import fit_sections
from bayesdist.app.store import as_json
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import MagnitudeErrors
from bayesdist.infer import load_fit, load_posterior
from tests.app.support import as_table, simulated, snapshot, summary_of, write_job


@pytest.fixture(scope="module")
def job(finished):
    config, _ = load_config(finished.config)
    return config, finished.config.parent


@pytest.fixture(scope="module")
def fitted(job):
    config, base = job
    matched = match_stars(read_stars(config, base), config)
    return matched, fit_stars(matched, config)


def test_functions_find_what_a_run_finds(finished, job, fitted):
    before = snapshot(finished.path.parent)
    (config, _), (matched, found) = job, fitted
    posterior = sample_stars(FitData(matched, found), config)
    assert snapshot(finished.path.parent) == before
    known, draws = load_fit(finished.path / "fit.nc"), load_posterior(finished.path)
    np.testing.assert_array_equal(found.linear.mean, known.mean)
    np.testing.assert_array_equal(found.linear.cov, known.cov)
    np.testing.assert_array_equal(posterior.theta, draws.theta)
    sections = as_json(fit_sections(found, matched.stars))
    assert {name: summary_of(finished.path)[name] for name in sections} == sections


@pytest.mark.parametrize("data", [{}, {"sigma": "by_magnitude"}])
def test_a_fit_that_is_read_gives_the_same_stars(data, tmp_path):
    """Errors that are far too small, others by magnitude; some stars are held out."""
    matches, _ = simulated(2000, mag=np.linspace(12.0, 18.0, 2000))
    table = as_table(matches)
    for name in ("sigma_u", "sigma_v"):
        table[name] /= 50.0
    path = write_job(
        tmp_path / "input",
        table,
        stars="stars.parquet",
        data={"matches": "stars.parquet", **data},
        holdout={"fraction": 0.3},
    )
    config, _ = load_config(path)
    matched = match_stars(read_stars(config, path.parent), config)
    found = fit_stars(matched, config)
    found.save(tmp_path)
    read = kind_of(config).load_fitted(tmp_path, lambda: matched)
    assert (found.errors.factor > 20) == (not data)
    for made, again in (
        (FitData(matched, found).stars, FitData(matched, read).stars),
        (FitData(matched, found).held, FitData(matched, read).held),
    ):
        assert len(made) == len(again) > 0
        np.testing.assert_array_equal(made.sigma_u, again.sigma_u)
        np.testing.assert_array_equal(made.sigma_v, again.sigma_v)
    assert len(matched.stars) + len(matched.held) == len(matches)


def test_another_artefact_drops_what_rested_on_the_former(finished, fitted):
    with open_results(RunDirectory.open(finished.path)) as results:
        _, found = fitted
        posterior, sums, data = results.posterior, results.diagnostics.sums, results.data
        flagged = results.having(posterior=replace(posterior, n_flagged=7))
        assert flagged.posterior.n_flagged == 7 and results.posterior is posterior
        assert flagged.data is data and flagged.diagnostics.sums is not sums
        refitted = flagged.having(fitted=found)
        assert refitted.fit is found.linear and refitted.data is not data
        assert refitted.posterior.n_flagged == posterior.n_flagged  # of the run's folder again
        assert refitted.matched is results.matched


def test_one_law_of_errors_for_all_stars():
    table = simulated(50, mag=np.linspace(12.0, 18.0, 50))[0]
    mag = np.array([12.0, 18.0])
    sigma = np.array([0.03, 0.04])
    errors = MagnitudeErrors(mag, sigma, sigma, np.array([25, 25]), sigma, sigma)
    assert ErrorLaw().applied(table) is table
    np.testing.assert_allclose(ErrorLaw(3.0).applied(table).sigma_u, 3 * table.sigma_u)
    at, _ = errors.at(table.mag)
    np.testing.assert_allclose(ErrorLaw(by_magnitude=errors).applied(table).sigma_u, at)
    both = ErrorLaw(by_magnitude=errors, with_catalogue=True).applied(table)
    np.testing.assert_allclose(both.sigma_u, np.hypot(at, table.sigma_u))


def test_stars_are_read_anew_only_where_they_are_others(fitted):
    matched, found = fitted
    reader, model = StarReader(), found.linear.model
    shards = reader.shards(model, matched.stars)
    assert reader.shards(model, matched.stars) is shards
    assert reader.sample(matched.stars) is reader.sample(matched.stars)
    assert reader.shards(model, matched.stars, ErrorLaw(2.0)) is not shards
    reader.close()
