"""NumPyro's NUTS on the same posterior: jax, float64, CPU.

The density is that of tests/infer/test_nuts.py, taken apart so that warm-up, sampling and
compilation are timed by themselves.  Two sets of coordinates: the orthogonal (Legendre)
coefficients, each in units of its own standard deviation, and all of them whitened by the
posterior covariance.  Both are given for free, in favour of NUTS.

In these coordinates the posteriors of few and of many stars are alike: with more stars a gradient
takes longer, and a draw as many of them.  So chains of more stars have the step sizes of those of
fewer and need no warm-up, and are run until the seconds of a gradient are known.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.effective import smallest_ess
from tests.benchmarks.plain import legendre_design
from tests.benchmarks.problem import Problem
from tests.benchmarks.timing import Deadline
from tests.benchmarks.walkers import White

__all__ = ["BASES", "Chains", "log_density", "nuts"]

Float = NDArray[np.float64]

BASES = ("orthogonal", "whitened")
CHAINS = 4
BLOCK = 25  # draws of one compiled call


@dataclass(frozen=True, eq=False)
class Chains:
    """What chains of fewer stars say of those of more, in the same coordinates."""

    n_stars: int
    adapted: Any  # step sizes and masses after warm-up
    per_pass: float  # effective draws of a gradient
    sampling: float  # fraction of the seconds of warm-up and sampling together


def log_density(problem: Problem) -> tuple[Any, tuple[Any, ...]]:
    """Log posterior of one point in jax, and the data that it takes as further arguments.

    Parameters
    ----------
    problem : Problem

    Returns
    -------
    function : callable
        function(psi, *data) -> scalar.
    data : tuple of jax.Array
    """
    import jax
    import jax.numpy as jnp
    import numpyro.distributions as dist

    jax.config.update("jax_enable_x64", True)
    m = problem.matches
    phi = legendre_design(m.x, m.y, problem.model.order)
    K, scale = phi.shape[1], problem.scale
    data = tuple(jnp.asarray(a) for a in (phi, m.u, m.v, m.sigma_u**2, m.sigma_v**2))

    def normal(r: Any, s2: Any) -> Any:
        return -0.5 * (r**2 / s2 + jnp.log(2 * jnp.pi * s2))

    def function(psi: Any, phi: Any, u: Any, v: Any, s2u: Any, s2v: Any) -> Any:
        log_j, logit_f, log_s = psi[2 * K :]
        j, f, excess2 = jnp.exp(log_j), jax.nn.sigmoid(logit_f), jnp.exp(2 * log_s)
        core2 = scale**2 + j**2
        s2 = core2 + excess2
        # the documented priors, with the Jacobians of the three transformations
        prior = dist.StudentT(4.0, 0.0, scale).log_prob(j) + log_j
        prior += dist.Beta(1.0, 9.0).log_prob(f) + jnp.log(f) + jnp.log1p(-f)
        prior += dist.InverseGamma(1.0, 25 * core2).log_prob(excess2) + jnp.log(2 * excess2)
        ru, rv = u - phi @ psi[:K], v - phi @ psi[K : 2 * K]
        good = jnp.log1p(-f) + normal(ru, s2u + j**2) + normal(rv, s2v + j**2)
        bad = jnp.log(f) + normal(ru, s2) + normal(rv, s2)
        return prior + jnp.logaddexp(good, bad).sum()

    return function, data


def nuts(
    problem: Problem,
    white: White,
    basis: str,
    known: Chains | None = None,
    *,
    seconds: float,
    warmup: int,
    draws: int,
    seed: int = 5,
) -> tuple[dict[str, Any], Chains, Float]:
    """Four vectorised chains until so many draws are made or the time is up.

    Parameters
    ----------
    problem : Problem
    white : White
        Posterior mean and covariance root.
    basis : {'orthogonal', 'whitened'}
    known : Chains, optional
        Of fewer stars: then there is no warm-up, and what a draw takes is not measured anew.
    seconds : float
        For warm-up and sampling together; compilation is timed apart.
    warmup, draws : int
        Of each chain.
    seed : int

    Returns
    -------
    row : dict
    chains : Chains
    draws : ndarray (chains, n, D)
    """
    import jax
    from numpyro.infer import NUTS

    function, data = log_density(problem)
    root = white.root
    if basis == "orthogonal":
        root = np.diag(np.sqrt((root**2).sum(axis=1)))
    centre, matrix = jax.numpy.asarray(white.centre), jax.numpy.asarray(root)

    def advance(state: Any, *data: Any) -> tuple[Any, tuple[Any, Any]]:
        # the data are arguments: as constants the compiler would fold them into the program
        kernel = NUTS(potential_fn=lambda z: -function(centre + matrix @ z, *data))
        _setup(kernel)

        def one(state: Any, _: None) -> tuple[Any, tuple[Any, Any]]:
            state = kernel.sample(state, (), {})
            return state, (state.z, state.num_steps)

        return jax.lax.scan(one, state, None, length=BLOCK)

    def _setup(kernel: Any) -> Any:
        keys = jax.random.split(jax.random.PRNGKey(seed), CHAINS)
        z = np.random.default_rng(seed).standard_normal((CHAINS, problem.dim))
        # a kernel is complete only after init, which also gives the first state
        return kernel.init(keys, warmup, jax.numpy.asarray(z), (), {})

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        clock = Deadline(seconds)
        state = jax.jit(
            lambda *data: _setup(NUTS(potential_fn=lambda z: -function(centre + matrix @ z, *data)))
        )(*data)
        program = jax.jit(advance).lower(state, *data).compile()
        compile_s = clock.elapsed

        clock = Deadline(seconds)
        if known is None:
            for _ in range(-(-warmup // BLOCK)):
                state, _ = program(state, *data)
            jax.block_until_ready(state)
        else:
            state = state._replace(i=state.i + warmup, adapt_state=known.adapted)
        warm_s = clock.elapsed
        points, gradients, sampling = [], 0, Deadline(max(seconds - warm_s, 0.0))
        while len(points) * BLOCK < draws and not (points and sampling.over):
            state, (z, steps) = program(state, *data)
            points.append(np.asarray(z))
            gradients += int(np.asarray(steps).sum())
        sample_s = sampling.elapsed
    psi = white.centre + np.concatenate(points).swapaxes(0, 1) @ root.T
    bulk, tail = smallest_ess(psi)
    worst = min(bulk, tail)
    flags = [f"short run of {psi.shape[1]} draws"] if worst < 400 else []
    chains = Chains(
        len(problem), state.adapt_state, worst / gradients, sample_s / (sample_s + warm_s)
    )
    if known is not None:
        chains, flags = known, [f"ESS per gradient and warm-up from N = {known.n_stars:,}"]
    rate = chains.per_pass * gradients / sample_s
    row = {
        "ess_bulk": bulk,
        "ess_tail": tail,
        "seconds": sample_s,
        "warmup_s": warm_s if known is None else None,
        "compile_s": compile_s,
        "passes": gradients,
        "rate": rate,
        "rate_total": rate * chains.sampling,
        "per_pass": chains.per_pass,
        "acceptance": float(np.mean(np.asarray(state.mean_accept_prob))),
        "setting": f"{basis}, {CHAINS} chains",
        "flags": flags,
    }
    return row, chains, psi
