"""Patterns: errors as actual solutions scatter, and the order in which patterns come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.sparse import coo_array, csr_array, hstack
from scipy.sparse.linalg import spsolve

from bayesdist.errors import InputError
from bayesdist.kinds.selfcal.infer import self_calibrate
from bayesdist.kinds.selfcal.patterns.dithers import (
    Camera,
    PlannedStars,
    PriorInformation,
    compare_patterns,
    lacking,
)
from bayesdist.kinds.selfcal.patterns.exposures import (
    DitherPattern,
    dither_pattern,
    dithered_model,
    flat_coefficients,
    grid_offsets,
    rolls_in_turn,
    sky_seen,
    stars_on_detector,
)
from bayesdist.model import Chip
from tests.kinds.selfcal.dithered_fields import simulate_dithers, smooth_distortion
from tests.kinds.selfcal.infer.fields import aligned
from tests.reduced import case_in_full

SIZE = (1024.0, 1024.0)
CHIP = Chip(1, "C", SIZE, (512.0, 512.0))
CAMERA = Camera((CHIP,), flat_coefficients(3, (CHIP,)))
STARS = PlannedStars(600.0, 0.02)
NOTHING = PriorInformation()


def _pattern(name="some", n=8, rolls=(0, 60, 130), largest=0.75):
    rng = np.random.default_rng(3)
    return DitherPattern(name, *dither_pattern(n, SIZE, rolls, rng, largest=largest))


def _deviation(model, truth, free, rng):
    """Errors (F,) of one campaign, by sparse least squares with every star a parameter."""
    low, high = sky_seen(model, truth)
    n = rng.poisson(STARS.per_detector * np.prod(high - low) / np.prod(SIZE))
    sky = low + rng.uniform(size=(n, 2)) * (high - low)
    x, y, exposure, chip, star = stars_on_detector(model, truth, sky)
    twice = np.bincount(star, minlength=n)[star] >= 2
    x, y, exposure, chip, star = (a[twice] for a in (x, y, exposure, chip, star))
    _, star = np.unique(star, return_inverse=True)
    noisy = [a + STARS.sigma * rng.normal(size=len(a)) for a in (x, y)]
    where = {"exposure": exposure, "chip": chip}
    off = model.predict(truth, *noisy, **where) - model.predict(truth, x, y, **where)
    J = model.jacobian(truth, x, y, **where)[:, :, free].reshape(2 * len(x), -1)
    row = np.arange(2 * len(x))
    column = 2 * np.repeat(star, 2) + np.tile([0, 1], len(x))
    S = coo_array((-np.ones(len(row)), (row, column)))
    A = hstack([csr_array(J), S]).tocsc()
    scale = 1.0 / np.sqrt(np.asarray(A.multiply(A).sum(axis=0)).ravel())
    A = (A * scale).tocsc()
    solved = spsolve((A.T @ A).tocsc(), -A.T @ off.ravel()) * scale
    return solved[: len(free)]


@pytest.mark.parametrize(
    "rolls",
    [
        pytest.param((0, 60, 130), id="three rolls"),
        case_in_full((0,), instead="three rolls are run", id="one roll"),
    ],
)
def test_expected_covariance_is_the_scatter_of_solutions(rolls, full, capsys):
    """Campaigns, each of its own stars and noise, solved by other means."""
    times = 40 if full else 20
    pattern = _pattern(rolls=rolls)
    [found] = compare_patterns([pattern], CAMERA, STARS, NOTHING)
    solution = found.solution
    free = np.setdiff1d(np.arange(solution.model.n_params), solution.gauge.held)
    cov = solution.cov[np.ix_(free, free)]
    rng = np.random.default_rng(5)
    off = np.array([_deviation(solution.model, solution.mean, free, rng) for _ in range(times)])
    chi2 = np.einsum("nf,nf->", off, np.linalg.solve(cov, off.T).T)
    low, high = stats.chi2.ppf([0.005, 0.995], off.size)
    n = found.solution.model.n_polynomial - solution.gauge.held.size
    ratio = np.sqrt((off[:, :n] ** 2).mean(axis=0) / np.diag(cov)[:n])
    with capsys.disabled():
        print(
            f"\nexpected covariance, {pattern.name}, rolls {rolls}: chi-square {chi2:.0f} of "
            f"{off.size}; scatter of coefficients over expected {ratio.min():.2f} to "
            f"{ratio.max():.2f}, mean {ratio.mean():.3f}"
        )
    assert low < chi2 < high
    # each coefficient by itself
    z = stats.chi2.ppf([0.0001, 0.9999], times)
    assert (ratio > np.sqrt(z[0] / times)).all() and (ratio < np.sqrt(z[1] / times)).all()


@pytest.mark.slow
def test_false_detections_cost_what_is_expected(full, capsys):
    """Campaigns with 5 % false detections, by the whole self-calibration."""
    n = 30 if full else 10
    pattern, false, sigma = _pattern(n=9), 0.05, 0.02
    truth = dithered_model(CAMERA.chips, CAMERA.coefficients, pattern.offsets, pattern.rolls)
    low, high = sky_seen(*truth)
    stars = PlannedStars(400.0, sigma, false, least=3)
    n_stars = int(stars.per_detector * np.prod(high - low) / CAMERA.pixels)
    [found] = compare_patterns([pattern], CAMERA, stars, NOTHING)
    gauge, cov = found.solution.gauge, found.solution.cov
    free = np.setdiff1d(np.arange(len(cov)), gauge.held)
    chi2, dof = 0.0, n * len(free)
    for seed in range(100, 100 + n):
        simulated = simulate_dithers(
            CAMERA.chips, CAMERA.coefficients, pattern.offsets, pattern.rolls, n_stars=n_stars,
            rng=np.random.default_rng(seed), sigma=sigma, disturbed=false,
        )  # fmt: skip
        solved = self_calibrate(
            simulated.model, simulated.unlabelled, simulated.theta, match_radius=1.0, jitter=0.0,
            min_detections=3,
        ).mode  # fmt: skip
        off = (aligned(solved.theta, simulated.theta, gauge) - simulated.theta)[free]
        chi2 += off @ np.linalg.solve(cov[np.ix_(free, free)], off)
    with capsys.disabled():
        print(f"\n5 % false: chi-square {chi2:.0f} of {dof}")
    low, high = stats.chi2.ppf([0.005, 0.995], dof)
    assert low < chi2 < high


def test_laws_of_errors_and_numbers():
    """Errors scale with those of detections, and with the root of the number of stars."""
    pattern = _pattern()
    [one] = compare_patterns([pattern], CAMERA, STARS, NOTHING)
    [worse] = compare_patterns([pattern], CAMERA, replace(STARS, sigma=0.06), NOTHING)
    assert worse.rms("shape") == pytest.approx(3 * one.rms("shape"), rel=1e-6)
    [more] = compare_patterns([pattern], CAMERA, replace(STARS, per_detector=5400.0), NOTHING)
    assert more.rms("shape") == pytest.approx(one.rms("shape") / 3, rel=0.05)


def test_absolute_scale_by_closed_form():
    """Commanded offsets fix the scale as a regression does, whatever the rolls."""
    pattern, sigma = _pattern(), 0.3
    stars, known = replace(STARS, sigma=0.001), PriorInformation(sigma)
    [found] = compare_patterns([pattern], CAMERA, stars, known)
    lever = np.sqrt(((pattern.offsets - pattern.offsets.mean(axis=0)) ** 2).sum())
    expected = sigma / lever
    for name in ("scale", "rotation"):
        one = next(d for d in found.solution.gauge.directions if d.name == name)
        assert one.free and one.sigma_fixed == pytest.approx(expected, rel=1e-3)
    # on a square of side a a relative error s of scale and of rotation is, in the mean square over
    # the detector, s^2 a^2 / 6 on each axis; the grid has its edges in
    a = SIZE[0] - 1
    grid = [np.linspace(-a / 2, a / 2, k) for k in (33, 17)]
    square = sum((g**2).mean() for g in grid)
    assert found.rms("absolute") == pytest.approx(expected * np.sqrt(square), rel=1e-3)
    # a scale of better error beside them
    tied = PriorInformation(sigma, scale_sigma=1e-6)
    [found] = compare_patterns([pattern], CAMERA, replace(STARS, sigma=0.001), tied)
    scale = next(d for d in found.solution.gauge.directions if d.name == "scale")
    assert scale.sigma_fixed == pytest.approx(1 / np.hypot(1 / expected, 1e6), rel=1e-3)


def _of_five_pixels(rolls, name):
    round_ = grid_offsets((3, 3), (5.0, 5.0))
    turned = np.radians(rolls_in_turn(9, 9, rolls))
    return DitherPattern(name, round_ - round_[0], turned - turned[0])


def test_large_offsets_with_rolls_are_best_and_five_pixels_alone_worst():
    patterns = [
        _of_five_pixels((0,), "5 pix"),
        _pattern("3/4", 9, (0,)),
        _of_five_pixels((0, 60, 130), "5 pix, rolls"),
        _pattern("3/4, rolls", 9),
    ]
    known = PriorInformation(offset_sigma=0.1)
    found = compare_patterns(patterns, CAMERA, STARS, known)
    assert [one.pattern.name for one in found] == ["3/4, rolls", "5 pix, rolls", "3/4", "5 pix"]
    by_name = {one.pattern.name: one for one in found}
    # without rolls a small step says of a polynomial only how it changes along the step
    short, long_ = by_name["5 pix"].by_degree, by_name["3/4"].by_degree
    assert all(short[k] > 5 * long_[k] for k in (2, 3))
    assert short[2] > short[3]  # low orders change least along it
    assert not lacking(by_name["3/4, rolls"])
    text = " | ".join(lacking(by_name["5 pix"]))
    assert "no rolls: linear skew rests on the commanded offsets" in text
    assert "no large offsets: two pointings are 14.1 pix apart at most, 0.014 of" in text
    # nothing known: without rolls nothing bounds the shape
    free = {one.pattern.name: one for one in compare_patterns(patterns, CAMERA, STARS, NOTHING)}
    assert not np.isfinite(free["3/4"].rms("shape")) and free["3/4"].maps["absolute"] is None
    assert np.isfinite(free["3/4"].rms("gauge-free")) and free["3/4"].n_free == 6
    assert "cannot be told from one of the sky" in lacking(free["3/4"])[0]
    # commands of 0.1 pix say next to nothing of a shape that thousands of stars know
    for one in (free, by_name):
        assert one["3/4, rolls"].rms("shape") == pytest.approx(one["3/4, rolls"].rms("gauge-free"))
    known_shape, alone = (one["3/4, rolls"].rms("shape") for one in (by_name, free))
    assert alone == pytest.approx(known_shape, rel=1e-3) and alone > known_shape


def test_offsets_along_one_line_and_rolls_alone_are_told():
    line = DitherPattern("line", np.outer(np.arange(5) * 100.0, [1.0, 0.5]), np.zeros(5))
    turned = DitherPattern("turned", np.zeros((4, 2)), np.radians([0, 40, 90, 140]))
    found = {
        one.pattern.name: one
        for one in compare_patterns([line, turned], CAMERA, STARS, PriorInformation(0.1))
    }
    assert any("along one line" in text and "is free" in text for text in lacking(found["line"]))
    # with s along the line and t across it: two zero points, four linear maps, t^2 and t^3 on both
    # axes, and (-s t, s^2 / 2), which a step along s changes by a rotation
    assert found["line"].n_free == 2 + 4 + 2 * 2 + 1
    assert any("radial distortion, is free" in text for text in lacking(found["turned"]))


def test_half_turns_are_no_rolls():
    [found] = compare_patterns([_pattern(rolls=(0, 180))], CAMERA, STARS, NOTHING)
    assert lacking(found)[0].startswith("no rolls but half turns: a linear skew")
    assert found.n_free == 6 and found.maps["shape"] is None


def test_chips_that_share_no_star():
    chips = (CHIP, Chip(2, "D", SIZE, (512.0, 512.0)))
    camera = Camera(chips, flat_coefficients(3, chips))
    found = {
        one.pattern.name: one
        for one in compare_patterns(
            [_of_five_pixels((0,), "5 pix"), _pattern("3/4", 9)], camera, STARS, NOTHING
        )
    }
    assert not found["5 pix"].chips_share_stars and found["3/4"].chips_share_stars
    assert any("no star is seen on two chips" in text for text in lacking(found["5 pix"]))
    # the one above the other may be shifted; its rotation and scale go with steps of the exposures
    gauge = found["5 pix"].solution.gauge
    assert {"D.shift_u", "D.shift_v"} == {n for n in gauge.free_names if n.startswith("D.")}
    assert found["5 pix"].n_free == 6 + 2 and not gauge.unnamed
    assert camera.side == pytest.approx(1024.0, abs=1.0)


def test_a_strong_distortion_changes_little():
    """Without knowing it, a plan for a flat detector holds to a few percent."""
    pattern = _pattern(n=12)
    strong = smooth_distortion(3, (CHIP,), 20.0, np.random.default_rng(4))  # 4 % of the half side
    flat, bent = (
        compare_patterns([pattern], camera, replace(STARS, per_detector=3000.0), NOTHING)[0]
        for camera in (CAMERA, Camera((CHIP,), strong))
    )
    assert bent.rms("shape") == pytest.approx(flat.rms("shape"), rel=0.03)


def test_exposures_that_do_not_overlap_are_named():
    far = np.array([[0, 0], [10, 0], [5000, 0], [5010, 0], [-9000.0, 0]])
    with pytest.raises(InputError, match=r"'far': .* 3 groups .*: 1, 2 \| 3, 4 \| 5 \(numbers"):
        compare_patterns([DitherPattern("far", far, np.zeros(5))], CAMERA, STARS, NOTHING)
    with pytest.raises(InputError, match=r"stars\.per_detector: .* stars; give fewer"):
        compare_patterns([_pattern()], CAMERA, replace(STARS, per_detector=1e7), NOTHING)


def test_every_offset_meets_every_roll():
    for n_offsets, rolls in ((9, 3), (4, 3), (2, 3), (6, 4), (1, 3)):
        turned = rolls_in_turn(n_offsets * rolls, n_offsets, range(rolls))
        pairs = {(k % n_offsets, r) for k, r in enumerate(turned)}
        assert len(pairs) == n_offsets * rolls
