"""Draws by way of a surrogate: exact with the second stage, labelled and bounded without it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

from bayesdist.errors import InputError
from bayesdist.infer import OutlierMixture, fit_linear, load_posterior, sample, save_posterior
from bayesdist.infer.density.grid import build_proposal
from bayesdist.infer.sampler.certified import AFFORDABLE, run_certified
from bayesdist.infer.sampler.chains import Settings
from bayesdist.products.common.cards import convergence_cards

from ..support import simulated, target_of

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def problem():
    model, matches, _ = simulated(41, 4000, order=2, fraction=0.03, jitter=0.02)
    return fit_linear(matches, model), matches


@pytest.fixture(scope="module")
def runs(problem):
    fit, matches = problem
    made = {
        "exact": sample(fit, matches, seed=3, target_ess=3000),
        "delayed": sample(
            fit, matches, seed=4, target_ess=3000, method="certified", second_stage="always"
        ),
        "approximate": sample(
            fit, matches, seed=5, target_ess=3000, method="certified", second_stage="never"
        ),
    }
    assert all(p.convergence.converged for p in made.values())
    return made


@pytest.mark.parametrize("kind", ["delayed", "approximate"])
def test_moments_are_those_of_the_exact_chains(runs, kind):
    a, b = runs["exact"], runs[kind]
    mcse = np.hypot(a.convergence.mcse_mean, b.convergence.mcse_mean)[: len(a.mean)]
    bound = 0.0 if kind == "delayed" else b.certificate.mean_shift_bound * a.sigma
    limit = stats.norm.isf(1e-3 / len(a.mean) / 2)
    assert (np.abs(a.mean - b.mean) < limit * mcse + bound).all()
    mcse = np.hypot(a.convergence.mcse_sd, b.convergence.mcse_sd)[: len(a.mean)]
    assert (np.abs(a.sigma - b.sigma) < limit * mcse + bound).all()
    for name in a.hyper:
        x, y = np.log(a.hyper[name]).ravel(), np.log(b.hyper[name]).ravel()
        # draws are nearly independent
        assert stats.ks_2samp(x[::2], y[::2]).pvalue > 1e-4


def test_only_approximate_draws_are_labelled(runs):
    assert runs["exact"].certificate is None and runs["exact"].approximation == ""
    assert runs["delayed"].certificate.granted and runs["delayed"].approximation == ""
    assert "delayed acceptance" in runs["delayed"].sampler.method
    label = runs["approximate"].approximation
    assert "approximate, with certificate" in label
    assert "approximate" in runs["approximate"].sampler.method
    cards = " ".join(c[8:].strip() for c in convergence_cards(runs["approximate"]))
    assert "approximate, with certificate" in cards
    assert "approximate" not in " ".join(convergence_cards(runs["delayed"]))


def test_approximate_draws_cost_the_pilots_only(runs):
    assert runs["approximate"].sampler.passes <= 400
    assert runs["approximate"].convergence.ess_bulk_min > 10 * 400


def test_the_certificate_survives_a_file(runs, problem, tmp_path):
    for kind in ("exact", "approximate"):
        save_posterior(runs[kind], problem[1], tmp_path / "posterior.nc")
        again = load_posterior(tmp_path)
        assert again.certificate == runs[kind].certificate
        assert again.approximation == runs[kind].approximation
        assert again.sampler == runs[kind].sampler


def test_the_second_stage_is_left_out_where_it_is_not_affordable(problem, monkeypatch):
    fit, matches = problem
    target, _ = target_of(fit.model, matches, OutlierMixture())
    proposal = build_proposal(target, fit)
    for n_stars, expected in ((4000, True), (int(AFFORDABLE), False)):
        settings = Settings(seeds=(1, 2, 3, 4), n_stars=n_stars)
        *_, exact = run_certified(target, proposal, settings)
        assert exact is expected


def test_a_certificate_that_is_refused_is_not_converged():
    """Weakly identified outliers: the Laplace proposal is far from the posterior."""
    model, matches, _ = simulated(42, 150, order=2, fraction=0.0)
    fit = fit_linear(matches, model)
    rough = sample(fit, matches, method="certified", second_stage="never")
    assert not rough.certificate.granted and not rough.convergence.converged
    assert any("certificate refused" in r for r in rough.convergence.reasons)
    assert json.dumps(rough.convergence.reasons)


def test_log_density_of_approximate_draws_is_the_exact_one_but_for_the_remainder(problem):
    fit, matches = problem
    target, _ = target_of(fit.model, matches, OutlierMixture())
    proposal = build_proposal(target, fit)
    settings = Settings(seeds=(1, 2), n_stars=4000)
    chains, certificate, _ = run_certified(target, proposal, settings, "never")
    psi = chains.psi.reshape(-1, chains.psi.shape[-1])
    remainder = target.log_density(psi) - chains.log_prob.ravel()
    remainder -= np.median(remainder)
    # fresh draws, not the pilots that the certificate was made from: far in the tails they reach
    # beyond what 200 pilots can show, but not by much, and seldom
    assert np.quantile(np.abs(remainder), 0.98) < 2 * certificate.remainder_max
    core = 1.4826 * np.median(np.abs(remainder))
    assert 0.1 * certificate.remainder_sd < core < 1.5 * certificate.remainder_sd
    assert target.log_density(psi).std() > 50 * remainder.std()


def test_unknown_choices_are_refused(problem):
    fit, matches = problem
    with pytest.raises(InputError, match=r"sampler\.method.*exact or certified"):
        sample(fit, matches, method="magic")
    with pytest.raises(InputError, match=r"sampler\.second_stage.*auto, always, never"):
        sample(fit, matches, method="certified", second_stage="sometimes")
