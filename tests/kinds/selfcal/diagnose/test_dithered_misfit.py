"""Structure that a self-calibration leaves is found, where fitted stars do not hide it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesdist.kinds.selfcal.diagnose.eliminated import taken_by_stars
from bayesdist.kinds.selfcal.diagnose.tests import _shifts, dithered_misfit
from bayesdist.kinds.selfcal.infer import self_calibrate
from bayesdist.kinds.selfcal.infer.elimination import memberships
from tests.kinds.selfcal.dithered_fields import simulate_dithers, smooth_distortion
from tests.kinds.selfcal.infer.fields import SIZE, chips, field, with_ellipses


def _solved(simulated, detections=None):
    return self_calibrate(
        simulated.model,
        simulated.unlabelled if detections is None else detections,
        simulated.theta,
        match_radius=1.0,
        start_radius=2.0,
    ).mode


def _simulated(seed, **more):
    return field(seed, 8, 900, disturbed=0.025, spurious=0.025, **more)


def _waved(detections, rms, period=150.0):
    wave = np.sqrt(2) * rms * np.sin(2 * np.pi * detections.x / period)
    return replace(detections, x=detections.x + wave)


def test_a_wave_is_found_with_its_size():
    simulated = _simulated(5)
    found = dithered_misfit(_solved(simulated, _waved(simulated.unlabelled, 0.01)))
    assert found.significant and found.partition == "columns" and found.power > 0.95
    # means over columns of 150 / 1024 * 64 bins hold nearly all of the wave
    assert abs(found.structure - 0.01) < 0.0015


def test_a_wave_on_the_second_chip_is_found_along_its_axis():
    simulated = _simulated(6, n_chips=2)
    d = simulated.unlabelled
    wave = 0.02 * np.sqrt(2) * np.sin(2 * np.pi * d.y / 150.0)
    found = dithered_misfit(_solved(simulated, replace(d, y=d.y + np.where(d.chip == 2, wave, 0))))
    assert found.significant and found.partition == "rows"
    # over both chips: half of the area has it
    assert abs(found.structure - 0.02 / np.sqrt(2)) < 0.002


def test_errors_of_elongated_images_are_no_structure():
    """Sums along both axes are nearly one; a wave on top is found with its size."""
    p = []
    for seed in range(4):
        simulated = with_ellipses(field(seed, 8, 600, sigma=1e-9), seed, rho=0.95)
        solved = _solved(simulated)
        p.append(dithered_misfit(solved).p_value)
        w = memberships(solved.problem, solved.theta, solved.mixture, solved.stars)
        whole = np.bincount(solved.problem.star, w > 0.999) == solved.problem.counts
        # the two numbers of a position are one in two of each detection's
        taken = np.bincount(solved.problem.star, taken_by_stars(solved))[whole]
        np.testing.assert_allclose(taken[solved.problem.counts[whole] > 2], 1.0, atol=0.02)
    assert min(p) > 1e-3 / 4 and max(p) > 0.03
    found = dithered_misfit(_solved(simulated, _waved(simulated.unlabelled, 0.02)))
    assert found.significant and abs(found.structure - 0.02) < 0.004


def test_what_small_dithers_hide_is_said():
    """Stars that hardly move take the wave up; nobody could see it, and none is claimed."""
    rng = np.random.default_rng(3)
    parts = chips()
    offsets = np.array([[0, 0], [3, 1], [-2, 4], [1, -3], [4, 4], [-4, -1]]) / 8
    simulated = simulate_dithers(
        parts,
        smooth_distortion(3, parts, 3.0, rng),
        offsets,
        np.zeros(6),
        n_stars=900,
        rng=rng,
        sigma=(0.01, 0.05),
    )
    found = dithered_misfit(_solved(simulated, _waved(simulated.unlabelled, 0.01)))
    assert found.power < 0.2 and found.underpowered
    assert not found.significant


def test_a_star_of_as_many_numbers_as_detections_takes_all():
    """Two detections, position and motion: nothing is left, and no number is lost to rounding."""
    simulated = field(4, 6, 60, order=1, epochs=np.linspace(2020, 2022, 6))
    found = self_calibrate(
        simulated.model,
        simulated.unlabelled,
        simulated.theta,
        match_radius=1.0,
        start_radius=2.0,
        motion="proper_motion",
    ).mode
    counts = found.problem.counts
    assert (counts == 2).any() and counts.max() == 6
    taken = taken_by_stars(found)
    assert np.isfinite(taken).all() and taken.max() <= 0.99
    np.testing.assert_allclose(taken[counts[found.problem.star] == 2], 0.99)
    # of detections that are all members, the numbers of a star are shared among them
    w = memberships(found.problem, found.theta, found.mixture, found.stars)
    whole = np.bincount(found.problem.star, w > 0.999) == counts
    shares = np.bincount(found.problem.star, taken)[whole & (counts > 2)]
    np.testing.assert_allclose(shares, 2.0, atol=0.02)
    assert np.isfinite(dithered_misfit(found).p_value)


def _brute(solution, bins):
    """Hat matrix of the stars, and pull and curvature of shifts of cells, by dense algebra.

    Derivatives are those of the places' finite differences.
    """
    p, theta = solution.problem, solution.theta
    n, step = len(p), 0.01
    slopes = np.empty((n, 2, 2))
    half = SIZE[0] / 2
    for k, name in enumerate(("X", "Y")):
        off = [
            replace(p, **{name: getattr(p, name) + sign * step / half}).places(theta)
            for sign in (1, -1)
        ]
        slopes[:, :, k] = (off[0] - off[1]) / (2 * step)
    weight = memberships(p, theta, solution.mixture, solution.stars) / (
        p.var + solution.mixture.jitter**2
    )
    to_pixels = np.linalg.inv(slopes)
    stars = np.zeros((2 * n, 2 * p.n_stars))
    for i, s in enumerate(p.star):
        stars[2 * i : 2 * i + 2, 2 * s : 2 * s + 2] = to_pixels[i]
    residual = np.einsum("nij,nj->ni", to_pixels, p.places(theta) - p.star_places(solution.stars))
    cells = np.zeros((2 * n, 2 * bins[0] * bins[1]))
    ix, iy = (
        np.floor((seen + 1) / 2 * b).astype(int) for seen, b in zip(p.seen, bins, strict=True)
    )
    for i, c in enumerate(iy * bins[0] + ix):
        cells[2 * i, c] = cells[2 * i + 1, bins[0] * bins[1] + c] = 1.0
    root = np.sqrt(np.repeat(weight, 2))[:, None]
    A, G = root * stars, root * cells
    hat = A @ np.linalg.solve(A.T @ A, A.T)
    return hat, G.T @ (root[:, 0] * residual.ravel()), G.T @ (G - hat @ G)


def test_stars_are_eliminated_as_by_dense_algebra():
    simulated = field(2, 5, 60, order=2, disturbed=0.05)
    solution = _solved(simulated)
    hat, pull, curvature = _brute(solution, (4, 3))
    [found] = _shifts(solution, [(4, 3)])
    np.testing.assert_allclose(found.gradient, pull, atol=1e-6 * np.abs(pull).max())
    np.testing.assert_allclose(found.curvature, curvature, atol=1e-6 * curvature.max())
    share = np.diag(hat).reshape(-1, 2).mean(axis=1)
    np.testing.assert_allclose(taken_by_stars(solution), share, atol=1e-6)
