"""Deviations of single exposures, with and without frames of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.diagnose.correlated import deviations, estimate_discrepancy
from bayesdist.infer import Rejection, build_model, fit_linear
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
