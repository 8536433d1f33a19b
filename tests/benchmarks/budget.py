"""The error budget and a requirement followed through time, on a fine grid and many epochs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesdist.assess import Requirement, UserTerm
from bayesdist.assess.model import error_model
from bayesdist.assess.requirements.margins import validity_period
from bayesdist.infer import Solution
from bayesdist.model import Chip, DistortionModel, TimeDependence
from tests.benchmarks.timing import best, say
from tests.budgets import detector_budget

__all__ = ["FULL", "QUICK", "Sizes", "run"]

YEARS = (2002.0, 2020.0)
STATISTICS = ("rms", "p95", "max")
SIGMA = 1e-3  # of a coefficient, in pixels


@dataclass(frozen=True)
class Sizes:
    """What is run: two chips, each with the grid."""

    grid: tuple[int, int]
    epochs: int
    draws: int


FULL = Sizes(grid=(65, 33), epochs=40, draws=1000)
QUICK = Sizes(grid=(9, 5), epochs=3, draws=50)


@dataclass(frozen=True, eq=False)
class _Gaussian(Solution):
    """A solution of independent coefficients."""

    model: DistortionModel
    mean: np.ndarray

    def draws(self, n: int, rng: np.random.Generator) -> np.ndarray:
        return self.mean + SIGMA * rng.standard_normal((n, self.mean.size))


def _solution() -> _Gaussian:
    """Two chips of order 5, four terms that drift, one break."""
    size, centre = (4096.0, 2048.0), (2048.0, 1024.0)
    terms = (("u", 1, 0), ("u", 0, 1), ("v", 1, 0), ("v", 0, 1))
    time = TimeDependence(terms, (2004.5, 2012.5), (2009.4,))
    chips = tuple(Chip(k, f"WFC{k}", size, centre) for k in (1, 2))
    model = DistortionModel(5, chips, time=time)
    return _Gaussian(model, np.zeros(model.n_params))


def run(sizes: Sizes) -> dict[str, Any]:
    """Seconds of the budget at all epochs, and of each statistic of all draws at all epochs.

    Parameters
    ----------
    sizes : Sizes

    Returns
    -------
    dict
    """
    solution, epochs = _solution(), np.linspace(*YEARS, sizes.epochs)
    what = {
        "terms": (
            UserTerm("reference catalogue", "systematic", 0.02, 0.02, "pix"),
            UserTerm("centroid", "random", 0.01, 0.01, "pix"),
        ),
        "grid": sizes.grid,
        "n_draws": sizes.draws,
    }

    def budgets() -> None:
        for epoch in epochs:
            detector_budget(solution, epoch=epoch, rng=np.random.default_rng(1), **what)

    def followed(statistic: str) -> None:
        model = error_model(solution, terms=what["terms"])
        errors = model.drawn(sizes.draws, np.random.default_rng(1))
        asked = Requirement("r", statistic, 0.1, "pix", probability=0.95)
        validity_period(errors, asked, epochs, grid=sizes.grid)

    rows = [{"what": "budget by term", "seconds": best(budgets, 2)}]
    for name in STATISTICS:
        say(f"budget: {name}")
        seconds = best(lambda name=name: followed(name), 2)
        rows.append({"what": f"{name} of every draw", "seconds": seconds})
    return {
        "grid": list(sizes.grid),
        "chips": len(solution.model.chips),
        "epochs": sizes.epochs,
        "draws": sizes.draws,
        "rows": rows,
    }
