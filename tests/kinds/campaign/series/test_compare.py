"""What is claimed, and what is not: over truths with a line, a break, or neither."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.kinds.campaign.series import (
    Series,
    TrendModel,
    block_folds,
    compare,
    default_candidates,
    describe,
    exposure_folds,
    fit_series,
    serial_correlation,
)
from bayesdist.kinds.campaign.series.posterior import held_out
from tests.infer.calibration import over_seeds
from tests.reduced import case_in_full, only_in_full

from .campaign import BREAK, campaign, drifting, is_line

SIMPLE = (TrendModel("constant"), TrendModel("line"))


def white(seed: int, slope: float = 0.0, n: int = 60) -> Series:
    """Scatter of one about a line, a few exposures far off."""
    rng = np.random.default_rng([49, seed])
    epoch = rng.uniform(2002, 2014, n)
    values = rng.standard_normal((n, 2)) + slope * (epoch - 2008)[:, None] * [1, 0]
    values[:2] += 15 * rng.standard_normal((2, 2))
    return Series.of(epoch, values, 0.1, coefficients=("a", "b"))


@pytest.mark.slow
@only_in_full("a break is found where it is")
def test_acs_before_and_after_sm4():
    """A line in each segment, and no simpler trend, as the report has it."""
    broken = [TrendModel(kind, (BREAK,)) for kind in ("step", "line+step", "lines")]
    verdict = describe(campaign(3).series, (TrendModel("line"), *broken, TrendModel("spline")))
    assert verdict.claim == f"break at {BREAK:.2f}: a line in each segment"
    assert is_line(verdict)
    first, second = verdict.text.split("segment 1")[1].split("segment 2")
    assert "A_2" in first and "B_2" in first and "A_2" in second and "B_2" in second
    table = verdict.comparison.table()
    scores = dict(zip(table["trend"], table["score"], strict=True))
    assert scores["lines, break at 2009.4"] > scores["line+step, break at 2009.4"] + 4
    assert scores["line+step, break at 2009.4"] > scores["line"] + 4 > scores["constant"] + 8
    assert table["difference"][0] == 0 and (np.diff(table["score"]) <= 0).all()
    assert table.meta["held_out"] == "exposures" and table["converged"].all()


def test_a_line_is_claimed_where_it_is():
    verdict = describe(white(1, slope=0.25), SIMPLE)
    assert verdict.claim == "line" and is_line(verdict)
    slope = verdict.posterior.beta[:, 0]
    assert (np.abs(slope.mean(axis=0) - [0.25, 0.0]) < 4 * slope.std(axis=0)).all()
    named = verdict.text.split("Slopes per year: ")[1]
    assert named.startswith("a 0.") and "b " not in named
    assert verdict.rivals == ()


def test_no_line_without_one():
    verdict = describe(white(2), SIMPLE)
    assert verdict.claim == "no line" and not is_line(verdict)
    assert "not enough" in verdict.text


@pytest.mark.slow
@only_in_full("a line, and no line are told")
def test_a_trend_with_slopes_is_measured_against_the_one_without():
    comparison = compare(white(3), (TrendModel("lines", (2008.0,)),))
    assert [c.kind for c in comparison.trends] == ["constant", "step", "lines"]
    assert comparison.trends[comparison.selected].kind == "constant"


def test_a_break_is_found_where_it_is(rng):
    epoch = rng.uniform(2002, 2014, 70)
    values = rng.standard_normal((70, 2)) + 3.0 * (epoch > 2006.4)[:, None] * [1, 0]
    series = Series.of(epoch, values, 0.1, coefficients=("a", "b"))
    verdict = describe(series, (TrendModel("line"), TrendModel("step", find=1)))
    assert verdict.claim.startswith("break at 2006.") and not is_line(verdict)
    gap = np.sort(epoch)[np.searchsorted(np.sort(epoch), 2006.4) - 2 :][:4]
    assert gap[0] < verdict.breaks[0, 0] < gap[-1]
    level, _ = verdict.posterior.change()
    assert abs(level.value[0] - 3.0) < 4 * level.sigma[0] and abs(level.significance[1]) < 4


@pytest.mark.slow
@only_in_full("one break is found where it is")
def test_several_breaks_are_found(rng):
    epoch = np.sort(rng.uniform(2002, 2014, 90))
    true = (2005.0, 2008.5, 2011.2)
    values = np.array([0.0, 4.0, -2.0, 3.0])[np.digitize(epoch, true)] + rng.standard_normal(90)
    series = Series.of(epoch, values, coefficients=("a",))
    posterior = fit_series(series, TrendModel("step", find=3))
    assert posterior.convergence.converged, posterior.convergence.reasons
    low, high = np.quantile(posterior.breaks, [0.001, 0.999], axis=0)
    spacing = np.diff(epoch).max()
    assert ((low - spacing < true) & (true < high + spacing)).all()
    assert (np.diff(posterior.breaks, axis=1) > 0).all()


def test_serial_correlation_is_seen():
    together, apart = drifting(0), white(4)
    one, other = (fit_series(s, TrendModel("constant")) for s in (together, apart))
    assert serial_correlation(one) == pytest.approx(0.7, abs=0.25)
    assert abs(serial_correlation(other)) < 0.3
    assert compare(together, SIMPLE).scheme == "blocks"
    assert compare(apart, SIMPLE).scheme == "exposures"


def false_claim(seed: int) -> tuple[str, bool, float]:
    """Verdict on deviations that hang together, and the slope's significance if they did not."""
    series = drifting(seed)
    verdict = describe(series, SIMPLE)
    line = next(p for p in verdict.comparison.posteriors if p.trend.kind == "line")
    ratio = line.beta.mean(axis=0) / line.beta.std(axis=0)
    return verdict.claim, is_line(verdict), float(np.abs(ratio).max())


