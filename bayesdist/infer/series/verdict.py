"""Description of the trend of a series in words, limited to what the comparison supports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesdist.infer.series.compare import Comparison, compare
from bayesdist.infer.series.posterior import SeriesPosterior
from bayesdist.infer.series.series import Series
from bayesdist.infer.series.trend import TrendModel
from bayesdist.utils.arrays import Float

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
class Verdict:
    """Description of the trend of a series.

    Parameters
    ----------
    claim : str
        Short description: 'no line', 'line', or 'break at 2009.41' with the form of the segments.
    text : str
        The claim in full sentences, with its evidence.
    comparison : Comparison
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
    comparison: Comparison
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
) -> Verdict:
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
    comparison: Comparison,
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
