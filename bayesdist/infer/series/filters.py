"""Comparison of the drift between filters (ACS ISR 2015-06, section 4.4.4).

Common slopes with an offset for each filter, against slopes of their own: each further filter's
slope differs from that of the first by one amount in all segments.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.errors import InputError
from bayesdist.infer.series.compare import Comparison, compare
from bayesdist.infer.series.posterior import Change, SeriesPosterior
from bayesdist.infer.series.series import Series
from bayesdist.infer.series.trend import TrendModel

__all__ = ["FilterDependence", "filter_dependence"]


@dataclass(frozen=True, eq=False)
class FilterDependence:
    """Comparison of common slopes with a slope for each filter.

    Parameters
    ----------
    names : tuple of str
        Filters; the first has most exposures, and the others are compared with it.
    offset : dict of str to Change
        Offset of each further filter's coefficients, with common slopes.
    slope : dict of str to Change
        Difference of its slopes, per year, where it has its own.
    all_slopes : Change
        All of these in one vector, filter by filter, with their covariance.
    common, separate : SeriesPosterior
    comparison : Comparison
        Held-out scores of the two, in this order.
    """

    names: tuple[str, ...]
    offset: dict[str, Change]
    slope: dict[str, Change]
    all_slopes: Change
    common: SeriesPosterior
    separate: SeriesPosterior
    comparison: Comparison

    @property
    def gain(self) -> tuple[float, float]:
        """Gain of own slopes in predicting held-out exposures, with standard error."""
        return self.comparison.difference(*self._places)

    @property
    def depends(self) -> bool:
        """True if own slopes predict significantly better."""
        return self.comparison.beats(*self._places)

    @property
    def _places(self) -> tuple[int, int]:
        posteriors = self.comparison.posteriors
        return posteriors.index(self.separate), posteriors.index(self.common)


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
        offset={f: Change.of(common.group_offset[:, i]) for i, f in enumerate(names[1:])},
        slope={f: Change.of(slopes[:, i]) for i, f in enumerate(names[1:])},
        all_slopes=Change.of(np.ascontiguousarray(slopes.reshape(len(slopes), -1))),
        common=common,
        separate=separate,
        comparison=comparison,
    )
