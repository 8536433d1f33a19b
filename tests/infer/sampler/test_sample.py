"""Whole runs: against quadrature, against the truth, and again from their checkpoints."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from scipy import stats

from bayesdist.errors import InputError
from bayesdist.infer import (
    GaussianPriors,
    OutlierMixture,
    fit_linear,
    memberships,
    sample,
)
from bayesdist.model import TimeDependence
from tests.reduced import case_in_full

from ..oracle import JitterOracle
from ..support import UNCLIPPED, simulated, table

pytestmark = pytest.mark.usefixtures("one_thread")

# -- against quadrature ---------------------------------------------------------------------------


def thinned(posterior, name: str, every: int) -> np.ndarray:
    """Draws of a hyperparameter far enough apart to count as independent."""
    W = posterior.sampler.walkers
    values = posterior.hyper[name]
    by_walker = values.reshape(values.shape[0], W, -1)
    return by_walker[:, :, ::every].ravel()


def test_jitter_at_its_bound_is_sampled_as_the_closed_form_says():
    model, matches, _ = simulated(71, 60, order=1)
    fit = fit_linear(matches, model, **UNCLIPPED)
    posterior = sample(fit, matches, outliers=OutlierMixture("none"), seed=1, target_ess=2000)
    assert posterior.convergence.converged
    oracle = JitterOracle.of(1, matches)
    log_j = np.log(thinned(posterior, "j", 4))
    assert len(log_j) > 500
    assert stats.kstest(log_j, oracle.cdf).pvalue > 1e-3
    # theta: a scale mixture of Gaussians
    formal = oracle.expect(oracle.variance) * np.diag(oracle.unit_cov)
    c = posterior.convergence
    assert (np.abs(posterior.sigma - np.sqrt(formal)) < 4.5 * c.mcse_sd[:6]).all()
    assert (np.abs(posterior.mean - oracle.centre) < 4.5 * c.mcse_mean[:6]).all()


def test_fraction_and_scale_of_outliers_against_a_grid():
    """theta pinned by priors: two dimensions are left, and are summed over directly."""
    model, matches, truth = simulated(72, 300, order=1, fraction=0.08, outlier_scale=0.5)
    pinned = dict(zip(model.names, ((value, 1e-6) for value in truth.theta), strict=True))
    priors = GaussianPriors.of(model, pinned)
    fit = fit_linear(matches, model, priors=priors)
    posterior = sample(fit, matches, outliers=OutlierMixture(jitter=0.0), priors=priors, seed=2)
    assert posterior.convergence.converged

    residual = np.column_stack([matches.u, matches.v]) - model.predict(
        truth.theta, matches.x, matches.y
    )
    f, s = np.linspace(1e-4, 0.3, 401), np.exp(np.linspace(-3.0, 2.0, 301))
    good = stats.norm(scale=0.05).logpdf(residual).sum(axis=1)
    log_density = np.empty((len(f), len(s)))
    for k, scale in enumerate(s):
        # the excess over the core, whose own scale is the quoted error
        bad = stats.norm(scale=np.hypot(0.05, scale)).logpdf(residual).sum(axis=1)
        loglik = np.logaddexp(np.log1p(-f)[:, None] + good, np.log(f)[:, None] + bad).sum(axis=1)
        prior = stats.invgamma(1, scale=0.25**2).logpdf(scale**2) + np.log(2 * scale**2)
        log_density[:, k] = loglik + prior  # per d log s
    log_density += stats.beta(1, 9).logpdf(f)[:, None]
    weight = np.exp(log_density - log_density.max())
    for name, axis, grid in (("f", 1, f), ("s_out", 0, np.log(s))):
        marginal = weight.sum(axis=axis)
        cdf = np.cumsum((marginal[1:] + marginal[:-1]) / 2)
        cdf = np.concatenate([[0], cdf]) / cdf[-1]
        draws = thinned(posterior, name, 4)
        draws = 0.5 * np.log(draws**2 - 0.05**2) if name == "s_out" else draws
        assert stats.kstest(draws, lambda x, g=grid, c=cdf: np.interp(x, g, c)).pvalue > 1e-3, name


# -- against the truth ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def campaign():
    """Three exposures, drift, false matches, errors that are quoted too small."""
    model, matches, truth = simulated(
        73,
        2400,
        order=3,
        frames="shift_rotation",
        n_exposures=4,
        time=TimeDependence((("u", 1, 0),), (2005.0,)),
        epochs=[2003.0, 2005.0, 2007.0, 2009.0],
        fraction=0.05,
        jitter=0.05,
    )
    return fit_linear(matches, model), matches, truth


@pytest.fixture(scope="module")
def posterior(campaign):
    fit, matches, _ = campaign
    return sample(fit, matches, seed=3)


def test_the_truth_lies_within_the_posterior(campaign, posterior):
    _, _, truth = campaign
    assert posterior.convergence.converged, posterior.convergence.reasons
    d = posterior.mean - truth.theta
    p = stats.chi2(len(d)).sf(d @ np.linalg.solve(posterior.cov, d))
    assert 1e-3 < p < 1 - 1e-3
    for name, true in (("f", truth.false.mean()), ("j", 0.05), ("s_out", 1.0)):
        draws = posterior.hyper[name]
        assert abs(draws.mean() - true) < 4 * draws.std()


def test_false_matches_are_found(campaign, posterior):
    _, matches, truth = campaign
    p = memberships(posterior, matches).outlier_probability
    assert p.shape == (len(matches),) and (p >= 0).all() and (p <= 1).all()
    # calibrated: the expected number of false matches is theirs within its own scatter
    assert abs(p.sum() - truth.false.sum()) < 4 * np.sqrt((p * (1 - p)).sum())
    assert truth.false[p > 0.99].mean() > 0.97
    assert truth.false[p < 0.01].mean() < 0.01


def test_moments_and_draws_are_those_of_the_chains(posterior):
    chains = posterior.theta
    assert chains.shape[0] == posterior.sampler.ensembles == 4
    flat = chains.reshape(-1, chains.shape[-1])
    np.testing.assert_allclose(posterior.mean, flat.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(posterior.cov, np.cov(flat.T), rtol=1e-10)
    draws = posterior.draws(500, np.random.default_rng(0))
    rows = {row.tobytes() for row in flat}
    taken = [row.tobytes() for row in draws]
    assert set(taken) <= rows
    more = posterior.draws(len(flat) + 5, np.random.default_rng(0))
    assert more.shape == (len(flat) + 5, flat.shape[1])
    low, high = posterior.interval(0.683).T
    inside = ((flat > low) & (flat < high)).mean(axis=0)
    np.testing.assert_allclose(inside, 0.683, atol=0.002)


def test_the_seed_decides_everything(campaign, posterior):
    fit, matches, _ = campaign
    again = sample(fit, matches, seed=3)
    np.testing.assert_array_equal(again.theta, posterior.theta)
    np.testing.assert_array_equal(again.hyper["j"], posterior.hyper["j"])
    assert (again.n_flagged, again.n_false) == (posterior.n_flagged, posterior.n_false)
    other = sample(fit, matches, seed=4)
    assert not np.array_equal(other.theta[:, :50], posterior.theta[:, :50])


def test_inputs_are_not_changed(campaign):
    fit, matches, _ = campaign
    assert fit.mean.flags.owndata
    before = [fit.mean.copy(), fit.cov.copy(), matches.u.copy(), matches.sigma_u.copy()]
    sample(fit, matches, seed=3, max_steps=60)
    for a, b in zip(before, (fit.mean, fit.cov, matches.u, matches.sigma_u), strict=True):
        np.testing.assert_array_equal(a, b)


def test_too_short_a_run_says_so(campaign):
    fit, matches, _ = campaign
    short = sample(fit, matches, seed=3, max_steps=30, target_ess=40_000)
    assert short.sampler.steps == 30
    assert not short.convergence.converged and short.convergence.reasons


@pytest.mark.parametrize("walkers", [None, 8])
def test_counts_of_passes(campaign, monkeypatch, walkers):
    """Evaluations of the likelihood of all stars, as the report states them, but for the mode."""
    from bayesdist.infer.density.target import Target
    from bayesdist.infer.sampler import sample as sampling

    fit, matches, _ = campaign
    count, real, build = [0], Target.log_density, sampling.build_proposal

    def counting(self, psi):
        count[0] += len(psi)
        return real(self, psi)

    def building(*arguments, **options):
        out = build(*arguments, **options)
        count[0] = 0
        return out

    monkeypatch.setattr(Target, "log_density", counting)
    monkeypatch.setattr(sampling, "build_proposal", building)
    result = sample(fit, matches, seed=3, walkers=walkers)
    assert result.convergence.converged
    assert result.sampler.passes == count[0] > 500


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"ensembles": 1}, "cannot show convergence"),
        ({"max_steps": 0}, "max_steps is 0; give a whole number of 1 or more"),
        ({"checkpoint_every": 0}, "checkpoint_every is 0; give a whole number"),
    ],
    ids=str,
)
def test_errors(campaign, options, says):
    fit, matches, _ = campaign
    with pytest.raises(InputError, match=says):
        sample(fit, matches, **options)


# -- checkpoints ----------------------------------------------------------------------------------

LONG = {"target_ess": 1e9, "seed": 5, "walkers": 8}  # runs to its last step


@pytest.fixture(scope="module")
def small():
    model, matches, _ = simulated(
        74,
        200,
        frames="shift",
        n_exposures=2,
        time=TimeDependence((("u", 1, 0),), (2005.0,)),
        epochs=[2003.0, 2008.0],
        fraction=0.05,
    )
    return fit_linear(matches, model), matches


@pytest.fixture(scope="module")
def whole(small):
    """220 steps in one go, in memory; blocks end at 15, 19, 24, 30, ... and 220."""
    return sample(*small, max_steps=220, checkpoint_every=60, **LONG)


@pytest.fixture(scope="module")
def kept(small, tmp_path_factory):
    """The same run with its checkpoints."""
    folder = tmp_path_factory.mktemp("chains")
    sample(*small, max_steps=220, checkpoint_every=60, folder=folder, **LONG)
    return folder


@pytest.fixture
def folder(kept, tmp_path):
    return shutil.copytree(kept, tmp_path / "chains")


def assert_same(a, b):
    np.testing.assert_array_equal(a.theta, b.theta)
    np.testing.assert_array_equal(a.log_prob, b.log_prob)
    for name in a.hyper:
        np.testing.assert_array_equal(a.hyper[name], b.hyper[name])
    assert (a.n_flagged, a.n_false) == (b.n_flagged, b.n_false)
    np.testing.assert_array_equal(a.convergence.rhat, b.convergence.rhat)


def resumed(small, folder, **changes):
    options = {"max_steps": 220, "checkpoint_every": 60, "folder": folder} | LONG | changes
    return sample(*small, **options)


def test_a_finished_run_is_read_back(small, whole, folder):
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    assert_same(resumed(small, folder), whole)
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


@pytest.mark.parametrize(
    "lost",
    [
        *("first", "proposal", "half"),
        *(
            case_in_full(lost, instead="other blocks are lost")
            for lost in ("middle", "last", "pilot", "pilot and first", "one ensemble")
        ),
    ],
)
def test_lost_blocks_are_run_again_bit_for_bit(small, whole, folder, lost):
    blocks = sorted(folder.glob("chain-[1-9]-*.h5"))
    gone = {
        "first": blocks[:1],
        "middle": [b for b in blocks if b.name.startswith("chain-3")][1:2],
        "last": blocks[-1:],
        "proposal": [folder / "chain-0-proposal.h5"],
        "pilot": [folder / "chain-0-pilot.h5"],
        "pilot and first": [folder / "chain-0-pilot.h5", *blocks[:1]],
        "one ensemble": [b for b in blocks if b.name.startswith("chain-2")],
        # killed during the fourth round: two ensembles are ahead of the others
        "half": [b for b in blocks if int(b.stem[-6:]) > _ends(blocks)[3]]
        + [folder / f"chain-{e}-{_ends(blocks)[3]:06d}.h5" for e in (3, 4)],
    }[lost]
    assert gone
    for path in gone:
        path.unlink()
    assert_same(resumed(small, folder), whole)


def _ends(blocks):
    return sorted({int(b.stem[-6:]) for b in blocks})


def test_the_total_of_steps_counts_over_resumed_runs(small, whole, tmp_path):
    first = resumed(small, tmp_path, max_steps=100)
    assert first.sampler.steps == 100
    second = resumed(small, tmp_path, max_steps=220)
    assert second.sampler.steps == 220
    assert_same(second, whole)
    assert_same(resumed(small, tmp_path, max_steps=100), first)


@pytest.mark.parametrize(
    ("first", "then"), [(60, 200), case_in_full(200, 60, instead="it is made longer")]
)
def test_the_spacing_of_checkpoints_does_not_matter(small, tmp_path, first, then):
    """It may be changed between two runs: the chain is the same, or the resume is refused."""
    one = resumed(small, tmp_path, checkpoint_every=first, max_steps=300)
    try:
        two = resumed(small, tmp_path, checkpoint_every=then, max_steps=300)
    except InputError as error:
        assert "checkpoint" in str(error)
    else:
        assert_same(two, one)


def changed(matches, **columns):
    names = ("x", "y", "u", "v", "epoch", "exposure", "chip", "mag")
    old = {n: getattr(matches, n) for n in names} | {"sigma": matches.sigma_u}
    new = old | columns
    return table(**new, exposure_names=matches.exposure_names, chip_numbers=matches.chip_numbers)


CHANGES = {
    "a position": lambda m: changed(m, u=np.where(np.arange(200) == 7, m.u + 1e-6, m.u)),
    "an error": lambda m: changed(m, sigma=np.where(np.arange(200) == 7, 0.051, m.sigma_u)),
    "a pixel": lambda m: changed(m, x=np.where(np.arange(200) == 7, m.x + 1e-6, m.x)),
    "a row dropped": lambda m: m.select(np.arange(199)),
    "the epochs": lambda m: changed(m, epoch=m.epoch + np.where(m.exposure == 1, 2.0, 0.0)),
    "the exposure of a star": lambda m: changed(
        m,
        exposure=np.where(np.arange(200) == 100, 0, m.exposure),
        epoch=np.where(np.arange(200) == 100, 2003.0, m.epoch),
    ),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_checkpoints_of_other_data_are_refused(small, folder, change):
    fit, matches = small
    with pytest.raises(InputError, match="other data or settings"):
        resumed((fit, change(matches)), folder)


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 6},
        {"walkers": 20},
        {"ensembles": 3},
        {"outliers": OutlierMixture("uniform", match_radius=2.0)},
        {"outliers": OutlierMixture(fraction_prior=(1.0, 5.0))},
        {"outliers": OutlierMixture(jitter=0.0)},
    ],
    ids=str,
)
def test_checkpoints_of_other_settings_are_refused(small, folder, changes):
    with pytest.raises(InputError, match="other data or settings"):
        resumed(small, folder, **changes)


def test_checkpoints_of_other_priors_are_refused(small, folder):
    priors = GaussianPriors.of(small[0].model, {"u_1_1": (0.0, 10.0)})
    with pytest.raises(InputError, match="other data or settings"):
        resumed(small, folder, priors=priors)


@pytest.mark.parametrize("name", ["chain-2-000030.h5", "chain-0-proposal.h5", "chain-0-pilot.h5"])
@pytest.mark.parametrize(
    "damage",
    ["cut", *(case_in_full(damage, instead="files are cut") for damage in ("empty", "text"))],
)
def test_damaged_checkpoints_are_named(small, whole, folder, name, damage):
    path = folder / name
    data = path.read_bytes()
    path.write_bytes({"empty": b"", "cut": data[: len(data) // 2], "text": b"x" * 5000}[damage])
    with pytest.raises(InputError, match=rf"{name}: this is not a checkpoint .*damaged"):
        resumed(small, folder)
    path.unlink()  # as the message says
    assert_same(resumed(small, folder), whole)


def test_a_folder_that_cannot_be_written(small, tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        resumed(small, tmp_path / "missing")
