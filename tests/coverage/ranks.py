"""Ranks of the truth among what a whole run claims, the truth drawn from the priors.

Jitter, share and scatter of false matches, higher orders, field and its length are drawn from their
priors, the polynomial from anywhere, as its prior is flat; of exposures, too, the scatter of scale
and shears, the second-order terms and the smooth fields that each has by itself.  If draws of the
error are what the data leave open, the actual error has an even rank among them (Talts et al. 2018,
arXiv:1804.06788).  Errors that are right one by one may be wrong together, and then the likelihood
of the data has uneven ranks (Modrak et al. 2023, arXiv:2211.02383): it is among the quantities, and
so are the amplitudes of what is left out.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.stats import t as student_t

from bayesdist.app.evaluating import drawn_errors_of_run, margins_of_run
from bayesdist.app.run import Run
from bayesdist.assess import Requirement
from bayesdist.assess.domain import EvaluationDomain, field_statistic
from bayesdist.diagnose.correlated import Discrepancy, DiscrepancyPriors
from bayesdist.diagnose.correlated.exposure_fields import ExposureFields
from bayesdist.diagnose.correlated.neighbours import LENGTHS as LENGTHS_OF
from bayesdist.diagnose.correlated.priors import STRUCTURE_DOF, StructureFunctions
from bayesdist.diagnose.correlated.structure import LENGTHS, UNLIKE
from bayesdist.infer import OutlierMixture
from bayesdist.model import Chip
from bayesdist.model.grid import grid_pixels, mesh
from tests.adversarial import fields
from tests.adversarial.exposure_kinds import deviating, in_frames, pointings
from tests.adversarial.measure import GRID, assessed
from tests.adversarial.truth import SIGMA, Frame, Truth, mapped, order_config, pixels
from tests.infer.support import draw_prior

from .places import one_thread

ORDER, STARS = 3, 1500
MOST = SIGMA  # the prior of amplitudes ends at the error of a star
STATISTICS = ("rms", "p95", "max")
FEW = 400  # draws of the likelihood
MOST_SCATTER = 100.0  # in units of its prior median: scatters beyond are not looked for
# what exposures have by themselves
SCATTER, SECOND_ORDER, FIELDS = ("scatter of exposures", "second order", "fields of exposures")
# grids of sizes begin at a fraction of the prior's median: smaller ones move no position
ALIKE = 0.5
MEDIANS = {
    "higher orders": DiscrepancyPriors.higher_order,
    "field": DiscrepancyPriors.structure,
    SCATTER: DiscrepancyPriors.exposure,
    SECOND_ORDER: DiscrepancyPriors.higher_order,
    FIELDS: DiscrepancyPriors.structure,
}
ALL = slice(None)
AT = [(k, k) for k in (0, 4, 8, 12, 16)]  # of the grid: a corner, the middle, the other corner
EXACT = {
    "name": "reference catalogue",
    "kind": "systematic",
    "sigma_u": 0.0,
    "sigma_v": 0.0,
    "source": "exact in the simulation",
}


def half_t(
    rng: np.random.Generator, median: float, most: float, dof: float = STRUCTURE_DOF
) -> float:
    scale = median / student_t(dof).ppf(0.75)
    while (value := scale * abs(rng.standard_t(dof))) > most:
        pass
    return float(value)


@dataclass(frozen=True, eq=False)
class DrawnStructure:
    """What the model leaves out, and its parts.

    Parameters
    ----------
    functions : StructureFunctions
    waves : ndarray
        Of what is finer than the functions.
    coefficients : ndarray, shape (..., 2, m)
        Of terms, sines and finer waves, along u and v.
    """

    functions: StructureFunctions
    waves: np.ndarray
    coefficients: np.ndarray

    @classmethod
    def of_run(cls, kept: Discrepancy) -> DrawnStructure:
        """All draws of a run with one chip."""
        (chip,) = kept.structure.values()
        return cls(chip.functions, chip.waves, np.asarray(chip.coefficients, float))

    def values(self, x: np.ndarray, y: np.ndarray, draws: slice = ALL) -> np.ndarray:
        """Displacements (..., N, 2) at pixels (N,)."""
        along = self.coefficients[draws] if self.coefficients.ndim > 2 else self.coefficients
        return np.swapaxes(along @ self._at(x, y).T, -1, -2)

    def amplitudes(self) -> dict[str, np.ndarray]:
        """Rms (...) over the detector of the higher orders and of the field, both axes together."""
        here, terms = self._at(*fields.even_pixels(12)), self.functions.n_terms
        parts = {"higher orders": slice(0, terms), "field": slice(terms, None)}
        return {
            name: np.sqrt(np.mean((self.coefficients[..., p] @ here[:, p].T) ** 2, axis=(-1, -2)))
            for name, p in parts.items()
        }

    def _at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        X, Y = fields.scaled(x), fields.scaled(y)
        every = [self.functions.evaluate(X, Y), self.functions.evaluate_finer(self.waves, X, Y)]
        return np.concatenate(every, axis=1)


def structure(rng: np.random.Generator) -> DrawnStructure:
    """What the model leaves out, from its prior."""
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
    return DrawnStructure(functions, waves, np.array(coefficients))


@dataclass(frozen=True, eq=False)
class Drawn:
    """A truth from the priors, part by part.

    Parameters
    ----------
    truth : Truth
    polynomial : callable
        Beneath all that is left out.
    left_out : DrawnStructure
    hyper : dict of str to float
        f, j and s_out.
    sizes : dict of str to float
        Of what exposures have by themselves: scale and shears, second order, field; empty of one
        exposure.
    """

    truth: Truth
    polynomial: fields.Field
    left_out: DrawnStructure
    hyper: dict[str, float]
    sizes: dict[str, float] = field(default_factory=dict)


def of_exposures(rng: np.random.Generator) -> dict[str, float]:
    """Sizes of what exposures have by themselves, from their priors."""
    priors = DiscrepancyPriors()
    return {
        SCATTER: half_t(rng, priors.exposure, MOST_SCATTER * priors.exposure, dof=1.0),
        SECOND_ORDER: half_t(rng, priors.higher_order, MOST),
        FIELDS: half_t(rng, priors.structure, MOST),
    }


def deviating_exposures(
    rng: np.random.Generator,
    uv: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    code: np.ndarray,
    sizes: dict[str, float],
) -> np.ndarray:
    """Positions (N, 2) as exposures deviate from one another, by code (N,)."""
    n = int(code.max()) + 1
    out = deviating(uv, sizes[SCATTER] * rng.standard_normal((n, 3))[code])
    second, amplitude, length = (
        np.full(n, size) for size in (sizes[SECOND_ORDER], sizes[FIELDS], rng.choice(LENGTHS_OF))
    )
    beyond = ExposureFields(np.empty((n, 0)), second, amplitude, length, n)
    chip = Chip(1, "", (fields.SIDE, fields.SIDE), (fields.MIDDLE, fields.MIDDLE))
    waves = beyond.functions(chip).finer_waves(rng)
    coefficients = beyond.coefficients(chip, rng)
    here = beyond.evaluate(chip, waves, fields.scaled(x), fields.scaled(y))
    return out + np.einsum("nam,nm->na", coefficients[code], here)


def from_priors(seed: int, exposures: int = 1) -> Drawn:
    """Matched stars of one exposure, or of several that point somewhere else each."""
    rng = np.random.default_rng([31, seed] if exposures == 1 else [33, seed])
    polynomial, left_out = fields.distortion(rng, ORDER), structure(rng)
    true_map = mapped(polynomial, left_out.values)
    hyper = OutlierMixture("gaussian").bind(SIGMA)
    drawn = {k: float(v[0]) for k, v in hyper.values(draw_prior(hyper, 1, rng)).items()}
    x, y = pixels(rng, STARS)
    uv, false = true_map(x, y, None), rng.uniform(size=STARS) < drawn["f"]
    sizes, frames, config, columns = {}, {}, order_config(ORDER), {}
    if exposures > 1:
        sizes = of_exposures(rng)
        frames, code = pointings(rng, exposures), np.arange(STARS) % exposures
        frames["e00"] = Frame((0.0, 0.0), 0.0)  # the polynomials are along its axes
        uv = deviating_exposures(rng, uv, x, y, code, sizes)
        uv = in_frames(uv, code, frames)
        columns["exposure"] = np.array(list(frames))[code]
        config = order_config(ORDER, frames="shift_rotation")
    core = np.hypot(SIGMA, drawn["j"])
    uv += np.where(false, drawn["s_out"], core)[:, None] * rng.standard_normal((STARS, 2))
    quoted = np.full(STARS, SIGMA)
    stars = {"x": x, "y": y, "u": uv[:, 0], "v": uv[:, 1], "sigma_u": quoted, "sigma_v": quoted}
    config["budget"] = [EXACT | {"unit": "pix"}]
    truth = Truth(stars | columns, true_map, config, frames=frames)
    return Drawn(truth, polynomial, left_out, drawn, sizes)


def log_likelihood(residual: np.ndarray, f: Any, j: Any, s_out: Any) -> np.ndarray:
    """Of residuals (..., N, 2) whose quoted errors are `SIGMA`, as written in docs/method.md."""
    square = np.sum(residual**2, axis=-1)
    core, out = (np.asarray(a)[..., None] for a in (SIGMA**2 + np.square(j), np.square(s_out)))
    f = np.asarray(f)[..., None]
    inner = np.log1p(-f) - np.log(2 * np.pi * core) - square / (2 * core)
    outer = np.log(f) - np.log(2 * np.pi * out) - square / (2 * out)
    return np.logaddexp(inner, outer).sum(axis=-1)


def ranks(seed: int, exposures: int = 1) -> dict[str, float]:
    """Fractions of the draws that are below the truth, by name."""
    drawn = from_priors(seed, exposures)
    with (
        one_thread(),
        TemporaryDirectory() as folder,
        closing(assessed(drawn.truth, Path(folder), seed)) as results,
    ):
        out = _of_coefficients(results, drawn, seed) | _of_positions(results, drawn)
        kept = results.diagnostics.correlated
        said = DrawnStructure.of_run(kept).amplitudes()
        if drawn.sizes:
            said |= {
                SCATTER: kept.linear.scatter["shape"],
                SECOND_ORDER: kept.fields.second_order,
                FIELDS: kept.fields.amplitude,
            }
        true, rng = drawn.left_out.amplitudes() | drawn.sizes, np.random.default_rng([34, seed])
        return out | {
            name: rank_of_size(draws, true[name], ALIKE * MEDIANS[name], rng)
            for name, draws in said.items()
        }


def rank_of_size(draws: np.ndarray, true: float, floor: float, rng: np.random.Generator) -> float:
    """Fraction of draws that are below the truth; all sizes up to a floor are alike.

    Among its equals the truth has a random rank.
    """
    draws, true = np.maximum(draws, floor), max(float(true), floor)
    return float(np.mean(draws < true) + rng.uniform() * np.mean(draws == true))


def rank(draws: np.ndarray, true: Any) -> float:
    """Fraction of draws that are below the truth."""
    return float(np.mean(draws < true))


def _of_coefficients(results: Run, drawn: Drawn, seed: int) -> dict[str, float]:
    """Ranks of the coefficients and, of one exposure, of the mixture and the likelihood."""
    model = results.solution.model
    basis, points = model.basis(), fields.even_pixels(24)
    at = np.stack(points, axis=1) - fields.MIDDLE + drawn.polynomial(*points)
    true = np.linalg.lstsq(basis.evaluate(*points), at, rcond=None)[0].T
    kept, own = results.diagnostics.correlated, results.error_model.solution.solution
    n, rng = results.evaluation_settings.draws, np.random.default_rng([32, seed])
    flat, rows = own.drawn_rows(n, rng)
    which = np.arange(n) % kept.n_draws
    theta = flat[rows] + kept.structure_theta[which]
    for term in (kept.linear, kept.fields) if drawn.sizes else ():
        theta = theta + term.theta[rng.integers(len(term.theta), size=n)]
    slices = [model.coefficient_slice(1, axis) for axis in (0, 1)]
    out = {}
    for axis, part in enumerate(slices):
        for name, draws, actual in zip(
            model.names[part], theta[:, part].T, true[axis], strict=True
        ):
            out[name] = rank(draws, actual)
    if drawn.sizes:
        return out
    hyper = {name: values.ravel()[rows] for name, values in own.hyper.items()}
    out |= {name: rank(draws, drawn.hyper[name]) for name, draws in hyper.items()}
    stars, some = drawn.truth.stars, slice(0, FEW)
    x, y = stars["x"], stars["y"]
    seen = np.column_stack([stars["u"], stars["v"]])
    design = basis.evaluate(x, y)
    fitted = np.stack([theta[some, part] @ design.T for part in slices], axis=-1)
    residual = seen - fitted - DrawnStructure.of_run(kept).values(x, y, some)
    said = log_likelihood(residual, *(hyper[name][some] for name in ("f", "j", "s_out")))
    actual = log_likelihood(seen - drawn.truth.true_map(x, y, None), **drawn.hyper)
    return out | {"log-likelihood": rank(said, actual)}


def _of_positions(results: Run, drawn: Drawn) -> dict[str, float]:
    """Ranks of errors of positions, and of their statistics over the field."""
    model, mean = results.solution.model, np.asarray(results.solution.mean)
    errors = drawn_errors_of_run(results)
    n, true_map = errors.n_draws, drawn.truth.true_map
    x, y = mesh(*grid_pixels(model.chips[0].size, GRID))
    error = true_map(x, y, None) - model.predict(mean, x, y)
    out = {}
    said = errors.errors(EvaluationDomain.of_chips(model, GRID))(slice(0, n), np.zeros(1))
    for i, j in AT:
        k = j * GRID[0] + i
        for axis, name in enumerate("uv"):
            out[f"{name} at {i}, {j}"] = rank(said[:, k, axis], error[k, axis])
    asked = tuple(Requirement(s, s, 1.0) for s in STATISTICS)
    for margin in margins_of_run(results, asked):
        name = margin.requirement.statistic
        out[name] = rank(margin.draws, field_statistic(name, error))
    return out
