"""Errors of positions in one campaign: what they are, and what the budget says of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.stats import norm

from bayesdist.app.evaluating import drawn_errors_of_run
from bayesdist.assess.budget import TOTAL, place_budget
from bayesdist.assess.budget_surface import JOINT as MODEL
from bayesdist.assess.domain import EvaluationDomain
from bayesdist.assess.drawn import DrawnErrors
from bayesdist.assess.terms.correlated import STRUCTURE_IN_FIT
from bayesdist.assess.terms.functions import PolynomialField
from bayesdist.assess.terms.given import CENTROID
from bayesdist.assess.terms.parameters import COEFFICIENTS, TIME_DEPENDENCE
from bayesdist.diagnose.correlated import Discrepancy
from bayesdist.infer import kernel
from bayesdist.model import DistortionModel

from .campaigns import (
    BEYOND,
    BRIGHT,
    EXPOSURES,
    FAINT,
    JITTER,
    KINDS,
    LAST,
    OFFSET,
    SIDE,
    Campaign,
    assessed,
    campaign,
    centroid_sigma,
)

LEVELS = (0.683, 0.954)
LIMITS = [float(norm.ppf(0.5 + level / 2)) for level in LEVELS]  # standard deviations
PLACES, DATES = 50, 10  # so many places at each date and of each magnitude
EVEN = 160  # points on each axis, over which a pattern is fitted
PLACE_TOTAL = "total of a place"  # without a star there


@contextmanager
def one_thread() -> Iterator[None]:
    before = kernel.get_threads()
    kernel.set_threads(1)
    yield
    kernel.set_threads(before)


def model_errors(
    truth: Campaign, model: DistortionModel, mean: np.ndarray, x, y, epoch, exposure
) -> dict[str, np.ndarray]:
    """Predicted minus true positions (N, 2) along the axes of the polynomials, and their parts."""

    def without_drift(of: DistortionModel, theta: np.ndarray) -> np.ndarray:
        still = theta.copy()
        still[of.tdd_slice(1)] = 0.0
        return of.predict(still, x, y, epoch=epoch)

    pairs = ((model, mean), (truth.model, truth.theta))
    still = np.subtract(*(without_drift(*pair) for pair in pairs))
    whole = np.subtract(*(of.predict(theta, x, y, epoch=epoch) for of, theta in pairs))
    seen = np.subtract(
        *(of.predict(theta, x, y, epoch=epoch, exposure=exposure) for of, theta in pairs)
    )
    turns = np.stack([truth.model.frame(truth.theta, int(e))[0] for e in exposure])
    along = np.linalg.solve(turns, seen[..., None])[..., 0]
    return {COEFFICIENTS: still, TIME_DEPENDENCE: whole - still, MODEL: along}


def covered(name: str, seed: int) -> dict[str, dict[str, np.ndarray]]:
    """For each term at 50 random places: its error in units of what is said, and what is expected.

    Returns
    -------
    dict
        By term: 'pull' (50, 2); 'inside' (levels,), how many of the 100 errors are within the
        level's interval; 'expected' (levels, draws), how many are in each draw of the claimed
        errors, with their correlation between places.
    """
    kind = KINDS[name]
    with TemporaryDirectory() as folder, one_thread():
        truth = campaign(kind, seed)
        with closing(assessed(kind, seed, truth.stars, Path(folder))) as results:
            solution, errors = results.solution, drawn_errors_of_run(results)
            discrepancy = results.diagnostics.correlated
        rng = truth.rng
        x, y = rng.uniform(0.5, SIDE + 0.5, (2, PLACES))
        mag = np.repeat(rng.uniform(BRIGHT, FAINT, DATES), PLACES // DATES)
        epoch = None
        if kind.drift:
            epoch = np.repeat(rng.uniform(LAST, BEYOND, DATES), PLACES // DATES)
        exposure = np.full(PLACES, rng.integers(1, EXPOSURES) if kind.drift else 0)
        of_star = rng.standard_normal((PLACES, 2)) * np.hypot(centroid_sigma(mag), JITTER)[:, None]
        offset = OFFSET * rng.standard_normal(2)
        true = model_errors(truth, solution.model, np.asarray(solution.mean), x, y, epoch, exposure)
        pattern = truth.pattern(x, y)
        # what a polynomial could follow of the pattern belongs to the coefficients
        true[COEFFICIENTS] = true[COEFFICIENTS] - _followed(truth, x, y)
        true[CENTROID] = of_star
        true[PLACE_TOTAL] = true.pop(MODEL) - pattern + offset
        true[TOTAL] = true[PLACE_TOTAL] + of_star
        said = _said(errors, x, y, epoch, mag)
        drawn = _drawn(errors, discrepancy, x, y, epoch, said, rng)
        out = {}
        for term in said.keys() & true.keys():
            pull = true[term] / said[term]
            out[term] = {
                "pull": pull,
                "inside": np.array([(np.abs(pull) < z).sum() for z in LIMITS]),
                "expected": np.array([(np.abs(drawn[term]) < z).sum(axis=(1, 2)) for z in LIMITS]),
            }
        return out


def _followed(truth: Campaign, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The polynomial (N, 2) that is next to the pattern over the whole detector."""
    basis = truth.model.basis(1)
    line = (np.arange(EVEN) + 0.5) * SIDE / EVEN + 0.5
    at = [a.ravel() for a in np.meshgrid(line, line)]
    fitted = np.linalg.lstsq(basis.evaluate(*at), truth.pattern(*at), rcond=None)[0]
    return basis.evaluate(x, y) @ fitted


