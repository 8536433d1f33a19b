"""The mode together with the parameters fixed by convention, as one decision.

Free directions are found at a solution, and a solution needs the fixed parameters.  With the errors
of a start more seems free than at the mode; where rolls hardly differ the two answers differ.  So
the question is asked again at the mode, and the answer is stored with the solution for all later
uses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import DegenerateError, NotSettledError
from bayesdist.infer.selfcal.gauge import Gauge, find_gauge
from bayesdist.infer.selfcal.information import Information
from bayesdist.infer.selfcal.normal import Mixture, expand
from bayesdist.infer.selfcal.problem import Problem, StarPriors
from bayesdist.infer.selfcal.solve import Solution, solve, wide_mixture

__all__ = ["Knowledge", "curvatures", "gauge_of", "solved_in_gauge"]

Float = NDArray[np.float64]

Knowledge = Callable[[Float], Information]


def solved_in_gauge(
    problem: Problem,
    theta: Float,
    knowledge: Knowledge,
    *,
    stars: Float | None = None,
    mixture: Mixture | None = None,
    jitter: float | None = None,
) -> Solution:
    """Mode of a problem, with the parameters fixed by convention as decided there.

    The search starts at theta (D,); `knowledge` gives information from other sources than the
    detections, linearised at parameters (D,).  Where the detections determine more at the mode than
    at the start, that is fitted; where it then turns out to be free after all, it stays fixed.
    DegenerateError and NotSettledError as `solve`.
    """
    information = knowledge(theta)

    def solved(gauge: Gauge, begin: Solution | None) -> Solution:
        free = np.setdiff1d(np.arange(problem.model.n_params), gauge.held)
        found = solve(
            problem,
            theta if begin is None else begin.theta,
            free,
            information,
            stars=stars if begin is None else begin.stars,
            mixture=mixture if begin is None else begin.mixture,
            jitter=jitter,
        )
        return replace(found, decision=gauge.decision)

    def asked_at(solution: Solution) -> Gauge:
        bare = replace(solution, decision=None)
        return gauge_of(bare.problem, bare.theta, knowledge(bare.theta), bare)

    gauge = gauge_of(problem, theta, information)
    solution = solved(gauge, None)
    at_mode = asked_at(solution)
    if at_mode.held.size > gauge.held.size:
        return solved(at_mode, solution)
    while at_mode.held.size < gauge.held.size:
        try:
            freer = solved(at_mode, solution)
        except (DegenerateError, NotSettledError):
            return solution
        gauge, at_mode = at_mode, asked_at(freer)
        if at_mode.held.size > gauge.held.size:
            return solution
        solution = freer
    # as many are fixed: the choice of the parameters is arbitrary
    return replace(solution, decision=replace(at_mode.decision, held=gauge.held))


def gauge_of(
    problem: Problem, theta: Float, information: Information, solution: Solution | None = None
) -> Gauge:
    """Free directions of a problem, and what fixes them.

    Before there is a solution, stars lie at the means of their detections.  The solution's decision
    on the free directions is used.
    """
    decision = None if solution is None else solution.decision
    if solution is None:
        stars = problem.mean_places(theta)
        problem = problem.at(theta, stars)
        mixture = wide_mixture(problem, theta, stars)
    else:
        stars, mixture = solution.stars, solution.mixture
    alone, known = curvatures(problem, theta, mixture, stars)
    return find_gauge(problem, theta, alone, information, known=known, decision=decision)


def curvatures(
    problem: Problem, theta: Float, mixture: Mixture, stars: Float
) -> tuple[Float, Float]:
    """Curvature (D, D) by the detections alone, and with the priors of the stars."""
    known = expand(problem, theta, mixture, stars, observed=False).curvature
    if not problem.priors.informed.any():
        return known, known
    bare = replace(problem, priors=StarPriors.none(problem.n_stars, problem.n_star))
    return expand(bare, theta, mixture, stars, observed=False).curvature, known
