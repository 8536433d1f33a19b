"""Trends: what their parameters mean, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import DegenerateError, InputError
from bayesdist.kinds.campaign.series import KINDS, Design, Series, TrendModel
from bayesdist.kinds.campaign.series.trend import Drift

BREAKS = (2005.3, 2011.0)


def series(rng, n=60, group=()):
    epoch = rng.uniform(2002, 2014, n)
    return Series.of(epoch, rng.standard_normal((n, 2)), coefficients=("a", "b"), group=group)


def some_trend(kind: str, **options) -> TrendModel:
    given = {} if kind in ("constant", "line", "spline", "random_walk") else {"breaks": BREAKS}
    return TrendModel(kind, **given, **options)


@pytest.mark.parametrize("kind", KINDS)
def test_levels_and_slopes_are_those_of_the_columns(kind, rng):
    """alpha and beta against values and differences of the trend itself."""
    trend = some_trend(kind, reference=(2004.5,))
    design = Design(trend, series(rng))
    b = rng.standard_normal((3, 2, design.n_columns))
    b[..., design.n_fixed :] = 0.0  # alpha and beta are those of the trend without the drift
    level, slope = design.lines(b, design.given_breaks())
    limits = (2002.0, *trend.breaks, 2014.0)
    for s in range(trend.n_segments):
        t = np.array([limits[s] + 0.1, limits[s] + 1.1])
        values = design.matrix(t, np.zeros(2, int))[0] @ np.swapaxes(b, 1, 2)  # (3, 2 epochs, k)
        expected = level[:, s, None] + slope[:, s, None] * (t - design.reference[s])[:, None]
        np.testing.assert_allclose(values, expected, atol=1e-10)


def test_piecewise_is_continuous_and_steps_are_not(rng):
    edges = np.array([BREAKS[0] - 1e-9, BREAKS[0]])
    for kind, continuous in (("piecewise", True), ("lines", False), ("step", False)):
        design = Design(some_trend(kind), series(rng))
        values = design.matrix(edges, np.zeros(2, int))[0] @ rng.standard_normal(design.n_columns)
        assert (abs(values[1] - values[0]) < 1e-6) == continuous


def test_reference_dates_are_the_mean_dates_of_the_segments(rng):
    one = series(rng)
    design = Design(some_trend("lines"), one)
    segment = np.digitize(one.epoch, BREAKS)
    expected = [one.epoch[segment == s].mean() for s in range(3)]
    np.testing.assert_allclose(design.reference, expected)


def test_groups_add_an_offset_and_a_slope(rng):
    group = tuple(rng.choice(["F606W", "F814W", "F435W"], 60, p=[0.6, 0.2, 0.2]))
    one = series(rng, group=group)
    assert one.group_names[0] == "F606W"
    plain, own = (Design(TrendModel("line", groups=g), one) for g in ("offsets", "slopes"))
    assert (plain.n_columns, own.n_columns) == (4, 6)
    for code in range(3):
        t = np.array([2003.0, 2004.0])
        columns = own.matrix(t, np.full(2, code))[0]
        first = own.matrix(t, np.zeros(2, int))[0]
        extra = columns - first
        assert (np.abs(extra[:, 2:]).sum(axis=1) > 0).all() == (code > 0)
        np.testing.assert_array_equal(extra[:, :2], 0)


@pytest.mark.parametrize("smooth", [False, True])
def test_drift_is_exact_at_its_knots(smooth):
    """Covariance of the columns is the process's at the knots, and never more between them."""
    epoch = np.linspace(2002, 2014, 200)
    drift = Drift.over(epoch, 9, smooth=smooth)
    at_knots = drift.origin + drift.years * drift.knots
    columns = drift.columns(at_knots)
    np.testing.assert_allclose(
        columns @ columns.T, drift.kernel(drift.knots, drift.knots), atol=1e-10
    )
    places = (epoch - drift.origin) / drift.years
    unseen = np.diag(drift.kernel(places, places)) - (drift.columns(epoch) ** 2).sum(axis=1)
    assert (unseen > -1e-9).all() and unseen.max() > 1e-6


@pytest.mark.parametrize(
    ("build", "error", "says"),
    [
        (lambda: TrendModel("cubic"), InputError, "unknown trend"),
        (lambda: TrendModel("step"), InputError, "give one of breaks and find"),
        (lambda: TrendModel("step", (2009.4,), find=1), InputError, "give one of breaks and find"),
        (lambda: TrendModel("line", (2009.4,)), InputError, "has no breaks"),
        (lambda: TrendModel("lines", (2010.0, 2009.4)), InputError, "are not ascending"),
        (
            lambda: TrendModel("lines", (2009.4,), reference=(1, 2, 3)),
            InputError,
            "3 reference dates",
        ),
        (lambda: TrendModel("line", groups="none"), InputError, "offsets or slopes"),
        (lambda: TrendModel("lines", (np.nan,)), InputError, "not finite"),
    ],
)
def test_wrong_trends(build, error, says):
    with pytest.raises(error, match=says):
        build()


def test_segments_without_exposures(rng):
    with pytest.raises(DegenerateError, match="segment from 2020 to inf has 0 exposures"):
        Design(TrendModel("lines", (2020.0,)), series(rng))
    with pytest.raises(DegenerateError, match="the same date"):
        Design(
            TrendModel("line"), Series.of(np.full(5, 2003.0), np.arange(5.0), coefficients=("a",))
        )
    with pytest.raises(DegenerateError, match="at least 15 dates"):
        Design(TrendModel("step", find=2), series(rng, n=12))


def test_a_filter_with_two_exposures_has_no_slope(rng):
    group = ("F606W",) * 58 + ("F814W",) * 2
    with pytest.raises(DegenerateError, match="2 exposures of group 'F814W'"):
        Design(TrendModel("line", groups="slopes"), series(rng, group=group))


def test_a_filter_for_each_segment_is_no_break(rng):
    """One filter before and another after a break: its step is the filters' offset."""
    one = series(rng)
    group = tuple(np.where(one.epoch < BREAKS[0], "F606W", "F814W"))
    mixed = Series.of(one.epoch, one.values, coefficients=("a", "b"), group=group)
    with pytest.raises(
        DegenerateError, match=r"F606W\) cannot be distinguished from the trend 'step"
    ):
        Design(TrendModel("step", BREAKS[:1]), mixed)
    assert Design(TrendModel("line"), mixed).n_columns == 3
