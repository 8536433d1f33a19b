"""A series in words: a line, no line, a break; never more than the comparison supports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.infer.series.compare import Comparison, compare
from bayesdist.infer.series.posterior import SeriesPosterior
from bayesdist.infer.series.series import Series
from bayesdist.infer.series.trend import TrendModel
from bayesdist.utils.arrays import Float

MIN_SIGNIFICANCE = 3.0  # sigma from which a coefficient's own slope or step is named
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
class Verdict:
    """Verdict on the trend of a series.

    Parameters
    ----------
    claim : str
        'no line', 'line', or 'break at 2009.41', with the form of the segments.
    text : str
        The claim in full sentences, with its evidence.
    comparison : Comparison
    posterior : SeriesPosterior
        Of the selected trend.
    breaks : ndarray, shape (B, 3)
        Median and central 68 % interval of each break of that trend.
    rivals : tuple of str
        Names of drifts that predict as well: a spline or a random walk can follow a line, so that
        one of these in addition to a claimed slope means that the slope need not go on.
    """

    claim: str
    text: str
    comparison: Comparison
    posterior: SeriesPosterior
    breaks: Float
    rivals: tuple[str, ...]


def default_candidates(breaks: tuple[float, ...] = ()) -> tuple[TrendModel, ...]:
    """Trends to compare: with the given breaks, or with one break that is to be found."""
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
) -> Verdict:
    """Describe the trend of a series in words.

    Parameters
    ----------
    series : Series
    candidates : tuple of TrendModel, optional
        By default a constant, a line, steps and lines with a break, a smooth and an irregular
        drift.
    breaks : tuple of float
        Given breaks of the default candidates; one is to be found where none are given.
    seed : int

    Returns
    -------
    Verdict
    """
    chosen = default_candidates(breaks) if candidates is None else candidates
    comparison = compare(series, chosen, seed=seed)
    posterior = comparison.posteriors[comparison.selected]
    dates = _break_dates(posterior)
    claim = _claim(posterior.trend, dates)
    rivals = _rivals(comparison)
    text = _text(claim, comparison, posterior, dates, rivals)
    return Verdict(claim, text, comparison, posterior, dates, rivals)


def _rivals(comparison: Comparison) -> tuple[str, ...]:
    here = comparison.selected
    return tuple(
        c.name
        for i, c in enumerate(comparison.trends)
        if i != here and c.drifts and not comparison.beats(here, i)
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
    comparison: Comparison,
    posterior: SeriesPosterior,
    dates: Float,
    rivals: tuple[str, ...],
) -> str:
    trends = comparison.trends
    constant = next(i for i, c in enumerate(trends) if c.kind == "constant")
    here = comparison.selected
    n_folds = len(np.unique(comparison.scores[here].fold))
    held = "blocks of successive exposures" if comparison.scheme == "blocks" else "exposures"
    parts = [f"{claim[0].upper()}{claim[1:]}."]
    if here == constant:
        others = [i for i in range(len(trends)) if i != constant]
        best = max(others, key=lambda i: comparison.scores[i].total)
        value, error = comparison.difference(best, constant)
        parts.append(
            f"The best other trend ({_plain(trends[best].name)}) predicts held-out {held} "
            f"({n_folds} folds) better than a constant by {value:.1f} +- {error:.1f} in log "
            "density, which is not enough."
        )
    else:
        value, error = comparison.difference(here, constant)
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
            "and steps that take them for independent are too small."
        )
    if not posterior.convergence.converged:
        parts.append(f"The draws have not converged: {'; '.join(posterior.convergence.reasons)}.")
    return " ".join(parts)


def _plain(names: str) -> str:
    """Names of trends as words."""
    return names.replace("_", " ")


def _named_slopes(posterior: SeriesPosterior) -> list[str]:
    """Names of the coefficients that drift, for a trend that claims a drift."""
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
