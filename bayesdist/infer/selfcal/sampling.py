"""From a mode to posterior draws of distortion and frames, the stars integrated out."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from bayesdist.errors import InputError
from bayesdist.infer.convergence import Limits
from bayesdist.infer.posterior import Posterior, SamplerInfo
from bayesdist.infer.sampler.chains import Settings, run_chains
from bayesdist.infer.selfcal.normal import memberships
from bayesdist.infer.selfcal.proposal import propose
from bayesdist.infer.selfcal.solve import Solution
from bayesdist.infer.selfcal.target import SelfTarget

__all__ = ["sample_selfcal"]

Float = NDArray[np.float64]

# cost of a detection in a pass, in matched stars: its star's mode is found anew each time
DEARER = 60


@threadpool_limits.wrap(limits=1, user_api="blas")
def sample_selfcal(
    solution: Solution,
    *,
    jitter: float | None = None,
    fraction_prior: tuple[float, float] = (1.0, 9.0),
    jitter_scale: float | None = None,
    seed: int = 1,
    ensembles: int = 4,
    target_ess: float = 400.0,
    target_rhat: float = 1.01,
    max_steps: int = 20_000,
    checkpoint_every: int = 200,
    folder: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """Sample distortion, frames, jitter and fraction of false detections.

    Parameters
    ----------
    solution : Solution
    jitter : float, optional
        Fixed value, in pixels; sampled by default.
    fraction_prior : tuple of float
        As `OutlierMixture`.
    jitter_scale : float, optional
        As `OutlierMixture`, in pixels.
    seed, ensembles, target_ess, target_rhat, max_steps, checkpoint_every, folder, progress
        As `sample`.

    Returns
    -------
    Posterior
        Parameters that the gauge fixes have one value in all draws and are not judged.  The
        jitter is in pixels.

    Raises
    ------
    DegenerateError, InputError
        As `sample`.
    """
    if ensembles < 2:
        raise InputError(
            f"{ensembles} ensemble cannot show convergence", where="sampler.ensembles", do="use 4"
        )
    started = time.monotonic()
    target = SelfTarget(solution, jitter, fraction_prior, jitter_scale)
    proposal = propose(target)
    seeds = np.random.SeedSequence(seed).generate_state(ensembles + 1)
    settings = Settings(
        seeds=tuple(int(s) for s in seeds[:-1]),
        n_stars=DEARER * len(solution.problem),
        limits=Limits(target_ess, target_rhat),
        max_steps=max_steps,
        checkpoint_every=checkpoint_every,
        folder=None if folder is None else Path(folder),
        fingerprint=_fingerprint(
            solution,
            jitter,
            fraction_prior,
            jitter_scale,
            seed,
            ensembles,
            checkpoint_every,
        ),
        progress=progress,
    )
    chains = run_chains(target, proposal, settings)  # type: ignore[arg-type]
    E, T, W, D = chains.psi.shape
    draws = np.swapaxes(chains.psi, 1, 2).reshape(E, W * T, D)
    n, expansion = target.n_theta, solution.expansion
    member = memberships(solution.problem, solution.theta, solution.mixture, solution.stars)
    return Posterior(
        model=solution.problem.model,
        mixture=target.mixture,
        theta=target.theta(draws[..., :n]),
        hyper=target.hyper.values(draws[..., n:]),
        log_prob=np.swapaxes(chains.log_prob, 1, 2).reshape(E, W * T),
        n_stars=len(solution.problem),
        n_flagged=int((member < 0.5).sum()),
        n_false=len(solution.problem) - expansion.n_members,
        reference_sigma=target.hyper.scale,
        convergence=chains.verdict.among((*solution.problem.model.names, *target.hyper.names)),
        sampler=SamplerInfo(
            method=f"emcee {chains.plan.method}",
            ensembles=ensembles,
            walkers=chains.plan.walkers,
            steps=chains.steps,
            warmup=chains.warmup,
            passes=chains.passes,
            acceptance=chains.acceptance,
            wall_s=time.monotonic() - started,
            seed=seed,
        ),
        own_places=True,
    )


def _fingerprint(solution: Solution, *settings: object) -> str:
    """Fingerprint of everything that must not change between a run and its resumption."""
    p, digest = solution.problem, hashlib.sha256()
    for column in (p.seen, p.var, p.starts, p.groups.index, solution.theta):
        digest.update(np.ascontiguousarray(column).data)
    digest.update(repr((p.model.to_dict(), settings)).encode())
    return digest.hexdigest()
