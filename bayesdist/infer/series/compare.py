"""Choice of the course of a series, by predictive densities of held-out exposures.

A difference counts where it is at least 4 and at least as many of its standard errors as Student's
t needs for 95 %: below 4 standard errors are too small themselves (Sivula et al. 2020).  Where the
exposures are correlated in time, whole blocks of them are held out: an exposure's neighbours would
predict it, and an irregular drift would pass for a line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray
from scipy.stats import t as student_t

from bayesdist.errors import InputError
from bayesdist.infer.series.breaks import BreakMoves
from bayesdist.infer.series.course import KINDS, Course
from bayesdist.infer.series.design import Design
from bayesdist.infer.series.fit import fit_series
from bayesdist.infer.series.heldout import LOTS, HeldOut, block_folds, exposure_folds, held_out
from bayesdist.infer.series.posterior import SeriesPosterior
from bayesdist.infer.series.problem import WIDE, Problem, normal_equations
from bayesdist.infer.series.series import Series
from bayesdist.infer.series.small import cholesky, precision_of

__all__ = ["Comparison", "compare", "serial_correlation"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

LEAST_DIFFERENCE = 4.0
CONFIDENCE = 0.95
# lag-1 correlation, in its standard errors, from which exposures count as correlated
SERIAL = 2.33
LEAST_BLOCKS, CORRELATION_LENGTHS = 6, 3


@dataclass(frozen=True, eq=False)
class Comparison:
    """Courses of one series, with their predictions of held-out exposures.

    Parameters
    ----------
    courses : tuple of Course
        The simplest first.
    posteriors : tuple of SeriesPosterior
    scores : tuple of HeldOut
    scheme : str
        How they were held out: 'exposures', 'each', 'blocks', or 'given'.
    correlation : float
        Lag-1 correlation of the residuals of the course that leaves least.
    """

    courses: tuple[Course, ...]
    posteriors: tuple[SeriesPosterior, ...]
    scores: tuple[HeldOut, ...]
    scheme: str
    correlation: float

    @property
    def single(self) -> bool:
        """True if exposures count as independent of each other."""
        return self.scheme in ("exposures", "each")

    def difference(self, a: int, b: int) -> tuple[float, float]:
        """Score of course a minus that of course b, and its standard error."""
        each = self.scores[a].log_density - self.scores[b].log_density
        fold = self.scores[a].fold
        # where whole blocks are held out they are the independent items, else the exposures
        items = np.bincount(fold, each) if not self.single else each
        return float(each.sum()), float(np.sqrt(len(items)) * items.std(ddof=1))

    def beats(self, a: int, b: int) -> bool:
        """True if course a predicts significantly better than course b."""
        value, error = self.difference(a, b)
        n = len(self.scores[a].fold)
        n = n if self.single else len(np.unique(self.scores[a].fold))
        quantile = float(student_t.ppf((1 + CONFIDENCE) / 2, n - 1))
        return value >= LEAST_DIFFERENCE and value >= quantile * error

    @property
    def best(self) -> int:
        """Index of the course with the best score."""
        return int(np.argmax([s.total for s in self.scores]))

    @property
    def carried(self) -> int:
        """Index of the simplest course that beats the constant and that the best does not beat.

        The constant's index where nothing beats it.  A break that was found, and not given, has to
        predict held-out exposures better than drifts without one: a break can follow any drift.
        """
        constant = next(i for i, c in enumerate(self.courses) if c.kind == "constant")
        drifts = [s.total for c, s in zip(self.courses, self.scores, strict=True) if c.drifts]
        for i, course in enumerate(self.courses):
            if course.find and drifts and max(drifts) > self.scores[i].total:
                continue
            if self.beats(i, constant) and not self.beats(self.best, i):
                return i
        return constant

    def table(self) -> Table:
        """Table with one row for each course, the best first.

        Columns: course, score, its difference to the best with standard error, Monte-Carlo error,
        fraction of measurements in the 68 % and 95 % predictive intervals, and convergence of the
        posterior.
        """
        order = sorted(range(len(self.courses)), key=lambda i: -self.scores[i].total)
        gaps = [self.difference(i, self.best) for i in order]
        out = Table()
        out["course"] = [self.courses[i].name for i in order]
        out["score"] = [self.scores[i].total for i in order]
        out["difference"] = [g[0] for g in gaps]
        out["standard_error"] = [g[1] for g in gaps]
        out["mc_error"] = [self.scores[i].mc_error for i in order]
        for level in (68, 95):
            out[f"covered_{level}"] = [
                float(self.scores[i].covered(level / 100).mean()) for i in order
            ]
        out["converged"] = [self.posteriors[i].convergence.converged for i in order]
        out.meta["held_out"] = self.scheme
        out.meta["serial_correlation"] = self.correlation
        out.meta["carried"] = self.courses[self.carried].name
        return out


def compare(
    series: Series,
    candidates: Sequence[Course],
    *,
    folds: str | Int = "auto",
    seed: int = 1,
) -> Comparison:
    """Compare courses by their predictive densities of held-out exposures.

    Parameters
    ----------
    series : Series
    candidates : sequence of Course
        The constant is added, and to every course with breaks and slopes the one without slopes:
        without them a slope could not be distinguished from none.
    folds : str or ndarray of int, shape (E,)
        'exposures': in 30 groups, neighbours in different ones; 'each': one by one; 'blocks':
        successive ones together; 'auto': exposures, or blocks where the residuals of every course
        but the drifting ones are correlated in time; or codes of those to be held out together.
    seed : int

    Returns
    -------
    Comparison
        Without courses whose one break, at any date, gains less likelihood from the very exposures
        that it is fitted to than held-out ones would have to show.
    """
    courses, posteriors = _fitted(series, _completed(candidates), seed)
    found = [serial_correlation(p) for p in posteriors if p.course.kind not in ("spline", "wander")]
    correlation = min(found, key=abs)
    breaks = tuple(sorted({b for c in courses for b in c.breaks}))
    if isinstance(folds, str):
        if folds not in ("auto", "exposures", "each", "blocks"):
            raise InputError(
                f"folds is {folds!r}",
                where=series.source,
                do="choose auto, exposures, each or blocks",
            )
        scheme = folds
        if folds == "auto":
            serial = correlation * np.sqrt(len(series)) > SERIAL
            scheme = "blocks" if serial else "exposures"
        fold = _folds(series, scheme, breaks, correlation)
    else:
        scheme, fold = "given", np.unique(np.asarray(folds), return_inverse=True)[1]
        if len(fold) != len(series) or fold.max() < 1:
            raise InputError(
                f"{len(fold)} folds for {len(series)} exposures",
                where=series.source,
                do="give one for each exposure, at least two different",
            )
    scores = tuple(held_out(p, fold, seed=seed) for p in posteriors)
    return Comparison(courses, posteriors, scores, scheme, correlation)


def _fitted(
    series: Series, candidates: tuple[Course, ...], seed: int
) -> tuple[tuple[Course, ...], tuple[SeriesPosterior, ...]]:
    """Courses, and the posterior of each, without breaks that cannot be significant."""
    fitted = {c: fit_series(series, c, seed=seed) for c in candidates if c.find != 1}
    # no course of these can be beaten by a break that gains less over each
    plain = [p for c, p in fitted.items() if not (c.n_breaks or c.drifts)]
    for course in candidates:
        if course.find == 1 and max(_gain(course, p) for p in plain) >= LEAST_DIFFERENCE:
            fitted[course] = fit_series(series, course, seed=seed)
    courses = tuple(c for c in candidates if c in fitted)
    return courses, tuple(fitted[c] for c in courses)


def _gain(course: Course, plain: SeriesPosterior) -> float:
    """Gain in log likelihood of a break over a course without one, at the best date of all.

    With the scatter about the course without a break, or as much less as the chi-square is less,
    and exposures that lie off it counted little or in full, whichever gains most.
    """
    problem = plain.engine.problem
    design = Design(course, problem.series)
    moves = BreakMoves(design)
    dates = (moves.dates[:-1] + moves.width / 2)[:, None]
    broken = replace(problem, design=design).columns(dates[moves.possible(dates)])
    sigma = plain.raw.sigma.mean(axis=(0, 1))[..., None]
    precision = precision_of(cholesky(problem.formal + sigma))[:, :, None]
    lies_off = plain.outlier_probability
    gains = []
    for off in (np.zeros(len(lies_off)), lies_off):
        weight = precision / (1 - off + off * plain.raw.kappa2.mean())
        total = np.einsum("ie,ijce,je->", problem.y, weight, problem.y)
        none, best = (
            total - _explained(problem, weight, columns).max()
            for columns in (problem.columns(plain.raw.breaks[:1, 0]), broken)
        )
        freedom = problem.y.size
        gains += [0.5 * (none - best), 0.5 * freedom * np.log(none / best)]
    return float(max(gains))


def _explained(problem: Problem, precision: Float, columns: Float) -> Float:
    """Part of the chi-square that columns (M, E, p) explain, each with its best parameters."""
    matrix, right = normal_equations(precision, problem.y, columns[None])
    matrix = matrix + WIDE**-2 * np.eye(matrix.shape[-1])
    return (right * np.linalg.solve(matrix, right[..., None])[..., 0]).sum(axis=-1)[0]


def _completed(candidates: Sequence[Course]) -> tuple[Course, ...]:
    """Courses with those that a claim has to be compared with, the simplest first."""
    out = list(dict.fromkeys(candidates))
    groups = out[0].groups if out else "offsets"
    if not any(c.kind == "constant" for c in out):
        out.append(Course("constant", groups=groups))
    for c in tuple(out):
        flat = Course("step", c.breaks, c.find, groups=c.groups) if c.n_breaks else None
        if flat and not any((o.kind, o.breaks, o.find) == ("step", c.breaks, c.find) for o in out):
            out.append(flat)

    def cost(course: Course) -> tuple[int, int, int]:
        drifts = course.kind in ("spline", "wander")
        s = course.n_segments
        columns = {"line": 2, "step": s, "line+step": s + 1, "piecewise": s + 1, "lines": 2 * s}
        return (drifts, columns.get(course.kind, 1) + course.find, KINDS.index(course.kind))

    return tuple(sorted(out, key=cost))


def _folds(series: Series, scheme: str, breaks: tuple[float, ...], correlation: float) -> Int:
    n = len(series)
    if scheme != "blocks":
        return exposure_folds(series.epoch, n if scheme == "each" else LOTS)
    rho = float(np.clip(correlation, 0.0, 0.95))
    length = int(np.ceil(CORRELATION_LENGTHS * (1 + rho) / (1 - rho)))
    return block_folds(series.epoch, breaks, max(1, min(length, n // LEAST_BLOCKS)))


def serial_correlation(posterior: SeriesPosterior) -> float:
    """Correlation of the residuals of successive exposures, the mean over the coefficients.

    Exposures that lie off are weighted down by their probability.  Without correlation it scatters
    by at most 1 / sqrt(E).
    """
    series = posterior.series
    b = posterior.raw.b.mean(axis=(0, 1))
    if posterior.course.find:
        # the parameters belong to draws of the breaks: average the course, not its parameters
        sweeps = np.linspace(0, posterior.raw.b.shape[1] - 1, 20).astype(int)
        some = posterior.raw.b[:, sweeps].reshape(-1, *b.shape)
        dates = posterior.raw.breaks[:, sweeps].reshape(len(some), -1)
        columns = posterior.design.matrix(series.epoch, series.group_code, dates)
        fitted = (columns @ np.swapaxes(some, 1, 2)).mean(axis=0)
    else:
        columns = posterior.design.matrix(series.epoch, series.group_code)[0]
        fitted = columns @ b.T
    order = np.argsort(series.epoch, kind="stable")
    residual = ((series.values - series.centre) / series.spread - fitted)[order]
    residual = residual * (1 - posterior.outlier_probability[order])[:, None]
    residual = residual - residual.mean(axis=0)
    lagged = (residual[1:] * residual[:-1]).sum(axis=0)
    return float((lagged / (residual**2).sum(axis=0)).mean())
