"""Draws of a density by NumPyro's NUTS, which knows nothing of ours."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping

import numpy as np


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
