"""From a linear fit to a posterior: mode, proposal, ensembles, and the decision when to stop."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from bayesdist.data.files import atomic_path
from bayesdist.data.matches import MatchTable
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.labelled.convergence import (
    Convergence,
    Limits,
    diagnose,
    importance_efficiency,
    pareto_k,
)
from bayesdist.infer.linear import LinearFit
from bayesdist.infer.mixture import OutlierMixture
from bayesdist.infer.posterior import Posterior, SamplerInfo
from bayesdist.infer.prior import GaussianPriors
from bayesdist.infer.proposal import GridProposal, build_proposal
from bayesdist.infer.sampler import START_DRAWS, Ensembles, Whitening, boundaries, plan_moves
from bayesdist.infer.stars import prepare
from bayesdist.infer.target import Target

__all__ = ["sample"]

Float = NDArray[np.float64]

ENGINES = ("emcee", "numba", "numpy", "scipy")  # another version may give other bits
LEAST_ROWS = 10  # rows of a chain that diagnostics make sense of
PILOT = 512  # proposals that judge the proposal
PILOT_STARS = 200_000_000  # star evaluations that the pilot may cost
MEMBERSHIP_DRAWS = 64  # draws over which the outlier probability of a star is averaged


# matrices here are small: more BLAS threads only get in each other's way
@threadpool_limits.wrap(limits=1, user_api="blas")
def sample(
    fit: LinearFit,
    matches: MatchTable,
    *,
    outliers: OutlierMixture | None = None,
    priors: GaussianPriors | None = None,
    seed: int = 1,
    ensembles: int = 4,
    walkers: int | None = None,
    target_ess: float = 400.0,
    target_rhat: float = 1.01,
    max_steps: int = 20_000,
    checkpoint_every: int = 200,
    folder: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """Sample the posterior of the distortion and of the outlier mixture.

    Parameters
    ----------
    fit : LinearFit
        Of the same matches; it seeds the search for the mode.
    matches : MatchTable
        All rows: none is clipped.
    outliers : OutlierMixture, optional
        Gaussian outliers by default.
    priors : GaussianPriors, optional
    seed : int
        All random numbers follow from it.
    ensembles : int
        Independent ensembles, over which convergence is judged; 2 or more.
    walkers : int, optional
        Walkers of one ensemble; chosen with the moves by default.
    target_ess, target_rhat : float
        The run stops when every parameter has reached them.
    max_steps : int
        Largest total of steps of each ensemble, also over resumed runs.
    checkpoint_every : int
        Most steps between two checkpoints.
    folder : path, optional
        Where checkpoints are kept.  Blocks found there are read instead of run, so that a killed
        run goes on bit for bit.
    progress : callable, optional
        Called with (steps made, `max_steps`).

    Returns
    -------
    Posterior
        `convergence.converged` says whether the targets were reached.

    Raises
    ------
    DegenerateError
        When no posterior mode is found.
    InputError
        For checkpoints of other data or settings, or a disk that is full.
    """
    if ensembles < 2:
        raise InputError(
            f"{ensembles} ensemble cannot show convergence", where="sampler.ensembles", do="use 4"
        )
    if max_steps < 1 or checkpoint_every < 1:
        raise InputError("steps must be positive", where="sampler")
    started = time.monotonic()
    mixture = outliers or OutlierMixture()
    target = Target(prepare(fit.model, matches), mixture, priors or GaussianPriors.none(fit.model))
    limits = Limits(target_ess, target_rhat)
    folder = None if folder is None else Path(folder)
    seeds = np.random.SeedSequence(seed).generate_state(ensembles + 1)

    known = _fingerprint(target, seed, ensembles, walkers, checkpoint_every)
    proposal = _proposal(target, fit, folder, known)
    n_pilot = int(np.clip(PILOT_STARS // len(matches), 64, PILOT))
    pilot = proposal.draw(n_pilot, np.random.default_rng(int(seeds[-1])))
    ok = np.isfinite(pilot).all(axis=1)
    if ok.sum() < 2:
        raise DegenerateError(
            "the Laplace approximation has no mass inside the support",
            where="posterior",
            do="check the match, the errors and the outlier model",
        )
    log_weights = target.log_density(pilot[ok]) - proposal.log_density(pilot[ok])
    n_outside = int((~ok).sum())
    efficiency = importance_efficiency(log_weights, n_outside)
    plan = plan_moves(efficiency, pareto_k(log_weights), len(target.names), walkers)
    if max_steps < 10 * plan.thin:
        plan = replace(plan, thin=1)  # too few steps to leave any out
    whitening = Whitening.of(target, proposal, pilot[ok])
    starts = tuple(int(s) for s in seeds[:-1])
    runs = Ensembles(target, proposal, whitening, plan, starts, folder, known)

    states = [runs.start(e) for e in range(ensembles)]
    psi: list[list[Float]] = [[] for _ in range(ensembles)]
    log_prob: list[list[Float]] = [[] for _ in range(ensembles)]
    accepted = 0.0
    begin, verdict = 0, None
    for end in boundaries(checkpoint_every, max_steps, plan.thin):
        for e in range(ensembles):
            block = runs.block(e, states[e], begin, end)
            psi[e].append(block.psi)
            log_prob[e].append(block.log_prob)
            states[e] = block.state
            accepted += float(block.accepted.sum())
        begin = end
        if progress is not None:
            progress(end, max_steps)
        made = sum(len(block) for block in psi[0])
        warmup = min(plan.warmup // plan.thin, made // 2)
        if plan.weights[0] < 0.9:
            warmup = made // 2
        if made - warmup < LEAST_ROWS and end + plan.thin <= max_steps:
            continue
        kept = slice(warmup, None)
        chains = np.array([np.concatenate(p) for p in psi])[:, kept]
        verdict = diagnose(
            chains,
            target.names,
            log_weights,
            limits,
            coupled=plan.weights[2] > 0,
            n_outside=n_outside,
        )
        if verdict.converged:
            break
    assert verdict is not None
    n_moves = ensembles * plan.walkers * begin
    info = SamplerInfo(
        method=f"emcee {plan.method}",
        ensembles=ensembles,
        walkers=plan.walkers,
        steps=begin,
        warmup=warmup * plan.thin,
        passes=n_pilot + (START_DRAWS + 1) * ensembles * plan.walkers + n_moves,
        acceptance=accepted / (ensembles * plan.walkers * made),
        wall_s=time.monotonic() - started,
        seed=seed,
    )
    heights = np.array([np.concatenate(p) for p in log_prob])[:, kept]
    return _posterior(target, chains, heights, verdict, info, int(seeds[-1]))


def _posterior(
    target: Target,
    chains: Float,
    log_prob: Float,
    verdict: Convergence,
    info: SamplerInfo,
    seed: int,
) -> Posterior:
    E, T, W, D = chains.shape
    draws = np.swapaxes(chains, 1, 2).reshape(E, W * T, D)
    flat = draws.reshape(-1, D)
    n = target.n_theta
    some = np.random.default_rng(seed).choice(len(flat), min(MEMBERSHIP_DRAWS, len(flat)), False)
    return Posterior(
        model=target.stars.model,
        mixture=target.mixture,
        theta=draws[..., :n].copy(),
        hyper=target.hyper.values(draws[..., n:]),
        log_prob=np.swapaxes(log_prob, 1, 2).reshape(E, W * T),
        outlier_probability=target.outlier_probability(flat[np.sort(some)]),
        convergence=verdict,
        sampler=info,
    )


def _fingerprint(target: Target, *settings: int | None) -> str:
    """What must not change between a run and its resumption."""
    digest = hashlib.sha256()
    stars = target.stars
    columns = (stars.X, stars.Y, stars.u, stars.v, stars.var_u, stars.var_v, stars.starts)
    for column in (*columns, stars.groups.chip, stars.groups.exposure, stars.groups.epoch):
        digest.update(np.ascontiguousarray(column).tobytes())
    digest.update(repr([(name, metadata.version(name)) for name in ENGINES]).encode())
    digest.update(target.priors.centre.tobytes() + target.priors.precision.tobytes())
    digest.update(repr((stars.model.to_dict(), target.mixture, settings)).encode())
    return digest.hexdigest()


def _proposal(
    target: Target, fit: LinearFit, folder: Path | None, fingerprint: str
) -> GridProposal:
    """The proposal, kept in a file so that a resumed run has the very same one."""
    path = None if folder is None else folder / "chain-0-proposal.h5"
    if path is not None and path.exists():
        try:
            with h5py.File(path, "r") as file:
                known = file.attrs["fingerprint"]
                arrays = {name: file[name][...] for name in file}
        except (OSError, KeyError) as error:
            raise InputError(
                "the checkpoint cannot be read", where=str(path), do="start again with --force"
            ) from error
        if known != fingerprint:
            raise InputError(
                "the checkpoints belong to other data or settings",
                where=str(path.parent),
                do="restore them, or start again with --force",
            )
        return GridProposal.from_arrays(target, arrays)
    proposal = build_proposal(target, fit)
    if path is not None:
        with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
            for name, values in proposal.to_arrays().items():
                file[name] = values
            file.attrs["fingerprint"] = fingerprint
    return proposal
