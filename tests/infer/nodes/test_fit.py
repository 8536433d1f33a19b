"""Polynomial and tables in turn, against the exact solution of both at once."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer import fit_linear
from bayesdist.infer.nodes import Matern, fit_with_tables, pixel_shifts
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.model.lookup import LookupTable, corrected
from tests.infer.nodes.support import (
    CHIP,
    ORDER,
    SIZE,
    STEP,
    bilinear,
    grid,
    joint_solution,
    matern_covariance,
    node_pixels,
    pattern,
    places,
    position_sigma,
    predict,
    projector,
)
from tests.infer.nodes.test_pixels import turned_by
from tests.reduced import case_in_full, only_in_full

NOISE = 0.03
SECOND = Chip(2, "B", SIZE, (320.0, 256.0))
OPTIONS = {"step": STEP, "smoothness": (1.5,)}


def nearly_flat(model: DistortionModel) -> np.ndarray:
    """Positions that are the pixels but for 1e-4: then shifts of u, v are those of x, y."""
    theta = np.zeros(model.n_params)
    for chip in model.chips:
        for axis, size in enumerate(chip.size):
            c = np.zeros(model.n_terms)
            c[0], c[1 + axis] = (size + 1) / 2, size / 2
            c[3:] = 0.01 / (1 + np.arange(len(c) - 3))
            theta[model.coefficient_slice(chip.number, axis)] = c
    return theta


def bent(model: DistortionModel) -> np.ndarray:
    """A distortion of ten pixels and a skew of 8 %, as that of ACS/WFC."""
    theta = nearly_flat(model)
    for k, chip in enumerate(model.chips):
        for axis in (0, 1):
            part = theta[model.coefficient_slice(chip.number, axis)]
            part[2 - axis] += 0.08 * SIZE[axis] / 2
            part[3:6] += [6.0, -4.0, 2.0 + k]
    return theta


def observed(
    model, theta, tables, x, y, rng, *, chip=None, filters=None, names=("",), fraction=0.0, **more
) -> Matches:
    """Matches of raw pixels whose true positions go through tables and model."""
    chip = np.zeros(len(x), int) if chip is None else chip
    filters = np.zeros(len(x), int) if filters is None else filters
    numbers = np.array([c.number for c in model.chips])[chip]
    px, py = corrected(tables, x, y, chip=numbers, filter=np.array(names)[filters])
    of = {name: more.get(name) for name in ("exposure", "epoch")}
    uv = model.predict(theta, px, py, chip=numbers, **of)
    sigma = NOISE * rng.uniform(0.6, 1.6, len(x))
    error = sigma[:, None] * rng.standard_normal((len(x), 2))
    false = rng.random(len(x)) < fraction
    error[false] = rng.normal(0.0, 1.0, (false.sum(), 2))
    return Matches(
        x,
        y,
        *(uv + error).T,
        sigma_u=sigma,
        sigma_v=sigma,
        chip=chip,
        chip_numbers=tuple(c.number for c in model.chips),
        filter=filters,
        filter_names=names,
        **more,
    )


def table_of(rng, prior: Matern, chip: int = 1, filter: str = "") -> LookupTable:
    return replace(grid().table(pattern(rng, prior).T, filter=filter), chip=chip)


def flat(table: LookupTable) -> np.ndarray:
    return table.values.reshape(2, -1).T


PATTERN = Matern(0.08, 70.0, 1.5)


@pytest.mark.parametrize("gradient", [False, True])
def test_it_ends_at_the_exact_joint_solution(rng, gradient):
    """Mean and sigma of positions from one dense solve for 20 coefficients and 640 nodes."""
    model = DistortionModel(ORDER, (CHIP,))
    theta = nearly_flat(model)
    x, y = places(rng, 4000, gradient=gradient)
    matches = observed(model, theta, [table_of(rng, PATTERN)], x, y, rng)
    fit = fit_with_tables(matches, model, tolerance=1e-5, max_iterations=20, **OPTIONS)
    assert fit.converged
    [posterior] = fit.posteriors

    # the same weights: errors with jitter, stars by their probability of being true
    p = fit.mixture.probability
    assert p.min() > 0.01
    p = np.where(p >= 0.5, p, 1e-12)
    variance = (matches.sigma_u**2 + posterior.jitter**2) / p
    start = model.predict(theta, x, y)
    r = np.stack([matches.u, matches.v], axis=1) - start
    joint = joint_solution(x, y, r, variance, posterior.priors)

    px, py = places(rng, 300)
    shift, sigma = joint.at(px, py)
    got = predict(fit, px, py, chip=1) - model.predict(theta, px, py)
    assert np.abs((got - shift) / sigma).max() < 0.02
    np.testing.assert_allclose(position_sigma(fit, px, py, chip=1), sigma, rtol=0.01)


def test_with_drift_and_frames_the_sum_is_nearly_exact(rng):
    """The tables take their polynomial for constant in time; a dense solve of all does not.

    Sigma and mean of positions at dates within and beyond the data, stars denser on one side.
    """
    drift = TimeDependence((("u", 1, 0), ("v", 0, 1)), (2005.0,))
    names = tuple(f"e{k}" for k in range(6))
    model = DistortionModel(ORDER, (CHIP,), time=drift, frames="shift", exposures=names)
    theta = nearly_flat(model)
    x, y = places(rng, 5000, gradient=True)
    exposure = rng.choice(6, len(x), p=[0.4, 0.2, 0.1, 0.1, 0.1, 0.1])
    epoch = np.array([2002.0, 2003.0, 2005.0, 2009.0, 2010.0, 2012.0])[exposure]
    matches = observed(
        model,
        theta,
        [table_of(rng, PATTERN)],
        x,
        y,
        rng,
        exposure=exposure,
        exposure_names=names,
        epoch=epoch,
    )
    fit = fit_with_tables(matches, model, tolerance=1e-5, max_iterations=20, **OPTIONS)
    [posterior] = fit.posteriors

    p = fit.mixture.probability
    p = np.where(p >= 0.5, p, 1e-12)
    weight = p / (matches.sigma_u**2 + posterior.jitter**2)
    P, n, D = projector(), 320, model.n_params

    def design(px, py, **where) -> np.ndarray:
        """Rows (N, 2, D + 2 n): parameters of the model, nodes of x, nodes of y."""
        W = bilinear(px, py) @ P
        zero = np.zeros_like(W)
        nodes = np.stack([np.hstack([W, zero]), np.hstack([zero, W])], axis=1)
        return np.concatenate([model.jacobian(theta, px, py, **where), nodes], axis=2)

    A = design(x, y, epoch=epoch, exposure=exposure)
    r = np.stack([matches.u, matches.v], axis=1)
    r -= model.predict(theta, x, y, epoch=epoch, exposure=exposure)
    H = np.einsum("nap,n,naq->pq", A, weight, A, optimize=True)
    for a, prior in enumerate(posterior.priors):
        part = slice(D + a * n, D + (a + 1) * n)
        H[part, part] += np.linalg.inv(matern_covariance(prior, *node_pixels()))
    cov = np.linalg.inv(H)
    mean = cov @ np.einsum("nap,n,na->p", A, weight, r)
    px, py = places(rng, 150)
    for date in (2002.0, 2006.0, 2016.0):
        where = {"epoch": date, "exposure": 0}
        rows = design(px, py, **where)
        sigma = np.sqrt(np.einsum("nap,pq,naq->na", rows, cov, rows, optimize=True))
        ratio = position_sigma(fit, px, py, chip=1, **where) / sigma
        assert np.median(np.abs(ratio - 1)) < 0.01 and np.abs(ratio - 1).max() < 0.05
        got = predict(fit, px, py, chip=1, **where) - model.predict(theta, px, py, **where)
        assert np.abs((got - rows @ mean) / sigma).max() < 0.05


def test_rounds_move_less_and_less(rng):
    model = DistortionModel(ORDER, (CHIP,))
    x, y = places(rng, 10_000, gradient=True)
    matches = observed(model, bent(model), [table_of(rng, PATTERN)], x, y, rng)
    seen = []
    fit = fit_with_tables(
        matches, model, tolerance=1e-6, max_iterations=8, report=seen.append, **OPTIONS
    )
    assert tuple(seen) == fit.progress
    moved = [one.moved for one in fit.progress]
    assert fit.converged and moved[-1] < 1e-6
    assert all(b < a for a, b in pairwise(moved))
    assert fit.progress[-1].rms < 0.6 * fit.progress[0].rms
    noise = NOISE * np.sqrt(1.1**2 + 1 / 12)  # of errors between 0.6 and 1.6
    nodes = 1 - 320 / 10_000  # what they take up of it
    assert abs(fit.progress[-1].rms / (noise * np.sqrt(nodes)) - 1) < 0.03
    short = fit_with_tables(matches, model, tolerance=1e-6, max_iterations=1, **OPTIONS)
    assert not short.converged


def test_two_chips_and_turned_exposures(rng):
    """Frames of any roll, and a unit that is no pixel: tables stay in pixels of the detector."""
    model = DistortionModel(
        ORDER,
        (CHIP, SECOND),
        frames="shift_rotation_scale",
        exposures=("a", "b", "c"),
        origin=(16.0, 13.0),
        unit="arcsec",
    )
    theta = bent(replace(model, frames="none")) * 0.05
    theta = np.concatenate([theta, np.zeros(8)])
    for e, angle in ((1, 1.2), (2, 4.0)):
        theta[model.frame_slice(e)] = turned_by(angle, [0.3 * e, -0.2])
    truth = [table_of(rng, PATTERN, 1), table_of(rng, Matern(0.04, 70.0, 1.5), 2)]
    x, y = places(rng, 30_000)
    chip, exposure = rng.integers(2, size=len(x)), rng.integers(3, size=len(x))
    numbers = chip + 1
    px, py = corrected(truth, x, y, chip=numbers)
    uv = model.predict(theta, px, py, chip=numbers, exposure=exposure)
    sigma = np.full(len(x), 0.05 * NOISE)
    matches = Matches(
        x,
        y,
        *(uv + 0.05 * NOISE * rng.standard_normal((len(x), 2))).T,
        sigma_u=sigma,
        sigma_v=sigma,
        unit="arcsec",
        chip=chip,
        chip_numbers=(1, 2),
        exposure=exposure,
        exposure_names=("a", "b", "c"),
    )
    fit = fit_with_tables(matches, model, **OPTIONS)
    assert fit.converged
    for got, want in zip(fit.tables, truth, strict=True):
        assert got.chip == want.chip
        pull = (flat(got) - flat(want)) / flat(LookupTable(got.chip, got.sigma, step=STEP))
        assert 0.8 < (pull**2).mean() < 1.25
    where, there = places(rng, 400), {"exposure": 2, "chip": 2}
    true = model.predict(theta, *corrected(truth, *where, chip=2), **there)
    error = predict(fit, *where, **there) - true
    sigma_uv = position_sigma(fit, *where, **there)
    assert 0.7 < ((error / sigma_uv) ** 2).mean() < 1.4
    assert sigma_uv.max() < 0.05 * NOISE


@pytest.mark.parametrize("method", ["field", case_in_full("binned", instead="fields are run")])
def test_false_matches_are_found_and_do_not_pull(rng, method):
    model = DistortionModel(ORDER, (CHIP,))
    x, y = places(rng, 30_000)
    truth = table_of(rng, PATTERN)
    clean = observed(model, bent(model), [truth], x, y, np.random.default_rng(5))
    foul = observed(model, bent(model), [truth], x, y, np.random.default_rng(5), fraction=0.1)
    tables = []
    for matches in (clean, foul):
        fit = fit_with_tables(matches, model, method=method, tolerance=1e-3, **OPTIONS)
        tables.append(flat(fit.tables[0]) - flat(truth))
    found = fit.mixture
    assert abs(found.fraction - 0.1) < 0.01
    assert fit.solution.n_rows < 0.93 * len(x)
    rms = [np.sqrt((t**2).mean()) for t in tables]
    assert rms[1] < 1.15 * rms[0]  # a tenth of the stars is gone: 5 % by itself


@pytest.mark.slow
@only_in_full("tests/app/campaign has two filters")
def test_filters_have_their_own_polynomial_and_table(rng):
    """Positions in a second filter, with few stars: error and stated sigma agree."""
    model = DistortionModel(ORDER, (CHIP,), frames="shift", exposures=("a", "b", "c"))
    names = ("blue", "red")
    errors, sigmas = [], []
    for _ in range(6):
        detector = table_of(rng, PATTERN)
        own = table_of(rng, Matern(0.02, 100.0, 1.5), filter="blue")
        x, y = places(rng, 16_000, gradient=True)
        filters = (np.arange(len(x)) < 13_000).astype(int)  # "red" is the base
        exposure = np.where(filters == 1, np.arange(len(x)) % 2, 2)
        theta = np.concatenate([bent(DistortionModel(ORDER, (CHIP,))), [0.3, 0.1, -0.2, 0.4]])
        matches = observed(
            model,
            theta,
            [detector, own],
            x,
            y,
            rng,
            filters=filters,
            names=names,
            exposure=exposure,
            exposure_names=model.exposures,
        )
        red, blue = (matches.select(filters == k) for k in (1, 0))
        base = fit_with_tables(red, model, **OPTIONS)
        assert base.solution.model.exposures == ("a", "b")
        fit = fit_with_tables(blue, model, filter="blue", beneath=base.fitted, **OPTIONS)
        assert [t.filter for t in fit.tables] == ["", "blue"]
        assert fit.solution.model.exposures == ("c",)
        px, py = places(rng, 60)
        true = model.predict(
            theta, *corrected([detector, own], px, py, chip=1, filter="blue"), exposure=2
        )
        errors.append(predict(fit, px, py, chip=1) - true)
        sigmas.append(position_sigma(fit, px, py, chip=1))
        for found, stars in ((base, red), (fit, blue)):
            moved = found.corrected(stars)
            want = np.array(corrected(found.tables, x, y, chip=1, filter=found.filter))
            np.testing.assert_array_equal([moved.x, moved.y], want[:, moved.row])
            off = len(stars) - len(moved)  # the rim: 0.05 px of 2300 px and less
            assert moved.rejected.get("moved off the chip", 0) == off < 20
    pull = np.concatenate(errors) / np.concatenate(sigmas)
    assert 0.75 < (pull**2).mean() < 1.3
    assert 0.62 < (np.abs(pull) < 1).mean() < 0.75


def test_residuals_are_clean_afterwards(rng):
    """What the tables leave shows no pattern: neighbouring stars disagree as strangers do."""
    model = DistortionModel(ORDER, (CHIP,))
    x, y = places(rng, 20_000)
    matches = observed(model, bent(model), [table_of(rng, PATTERN)], x, y, rng)
    fit = fit_with_tables(matches, model, **OPTIONS)
    alike = []
    for solution, stars in (
        (fit_linear(matches, model), matches),
        (fit.solution, fit.corrected(matches)),
    ):
        order = np.lexsort((stars.y // 8, stars.x // 8))
        r = pixel_shifts(solution, stars).shift[order, 0]
        alike.append(np.corrcoef(r[1:], r[:-1])[0, 1])
    assert alike[0] > 0.3
    assert abs(alike[1]) < 4 / np.sqrt(len(x))


def test_wrong_input_is_named(rng):
    model = DistortionModel(ORDER, (CHIP,))
    x, y = places(rng, 500)
    matches = observed(model, bent(model), [], x, y, rng, names=("red",))
    with pytest.raises(InputError, match="no method 'spline'"):
        fit_with_tables(matches, model, method="spline", **OPTIONS)
    with pytest.raises(InputError, match="0 iterations"):
        fit_with_tables(matches, model, max_iterations=0, **OPTIONS)
    both = observed(model, bent(model), [], x, y, rng, filters=np.arange(500) % 2, names=("r", "b"))
    with pytest.raises(InputError, match="of filters 'r', 'b'"):
        fit_with_tables(both, model, **OPTIONS)
    fit = fit_with_tables(matches, model, method="binned", **OPTIONS)
    with pytest.raises(InputError, match="covariance of the nodes of binned tables is unknown"):
        fit.shift_variance(x, y, chip=1)
    field = fit_with_tables(matches, model, max_iterations=1, **OPTIONS)
    with pytest.raises(InputError, match="no table for chip 2"):
        field.shift_variance(x, y, chip=2)


def test_a_filter_without_the_exposure_that_holds_the_gauge_is_refused(rng):
    model = DistortionModel(ORDER, (CHIP,), frames="shift", exposures=("a", "b"), gauge="held")
    x, y = places(rng, 500)
    code = np.arange(500) % 2
    theta = np.concatenate([bent(DistortionModel(ORDER, (CHIP,))), [0.3, 0.1]])
    matches = observed(
        model,
        theta,
        [],
        x,
        y,
        rng,
        filters=code,
        names=("red", "blue"),
        exposure=code,
        exposure_names=("a", "b"),
    )
    red, blue = (matches.select(code == k) for k in (0, 1))
    assert fit_with_tables(red, model, max_iterations=1, **OPTIONS).solution.model.exposures == (
        "a",
    )
    with pytest.raises(InputError, match="no match is of exposure 'a', which holds the gauge"):
        fit_with_tables(blue, model, **OPTIONS)
