"""Stand-ins for solutions: all that assess/ asks of a fit or a posterior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from bayesdist.infer import Solution
from bayesdist.model import Chip, DistortionModel, TimeDependence


@dataclass(frozen=True, eq=False)
class StandIn(Solution):
    """A Gaussian solution of given mean and covariance."""

    model: DistortionModel
    mean: np.ndarray
    cov: np.ndarray

    def draws(self, n: int, rng: np.random.Generator) -> np.ndarray:
        values, vectors = np.linalg.eigh(self.cov)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return self.mean + rng.normal(size=(n, self.mean.size)) @ root.T


@dataclass(frozen=True)
class StandInConvergence:
    converged: bool = True
    reasons: tuple[str, ...] = ()
    ess_bulk_min: float = 1e6
    ess_tail_min: float = 1e6


@dataclass(frozen=True, eq=False)
class StandInPosterior(StandIn):
    convergence: StandInConvergence = StandInConvergence()


@pytest.fixture(scope="session")
def solution_of() -> Callable[..., Any]:
    """Maker of solutions: model, mean, cov (zero by default), fields of a convergence."""

    def make(model, mean=None, cov=None, **convergence):
        mean = np.zeros(model.n_params) if mean is None else np.asarray(mean, float)
        cov = np.zeros((mean.size, mean.size)) if cov is None else np.asarray(cov, float)
        if convergence:
            return StandInPosterior(model, mean, cov, StandInConvergence(**convergence))
        return StandIn(model, mean, cov)

    return make


@pytest.fixture(scope="session")
def from_monomials(solution_of) -> Callable[..., Any]:
    """Maker of a solution of one chip from monomial coefficients {(i, j): value} of u and of v."""

    def make(u, v, *, order, size, reference_pixel, unit="pix", cov=None):
        model = DistortionModel(order, (Chip(1, "A", size, reference_pixel),), unit=unit)
        basis = model.basis()
        coef = [basis.from_monomials([c.get(t, 0.0) for t in basis.terms]) for c in (u, v)]
        return solution_of(model, np.concatenate(coef), cov)

    return make


@pytest.fixture
def rich(solution_of):
    """Everything at once: two chips, drift with a break, turned exposures, correlations."""
    chips = (
        Chip(1, "WFC1", (4096.0, 2048.0), (2048.0, 1024.0)),
        Chip(2, "WFC2", (4096.0, 2048.0), (2100.0, 900.0)),
    )
    model = DistortionModel(
        order=3,
        chips=chips,
        time=TimeDependence((("u", 1, 0), ("v", 1, 1)), (2004.5, 2012.5), (2009.4,)),
        frames="shift_rotation_scale",
        exposures=("a", "b", "c", "d"),
        origin=(10.0, -20.0),
    )
    rng = np.random.default_rng(7)
    mean = 1e-2 * rng.normal(size=model.n_params)
    for number in (1, 2):
        basis = model.basis(number)
        mean[model.coefficient_slice(number, 0)][basis.terms.index((1, 0))] = 2048.0
        mean[model.coefficient_slice(number, 1)][basis.terms.index((0, 1))] = 1024.0
    for code, angle in ((1, 0.4), (2, np.pi / 2), (3, -2.0)):
        mean[model.frame_slice(code)] = 3.0, -5.0, 0.0, angle
    # small errors of each parameter in its own size: angles act over thousands of pixels
    size = np.array(
        [1e-6 if name.endswith((".scale", ".rotation")) else 1e-3 for name in model.names]
    )
    a = rng.normal(size=(model.n_params, model.n_params))
    cov = size[:, None] * (a @ a.T / model.n_params) * size
    return solution_of(model, mean, cov)
