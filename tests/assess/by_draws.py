"""Margins by the draws of the stated errors alone, as if the residuals had been examined."""

from __future__ import annotations

from dataclasses import replace

from bayesdist.assess.model import error_model
from bayesdist.assess.requirements.margins import judge
from bayesdist.assess.units import pixel_scale_of
from bayesdist.infer.posterior.checks import convergence_check


def margins_by_draws(
    solution,
    requirements,
    *,
    terms=(),
    aligned=False,
    n_draws=2000,
    rng,
    chip=None,
    pixel_scale=None,
    checks=(),
    block=None,
    **places,
):
    """Margins of requirements: what draws decide, if nothing is known to be wrong with them.

    `block`: positions times draws that are evaluated at a time. `places`: grid and epoch as of
    `judge`.
    """
    scale = pixel_scale_of(solution, chip, pixel_scale)
    errors = error_model(solution, terms=terms, aligned=aligned, pixel_scale=scale)
    if solution.convergence is not None:
        checks = (convergence_check(solution.convergence), *checks)
    drawn = errors.drawn(n_draws, rng)
    drawn = replace(drawn, block=block or drawn.block)
    return judge(drawn, requirements, chip=chip, pixel_scale=scale, checks=checks, **places)