@pytest.mark.slow
def test_an_irregular_drift_is_not_taken_for_a_line(full, capsys):
    """First-order processes without any trend: slopes of three sigma are common there."""
    n = 100 if full else 5
    claims = over_seeds(false_claim, n)
    share = np.mean([line for _, line, _ in claims])
    naive = np.mean([ratio > 3 for _, _, ratio in claims])
    with capsys.disabled():
        print(
            f"\n{n} drifts without a trend: lines claimed {share:.3f}, slopes > 3 sigma {naive:.3f}"
        )
    assert share <= 0.05 and naive > 0.1


def false_line(seed: int) -> bool:
    return is_line(describe(white(seed + 100), SIMPLE))


@pytest.mark.slow
@only_in_full("test_no_line_without_one is one such series")
def test_scatter_alone_is_not_taken_for_a_line():
    assert np.mean(over_seeds(false_line, 100)) <= 0.03


def test_folds():
    epoch = np.concatenate([np.linspace(2002, 2003, 10), np.linspace(2006, 2007, 14)])
    blocks = block_folds(epoch, (2006.5,), 4)
    assert len(blocks) == 24
    for code in np.unique(blocks):
        rows = np.flatnonzero(blocks == code)
        assert len(rows) >= 3 and (np.diff(rows) == 1).all()
        assert np.ptp(epoch[rows]) < 2 and not (epoch[rows][0] < 2006.5 <= epoch[rows][-1])
    groups = exposure_folds(epoch, 6)
    assert (np.bincount(groups) == 4).all() and (np.diff(groups) != 0).all()
    assert len(np.unique(exposure_folds(epoch, 30))) == 24


def test_default_candidates_have_what_is_asked():
    given = default_candidates((2009.4,))
    assert {c.kind for c in given} >= {"constant", "line", "step", "lines", "spline"}
    assert all(c.breaks == (2009.4,) for c in given if c.n_breaks)
    assert all(c.find == 1 for c in default_candidates() if c.n_breaks)


@pytest.mark.slow
@only_in_full("drifts that hang together are no lines")
def test_a_break_in_a_random_walk_is_not_believed():
    """41 dates of sums of random steps: a break found there only follows the drift."""
    broken = (
        TrendModel("line"),
        TrendModel("line+step", find=1),
        TrendModel("spline"),
        TrendModel("random_walk"),
    )
    for seed in range(3):
        rng = np.random.default_rng([50, seed])
        epoch = np.sort(rng.uniform(2013, 2019, 41))
        values = np.cumsum(0.5 * rng.standard_normal((41, 2)), axis=0)
        values += 0.3 * rng.standard_normal((41, 2))
        series = Series.of(epoch, values, 0.1, coefficients=("a", "b"))
        assert "break" not in describe(series, broken).claim


@pytest.mark.parametrize("kind", ["line", case_in_full("random_walk", instead="lines are run")])
def test_weighted_draws_predict_as_refits_do(kind):
    series = white(6, slope=0.1)
    posterior = fit_series(series, TrendModel(kind))
    fold = exposure_folds(series.epoch)
    weighted = held_out(posterior, fold)
    refitted = held_out(posterior, fold, max_pareto_k=-np.inf)
    error = np.hypot(weighted.mc_error, refitted.mc_error)
    assert error < 1.0
    assert abs(weighted.total - refitted.total) < 4 * error
    assert abs(weighted.rank - refitted.rank).max() < 0.1


@pytest.mark.slow
@only_in_full("a break with gain is found, and none is claimed")
def test_breaks_without_gain_are_not_fitted():
    def tried(step: float) -> set[str]:
        rng = np.random.default_rng(51)
        epoch = np.sort(rng.uniform(2002, 2014, 80))
        values = rng.standard_normal(80) + step * (epoch > 2008)
        series = Series.of(epoch, values, 0.1, coefficients=("a",))
        comparison = compare(series, (TrendModel("line"), TrendModel("step", find=1)))
        return {c.kind for c in comparison.trends}

    assert tried(0.0) == {"constant", "line"}
    assert tried(2.0) == {"constant", "line", "step"}
