"""Marginalised posteriors against NumPyro's NUTS, with every coefficient explicit, or dense."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.polynomial.legendre import legvander2d
from scipy.stats import kurtosis
from scipy.stats import t as student_t

from bayesdist.diagnose.correlated import DiscrepancyPriors
from bayesdist.diagnose.correlated.deviations import DeviationColumns, deviation_draws
from bayesdist.diagnose.correlated.priors import STRUCTURE_DOF, StructureFunctions
from bayesdist.diagnose.correlated.structure import LENGTHS, structure_posterior
from tests.infer.by_nuts import needs_numpyro, nuts_draws
from tests.reduced import only_in_full

pytestmark = [pytest.mark.slow, needs_numpyro]

ORDER, SIGMA = 2, 0.02
POWERS = [(i, j) for i in range(ORDER + 1) for j in range(ORDER + 1 - i)]


def polynomials(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
    every = legvander2d(X, Y, [ORDER] * 2)
    return np.stack([every[:, i * (ORDER + 1) + j] for i, j in POWERS], axis=1)


def nuts(density: Callable[[], None], start: dict[str, object], seed: int):
    """Draws (4, n, ...) of what the density samples and names."""
    settings = {"warmup": 1000, "target_accept": 0.9, "by_chain": True}
    return nuts_draws(density, start, 10_000, seed, **settings)


def _effective(chains: np.ndarray) -> np.ndarray:
    import arviz

    return np.array([float(arviz.ess(chains[..., k])) for k in range(chains.shape[-1])])


def agree(ours: np.ndarray, got: dict[str, np.ndarray], name: str, what: str, capsys) -> None:
    """Means and standard deviations within four Monte-Carlo errors of the chains (4, n, ...).

    A mean hangs on the amplitudes, which mix ten times more slowly than what they are amplitudes
    of: the slowest of all that was sampled says how many draws of a mean are independent.
    """
    theirs = got[name].reshape(*got[name].shape[:2], -1)
    sizes = _effective(theirs)
    slowest = min(_effective(v.reshape(*v.shape[:2], -1)).min() for v in got.values())
    flat = theirs.reshape(-1, theirs.shape[-1])
    sd = flat.std(axis=0)
    shift = np.abs(ours.mean(axis=0) - flat.mean(axis=0)) / sd
    ratio = ours.std(axis=0) / sd
    with capsys.disabled():
        print(
            f"\n{what}: {sd.size} quantities, at least {slowest:.0f} independent draws; "
            f"means differ by at most {shift.max():.3f} sd, sd ratio {ratio.min():.4f} to "
            f"{ratio.max():.4f}"
        )
    assert slowest > 400
    assert (shift < 4 / np.sqrt(slowest)).all()
    # tails are heavier than a normal distribution's
    assert (np.abs(ratio - 1) < 4 * np.sqrt(kurtosis(flat, axis=0, fisher=False) / 4 / sizes)).all()


@only_in_full(
    "test_against_dense has what is conditional, test_coverage and tests/coverage the rest"
)
@pytest.mark.parametrize("found", [True, False], ids=["a field", "nothing"])
def test_structure(found, capsys):
    """Polynomial, higher orders and sines of both axes; three amplitudes; length and likeness."""
    import jax
    import jax.numpy as jnp
    import numpyro
    import numpyro.distributions as dist

    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng(8)
    n, amplitude = 250, 0.012 if found else 0.0
    functions = StructureFunctions(ORDER, (1024.0, 1024.0), 6)
    X, Y = rng.uniform(-1, 1, (2, n))
    P = polynomials(X, Y)
    B = functions.evaluate(X, Y)
    T, m = functions.n_terms, functions.n_known
    truth = amplitude * np.sqrt(functions.spectrum(0.35))[:, None] * rng.standard_normal((m - T, 2))
    data = B[:, T:] @ truth + SIGMA * rng.standard_normal((n, 2))

    # the fit's share eliminated, as the estimate from cells does it
    hat = P @ np.linalg.solve(P.T @ P, P.T)
    left = B - hat @ B
    S = [left.T @ left / SIGMA**2] * 2
    score = [left.T @ data[:, a] / SIGMA**2 for a in (0, 1)]
    medians = {"higher_order": 2e-3, "structure": 2e-3}
    posterior = structure_posterior([[functions]] * 2, S, score, noise=SIGMA, **medians)
    # their own error is not in the limits
    drawn = np.stack(posterior.draws(160_000, rng), axis=1)[..., :m]
    places = np.array([[-0.9, 0.9, 0.0, 0.5], [-0.9, -0.9, 0.1, 0.8]])
    at, low_at = functions.evaluate(*places), polynomials(*places)
    root = np.linalg.cholesky(np.linalg.inv(P.T @ P)) * SIGMA
    theirs_given = [
        np.linalg.lstsq(P, data[:, [a]] - B @ drawn[:, a].T, rcond=None)[0] for a in (0, 1)
    ]
    of_fit = [t.T + rng.standard_normal((len(drawn), len(POWERS))) @ root.T for t in theirs_given]
    parts = [drawn[:, a] @ at.T for a in (0, 1)]
    totals = [part + t @ low_at.T for part, t in zip(parts, of_fit, strict=True)]
    ours = np.concatenate([*parts, *totals], axis=1)

    grid = posterior.terms_amplitude
    low = 0.01 * float(grid[0])
    high = max(SIGMA, 10 * medians["structure"])
    decline = jnp.array(functions.decline())
    spectra = jnp.array(np.stack([np.sqrt(functions.spectrum(s)) for s in LENGTHS]))
    stars, poly, every, points = (jnp.array(z) for z in (data, P, B, at))
    centre, spread = (jnp.array(z) for z in (np.linalg.lstsq(P, data, rcond=None)[0].T, root))

    def half_t(t, median):
        z = jnp.exp(t) / median * student_t(STRUCTURE_DOF).ppf(0.75)
        return jnp.log(z) - (STRUCTURE_DOF + 1) / 2 * jnp.log1p(z**2 / STRUCTURE_DOF)

    def density():
        flat = dist.ImproperUniform(dist.constraints.real, (), (2, len(POWERS)))
        theta = centre + numpyro.sample("theta", flat) @ spread.T
        terms = numpyro.sample("terms", dist.Normal(0, 1).expand((2, T)))
        sines = numpyro.sample("sines", dist.Normal(0, 1).expand((2, m - T)))
        within = dist.Uniform(np.log(low), np.log(high))
        of_terms = numpyro.sample("of_terms", dist.Uniform(np.log(low), np.log(high)))
        a = jnp.stack([numpyro.sample(f"of_field_{k}", within) for k in "uv"])
        z_terms = jnp.exp(of_terms) * decline * terms
        base = stars.T - theta @ poly.T - z_terms @ every[:, :T].T
        inside = 1 - 0.5 * (jnp.exp(np.log(low) - a[0]) + jnp.exp(a[0] - np.log(high)))
        apart = jnp.log(0.5) - jnp.abs(a[0] - a[1])
        rms = 0.5 * jnp.log(0.5 * jnp.exp(2 * a).sum())
        alike = jnp.log(0.8) + half_t(a[0], medians["structure"]) + apart - jnp.log(inside)
        unlike = jnp.log(0.2) + half_t(rms, medians["structure"]) + apart
        logs, fields = [], []
        for prior, sizes in ((alike, a[jnp.array([0, 0])]), (unlike, a)):
            for spectrum in spectra:
                z = jnp.exp(sizes)[:, None] * spectrum * sines
                logs.append(prior - 0.5 * ((base - z @ every[:, T:].T) ** 2).sum() / SIGMA**2)
                fields.append(jnp.concatenate([z_terms, z], axis=1) @ points.T)
        logs = jnp.stack(logs)
        numpyro.factor("posterior", half_t(of_terms, medians["higher_order"]))
        numpyro.factor("mixture", jax.scipy.special.logsumexp(logs))
        pick = numpyro.sample("pick", dist.Uniform())
        which = jnp.searchsorted(jnp.cumsum(jax.nn.softmax(logs)), pick)
        field = jnp.stack(fields)[which]
        numpyro.deterministic("at", jnp.stack([field, field + theta @ low_at.T]))

    start = {
        "theta": np.zeros((2, len(POWERS))),
        "terms": np.zeros((2, T)),
        "sines": np.zeros((2, m - T)),
        "of_terms": np.log(1e-3),
        "of_field_u": np.log(5e-3),
        "of_field_v": np.log(5e-3),
        "pick": 0.5,
    }
    got = nuts(density, start, 5)
    agree(ours, got, "at", "structure" + (" of a field" if found else " of nothing"), capsys)


MEDIANS = {"shape": 1e-5, "rotation": 1e-5, "curvature": 3e-7}
NOISE = 1e-4


@pytest.fixture
def deviations():
    """Scale and shears of six exposures and the curvature of a drift: their draws, and the data."""
    rng = np.random.default_rng(3)
    scatter = np.array(["shape"] * 18 + ["rotation"] * 6 + ["curvature"] * 2)
    priors = DiscrepancyPriors(exposure=MEDIANS["shape"], curvature=MEDIANS["curvature"])
    sizes = {"shape": 2e-5, "rotation": 5e-6, "curvature": 2e-7}
    q, n = len(scatter), 80
    d = np.array([sizes[s] for s in scatter]) * rng.standard_normal(q)
    A = rng.standard_normal((n, q))
    A[:, -2:] *= 40.0
    data = A @ d + NOISE * rng.standard_normal(n)
    S, score = A.T @ A / NOISE**2, A.T @ data / NOISE**2
    columns = DeviationColumns(
        None, np.zeros(1), (), ((0, 0, 1), (0, 1, 2)), scatter, np.zeros(1, int), 6, 2010.0, 1.0
    )
    found = deviation_draws(columns, S, score, -np.eye(q), priors, 60_000, rng)
    index = np.array([list(MEDIANS).index(s) for s in scatter])
    return found.theta, A / NOISE, data / NOISE, index


@only_in_full("test_against_dense has what is conditional")
def test_deviations_of_exposures_are_those_of_the_integral(deviations):
    """Dense, over a fine mesh of the three amplitudes: given these all else is normal."""
    theta, matrix, seen, index = deviations
    S, score = matrix.T @ matrix, matrix.T @ seen
    axes = [np.linspace(-7, 7, n) for n in (71, 31, 31)]
    logs = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def conditional(logs):
        """Means, covariances and log evidence of the deviations for each of the amplitudes."""
        spread = (np.exp(logs) * list(MEDIANS.values()))[:, index]
        precision = spread[:, :, None] * S * spread[:, None] + np.eye(len(index))
        cov = np.linalg.inv(precision) * spread[:, :, None] * spread[:, None]
        mean = cov @ score
        evidence = 0.5 * mean @ score - 0.5 * np.linalg.slogdet(precision)[1]
        return mean, cov, evidence + (logs - np.log1p(np.exp(2 * logs))).sum(axis=1)

    parts = np.array_split(logs, 100)
    density = np.concatenate([conditional(part)[2] for part in parts])
    some = density > density.max() - 15
    mean, cov, density = conditional(logs[some])
    weight = np.exp(density - density.max())
    weight /= weight.sum()
    expected = weight @ mean
    second = np.einsum("n,nq->q", weight, mean**2 + np.diagonal(cov, axis1=1, axis2=2))
    sd = np.sqrt(second - expected**2)
    # the amplitudes of the draws are those of a coarse mesh
    np.testing.assert_allclose((theta.mean(axis=0) - expected) / sd, 0, atol=0.05)
    np.testing.assert_allclose(theta.std(axis=0) / sd, 1, atol=0.03)


@only_in_full("test_against_dense has what is conditional")
def test_deviations_of_exposures(deviations, capsys):
    """The same density without any conjugacy."""
    import jax
    import jax.numpy as jnp
    import numpyro
    import numpyro.distributions as dist

    jax.config.update("jax_enable_x64", True)
    theta, *arrays, index = deviations
    q = len(index)
    matrix, seen = (jnp.array(a) for a in arrays)

    def density():
        logs = jnp.stack(
            [
                numpyro.sample(name, dist.Uniform(np.log(m) - 7, np.log(m) + 7))
                for name, m in MEDIANS.items()
            ]
        )
        z = jnp.exp(logs) / jnp.array(list(MEDIANS.values()))
        numpyro.factor("prior", (jnp.log(z) - jnp.log1p(z**2)).sum())
        own = numpyro.sample("own", dist.Normal(0, 1).expand((q,)))
        each = jnp.exp(logs)[index] * own
        numpyro.factor("seen", -0.5 * ((seen - matrix @ each) ** 2).sum())
        numpyro.deterministic("each", each)

    start = {"own": np.zeros(q)} | {name: np.log(m) for name, m in MEDIANS.items()}
    got = nuts(density, start, 4)
    agree(theta, got, "each", "deviations", capsys)
