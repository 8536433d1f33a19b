"""The posterior with the stars integrated out, against NUTS with every star a parameter."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.legendre import legder, legval, legvander

from bayesdist.infer.equations.priors import Prior
from bayesdist.infer.selfcal import sample_selfcal
from bayesdist.infer.selfcal.mode import solve
from tests.infer.by_nuts import nuts_draws
from tests.infer.selfcal.fields import SIZE, field, problem_of

pytestmark = pytest.mark.slow
numpyro = pytest.importorskip("numpyro", reason="NumPyro (extra 'test') is not installed")


def _basis(x, y, terms):
    """Legendre products and their derivatives by the pixel, by numpy alone."""
    X, Y = (2 * x - SIZE[0] - 1) / SIZE[0], (2 * y - SIZE[1] - 1) / SIZE[1]
    top = max(i for i, _ in terms)
    PX, PY = legvander(X, top), legvander(Y, top)
    unit = np.eye(top + 1)
    DX, DY = (
        np.stack([legval(t, legder(unit[k])) for k in range(top + 1)], axis=1) for t in (X, Y)
    )
    i, j = np.array(terms).T
    return PX[:, i] * PY[:, j], DX[:, i] * PY[:, j] * 2 / SIZE[0], PX[:, i] * DY[:, j] * 2 / SIZE[1]


def _nuts(simulated, problem, solution, draws, seed):
    """Free parameters, log j and logit f; the stars are parameters too."""
    import jax
    import jax.numpy as jnp
    import numpyro.distributions as dist

    jax.config.update("jax_enable_x64", True)
    model, d = simulated.model, simulated.detections
    rows = problem.rows
    K, E = model.n_terms, len(model.exposures)
    phi, phi_x, phi_y = map(jnp.asarray, _basis(d.x[rows], d.y[rows], model.basis().terms))
    exposure, star = jnp.asarray(d.exposure[rows]), jnp.asarray(problem.star)
    var, scale = jnp.asarray(d.sigma[rows] ** 2), float(np.median(d.sigma[rows]))
    o = jnp.asarray(model.origin)
    free = solution.free
    root = jnp.asarray(np.linalg.cholesky(np.linalg.inv(solution.precision)))
    middle = jnp.asarray(solution.stars)
    area = np.pi * problem.match_radius**2
    width = 0.01

    def density():
        real = dist.constraints.real
        z = numpyro.sample("z", dist.ImproperUniform(real, (), (len(free),)))
        theta = jnp.asarray(solution.theta).at[free].add(root @ z)
        w = numpyro.sample("w", dist.ImproperUniform(real, (), middle.shape))
        log_j = numpyro.sample("log_j", dist.ImproperUniform(real, (), ()))
        logit_f = numpyro.sample("logit_f", dist.ImproperUniform(real, (), ()))
        j, f = jnp.exp(log_j), jax.nn.sigmoid(logit_f)
        prior = dist.StudentT(4.0, 0.0, scale).log_prob(j) + log_j
        prior += dist.Beta(1.0, 9.0).log_prob(f) + jnp.log(f) + jnp.log1p(-f)
        C = theta[: 2 * K].reshape(2, K)
        frames = jnp.concatenate([jnp.zeros((1, 3)), theta[2 * K :].reshape(E - 1, 3)])[exposure]
        c, s = jnp.cos(frames[:, 2]), jnp.sin(frames[:, 2])

        def turned(a):
            return jnp.stack([c * a[:, 0] - s * a[:, 1], s * a[:, 0] + c * a[:, 1]], axis=1)

        place = turned(phi @ C.T - o) + o + frames[:, :2]
        by_x, by_y = turned(phi_x @ C.T), turned(phi_y @ C.T)
        # stars move with the detections' mean, which NUTS would otherwise have to follow
        mean = jnp.zeros(middle.shape).at[star].add(place) / jnp.asarray(problem.counts)[:, None]
        r = place - (mean + base + width * w)[star]
        det = by_x[:, 0] * by_y[:, 1] - by_y[:, 0] * by_x[:, 1]
        dx = (by_y[:, 1] * r[:, 0] - by_y[:, 0] * r[:, 1]) / det
        dy = (by_x[:, 0] * r[:, 1] - by_x[:, 1] * r[:, 0]) / det
        s2 = var + j**2
        good = jnp.log1p(-f) - jnp.log(2 * jnp.pi * s2) - 0.5 * (dx**2 + dy**2) / s2
        bad = jnp.log(f) - jnp.log(area)
        numpyro.factor("posterior", prior + jnp.logaddexp(good, bad).sum())
        numpyro.deterministic("theta", theta[free])

    base = middle - jnp.asarray(problem.middles(solution.theta))
    start = {
        "z": np.zeros(len(free)),
        "w": np.zeros(middle.shape),
        "log_j": np.log(0.3 * scale),
        "logit_f": -3.0,
    }
    got = nuts_draws(density, start, draws, seed, warmup=400)
    return np.column_stack([got["theta"], np.exp(got["log_j"]), got["logit_f"]])


def test_agrees_with_nuts(full, capsys):
    simulated = field(6, 5, 70, order=2, disturbed=0.04)
    problem, _ = problem_of(simulated, min_detections=3)
    K = simulated.model.n_terms
    free = np.setdiff1d(np.arange(simulated.model.n_params), [0, 1, K, K + 1])
    solution = solve(problem, simulated.theta, free, Prior.none(simulated.theta))
    posterior = sample_selfcal(solution, target_ess=20_000 if full else 6000, seed=4)
    assert posterior.convergence.converged
    h = {k: v.ravel() for k, v in posterior.hyper.items()}
    logit = np.log(h["f"]) - np.log1p(-h["f"])
    ours = np.column_stack([posterior.flat[:, free], h["j"], logit])
    nuts = _nuts(simulated, solution.problem, solution, 6000 if full else 800, seed=2)
    sd = nuts.std(axis=0)
    shift = np.abs(ours.mean(axis=0) - nuts.mean(axis=0)) / sd
    ratio = ours.std(axis=0) / sd
    with capsys.disabled():
        print(
            f"\nself-calibration: {len(problem)} detections of {problem.n_stars} stars; means "
            f"differ by at most {shift.max():.3f} sd, sd "
            f"ratio {ratio.min():.4f} to {ratio.max():.4f}"
        )
    assert shift.max() < 0.1
    assert np.abs(ratio - 1).max() < 0.06
