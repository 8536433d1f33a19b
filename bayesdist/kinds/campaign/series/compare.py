"""Selection of the trend of a series by the predictive density of held-out exposures.

A difference between the log predictive densities of two trends is significant if it is at least 4,
and significant at 95 % according to Student's t with its standard error.  For differences below 4,
the standard errors are too small (Sivula et al. 2020).  If the exposures are correlated in time,
blocks of consecutive exposures are held out.  Otherwise the neighbours of an exposure would predict
it, and an irregular drift would look like a line.

To test whether the drift depends on the filter (Kozhurina-Platais et al. 2015, section 4.4.4),
common slopes with an offset per filter are compared with a slope per filter.  The slope of each
other filter differs from that of the first one by the same amount in all segments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from astropy.table import Table

from bayesdist.errors import InputError
from bayesdist.infer.kernel import precisions
from bayesdist.kinds.campaign.series.posterior import (
    ChangeAtBreak,
    HeldOut,
    SeriesPosterior,
    block_folds,
    exposure_folds,
    fit_series,
    held_out,
)
from bayesdist.kinds.campaign.series.problem import WIDE, SeriesProblem, normal_equations
from bayesdist.kinds.campaign.series.sampler import BreakMoves
from bayesdist.kinds.campaign.series.series import Series
from bayesdist.kinds.campaign.series.trend import KINDS, Design, TrendModel
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.distributions import t_ppf

MIN_DIFFERENCE = 4.0  # smallest significant difference of log predictive densities
CONFIDENCE = 0.95  # confidence level of a significant difference
# lag-1 correlation, in its standard errors, above which exposures count as correlated
MIN_SERIAL_CORRELATION = 2.33
# minimum number of blocks, and length of a block in correlation lengths
MIN_BLOCKS, CORRELATION_LENGTHS = 6, 3

MIN_SIGNIFICANCE = 3.0  # significance (sigma) above which the slope of a coefficient is mentioned
CLAIMS = {
    "constant": "no line",
    "line": "line",
    "step": "no line",
    "line+step": "one slope throughout",
    "piecewise": "its slope changes there",
    "lines": "a line in each segment",
    "spline": "no line: a smooth drift",
    "random_walk": "no line: an irregular drift",
}


@dataclass(frozen=True, eq=False)
class TrendComparison:
    """Trends fitted to a series, with their predictions of held-out exposures.

    Parameters
    ----------
    trends : tuple of TrendModel
        Trends, starting with the simplest.
    posteriors : tuple of SeriesPosterior
        Posterior of each trend.
    scores : tuple of HeldOut
        Predictions of each trend.
    scheme : str
        'exposures' if single exposures are the independent items of the comparison, 'blocks' if
        blocks of consecutive exposures were held out.
    correlation : float
        Smallest lag-1 correlation of the residuals from any trend without random part.
    """

    trends: tuple[TrendModel, ...]
    posteriors: tuple[SeriesPosterior, ...]
    scores: tuple[HeldOut, ...]
    scheme: str
    correlation: float

    def difference(self, a: int, b: int) -> tuple[float, float]:
        """Score of trend a minus that of trend b, with its standard error.

        Parameters
        ----------
        a, b : int
            Indices of the trends.

        Returns
        -------
        value, error : float
            Difference and standard error.
        """
        each = self.scores[a].log_density - self.scores[b].log_density
        fold = self.scores[a].fold
        # the independent items are the blocks if blocks were held out, otherwise the exposures
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
        """Index of the simplest trend that is better than the constant and not worse than the best.

        If no trend is significantly better than the constant, this is the index of the constant.  A
        break at an unknown date must also predict held-out exposures better than smooth or
        irregular drifts, since a break can imitate any drift.
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
        """Table with one row per trend, starting with the best.

        Returns
        -------
        astropy.table.Table
            Columns trend, score, difference (to the best), standard_error, mc_error (Monte-Carlo
            error), covered_68 and covered_95 (fraction of measurements in the predictive
            intervals), converged.
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


def compare(series: Series, candidates: Sequence[TrendModel], *, seed: int = 1) -> TrendComparison:
    """Compare trends by the predictive density of held-out exposures.

    The exposures are held out in 30 groups, with neighbours in different groups.  If the residuals
    from all trends without random part are correlated in time, blocks of consecutive exposures are
    held out instead.

    Parameters
    ----------
    series : Series
    candidates : sequence of TrendModel
        Trends to compare. A constant is added and, for each trend with breaks and slopes, the same
        trend without slopes, which are needed to assess the significance of a slope.
    seed : int
        Seed of the random numbers.

    Returns
    -------
    TrendComparison
        Trends with one unknown break are omitted if the break cannot be significant: at the best
        date, the gain in likelihood is smaller than a significant difference.
    """
    trends, posteriors = _fitted(series, _completed(candidates), seed)
    correlations = [serial_correlation(p) for p in posteriors if not p.trend.drifts]
    correlation = min(correlations, key=abs)
    if correlation * np.sqrt(len(series)) > MIN_SERIAL_CORRELATION:
        breaks = tuple(sorted({b for c in trends for b in c.breaks}))
        scheme, fold = "blocks", _blocks(series, breaks, correlation)
    else:
        scheme, fold = "exposures", exposure_folds(series.epoch)
    scores = tuple(held_out(p, fold, seed=seed) for p in posteriors)
    return TrendComparison(trends, posteriors, scores, scheme, correlation)


def _fitted(
    series: Series, candidates: tuple[TrendModel, ...], seed: int
) -> tuple[tuple[TrendModel, ...], tuple[SeriesPosterior, ...]]:
    """Fit the trends, except for those with a break that cannot be significant."""
    fitted = {c: fit_series(series, c, seed=seed) for c in candidates if c.find != 1}
    # a break that gains too little over each of these trends cannot be better than the best of them
    plain = [p for c, p in fitted.items() if not (c.n_breaks or c.drifts)]
    for trend in candidates:
        if trend.find == 1 and max(_gain(trend, p) for p in plain) >= MIN_DIFFERENCE:
            fitted[trend] = fit_series(series, trend, seed=seed)
    trends = tuple(c for c in candidates if c in fitted)
    return trends, tuple(fitted[c] for c in trends)


def _gain(trend: TrendModel, plain: SeriesPosterior) -> float:
    """Gain in log likelihood of a break at the best date, relative to a trend without break.

    It is an upper limit: the largest gain for a fixed or a rescaled scatter, and for outliers that
    are weighted down or not.
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


