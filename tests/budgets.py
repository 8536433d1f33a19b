"""Error budget of a solution over the grid of its chips."""

from dataclasses import dataclass

import numpy as np

from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.model import error_model
from bayesdist.assess.terms.forms import Row
from bayesdist.assess.terms.functions import Polynomials
from bayesdist.infer.solution.solution import Solution
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


@dataclass(frozen=True)
class Curvature:
    """Drift that is curved in time: a linear term of u errs by the square of the years."""

    solution: Solution
    sigma: float  # in the unit of u, v per squared year
    rows: tuple[Row, ...] = (Row("curvature"),)

    def draw(self, n, rng):
        model, size = self.solution.model, self.sigma * rng.standard_normal(n)

        def more(epoch, chip):
            out = np.zeros((n, 2, model.n_terms))
            out[:, 0, 1] = size * (epoch - 2009.0) ** 2
            return out

        mean = np.asarray(self.solution.mean)
        theta = np.tile(mean[: model.n_global], (n, 1))
        return Polynomials(self.rows[0], model, mean, theta, more=more)
