"""Ranks of the truth among what a whole run claims, the truth drawn from the priors.

Jitter, share and scatter of false matches, higher orders, field and its length are drawn from their
priors, the polynomial from anywhere, as its prior is flat.  If draws of the error are what the data
leave open, the actual error has an even rank among them (Talts et al. 2018, arXiv:1804.06788).
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.stats import t as student_t

from bayesdist.app.results import errors_of, margins_of
from bayesdist.assess import Requirement
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.statistics import field_statistic
from bayesdist.diagnose.correlated import DiscrepancyPriors
from bayesdist.diagnose.correlated.functions import StructureFunctions
from bayesdist.diagnose.correlated.priors import STRUCTURE_DOF
from bayesdist.diagnose.correlated.structure import LENGTHS, UNLIKE
from bayesdist.infer import OutlierMixture
from bayesdist.model.grid import grid_pixels, mesh
from tests.adversarial import fields
from tests.adversarial.measure import GRID, assessed
from tests.adversarial.truth import SIGMA, Truth, mapped, order_config, pixels
from tests.infer.support import draw_prior

from .places import one_thread

ORDER, STARS = 3, 1500
MOST = SIGMA  # the prior of amplitudes ends at the error of a star
STATISTICS = ("rms", "p95", "max")
AT = [(k, k) for k in (0, 4, 8, 12, 16)]  # of the grid: a corner, the middle, the other corner
EXACT = {
    "name": "reference catalogue",
    "kind": "systematic",
    "sigma_u": 0.0,
    "sigma_v": 0.0,
    "source": "exact in the simulation",
}


def half_t(rng: np.random.Generator, median: float, most: float) -> float:
    scale = median / student_t(STRUCTURE_DOF).ppf(0.75)
    while (value := scale * abs(rng.standard_t(STRUCTURE_DOF))) > most:
        pass
    return float(value)


def structure(rng: np.random.Generator) -> fields.Field:
    """A field with the prior of what the model leaves out."""
    priors, size = DiscrepancyPriors(), float(fields.SIDE)
    functions = StructureFunctions.for_stars(ORDER, (size, size), STARS)
    length = float(rng.choice(LENGTHS))
    of_terms = half_t(rng, priors.higher_order, MOST)
    sizes = np.full(2, half_t(rng, priors.structure, MOST))
    if rng.uniform() < UNLIKE:
        # the rms of both is half-t, the logarithm of their ratio double exponential
        apart = np.exp(rng.laplace(size=1) * [0.5, -0.5])
        sizes *= apart / np.sqrt(np.mean(apart**2))
    waves = functions.finer_waves(rng)
    spread = np.sqrt(functions.spectrum(length))
    finer = np.sqrt(functions.finer_spectrum(length, waves))
    coefficients = [
        np.concatenate(
            [
                of_terms * functions.decline() * rng.standard_normal(functions.n_terms),
                a * spread * rng.standard_normal(functions.n_sines),
                a * np.tile(finer, 2) * rng.standard_normal(2 * len(waves)),
            ]
        )
        for a in sizes
    ]

    def field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        X, Y = fields.scaled(x).ravel(), fields.scaled(y).ravel()
        every = [functions.evaluate(X, Y), functions.evaluate_finer(waves, X, Y)]
        values = np.concatenate(every, axis=1) @ np.transpose(coefficients)
        return values.reshape(*np.shape(x), 2)

    return field


def from_priors(seed: int) -> tuple[Truth, fields.Field]:
    """Matched stars, and the polynomial beneath them."""
    rng = np.random.default_rng([31, seed])
    polynomial = fields.distortion(rng, ORDER)
    true_map = mapped(polynomial, structure(rng))
    hyper = OutlierMixture("gaussian").bind(SIGMA)
    drawn = {k: float(v[0]) for k, v in hyper.values(draw_prior(hyper, 1, rng)).items()}
    x, y = pixels(rng, STARS)
    uv, false = true_map(x, y, None), rng.uniform(size=STARS) < drawn["f"]
    core = np.hypot(SIGMA, drawn["j"])
    uv += np.where(false, drawn["s_out"], core)[:, None] * rng.standard_normal((STARS, 2))
    quoted = np.full(STARS, SIGMA)
    stars = {"x": x, "y": y, "u": uv[:, 0], "v": uv[:, 1], "sigma_u": quoted, "sigma_v": quoted}
    config = order_config(ORDER) | {"budget": [EXACT | {"unit": "pix"}]}
    return Truth(stars, true_map, config), polynomial


def ranks(seed: int) -> dict[str, float]:
    """Fractions of the draws that are below the truth, by name."""
    truth, polynomial = from_priors(seed)
    with (
        one_thread(),
        TemporaryDirectory() as folder,
        closing(assessed(truth, Path(folder), seed)) as results,
    ):
        model, mean = results.solution.model, np.asarray(results.solution.mean)
        basis, points = model.basis(), fields.even_pixels(24)
        at = np.stack(points, axis=1) - fields.MIDDLE + polynomial(*points)
        true = np.linalg.lstsq(basis.evaluate(*points), at, rcond=None)[0].T.ravel()
        errors, kept = errors_of(results), results.diagnostics.correlated
        n, rng = errors.n_draws, np.random.default_rng([32, seed])
        with_structure = kept.structure_theta[np.arange(n) % kept.n_draws]
        coefficients = results.errors.solution.solution.draws(n, rng) - mean + with_structure
        found = {
            name: float(np.mean(draws < actual))
            for name, draws, actual in zip(model.names, coefficients.T, true - mean, strict=True)
        }
        x, y = mesh(*grid_pixels(model.chips[0].size, GRID))
        error = truth.true_map(x, y, None) - model.predict(mean, x, y)
        drawn = errors.errors(EvaluationDomain.of_chips(model, GRID))(slice(0, n), np.zeros(1))
        for i, j in AT:
            k = j * GRID[0] + i
            for axis, name in enumerate("uv"):
                found[f"{name} at {i}, {j}"] = float(np.mean(drawn[:, k, axis] < error[k, axis]))
        asked = tuple(Requirement(s, s, 1.0) for s in STATISTICS)
        for margin in margins_of(results, asked):
            name = margin.requirement.statistic
            found[name] = float(np.mean(margin.draws < field_statistic(name, error)))
    return found
