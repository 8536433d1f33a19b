"""The posterior with the stars integrated out, against NUTS with every star a parameter."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.legendre import legder, legval, legvander

from bayesdist.infer.equations.priors import Prior
from bayesdist.kinds.selfcal.infer import sample_selfcal
from bayesdist.kinds.selfcal.infer.mode import solve
from tests.infer.by_nuts import needs_numpyro, nuts_draws, spread_draws, stein_pulls
from tests.kinds.selfcal.infer.fields import SIZE, field, problem_of
from tests.reduced import only_in_full

pytestmark = [pytest.mark.slow, needs_numpyro]


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


def _seen(simulated, rows):
    """Where detections lie on the sky, and its slopes by the pixel, (N, 2) each, as of JAX."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    model, d = simulated.model, simulated.detections
    K, E = model.n_terms, len(model.exposures)
    phi, phi_x, phi_y = map(jnp.asarray, _basis(d.x[rows], d.y[rows], model.basis().terms))
    exposure, o = jnp.asarray(d.exposure[rows]), jnp.asarray(model.origin)

    def seen(theta):
        C = theta[: 2 * K].reshape(2, K)
        frames = jnp.concatenate([jnp.zeros((1, 3)), theta[2 * K :].reshape(E - 1, 3)])[exposure]
        c, s = jnp.cos(frames[:, 2]), jnp.sin(frames[:, 2])

        def turned(a):
            return jnp.stack([c * a[:, 0] - s * a[:, 1], s * a[:, 0] + c * a[:, 1]], axis=1)

        place = turned(phi @ C.T - o) + o + frames[:, :2]
        return place, turned(phi_x @ C.T), turned(phi_y @ C.T)

    return seen


WIDTH = 0.01  # px: unit of the stars' places


def _density(simulated, problem, solution):
    """Free parameters, log j and logit f; the stars are parameters too."""
    import jax
    import jax.numpy as jnp
    import numpyro
    import numpyro.distributions as dist

    seen, sigma = _seen(simulated, problem.rows), simulated.detections.sigma[problem.rows]
    star, var = jnp.asarray(problem.star), jnp.asarray(sigma**2)
    scale, free = float(np.median(sigma)), solution.free
    root = jnp.asarray(np.linalg.cholesky(np.linalg.inv(solution.precision)))
    area = np.pi * problem.match_radius**2
    base = jnp.asarray(_base(problem, solution))

    def density():
        real = dist.constraints.real
        z = numpyro.sample("z", dist.ImproperUniform(real, (), (len(free),)))
        theta = jnp.asarray(solution.theta).at[free].add(root @ z)
        w = numpyro.sample("w", dist.ImproperUniform(real, (), base.shape))
        log_j = numpyro.sample("log_j", dist.ImproperUniform(real, (), ()))
        logit_f = numpyro.sample("logit_f", dist.ImproperUniform(real, (), ()))
        j, f = jnp.exp(log_j), jax.nn.sigmoid(logit_f)
        prior = dist.StudentT(4.0, 0.0, scale).log_prob(j) + log_j
        prior += dist.Beta(1.0, 9.0).log_prob(f) + jnp.log(f) + jnp.log1p(-f)
        place, by_x, by_y = seen(theta)
        # stars move with the detections' mean, which NUTS would otherwise have to follow
        mean = jnp.zeros(base.shape).at[star].add(place) / jnp.asarray(problem.counts)[:, None]
        r = place - (mean + base + WIDTH * w)[star]
        det = by_x[:, 0] * by_y[:, 1] - by_y[:, 0] * by_x[:, 1]
        dx = (by_y[:, 1] * r[:, 0] - by_y[:, 0] * r[:, 1]) / det
        dy = (by_x[:, 0] * r[:, 1] - by_x[:, 1] * r[:, 0]) / det
        s2 = var + j**2
        good = jnp.log1p(-f) - jnp.log(2 * jnp.pi * s2) - 0.5 * (dx**2 + dy**2) / s2
        bad = jnp.log(f) - jnp.log(area)
        numpyro.factor("posterior", prior + jnp.logaddexp(good, bad).sum())
        numpyro.deterministic("theta", theta[free])

    return density


def _base(problem, solution):
    """Places (S, 2) of the stars at the mode, from the means of their detections."""
    return solution.stars - problem.middles(solution.theta)


def _nuts(simulated, problem, solution, draws, seed):
    """Draws of NUTS: free parameters, j and logit f."""
    start = {
        "z": np.zeros(len(solution.free)),
        "w": np.zeros(solution.stars.shape),
        "log_j": np.log(0.3 * np.median(simulated.detections.sigma[problem.rows])),
        "logit_f": -3.0,
    }
    density = _density(simulated, problem, solution)
    got = nuts_draws(density, start, draws, seed, warmup=400)
    return np.column_stack([got["theta"], np.exp(got["log_j"]), got["logit_f"]])


