"""`match`, `fit` and `sample` as functions: their values are those of a run, written or not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.app.parts import read_stored_fit, write_stored_fit
from bayesdist.app.pipeline import fit, match, sample
from bayesdist.app.run import Run
from bayesdist.app.stages import FIT_ARTEFACTS, fit_sections
from bayesdist.app.stars import ErrorLaw, StarReader
from bayesdist.app.store import as_json
from bayesdist.app.store.rundir import RunDirectory
from bayesdist.data import MagnitudeErrors
from bayesdist.infer import load_fit, load_posterior
from tests.app.support import as_table, in_memory, simulated, snapshot, summary_of, write_job


@pytest.fixture(scope="module")
def job(finished):
    with in_memory(finished.config) as run:
        yield run


@pytest.fixture(scope="module")
def fitted(job):
    return fit(match(job))


def test_functions_find_what_a_run_finds(finished, fitted):
    before = snapshot(finished.path.parent)
    posterior = sample(fitted).posterior
    assert snapshot(finished.path.parent) == before
    known, draws = load_fit(finished.path / "fit.nc"), load_posterior(finished.path)
    np.testing.assert_array_equal(fitted.fit.mean, known.mean)
    np.testing.assert_array_equal(fitted.fit.cov, known.cov)
    np.testing.assert_array_equal(posterior.theta, draws.theta)
    sections = as_json(fit_sections(fitted))
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
    found = fit(match(in_memory(path)))
    write_stored_fit(tmp_path, **{name: getattr(found, name) for name in FIT_ARTEFACTS})
    read = match(in_memory(path)).having(**read_stored_fit(tmp_path))
    assert (found.errors.factor > 20) == (not data)
    for made, again in ((found.matches, read.matches), (found.held_out, read.held_out)):
        assert len(made) == len(again) > 0
        np.testing.assert_array_equal(made.sigma_u, again.sigma_u)
        np.testing.assert_array_equal(made.sigma_v, again.sigma_v)
    assert len(found.stars) + len(found.held_stars) == len(matches)


def test_another_artefact_drops_what_rested_on_the_former(finished, fitted):
    with Run.of(RunDirectory.open(finished.path)) as results:
        posterior, sums, matches = results.posterior, results.diagnostics.sums, results.matches
        flagged = results.having(posterior=replace(posterior, n_flagged=7))
        assert flagged.posterior.n_flagged == 7 and results.posterior is posterior
        assert flagged.matches is matches and flagged.diagnostics.sums is not sums
        refitted = flagged.having(fit=fitted.fit, priors=fitted.priors)
        assert refitted.fit is fitted.fit and "matches" not in vars(refitted)
        assert refitted.posterior.n_flagged == posterior.n_flagged  # of the run's folder again
        assert refitted.stars is results.stars


def test_an_artefact_that_no_stage_makes_is_refused(fitted):
    with pytest.raises(LookupError, match="fitted"):
        fitted.having(fitted=fitted.fit)


def test_another_configuration_keeps_the_stars(fitted):
    """The fit of a higher order has more parameters, and the same stars."""
    higher = fit(fitted.with_config(fitted.config.of_order(fitted.model.order + 1)))
    assert higher.stars is fitted.stars and higher.model.order == fitted.model.order + 1
    np.testing.assert_array_equal(higher.matches.x, fitted.matches.x)


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
    reader, model, stars = StarReader(), fitted.model, fitted.stars
    shards = reader.shards(model, stars)
    assert reader.shards(model, stars) is shards
    assert reader.sample(stars) is reader.sample(stars)
    assert reader.shards(model, stars, ErrorLaw(2.0)) is not shards
    reader.close()
