"""Cost of sampling, predicted from the pilot with which the run itself begins."""

from __future__ import annotations

from dataclasses import dataclass

from bayesdist.infer.convergence import Limits
from bayesdist.infer.density.grid import build_proposal
from bayesdist.infer.density.importance import Quality, quality_of
from bayesdist.infer.density.proposal import Proposal
from bayesdist.infer.density.target import Density, Target
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.sampler.chains import Settings, ensemble_seeds, pilot_of, plan_of
from bayesdist.infer.sampler.move_schedule import Plan, expected_passes
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.stars.mixture import OutlierMixture
from bayesdist.infer.stars.shards import Shards
from bayesdist.utils.limits import PARETO_K

# importance efficiency and distance of Pareto k from its limit within which further proposals
# may still lead to other moves; k scatters by about 0.1 with 2000 proposals
SURE_EFFICIENCY = 0.6
K_MARGIN = 0.1


@dataclass(frozen=True)
class Prediction:
    """Moves that a run will begin with, and the passes that it takes."""

    plan: Plan
    quality: Quality
    passes: int | None  # None if the number cannot be known before sampling
    most_passes: int  # after which `max_steps` ends the run


def predict(target: Density, proposal: Proposal, settings: Settings) -> Prediction:
    """Prediction by the pilot of a run with these settings; nothing is written.

    The pilot's proposals are those of the run, so that it begins with the same moves. Passes can be
    predicted only for independence moves: the number of steps in which other moves forget their
    start depends on the shape of the posterior.
    """
    s, ensembles = settings, len(settings.seeds)
    quality = quality_of(pilot_of(target, proposal, s).log_weights)
    plan = plan_of(target, quality, s)
    sure = quality.efficiency > SURE_EFFICIENCY and quality.k < PARETO_K.value - K_MARGIN
    passes = None
    if plan.independent and sure:
        passes = expected_passes(len(target.names), s.n_stars, s.limits, ensembles)
    most = ensembles * plan.walkers * s.max_steps
    return Prediction(plan, quality, passes, most)


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
) -> Prediction:
    """Prediction of what `sample` costs with the same arguments.

    DegenerateError if no posterior mode is found, as `sample`.
    """
    model = fit.model
    target = Target(shards, outliers.in_unit(model.unit), priors or GaussianPriors.none(model))
    seeds = ensemble_seeds(seed, ensembles)
    settings = Settings(seeds, len(shards), walkers, limits, max_steps)
    return predict(target, build_proposal(target, fit), settings)
