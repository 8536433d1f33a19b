"""Error budget of a solution over the grid of its chips."""

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.model import error_model
from bayesdist.model.grid import DEFAULT_GRID


def detector_budget(
    solution,
    *,
    terms=(),
    aligned=False,
    grid=DEFAULT_GRID,
    epoch=None,
    n_draws=4000,
    rng,
    pixel_scale=None,
):
    """Budget of all chips, the same grid on each."""
    errors = error_model(solution, terms=terms, aligned=aligned, pixel_scale=pixel_scale)
    domain = EvaluationDomain.of_chips(solution.model, grid, epoch=epoch)
    return errors.at(domain, n=n_draws, rng=rng)
