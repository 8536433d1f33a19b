"""Choice of the trend of a series, by predictive densities of held-out exposures.

A difference counts where it is at least 4 and at least as many of its standard errors as Student's
t needs for 95 %: below 4 standard errors are too small themselves (Sivula et al. 2020).  Where the
exposures are correlated in time, whole blocks of them are held out: an exposure's neighbours would
predict it, and an irregular drift would pass for a line.

Filters (ACS ISR 2015-06, section 4.4.4) are compared by common slopes with an offset for each,
against slopes of their own: each further filter's slope differs from that of the first by one
amount in all segments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from astropy.table import Table

from bayesdist.errors import InputError
from bayesdist.infer.kernel import precisions
from bayesdist.infer.series.breaks import BreakMoves
from bayesdist.infer.series.design import Design
from bayesdist.infer.series.fit import fit_series
from bayesdist.infer.series.heldout import HeldOut, block_folds, exposure_folds, held_out
from bayesdist.infer.series.posterior import Change, SeriesPosterior
from bayesdist.infer.series.problem import WIDE, Problem, normal_equations
from bayesdist.infer.series.series import Series
from bayesdist.infer.series.trend import KINDS, TrendModel
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import t_ppf

MIN_DIFFERENCE = 4.0
CONFIDENCE = 0.95
# lag-1 correlation, in its standard errors, from which exposures count as correlated
MIN_SERIAL_CORRELATION = 2.33
MIN_BLOCKS, CORRELATION_LENGTHS = 6, 3


@dataclass(frozen=True, eq=False)
class Comparison:
    """Trends of one series, with their predictions of held-out exposures.

    Parameters
    ----------
    trends : tuple of TrendModel
        The simplest first.
    posteriors : tuple of SeriesPosterior
    scores : tuple of HeldOut
    scheme : str
        How they were held out: 'exposures' by themselves, or whole 'blocks'.
    correlation : float
        Lag-1 correlation of the residuals of the trend that leaves least.
    """

    trends: tuple[TrendModel, ...]
    posteriors: tuple[SeriesPosterior, ...]
    scores: tuple[HeldOut, ...]
    scheme: str
    correlation: float

    def difference(self, a: int, b: int) -> tuple[float, float]:
        """Score of trend a minus that of trend b, and its standard error."""
        each = self.scores[a].log_density - self.scores[b].log_density
        fold = self.scores[a].fold
        # where whole blocks are held out they are the independent items, else the exposures
        items = np.bincount(fold, each) if self.scheme == "blocks" else each
        return float(each.sum()), float(np.sqrt(len(items)) * items.std(ddof=1))

    def beats(self, a: int, b: int) -> bool:
        """True if trend a predicts significantly better than trend b."""
        value, error = self.difference(a, b)
        fold = self.scores[a].fold
        n = len(np.unique(fold)) if self.scheme == "blocks" else len(fold)
        quantile = float(t_ppf((1 + CONFIDENCE) / 2, n - 1))
        return value >= MIN_DIFFERENCE and value >= quantile * error

    @property
    def best(self) -> int:
        """Index of the trend with the best score."""
        return int(np.argmax([s.total for s in self.scores]))

    @property
    def selected(self) -> int:
        """Index of the simplest trend that beats the constant and that the best does not beat.

        The constant's index where nothing beats it.  A break that was found, and not given, has to
        predict held-out exposures better than drifts without one: a break can follow any drift.
        """
        constant = next(i for i, c in enumerate(self.trends) if c.kind == "constant")
        drifts = [s.total for c, s in zip(self.trends, self.scores, strict=True) if c.drifts]
        for i, trend in enumerate(self.trends):
            if trend.find and drifts and max(drifts) > self.scores[i].total:
                continue
            if self.beats(i, constant) and not self.beats(self.best, i):
                return i
        return constant

    def table(self) -> Table:
        """Table with one row for each trend, the best first.

        Columns: trend, score, its difference to the best with standard error, Monte-Carlo error,
        fraction of measurements in the 68 % and 95 % predictive intervals, and convergence of the
        posterior.
        """
        order = sorted(range(len(self.trends)), key=lambda i: -self.scores[i].total)
        gaps = [self.difference(i, self.best) for i in order]
        out = Table()
        out["trend"] = [self.trends[i].name for i in order]
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
        out.meta["selected"] = self.trends[self.selected].name
        return out


def compare(series: Series, candidates: Sequence[TrendModel], *, seed: int = 1) -> Comparison:
    """Compare trends by their predictive densities of held-out exposures.

    They are held out in 30 groups, neighbours in different ones; successive ones together where the
    residuals of every trend but the drifting ones are correlated in time.

    Parameters
    ----------
    series : Series
    candidates : sequence of TrendModel
        The constant is added, and to every trend with breaks and slopes the one without slopes:
        without them a slope could not be distinguished from none.
    seed : int

    Returns
    -------
    Comparison
        Without trends whose one break, at any date, gains less likelihood from the very exposures
        that it is fitted to than held-out ones would have to show.
    """
    trends, posteriors = _fitted(series, _completed(candidates), seed)
    found = [serial_correlation(p) for p in posteriors if not p.trend.drifts]
    correlation = min(found, key=abs)
    if correlation * np.sqrt(len(series)) > MIN_SERIAL_CORRELATION:
        breaks = tuple(sorted({b for c in trends for b in c.breaks}))
        scheme, fold = "blocks", _blocks(series, breaks, correlation)
    else:
        scheme, fold = "exposures", exposure_folds(series.epoch)
    scores = tuple(held_out(p, fold, seed=seed) for p in posteriors)
    return Comparison(trends, posteriors, scores, scheme, correlation)


def _fitted(
    series: Series, candidates: tuple[TrendModel, ...], seed: int
) -> tuple[tuple[TrendModel, ...], tuple[SeriesPosterior, ...]]:
    """Trends, and the posterior of each, without breaks that cannot be significant."""
    fitted = {c: fit_series(series, c, seed=seed) for c in candidates if c.find != 1}
    # no trend of these can be beaten by a break that gains less over each
    plain = [p for c, p in fitted.items() if not (c.n_breaks or c.drifts)]
    for trend in candidates:
        if trend.find == 1 and max(_gain(trend, p) for p in plain) >= MIN_DIFFERENCE:
            fitted[trend] = fit_series(series, trend, seed=seed)
    trends = tuple(c for c in candidates if c in fitted)
    return trends, tuple(fitted[c] for c in trends)


def _gain(trend: TrendModel, plain: SeriesPosterior) -> float:
    """Gain in log likelihood of a break over a trend without one, at the best date of all.

    With the scatter about the trend without a break, or as much less as the chi-square is less,
    and exposures that lie off it counted little or in full, whichever gains most.
    """
    problem = plain.engine.problem
    design = Design(trend, problem.series)
    moves = BreakMoves(design)
    dates = (moves.dates[:-1] + moves.width / 2)[:, None]
    broken = replace(problem, design=design).columns(dates[moves.possible(dates)])
    precision = precisions(problem.formal, plain.raw.sigma.mean(axis=(0, 1))[None])
    lies_off = plain.outlier_probability
    gains = []
    for off in (np.zeros(len(lies_off)), lies_off):
        weight = precision / (1 - off + off * plain.raw.kappa2.mean())
        total = np.einsum("ie,cije,je->", problem.y, weight, problem.y)
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


def _completed(candidates: Sequence[TrendModel]) -> tuple[TrendModel, ...]:
    """Trends with those that a claim has to be compared with, the simplest first."""
    out = list(dict.fromkeys(candidates))
    groups = out[0].groups if out else "offsets"
    if not any(c.kind == "constant" for c in out):
        out.append(TrendModel("constant", groups=groups))
    for c in tuple(out):
        flat = TrendModel("step", c.breaks, c.find, groups=c.groups) if c.n_breaks else None
        if flat and not any((o.kind, o.breaks, o.find) == ("step", c.breaks, c.find) for o in out):
            out.append(flat)

    def cost(trend: TrendModel) -> tuple[int, int, int]:
        columns = 0 if trend.drifts else trend.n_columns + trend.find
        return (trend.drifts, columns, KINDS.index(trend.kind))

    return tuple(sorted(out, key=cost))


def _blocks(series: Series, breaks: tuple[float, ...], correlation: float) -> Int:
    """Blocks (E,) of successive exposures, longer than their correlation where there are enough."""
    rho = float(np.clip(correlation, 0.0, 0.95))
    length = int(np.ceil(CORRELATION_LENGTHS * (1 + rho) / (1 - rho)))
    return block_folds(series.epoch, breaks, max(1, min(length, len(series) // MIN_BLOCKS)))


def serial_correlation(posterior: SeriesPosterior) -> float:
    """Correlation of the residuals of successive exposures, the mean over the coefficients.

    Exposures that lie off are weighted down by their probability.  Without correlation it scatters
    by at most 1 / sqrt(E).
    """
    series = posterior.series
    b = posterior.raw.b.mean(axis=(0, 1))
    if posterior.trend.find:
        # the parameters belong to draws of the breaks: average the trend, not its parameters
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


@dataclass(frozen=True, eq=False)
class FilterDependence:
    """Comparison of common slopes with a slope for each filter.

    Parameters
    ----------
    names : tuple of str
        Filters; the first has most exposures, and the others are compared with it.
    all_slopes : Change
        Differences of the slopes, per year, in one vector, filter by filter.
    common, separate : SeriesPosterior
    comparison : Comparison
        Held-out scores of the two, in this order.
    """

    names: tuple[str, ...]
    all_slopes: Change
    common: SeriesPosterior
    separate: SeriesPosterior
    comparison: Comparison

    @property
    def depends(self) -> bool:
        """True if own slopes predict significantly better."""
        posteriors = self.comparison.posteriors
        return self.comparison.beats(posteriors.index(self.separate), posteriors.index(self.common))


def filter_dependence(series: Series, trend: TrendModel, *, seed: int = 1) -> FilterDependence:
    """Compare common slopes with a slope for each filter.

    Parameters
    ----------
    series : Series
        With filters as its groups.
    trend : TrendModel
        With slopes.
    seed : int

    Returns
    -------
    FilterDependence

    Raises
    ------
    InputError
        For a series of one filter, and a trend without slopes.
    DegenerateError
        For a filter with fewer than three exposures, or of one date only.
    """
    names = series.group_names
    if len(names) < 2:
        raise InputError(
            "there are no two filters to compare",
            where=series.source,
            do="give the filter of each exposure as its group",
        )
    if not trend.has_slope:
        raise InputError(
            f"trend {trend.name!r} has no slopes", where=series.source, do="ask for lines"
        )
    both = (replace(trend, groups="offsets"), replace(trend, groups="slopes"))
    comparison = compare(series, both, seed=seed)
    places = [comparison.trends.index(c) for c in both]
    common, separate = (comparison.posteriors[i] for i in places)
    slopes = separate.group_slope
    return FilterDependence(
        names=names,
        all_slopes=Change.of(np.ascontiguousarray(slopes.reshape(len(slopes), -1))),
        common=common,
        separate=separate,
        comparison=comparison,
    )
