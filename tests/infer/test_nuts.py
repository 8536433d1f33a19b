"""The posterior against a density written down anew, and draws of that by NumPyro's NUTS."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.legendre import legvander2d

from bayesdist.data import match_table, read_matches
from bayesdist.formats.hst1pass import read_matchup
from bayesdist.infer import OutlierMixture, build_model, fit_by_magnitude, fit_linear, sample
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import simulate_matches
from tests.infer.by_nuts import needs_numpyro, nuts_draws, spread_draws, stein_pulls
from tests.reduced import case_in_full

pytestmark = [pytest.mark.slow, needs_numpyro]


def _density(matches, fit):
    """Density of z, log j, logit f and log s; theta is the fit's mean + L z.

    Of the logarithm of j, and draws are compared by j itself: where that may be zero its
    logarithm has a tail which nobody's draws settle.
    """
    import jax
    import jax.numpy as jnp
    import numpyro
    import numpyro.distributions as dist

    jax.config.update("jax_enable_x64", True)
    model = fit.model
    nx, ny = model.chips[0].size
    X, Y = 2 * (matches.x - 0.5) / nx - 1, 2 * (matches.y - 0.5) / ny - 1
    V = legvander2d(X, Y, [model.order] * 2).reshape(len(X), model.order + 1, model.order + 1)
    phi = jnp.array(np.stack([V[:, i, j] for i, j in model.basis().terms], axis=1))
    u, v = jnp.array(matches.u), jnp.array(matches.v)
    s2u, s2v = jnp.array(matches.sigma_u**2), jnp.array(matches.sigma_v**2)
    scale = _scale(matches)
    root = jnp.array(np.linalg.cholesky(fit.cov))
    K = model.n_terms

    def normal(r, s2):
        return -0.5 * (r**2 / s2 + jnp.log(2 * jnp.pi * s2))

    def density():
        flat = dist.ImproperUniform(dist.constraints.real, (), (2 * K,))
        theta = fit.mean + root @ numpyro.sample("z", flat)
        log_j = numpyro.sample("log_j", dist.ImproperUniform(dist.constraints.real, (), ()))
        logit_f = numpyro.sample("logit_f", dist.ImproperUniform(dist.constraints.real, (), ()))
        log_s = numpyro.sample("log_s", dist.ImproperUniform(dist.constraints.real, (), ()))
        j, f = jnp.exp(log_j), jax.nn.sigmoid(logit_f)
        # the documented priors, with the Jacobians of the three transformations
        prior = dist.StudentT(4.0, 0.0, scale).log_prob(j) + log_j
        prior += dist.Beta(1.0, 9.0).log_prob(f) + jnp.log(f) + jnp.log1p(-f)
        # outliers scatter more widely than the core, by an excess with a prior
        core2, excess2 = scale**2 + j**2, jnp.exp(2 * log_s)
        prior += dist.InverseGamma(1.0, 25 * core2).log_prob(excess2) + jnp.log(2 * excess2)
        s2 = core2 + excess2
        numpyro.deterministic("log_s_out", 0.5 * jnp.log(s2))
        ru, rv = u - phi @ theta[:K], v - phi @ theta[K:]
        good = jnp.log1p(-f) + normal(ru, s2u + j**2) + normal(rv, s2v + j**2)
        bad = jnp.log(f) + normal(ru, s2) + normal(rv, s2)
        numpyro.factor("posterior", prior + jnp.logaddexp(good, bad).sum())
        numpyro.deterministic("theta", theta)

    return density


def _scale(matches) -> float:
    return float(np.median(np.concatenate([matches.sigma_u, matches.sigma_v])))


def _ours(posterior):
    h = {k: v.ravel() for k, v in posterior.hyper.items()}
    logit = np.log(h["f"]) - np.log1p(-h["f"])
    return np.column_stack([posterior.flat, h["j"], logit, np.log(h["s_out"])])


def _simulated(jitter: float, n: int):
    rng = np.random.default_rng(12)
    model = DistortionModel(3, (Chip(1, "chip", (1016.0, 1016.0), (508.5, 508.5)),))
    theta = rng.normal(size=model.n_params)
    sigma = 0.05 * np.exp(0.3 * rng.normal(size=(n, 2)))
    matches, _ = simulate_matches(
        model, theta, n, rng=rng, sigma=(sigma[:, 0], sigma[:, 1]), fraction=0.03, jitter=jitter
    )
    return matches, fit_linear(matches, model)


def _hst1pass(data_dir):
    folder = data_dir / "hst1pass_uvis"
    stars = read_matches(folder / "ie8j01xlq_flt.uvwXYMpq", sigma="by_magnitude")
    stars = match_table(stars, read_matchup(folder / "MATCHUP_XYMEEE_final"))
    model = build_model(stars, order=3, size=(1024.0, 1024.0))
    fit, table, _ = fit_by_magnitude(stars, model)
    return table, fit


def test_draws_of_another_density_are_seen(rng):
    """Means off by a tenth of a standard deviation, or widths by a tenth."""
    import numpyro

    def density():
        numpyro.sample("x", numpyro.distributions.Normal(np.zeros(3), 1.0).to_event(1))

    draws = rng.standard_normal((3000, 3))
    right, off, wide = (
        np.abs(stein_pulls(density, {"x": x})).max() for x in (draws, draws + 0.1, 1.1 * draws)
    )
    assert right < 4 < min(off, wide)


CASES = [
    "simulated",
    *(
        case_in_full(case, instead="simulated stars are run")
        for case in ("errors exact (j = 0)", "real hst1pass exposure")
    ),
]


def _case(name: str, n: int, request):
    """Matches and their fit."""
    if name.startswith("real"):
        return _hst1pass(request.getfixturevalue("data_dir"))
    return _simulated(0.02 if name == "simulated" else 0.0, n)


@pytest.mark.parametrize("case", CASES)
def test_draws_are_of_the_density(case, request):
    matches, fit = _case(case, 600, request)
    posterior = sample(fit, matches, outliers=OutlierMixture(), target_ess=4000, seed=5)
    assert posterior.convergence.converged
    some, h = spread_draws(posterior, 3000)
    draws = {
        "z": np.linalg.solve(np.linalg.cholesky(fit.cov), (some - fit.mean).T).T,
        "log_j": np.log(h["j"]),
        "logit_f": np.log(h["f"]) - np.log1p(-h["f"]),
        "log_s": 0.5 * np.log(h["s_out"] ** 2 - h["j"] ** 2 - _scale(matches) ** 2),
    }
    assert np.abs(stein_pulls(_density(matches, fit), draws)).max() < 4.5


@pytest.mark.parametrize("case", CASES)
def test_agrees_with_nuts(case, full, request, capsys):
    if not full:
        pytest.skip("NUTS takes minutes: set BAYESDIST_FULL=1")
    matches, fit = _case(case, 2000, request)
    # Standard deviations within 3 % ask for some 10^4 effective draws on either side.
    posterior = sample(fit, matches, outliers=OutlierMixture(), target_ess=30_000, seed=5)
    assert posterior.convergence.converged
    ours = _ours(posterior)
    start = {
        "z": np.zeros(fit.model.n_params),
        "log_j": np.log(0.3 * _scale(matches)),
        "logit_f": -3.0,
        "log_s": np.log(10 * _scale(matches)),
    }
    got = nuts_draws(_density(matches, fit), start, 12_000, seed=3)
    nuts = np.column_stack([got["theta"], np.exp(got["log_j"]), got["logit_f"], got["log_s_out"]])
    sd = nuts.std(axis=0)
    shift = np.abs(ours.mean(axis=0) - nuts.mean(axis=0)) / sd
    ratio = ours.std(axis=0) / sd
    with capsys.disabled():
        print(
            f"\n{case}: {len(matches)} stars, {len(sd)} parameters; means differ by at most "
            f"{shift.max():.3f} sd, sd ratio {ratio.min():.4f} to {ratio.max():.4f}"
        )
    assert shift.max() < 0.1
    assert np.abs(ratio - 1).max() < 0.03