def _together(n: int) -> list[slice]:
    """Places of one date."""
    step = PLACES // DATES
    return [slice(k, k + step) for k in range(0, n, step)]


def _said(errors: DrawnErrors, x, y, epoch, mag) -> dict[str, np.ndarray]:
    """Standard deviations (N, 2) by term."""
    out: dict[str, list] = {}
    for rows in _together(x.size):
        when = None if epoch is None else float(epoch[rows][0])
        place = {"chip": 1, "epoch": when, "magnitude": float(mag[rows][0])}
        for one in place_budget(errors, x[rows], y[rows], **place).every:
            out.setdefault(one.name, []).append(np.column_stack([one.u, one.v]))
    said = {name: np.concatenate(parts) for name, parts in out.items()}
    said[PLACE_TOTAL] = np.sqrt(said[TOTAL] ** 2 - said[CENTROID] ** 2)
    # the coefficients err by the noise of the stars, and by what drew the fit towards itself
    said[COEFFICIENTS] = np.hypot(said[COEFFICIENTS], said.pop(STRUCTURE_IN_FIT))
    # a term that is nothing on an axis covers nothing
    return {name: np.maximum(rows, np.finfo(float).tiny) for name, rows in said.items()}


def _drawn(
    errors: DrawnErrors,
    discrepancy: Discrepancy,
    x,
    y,
    epoch,
    said: dict[str, np.ndarray],
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Draws (n, N, 2) of the claimed errors, in units of what is said of each."""
    parts: dict[str, list] = {}
    for rows in _together(x.size):
        when = None if epoch is None else float(epoch[rows][0])
        domain = EvaluationDomain.at_pixels(errors.solution.model, 1, x[rows], y[rows], epoch=when)
        every = slice(0, errors.n_draws)
        joint = 0.0
        for field in errors.at(domain):
            for part in field.parts:
                if isinstance(part, PolynomialField):
                    parts.setdefault(part.rows[0].name, []).append(part.errors(every, {}))
            for one in field.summed:
                if isinstance(one, PolynomialField):
                    joint = joint + one.errors(every, {})
        parts.setdefault(MODEL, []).append(joint)
    out = {part: np.concatenate(found, axis=1) for part, found in parts.items()}
    out[COEFFICIENTS] = out[COEFFICIENTS] + out.pop(STRUCTURE_IN_FIT)
    shape = out[MODEL].shape
    found = discrepancy.structure[1]
    functions = found.evaluate(*discrepancy.model.basis(1).scaled(x, y))
    left = np.swapaxes(found.coefficients @ functions.T, 1, 2)
    assert len(left) == shape[0]  # draws of the structure belong to those of the fit's error
    out[CENTROID] = rng.standard_normal(shape) * said[CENTROID]
    offset = OFFSET * rng.standard_normal((shape[0], 1, 2))
    out[PLACE_TOTAL] = out.pop(MODEL) + left + offset
    out[TOTAL] = out[PLACE_TOTAL] + out[CENTROID]
    return {name: rows / said[name] for name, rows in out.items() if name in said}