def _stars_given(seen, var, f, area, starts, rng):
    """Places (n, S, 2) of stars given all else: a sum over which of its detections are true.

    Of detections at `seen` (n, N, 2), with slopes by x and y, and variances (n, N); those of star s
    are from starts[s] to starts[s + 1].  One of a star's detections at least is true.
    """
    place, by_x, by_y = seen
    to_pixels = np.linalg.inv(np.stack([by_x, by_y], axis=-1))
    A = np.swapaxes(to_pixels, -1, -2) @ to_pixels / var[..., None, None]
    b = (A @ place[..., None])[..., 0]
    square = (place * b).sum(axis=-1)
    odds = np.log((1 - f) / f * area)[:, None] - np.log(2 * np.pi * var)
    out = np.empty((len(f), len(starts) - 1, 2))
    for s, own in enumerate(map(slice, starts[:-1], starts[1:])):
        n = own.stop - own.start
        true = np.array([[k >> i & 1 for i in range(n)] for k in range(1, 2**n)], float)
        P = np.einsum("ki,dimn->kdmn", true, A[:, own])
        mean = np.linalg.solve(P, np.einsum("ki,dim->kdm", true, b[:, own])[..., None])[..., 0]
        left = np.einsum("ki,di->kd", true, (odds - 0.5 * square)[:, own])
        log_weight = (
            left
            - 0.5 * np.log(np.linalg.det(P))
            + 0.5 * np.einsum("kdm,kdmn,kdn->kd", mean, P, mean)
        )
        # the largest with Gumbel noise is drawn with its probability
        chosen = np.argmax(log_weight + rng.gumbel(size=log_weight.shape), axis=0)
        each = chosen, np.arange(len(f))
        root = np.linalg.cholesky(np.linalg.inv(P[each]))
        out[:, s] = mean[each] + (root @ rng.standard_normal((len(f), 2, 1)))[..., 0]
    return out


def _solved():
    """A field, its solution, and its free parameters."""
    simulated = field(6, 5, 70, order=2, disturbed=0.04)
    problem, _ = problem_of(simulated, min_detections=3)
    K = simulated.model.n_terms
    free = np.setdiff1d(np.arange(simulated.model.n_params), [0, 1, K, K + 1])
    return simulated, solve(problem, simulated.theta, free, Prior.none(simulated.theta)), free


@only_in_full("tests/infer/test_nuts has matched stars, and pulls are run")
def test_draws_are_of_the_density():
    """Stars are drawn where their detections say, given each draw of all else."""
    import jax

    simulated, solution, free = _solved()
    posterior = sample_selfcal(solution, target_ess=4000, seed=4)
    assert posterior.convergence.converged
    problem = solution.problem
    some, h = spread_draws(posterior, 3000)
    f, var = h["f"], simulated.detections.sigma[problem.rows] ** 2 + h["j"][:, None] ** 2
    seen = [np.asarray(one) for one in jax.vmap(_seen(simulated, problem.rows))(some)]
    area = np.pi * problem.match_radius**2
    stars = _stars_given(seen, var, f, area, problem.starts, np.random.default_rng(7))
    sums = np.add.reduceat(seen[0], problem.starts[:-1], axis=1)
    means = sums / problem.counts[:, None]
    root = np.linalg.cholesky(np.linalg.inv(solution.precision))
    draws = {
        "z": np.linalg.solve(root, (some[:, free] - solution.theta[free]).T).T,
        "log_j": np.log(h["j"]),
        "logit_f": np.log(f) - np.log1p(-f),
    }
    beside = {"w": (stars - means - _base(problem, solution)) / WIDTH}
    pulls = stein_pulls(_density(simulated, problem, solution), draws, beside=beside)
    assert np.abs(pulls).max() < 4.5
    # places half as far from where they belong would not be
    beside["w"] = 0.5 * beside["w"]
    wrong = stein_pulls(_density(simulated, problem, solution), draws, beside=beside)
    assert np.abs(wrong).max() > 10


@only_in_full("test_draws_are_of_the_density asks for no other sampler")
def test_agrees_with_nuts(capsys):
    simulated, solution, free = _solved()
    posterior = sample_selfcal(solution, target_ess=20_000, seed=4)
    assert posterior.convergence.converged
    h = {k: v.ravel() for k, v in posterior.hyper.items()}
    logit = np.log(h["f"]) - np.log1p(-h["f"])
    ours = np.column_stack([posterior.flat[:, free], h["j"], logit])
    problem = solution.problem
    nuts = _nuts(simulated, problem, solution, 6000, seed=2)
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