def _explained(problem: SeriesProblem, precision: Float, columns: Float) -> Float:
    """Decrease of chi-square (M,) by columns (M, E, p) with their best-fitting parameters."""
    matrix, right = normal_equations(precision, problem.y, columns[None])
    matrix = matrix + WIDE**-2 * np.eye(matrix.shape[-1])
    return (right * np.linalg.solve(matrix, right[..., None])[..., 0]).sum(axis=-1)[0]


def _completed(candidates: Sequence[TrendModel]) -> tuple[TrendModel, ...]:
    """Add the trends needed for comparison to the candidates, and sort by simplicity."""
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
    """Blocks (E,) of consecutive exposures, longer than the correlation length if possible."""
    rho = float(np.clip(correlation, 0.0, 0.95))
    length = int(np.ceil(CORRELATION_LENGTHS * (1 + rho) / (1 - rho)))
    return block_folds(series.epoch, breaks, max(1, min(length, len(series) // MIN_BLOCKS)))


def serial_correlation(posterior: SeriesPosterior) -> float:
    """Lag-1 correlation of the residuals of consecutive exposures, averaged over the coefficients.

    Outliers are weighted down according to their probability.  For uncorrelated exposures, the
    standard deviation of the result is at most 1 / sqrt(E).

    Parameters
    ----------
    posterior : SeriesPosterior

    Returns
    -------
    float
    """
    series = posterior.series
    b = posterior.raw.b.mean(axis=(0, 1))
    if posterior.trend.find:
        # average the trend rather than its parameters, which depend on the break dates
        sweeps = np.linspace(0, posterior.raw.b.shape[1] - 1, 20).astype(int)
        sample = posterior.raw.b[:, sweeps].reshape(-1, *b.shape)
        dates = posterior.raw.breaks[:, sweeps].reshape(len(sample), -1)
        columns = posterior.design.matrix(series.epoch, series.group_code, dates)
        fitted = (columns @ np.swapaxes(sample, 1, 2)).mean(axis=0)
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
    """Comparison of common slopes with a slope per filter.

    Parameters
    ----------
    names : tuple of str
        Filters. The first one has most exposures; the others are compared with it.
    all_slopes : ChangeAtBreak
        Differences of the slopes per year from those of the first filter, concatenated.
    common, separate : SeriesPosterior
        Posteriors with common slopes, and with a slope per filter.
    comparison : TrendComparison
        Comparison of these two, and of the trends added by `compare`.
    """

    names: tuple[str, ...]
    all_slopes: ChangeAtBreak
    common: SeriesPosterior
    separate: SeriesPosterior
    comparison: TrendComparison

    @property
    def depends(self) -> bool:
        """True if a slope per filter predicts held-out exposures significantly better."""
        posteriors = self.comparison.posteriors
        return self.comparison.beats(posteriors.index(self.separate), posteriors.index(self.common))


def filter_dependence(series: Series, trend: TrendModel, *, seed: int = 1) -> FilterDependence:
    """Compare common slopes with a slope per filter.

    Parameters
    ----------
    series : Series
        Series with the filters as its groups.
    trend : TrendModel
        Trend with slopes.
    seed : int
        Seed of the random numbers.

    Returns
    -------
    FilterDependence

    Raises
    ------
    InputError
        If the series has fewer than two filters, or the trend has no slopes.
    DegenerateError
        If a filter has fewer than three exposures, or exposures of a single date.
    """
    names = series.group_names
    if len(names) < 2:
        raise InputError(
            "the series has fewer than two filters to compare",
            where=series.source,
            do="give the filter of each exposure as its group",
        )
    if not trend.has_slope:
        raise InputError(
            f"trend {trend.name!r} has no slopes", where=series.source, do="choose lines"
        )
    alternatives = (replace(trend, groups="offsets"), replace(trend, groups="slopes"))
    comparison = compare(series, alternatives, seed=seed)
    places = [comparison.trends.index(c) for c in alternatives]
    common, separate = (comparison.posteriors[i] for i in places)
    slopes = separate.group_slope
    return FilterDependence(
        names=names,
        all_slopes=ChangeAtBreak.of(np.ascontiguousarray(slopes.reshape(len(slopes), -1))),
        common=common,
        separate=separate,
        comparison=comparison,
    )


# -- description of the trend of a series in words, limited to what the comparison supports --------


@dataclass(frozen=True, eq=False)
class TrendVerdict:
    """Description of the trend of a series.

    Parameters
    ----------
    claim : str
        Short description: 'no line', 'line', or 'break at 2009.41' with the form of the segments.
    text : str
        The claim in full sentences, with its evidence.
    comparison : TrendComparison
        Comparison of all candidates.
    posterior : SeriesPosterior
        Posterior of the selected trend.
    breaks : ndarray, shape (B, 3)
        Median and central 68 % interval of the date of each break of the selected trend.
    rivals : tuple of str
        Names of smooth or irregular drifts that predict equally well. Since these can follow a
        line, a slope need not continue beyond the data if there are rivals.
    """

    claim: str
    text: str
    comparison: TrendComparison
    posterior: SeriesPosterior
    breaks: Float
    rivals: tuple[str, ...]


def default_candidates(breaks: tuple[float, ...] = ()) -> tuple[TrendModel, ...]:
    """Trends to compare by default.

    Parameters
    ----------
    breaks : tuple of float
        Dates of breaks in decimal years; by default one break at an unknown date.

    Returns
    -------
    tuple of TrendModel
        A constant, a line, trends with breaks, a smooth and an irregular drift.
    """
    search = 0 if breaks else 1
    broken = ("step", "line+step", "lines")
    return (
        TrendModel("constant"),
        TrendModel("line"),
        *(TrendModel(kind, breaks, search) for kind in broken),
        TrendModel("spline"),
        TrendModel("random_walk"),
    )


def describe(
    series: Series,
    candidates: tuple[TrendModel, ...] | None = None,
    *,
    breaks: tuple[float, ...] = (),
    seed: int = 1,
) -> TrendVerdict:
    """Describe the trend of a series in words.

    Parameters
    ----------
    series : Series
    candidates : tuple of TrendModel, optional
        Trends to compare; those of `default_candidates` by default.
    breaks : tuple of float
        Dates of breaks of the default candidates; by default one break at an unknown date.
    seed : int
        Seed of the random numbers.

    Returns
    -------
    TrendVerdict

    Raises
    ------
    DegenerateError
        If the exposures do not determine a candidate.
    """
    chosen = default_candidates(breaks) if candidates is None else candidates
    comparison = compare(series, chosen, seed=seed)
    posterior = comparison.posteriors[comparison.selected]
    dates = _break_dates(posterior)
    claim = _claim(posterior.trend, dates)
    rivals = _rivals(comparison)
    text = _text(claim, comparison, posterior, dates, rivals)
    return TrendVerdict(claim, text, comparison, posterior, dates, rivals)


def _rivals(comparison: TrendComparison) -> tuple[str, ...]:
    selected = comparison.selected
    return tuple(
        c.name
        for i, c in enumerate(comparison.trends)
        if i != selected and c.drifts and not comparison.beats(selected, i)
    )


def _break_dates(posterior: SeriesPosterior) -> Float:
    trend = posterior.trend
    if trend.find:
        return np.quantile(posterior.breaks, [0.5, 0.16, 0.84], axis=0).T
    return np.repeat(np.array(trend.breaks)[:, None], 3, axis=1)


def _claim(trend: TrendModel, dates: Float) -> str:
    claim = CLAIMS[trend.kind]
    if not trend.n_breaks:
        return claim
    return f"break at {', '.join(f'{d[0]:.2f}' for d in dates)}: {claim}"


def _text(
    claim: str,
    comparison: TrendComparison,
    posterior: SeriesPosterior,
    dates: Float,
    rivals: tuple[str, ...],
) -> str:
    trends = comparison.trends
    constant = next(i for i, c in enumerate(trends) if c.kind == "constant")
    selected = comparison.selected
    n_folds = len(np.unique(comparison.scores[selected].fold))
    held = "blocks of successive exposures" if comparison.scheme == "blocks" else "exposures"
    parts = [f"{claim[0].upper()}{claim[1:]}."]
    if selected == constant:
        candidates = [i for i in range(len(trends)) if i != constant]
        best = max(candidates, key=lambda i: comparison.scores[i].total)
        value, error = comparison.difference(best, constant)
        parts.append(
            f"The best other trend ({_plain(trends[best].name)}) predicts held-out {held} "
            f"({n_folds} folds) better than a constant by {value:.1f} +- {error:.1f} in log "
            "density, which is not enough."
        )
    else:
        value, error = comparison.difference(selected, constant)
        parts.append(
            f"It predicts held-out {held} ({n_folds} folds) better than a constant by "
            f"{value:.1f} +- {error:.1f} in log density."
        )
    for middle, low, high in dates:
        if high > low:
            parts.append(f"Break at {middle:.2f} ({low:.2f} to {high:.2f} with 68 %).")
    parts += _named_slopes(posterior)
    if rivals and posterior.trend.has_slope:
        named = _plain(", ".join(rivals))
        parts.append(f"Others predict as well ({named}): the slope need not continue.")
    if comparison.scheme == "blocks":
        parts.append(
            f"Successive exposures are correlated ({comparison.correlation:.2f}); sigmas of slopes "
            "and steps that assume independent exposures are too small."
        )
    if not posterior.convergence.converged:
        parts.append(f"The draws have not converged: {'; '.join(posterior.convergence.reasons)}.")
    return " ".join(parts)


def _plain(names: str) -> str:
    """Names of trends with spaces instead of underscores."""
    return names.replace("_", " ")


def _named_slopes(posterior: SeriesPosterior) -> list[str]:
    """Sentences with the significant slopes of the coefficients; empty if the trend has none."""
    trend = posterior.trend
    if not trend.has_slope or trend.drifts:
        return []
    slope = posterior.beta
    mean, sigma = slope.mean(axis=0), slope.std(axis=0, ddof=1)
    names = posterior.series.coefficients
    out = []
    several = trend.form.slopes != "one"
    for s in range(trend.n_segments if several else 1):
        named = [
            f"{names[j]} {mean[s, j]:.3g} +- {sigma[s, j]:.1g}"
            for j in range(len(names))
            if abs(mean[s, j]) > MIN_SIGNIFICANCE * sigma[s, j]
        ]
        label = f" in segment {s + 1}" if several else ""
        out.append(f"Slopes per year{label}: {', '.join(named) if named else 'none significant'}.")
    return out
