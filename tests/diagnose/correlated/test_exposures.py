"""Deviations of single exposures, with and without frames of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.diagnose.correlated import deviations, estimate_discrepancy
from bayesdist.diagnose.correlated.deviations import DeviationsInTime
from bayesdist.infer import Rejection, build_model, fit_linear
from bayesdist.model import TimeDependence
from tests.diagnose.correlated.skies import SIZE, matched
from tests.reduced import case_in_full, only_in_full

EXPOSURES, SCATTER = 8, 3e-5


def breathing(
    frames: str, scatter: float = SCATTER, seed: int = 2, exposures: int = EXPOSURES, n: int = 300
):
    """A discrepancy of exposures of n stars each whose scales scatter."""
    rng = np.random.default_rng(seed)
    _, table, _ = matched(n * exposures, rng)
    code = np.arange(n * exposures) % exposures
    factor = 1 + (scatter * rng.standard_normal(exposures))[code]
    names = tuple(f"e{k}" for k in range(exposures))
    middle_u, middle_v = table.u.mean(), table.v.mean()
    table = replace(
        table,
        u=middle_u + factor * (table.u - middle_u),
        v=middle_v + factor * (table.v - middle_v),
        exposure=code,
        exposure_names=names,
    )
    model = build_model(table, order=3, size=(SIZE, SIZE), frames=frames)
    fit = fit_linear(table, model, rejection=Rejection(1e9, 1e9))
    return estimate_discrepancy(table, fit, rng=rng, stars=table)


@pytest.mark.parametrize(
    "frames", [case_in_full("none", instead="frames are fitted"), "shift_rotation"]
)
def test_the_scatter_of_the_scales_is_found(frames):
    found = breathing(frames).linear
    assert found is not None and found.n_exposures == EXPOSURES
    # of scale and two shears, of which the scale alone scatters
    assert SCATTER / 3 < np.median(found.scatter["shape"]) < 1.5 * SCATTER


def test_a_scatter_far_above_the_prior_is_found():
    """Its posterior does not end where the prior has little probability.

    One scatter is that of scale and two shears, of which only the scale scatters in E exposures. Of
    E - 1 deviations their rms has a relative error of 1 / sqrt(2 (E - 1)), and a scatter of three
    times as many one of 1 / sqrt(6 (E - 1)).
    """
    linear = breathing("shift_rotation", scatter=100 * SCATTER).linear
    assert linear is not None
    by_chance, width = 1 / np.sqrt(2 * (EXPOSURES - 1)), 1 / np.sqrt(6 * (EXPOSURES - 1))
    logs = np.log(linear.scatter["shape"] / (100 * SCATTER / np.sqrt(3)))
    assert abs(np.median(logs)) < 3 * by_chance
    assert 0.7 * width < np.std(logs) < 1.5 * width


@pytest.mark.parametrize(
    "frames", [case_in_full("none", instead="frames are fitted"), "shift_rotation"]
)
def test_of_many_exposures_some_stand_for_all(frames, monkeypatch):
    """A future exposure scatters as they do, and the fit by one over the root of their number."""
    n, per_exposure = 50, 6 if frames == "none" else 3
    monkeypatch.setattr(deviations, "MAX_DEVIATIONS", (n - 10) * per_exposure)
    found = breathing(frames, exposures=n, n=100)
    linear = found.linear
    assert linear is not None and linear.n_exposures == n
    scatter = np.median(linear.scatter["shape"])
    assert SCATTER / np.sqrt(3) * 0.8 < scatter < SCATTER
    # where the stars of an exposure, which lie at random, move the fit alike
    phi = found.model.basis(1).evaluate(SIZE * np.array([0.75, 0.5]), SIZE * np.array([0.5, 0.5]))
    deviation = linear.of_single_exposures(found.mean, 1, np.random.default_rng(1))
    single = (deviation @ (phi[0] - phi[1])).std(axis=0)
    at = np.zeros(1, int), np.zeros(1)
    moved = [found.model.polynomials(found.mean + t, *at)[0] for t in linear.theta]
    mean = (np.array(moved) @ (phi[0] - phi[1])).std(axis=0)
    np.testing.assert_allclose(mean, single / np.sqrt(n), rtol=0.15)


@pytest.mark.slow
@only_in_full("tests/diagnose/test_exposure_fields has the errors of one exposure")
@pytest.mark.parametrize(
    ("frames", "kinds"),
    [
        ("none", ("shift", "rotation", "scale", "shear")),
        case_in_full("shift", ("rotation", "scale", "shear"), instead="none and all are run"),
        ("shift_rotation_scale", ("shear",)),
    ],
)
def test_a_single_exposure_deviates_in_what_its_frame_does_not_fit(frames, kinds):
    found = breathing(frames)
    linear, rng = found.linear, np.random.default_rng(1)
    assert linear.kinds == kinds
    P = linear.of_single_exposures(found.mean, 1, rng)
    basis = found.model.basis(1)
    terms = list(basis.terms)
    x, y, constant = (terms.index(t) for t in ((1, 0), (0, 1), (0, 0)))
    # of u = a x + b y + ..., v = c x + d y + ...: a + d changes by scale, b - c by rotation
    a, b, c, d = P[:, 0, x], P[:, 0, y], P[:, 1, x], P[:, 1, y]
    size = SIZE / 2
    assert (np.std(a + d) > 1e-7 * size) == ("scale" in kinds)
    assert (np.abs(P[:, :, constant]).max() > 0) == ("shift" in kinds)
    assert np.std(a - d) > 1e-7 * size and np.std(b + c) > 1e-7 * size


def test_deviations_at_another_date_are_those_of_the_joint_distribution():
    """Mean and variance follow from the precision matrix of all dates together."""
    rng = np.random.default_rng(5)
    epoch, time = np.sort(rng.uniform(2000, 2010, 9)), np.array([0.0, 3.0, 8.0])
    found = DeviationsInTime(epoch, rng.standard_normal((3, 9, 2)), time)
    for at in (1999.0, 2004.2, 2011.5):
        mean, width = found.at(at)
        assert mean[0] == pytest.approx(0.0) and width[0] == 1.0
        dates = np.append(epoch, at)
        for k in (1, 2):
            precision = np.linalg.inv(np.exp(-np.abs(np.subtract.outer(dates, dates)) / time[k]))
            expected = -precision[-1, :-1] @ found.coefficients[k] / precision[-1, -1]
            np.testing.assert_allclose(mean[k], expected, atol=1e-3)
            assert width[k] == pytest.approx(1 / np.sqrt(precision[-1, -1]), abs=1e-3)


def test_an_exposure_deviates_as_those_of_its_date():
    """Scales that wander off from a line in time, seen at the date of the last exposure."""
    rng, exposures, n = np.random.default_rng(6), 30, 80
    _, table, true = matched(n * exposures, rng)
    code, dates = np.arange(n * exposures) % exposures, np.linspace(2000, 2010, exposures)
    factor = 1 + 5 * SCATTER * np.cumsum(rng.standard_normal((exposures, 2)), axis=0)
    table = replace(
        table,
        u=factor[code, 0] * table.u,
        v=factor[code, 1] * table.v,
        exposure=code,
        exposure_names=tuple(f"e{k:02d}" for k in range(exposures)),
        epoch=dates[code],
    )
    drift = TimeDependence((("u", 1, 0), ("v", 0, 1)), (2005.0,))
    model = build_model(table, order=3, size=(SIZE, SIZE), frames="shift_rotation", time=drift)
    fit = fit_linear(table, model, rejection=Rejection(1e9, 1e9))
    found = estimate_discrepancy(table, fit, rng=rng, stars=table)
    linear = found.linear
    assert linear is not None and linear.in_time is not None
    x, y = SIZE * np.array([0.9, 0.1]), SIZE * np.array([0.8, 0.2])
    phi = model.basis(1).evaluate(x, y)[0] - model.basis(1).evaluate(x, y)[1]
    at = np.zeros(1, int), dates[-1:]
    predicted = model.polynomials(found.mean, *at)[0]
    actual = factor[-1] * (true(x, y)[0] - true(x, y)[1]) - predicted @ phi
    moved = np.array([model.polynomials(found.mean + t, *at)[0] for t in linear.theta]) - predicted
    moved += linear.polynomials(dates[-1], 1)
    spread = {}
    for date in (None, dates[-1]):
        single = linear.of_single_exposures(found.mean, 1, np.random.default_rng(1), date)
        error = (moved + single) @ phi
        spread[date] = error.std(axis=0)
    # the residuals of the last exposure are known, whatever else is not
    assert (np.abs(actual) > 3 * spread[dates[-1]]).any()
    assert (np.abs(error.mean(axis=0) - actual) < 3 * spread[dates[-1]]).all()
    assert (spread[dates[-1]] < 0.3 * spread[None]).all()
