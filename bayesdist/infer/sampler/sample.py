"""Sampling of the posterior, starting from a linear fit, and a prediction of its cost."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.files.hdf5 import read_arrays, write_arrays
from bayesdist.infer.convergence import Limits
from bayesdist.infer.density.grid import build_proposal
from bayesdist.infer.density.proposal import GridProposal, Proposal, Quality, quality_of
from bayesdist.infer.density.target import Density, Target
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.posterior import Posterior
from bayesdist.infer.posterior.memberships import count_outliers
from bayesdist.infer.sampler.chains import (
    ChainSettings,
    ensemble_seeds,
    pilot_of,
    plan_of,
    run_chains,
)
from bayesdist.infer.sampler.ensembles import CHECKPOINT
from bayesdist.infer.sampler.schedule import Plan, expected_passes
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.stars.likelihood import OutlierMixture
from bayesdist.infer.stars.loading import opened
from bayesdist.infer.stars.shards import Compute, Shards
from bayesdist.infer.stars.stars import Stars
from bayesdist.utils.checks import PARETO_K
from bayesdist.utils.memory import require_memory
from bayesdist.utils.quantities import takes, whole_number

STEPS_KEPT = 100  # steps per walker assumed for the check of the available memory
FORMAT = 4  # version of the checkpoint files
ENGINES = ("emcee", "numba", "numpy", "scipy")  # results may depend on the versions of these

# With a smaller efficiency, or Pareto k closer to its limit, more proposals may still lead to other
# moves; the uncertainty of k is about 0.1 for 2000 proposals.
SURE_EFFICIENCY = 0.6
K_MARGIN = 0.1


@takes(fit=LinearFit, matches=(Matches, Shards), outliers=OutlierMixture, compute=Compute)
@one_thread
def sample(
    fit: LinearFit,
    matches: Matches | Shards,
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
    compute: Compute | None = None,
) -> Posterior:
    """Sample the posterior of the distortion and of the outlier mixture.

    Parameters
    ----------
    fit : LinearFit
        Linear fit to the same matches, at which the search for the posterior mode starts.
    matches : Matches or Shards
        All stars, including those that the fit rejected.
    outliers : OutlierMixture, optional
        Outlier model; Gaussian outliers by default. If it has no match radius, that of the matches
        is used.
    priors : GaussianPriors, optional
        Gaussian priors on the distortion parameters; flat by default.
    seed : int
        Seed of all random numbers.
    ensembles : int
        Number of independent ensembles (at least 2), which are compared to assess convergence.
    walkers : int, optional
        Walkers per ensemble; chosen together with the moves by default.
    target_ess, target_rhat : float
        Convergence criteria. Sampling stops when the bulk and tail effective sample sizes of all
        parameters are at least `target_ess` and their R-hat is at most `target_rhat`.
    max_steps : int
        Maximum number of steps of each ensemble, including those before a resume.
    checkpoint_every : int
        Maximum number of steps between two checkpoints.
    folder : path, optional
        Folder for checkpoints. Existing checkpoints are read instead of computing the steps again;
        the results are bit for bit the same.
    progress : callable, optional
        Called with (number of steps, `max_steps`) after each block of steps.
    compute : Compute, optional
        Computing engine; threads of this process by default.

    Returns
    -------
    Posterior
        Its `convergence.converged` is True if the criteria were met.

    Raises
    ------
    DegenerateError
        If no posterior mode is found.
    InputError
        If an argument is invalid, the checkpoints belong to other data or settings, or files cannot
        be written.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> posterior = bd.sample(fit, matches, seed=1, target_ess=100)
    >>> posterior.convergence.converged
    True
    """
    seed = whole_number(seed, "seed", least=0, where="sample")
    steps = {"max_steps": max_steps, "checkpoint_every": checkpoint_every}
    for name, number in steps.items():
        whole_number(number, name, least=1, where="sample")
    require_memory(
        8.0 * ensembles * (walkers or 1) * len(fit.model.names) * STEPS_KEPT,
        f"the draws of {ensembles} ensembles",
        where="sampler.ensembles",
        do="use fewer ensembles or walkers",
    )
    seeds = ensemble_seeds(seed, ensembles)
    started = time.monotonic()
    with opened(fit.model, matches, compute) as shards:
        mixture = outliers or OutlierMixture()
        if mixture.match_radius is None and isinstance(matches, Matches):
            mixture = replace(mixture, match_radius=matches.match_radius)
        mixture = mixture.in_unit(fit.model.unit)
        priors = priors or GaussianPriors.none(fit.model)
        target = Target(shards, mixture, priors)
        folder = None if folder is None else Path(folder)
        fingerprint = _fingerprint(target, seed, ensembles, walkers, checkpoint_every)
        proposal = _proposal(target, fit, folder, fingerprint)
        settings = ChainSettings(
            seeds=seeds,
            n_stars=len(shards),
            walkers=walkers,
            limits=Limits(target_ess, target_rhat),
            max_steps=max_steps,
            checkpoint_every=checkpoint_every,
            folder=folder,
            fingerprint=fingerprint,
            progress=progress,
        )
        chains = run_chains(target, proposal, settings)
        draws, n = chains.draws, target.n_theta
        flat = draws.reshape(-1, draws.shape[-1])
        flagged, expected = count_outliers(shards, target.hyper, flat[:, :n], flat[:, n:])
        return Posterior(
            model=target.model,
            mixture=mixture,
            theta=draws[..., :n].copy(),
            hyper=target.hyper.values(draws[..., n:]),
            log_prob=chains.log_densities,
            n_stars=len(shards),
            n_flagged=flagged,
            n_false=expected,
            reference_sigma=target.hyper.scale,
            convergence=chains.verdict,
            sampler=chains.info(seed, started),
            tangent_point=fit.tangent_point,
            matches_digest=matches.digest() if isinstance(matches, Matches) else "",
        )


def _fingerprint(target: Target, *settings: object) -> str:
    """Hash of the data, model, settings and library versions, which a resumed run must share."""
    digest = hashlib.sha256()
    digest.update("".join(target.shards.sum(_digest)).encode())
    digest.update(repr([(name, metadata.version(name)) for name in ENGINES]).encode())
    priors = target.priors
    digest.update(priors.centre.tobytes() + priors.precision.tobytes())
    if priors.joint is not None:
        digest.update(priors.joint.centre.tobytes() + priors.joint.precision.tobytes())
    digest.update(repr((target.model.to_dict(), target.mixture, settings, FORMAT)).encode())
    return digest.hexdigest()


def _digest(stars: Stars) -> tuple[str]:
    digest = hashlib.sha256()
    groups = stars.groups
    for column in (
        *stars.columns,
        *stars.offsets,
        stars.starts,
        groups.chip,
        groups.exposure,
        groups.epoch,
    ):
        digest.update(np.ascontiguousarray(column).data)
    return (digest.hexdigest(),)


def _proposal(
    target: Target, fit: LinearFit, folder: Path | None, fingerprint: str
) -> GridProposal:
    """Build the proposal, or read it from a file, so that a resumed run uses exactly the same."""
    path = None if folder is None else folder / "chain-0-proposal.h5"
    if path is not None and path.exists():
        arrays = read_arrays(path, fingerprint, CHECKPOINT, do="start again with --force")
        return GridProposal.from_arrays(target.n_theta, target.mixture.hyper, arrays)
    proposal = build_proposal(target, fit)
    if path is not None:
        write_arrays(path, fingerprint, proposal.to_arrays())
    return proposal


# -- cost of a run, from its pilot -----------------------------------------------------------------


@dataclass(frozen=True)
class SamplingPrediction:
    """Predicted moves and number of passes of a run.

    Parameters
    ----------
    plan : Plan
        Moves and walkers of the run.
    quality : Quality
        Quality of the proposal.
    passes : int or None
        Expected number of passes over the data; None if it cannot be predicted.
    most_passes : int
        Number of passes if the run continues to `max_steps`.
    """

    plan: Plan
    quality: Quality
    passes: int | None
    most_passes: int


def predict(target: Density, proposal: Proposal, settings: ChainSettings) -> SamplingPrediction:
    """Predict the cost of a run with these settings; no files are written.

    The pilot is that of the run, which will therefore start with the same moves.  Passes can be
    predicted for independence moves only, since the autocorrelation of other moves depends on the
    shape of the posterior.
    """
    s, ensembles = settings, len(settings.seeds)
    quality = quality_of(pilot_of(target, proposal, s).log_weights)
    plan = plan_of(target, quality, s)
    sure = quality.efficiency > SURE_EFFICIENCY and quality.k < PARETO_K.value - K_MARGIN
    passes = None
    if plan.independent and sure:
        passes = expected_passes(len(target.names), s.n_stars, s.limits, ensembles)
    most_passes = ensembles * plan.walkers * s.max_steps
    return SamplingPrediction(plan, quality, passes, most_passes)


@one_thread
def predict_sampling(
    fit: LinearFit,
    shards: Shards,
    *,
    outliers: OutlierMixture,
    priors: GaussianPriors | None,
    seed: int,
    ensembles: int,
    walkers: int | None,
    limits: Limits,
    max_steps: int,
) -> SamplingPrediction:
    """Predict the cost of `sample` with the same arguments.

    Raises DegenerateError if no posterior mode is found, like `sample`.
    """
    model = fit.model
    target = Target(shards, outliers.in_unit(model.unit), priors or GaussianPriors.none(model))
    seeds = ensemble_seeds(seed, ensembles)
    settings = ChainSettings(seeds, len(shards), walkers, limits, max_steps)
    return predict(target, build_proposal(target, fit), settings)
