"""Prediction of the cost of sampling from the pilot of the run."""

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

# With a smaller efficiency, or Pareto k closer to its limit, more proposals may still lead to other
# moves; the uncertainty of k is about 0.1 for 2000 proposals.
SURE_EFFICIENCY = 0.6
K_MARGIN = 0.1


@dataclass(frozen=True)
class Prediction:
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


def predict(target: Density, proposal: Proposal, settings: Settings) -> Prediction:
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
    return Prediction(plan, quality, passes, most_passes)


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
    """Predict the cost of `sample` with the same arguments.

    Raises DegenerateError if no posterior mode is found, like `sample`.
    """
    model = fit.model
    target = Target(shards, outliers.in_unit(model.unit), priors or GaussianPriors.none(model))
    seeds = ensemble_seeds(seed, ensembles)
    settings = Settings(seeds, len(shards), walkers, limits, max_steps)
    return predict(target, build_proposal(target, fit), settings)
