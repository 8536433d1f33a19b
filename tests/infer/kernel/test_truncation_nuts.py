"""The posterior of stars matched in circles, against a density written down anew for NumPyro."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss, legvander2d

from bayesdist.infer import OutlierMixture, fit_linear, sample
from tests.infer.by_nuts import needs_numpyro, nuts_draws, spread_draws, stein_pulls
from tests.reduced import only_in_full

from ..selected import SIDE, selected

pytestmark = [pytest.mark.slow, needs_numpyro]

NODES = 24  # of the integral over one axis, within 1e-8 for circles of three sigma


def _density(matches, fit, start, radius: float):
    """Density of z, log j, logit f and log s, of Gaussian outliers; theta is start + L z."""
    import jax
    import jax.numpy as jnp
    import numpyro
    import numpyro.distributions as dist
    from jax.scipy.special import erf

    jax.config.update("jax_enable_x64", True)
    order, K = fit.model.order, fit.model.n_terms
    X, Y = 2 * (matches.x - 0.5) / SIDE - 1, 2 * (matches.y - 0.5) / SIDE - 1
    V = legvander2d(X, Y, [order] * 2).reshape(len(X), order + 1, order + 1)
    phi = jnp.array(np.stack([V[:, i, j] for i, j in fit.model.basis().terms], axis=1))
    data = jnp.array(np.stack([matches.u, matches.v]))
    nominal = jnp.array(np.stack([matches.u_nominal, matches.v_nominal]))
    s2 = jnp.array(matches.sigma_u**2)  # of both axes
    scale = float(matches.sigma_u[0])
    root = jnp.array(np.linalg.cholesky(fit.cov))
    t, w = leggauss(NODES)
    across, half = radius * np.sin(t * np.pi / 2), radius * np.cos(t * np.pi / 2)
    weight = jnp.array(half * w * np.pi / 2)
    across, half = jnp.array(across), jnp.array(half)

    def normal(r, s2):
        return -0.5 * (r**2 / s2 + jnp.log(2 * jnp.pi * s2)).sum(axis=0)

    def log_mass(d, s2):
        """Of a round Gaussian in the circle about d (2, N)."""
        s = jnp.sqrt(s2)[..., None]
        first = jnp.exp(-0.5 * ((d[0][:, None] + across) / s) ** 2) / (s * np.sqrt(2 * np.pi))
        ends = [(d[1][:, None] + sign * half) / (s * np.sqrt(2)) for sign in (1, -1)]
        return jnp.log((first * 0.5 * (erf(ends[0]) - erf(ends[1])) * weight).sum(axis=1))

    def density():
        flat = dist.ImproperUniform(dist.constraints.real, (), (2 * K,))
        one = dist.ImproperUniform(dist.constraints.real, (), ())
        theta = start + root @ numpyro.sample("z", flat)
        log_j, logit_f = numpyro.sample("log_j", one), numpyro.sample("logit_f", one)
        log_s = numpyro.sample("log_s", one)
        j, f, excess2 = jnp.exp(log_j), jax.nn.sigmoid(logit_f), jnp.exp(2 * log_s)
        prior = dist.StudentT(4.0, 0.0, scale).log_prob(j) + log_j
        prior += dist.Beta(1.0, 9.0).log_prob(f) + jnp.log(f) + jnp.log1p(-f)
        core2 = scale**2 + j**2
        prior += dist.InverseGamma(1.0, 25 * core2).log_prob(excess2) + jnp.log(2 * excess2)
        out2 = core2 + excess2
        numpyro.deterministic("log_s_out", 0.5 * jnp.log(out2))
        model = jnp.stack([phi @ theta[:K], phi @ theta[K:]])
        r, d = data - model, nominal - model
        good = jnp.log1p(-f) + normal(r, s2 + j**2) - log_mass(d, s2 + j**2)
        bad = jnp.log(f) + normal(r, out2) - log_mass(d, jnp.broadcast_to(out2, s2.shape))
        numpyro.factor("posterior", prior + jnp.logaddexp(good, bad).sum())
        numpyro.deterministic("theta", theta)

    return density


def _sampled(n: int, target_ess: int):
    """Matches in circles, the radius of these, the fit and its posterior."""
    _, _, matches, radius = selected(3, 3.0, n, order=1)
    fit = fit_linear(matches, selected(3, 3.0, 1, order=1)[0])
    mixture = OutlierMixture("gaussian", match_radius=radius)
    posterior = sample(fit, matches, outliers=mixture, target_ess=target_ess, seed=5)
    assert posterior.convergence.converged
    return matches, radius, fit, posterior


@only_in_full("test_truncation integrates the density, and covers")
def test_draws_are_of_the_density():
    matches, radius, fit, posterior = _sampled(300, 4000)
    some, h = spread_draws(posterior, 3000)
    scale2 = float(matches.sigma_u[0]) ** 2
    draws = {
        "z": np.linalg.solve(np.linalg.cholesky(fit.cov), (some - posterior.mean).T).T,
        "log_j": np.log(h["j"]),
        "logit_f": np.log(h["f"]) - np.log1p(-h["f"]),
        "log_s": 0.5 * np.log(h["s_out"] ** 2 - h["j"] ** 2 - scale2),
    }
    pulls = stein_pulls(_density(matches, fit, posterior.mean, radius), draws)
    assert np.abs(pulls).max() < 4.5
    # which is far from what least squares says
    pull = (fit.mean - some.mean(axis=0)) / some.std(axis=0)
    assert np.abs(pull).max() > 3


def test_agrees_with_nuts(full, capsys):
    if not full:
        pytest.skip("NUTS takes minutes: set BAYESDIST_FULL=1")
    matches, radius, fit, posterior = _sampled(1000, 20_000)
    h = {k: v.ravel() for k, v in posterior.hyper.items()}
    logit = np.log(h["f"]) - np.log1p(-h["f"])
    ours = np.column_stack([posterior.flat, h["j"], logit, np.log(h["s_out"])])
    scale = float(matches.sigma_u[0])
    first = {
        "z": np.zeros(fit.model.n_params),
        "log_j": np.log(0.3 * scale),
        "logit_f": -3.0,
        "log_s": np.log(5 * scale),
    }
    got = nuts_draws(_density(matches, fit, posterior.mean, radius), first, 8000, seed=3)
    nuts = np.column_stack([got["theta"], np.exp(got["log_j"]), got["logit_f"], got["log_s_out"]])
    sd = nuts.std(axis=0)
    shift = np.abs(ours.mean(axis=0) - nuts.mean(axis=0)) / sd
    ratio = ours.std(axis=0) / sd
    with capsys.disabled():
        print(
            f"\n{len(matches)} stars in circles, {len(sd)} parameters; means differ by at most "
            f"{shift.max():.3f} sd, sd ratio {ratio.min():.4f} to {ratio.max():.4f}"
        )
    assert shift.max() < 0.1
    assert np.abs(ratio - 1).max() < 0.05
