"""A density written down for NumPyro: draws by its NUTS, or a check of the draws that we have."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from importlib.util import find_spec

import numpy as np
import pytest

# looked for, not imported: all tests are collected by each process
needs_numpyro = pytest.mark.skipif(
    find_spec("numpyro") is None, reason="NumPyro (extra 'test') is not installed"
)


def nuts_draws(
    density: Callable[[], None],
    start: Mapping[str, object],
    draws: int,
    seed: int,
    *,
    warmup: int = 800,
    target_accept: float = 0.8,
    by_chain: bool = False,
) -> dict[str, np.ndarray]:
    """Draws of four chains of all that the density samples or names, (4, n, ...) by chain."""
    import jax
    import numpyro

    kernel = numpyro.infer.NUTS(
        density,
        init_strategy=numpyro.infer.init_to_value(values=dict(start)),
        target_accept_prob=target_accept,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mcmc = numpyro.infer.MCMC(
            kernel,
            num_warmup=warmup,
            num_samples=draws,
            num_chains=4,
            chain_method="vectorized",
            progress_bar=False,
        )
        mcmc.run(jax.random.PRNGKey(seed))
    return {k: np.asarray(v) for k, v in mcmc.get_samples(group_by_chain=by_chain).items()}


def spread_draws(posterior, n: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Draws (n, D) of a posterior as far from one another as can be, and those of the mixture."""
    flat = posterior.flat
    rows = np.linspace(0, len(flat) - 1, n).astype(int)
    return flat[rows], {name: v.ravel()[rows] for name, v in posterior.hyper.items()}


def stein_pulls(
    density: Callable[[], None],
    draws: Mapping[str, np.ndarray],
    *,
    beside: Mapping[str, np.ndarray] | None = None,
    at_once: int = 100,
) -> np.ndarray:
    """Pulls (p, 1 + p) of Stein's identities, of independent draws (n, ...) of p parameters.

    Where draws x have a density whose logarithm has the gradient g, the mean of g is 0, and that
    of (x - mean) g' is -1: with the precision of n draws that shows wrong means, variances and
    correlations, and asks for no other sampler.  Other parameters of the density, `beside` (n, ...)
    these, need draws as well, and no identities.
    """
    import jax
    from jax.flatten_util import ravel_pytree
    from numpyro.infer.util import log_density

    start = {name: np.asarray(rows)[0] for name, rows in draws.items()}
    flat = [np.asarray(rows).reshape(len(rows), -1) for _, rows in sorted(draws.items())]
    x = np.concatenate(flat, axis=1)
    unravel = ravel_pytree(start)[1]

    def log_of(v, others):
        return log_density(density, (), {}, unravel(v) | others)[0]

    gradient = jax.jit(jax.vmap(jax.grad(log_of)))
    chunks = [slice(k, k + at_once) for k in range(0, len(x) - at_once + 1, at_once)]
    others = [{name: rows[some] for name, rows in (beside or {}).items()} for some in chunks]
    g = [gradient(x[some], other) for some, other in zip(chunks, others, strict=True)]
    g = np.concatenate([np.asarray(one) for one in g])
    # uncorrelated coordinates of unit variance
    x = x[: len(g)]
    root = np.linalg.cholesky(np.cov(x.T))
    away, g = np.linalg.solve(root, (x - x.mean(axis=0)).T).T, g @ root
    terms = np.concatenate([g[:, :, None], g[:, :, None] * away[:, None, :]], axis=2)
    expected = np.concatenate([np.zeros((x.shape[1], 1)), -np.eye(x.shape[1])], axis=1)
    return (terms.mean(axis=0) - expected) / (terms.std(axis=0) / np.sqrt(len(g)))
