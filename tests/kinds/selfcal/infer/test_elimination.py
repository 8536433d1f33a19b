"""Elimination of the stars against dense linear algebra, and the density against integrals."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import brentq
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from bayesdist.kinds.selfcal import kernel
from bayesdist.kinds.selfcal.infer import elimination
from bayesdist.kinds.selfcal.infer.elimination import Mixture, StarModes, expand, log_marginal
from bayesdist.kinds.selfcal.infer.problem import Problem
from bayesdist.kinds.selfcal.patterns.exposures import pixels_of
from bayesdist.model import TimeDependence
from tests.kinds.selfcal.infer.fields import field, problem_of, with_ellipses
from tests.reduced import case_in_full

NO_FALSE = Mixture(0.0, 1e-300)


def _dense(problem: Problem, theta, covariances=None):
    """Normal matrix of the distortion, from the full design of distortion and stars.

    If `covariances` (N, 2, 2) of the pixels are given, the weights are made from them and from
    differences of predictions.
    """
    p, model = problem, problem.model
    exposure = p.groups.exposure[p.groups.index]
    chip = np.array([c.number for c in model.chips])[p.groups.chip[p.groups.index]]
    x, y = np.empty(len(p)), np.empty(len(p))
    for one in model.chips:
        rows = chip == one.number
        x[rows] = (p.X[rows] * one.size[0] + one.size[0] + 1) / 2
        y[rows] = (p.Y[rows] * one.size[1] + one.size[1] + 1) / 2
    epoch = p.groups.epoch[p.groups.index] if model.time is not None else None
    J = model.jacobian(theta, x, y, exposure=exposure, chip=chip, epoch=epoch)
    H = p.W[:, [0, 1, 1, 2]].reshape(-1, 2, 2) / p.var[:, None, None]
    if covariances is not None:
        which = {"exposure": exposure, "chip": chip, "epoch": epoch}
        by = [
            (
                model.predict(theta, x + a, y + b, **which)
                - model.predict(theta, x - a, y - b, **which)
            )
            / 2
            for a, b in ((1, 0), (0, 1))
        ]
        pixel = np.stack(by, axis=-1)
        H = np.linalg.inv(pixel @ covariances @ np.swapaxes(pixel, 1, 2))
    S = np.zeros((len(p), 2, p.n_star))
    S[:, 0, 0] = S[:, 1, 1] = 1.0
    if p.n_star >= 4:
        S[:, 0, 2] = S[:, 1, 3] = p.time
    if p.n_star == 5:
        S[:, :, 4] = p.factor
    N = np.einsum("nad,nab,nbe->de", J, H, J)
    for s in range(p.n_stars):
        rows = slice(p.starts[s], p.starts[s + 1])
        A = np.einsum("nap,nab,nbq->pq", S[rows], H[rows], S[rows]) + p.priors.precision[s]
        B = np.einsum("nap,nab,nbe->pe", S[rows], H[rows], J[rows])
        N -= B.T @ np.linalg.solve(A, B)
    return N


@pytest.mark.parametrize("motion", ["none", "proper_motion", "parallax"])
@pytest.mark.parametrize("kind", ["one chip", "two chips", "scale", "drift"])
def test_elimination_is_the_schur_complement(kind, motion):
    simulated = field(
        1,
        9,
        120,
        n_chips=2 if kind == "two chips" else 1,
        frames="shift_rotation_scale" if kind == "scale" else "shift_rotation",
        epochs=np.linspace(2002.0, 2006.0, 9),
    )
    theta, model = simulated.theta, simulated.model
    if kind == "drift":
        time = TimeDependence((("u", 1, 0), ("v", 0, 1)), (2004.0,), ())
        model = replace(model, time=time)
        at = model.n_polynomial
        theta = np.concatenate([theta[:at], [0.002, -0.003], theta[at:]])
        simulated = replace(simulated, model=model, theta=theta)
    factors = np.random.default_rng(0).normal(size=(9, 2))
    problem, stars = problem_of(
        simulated,
        motion=motion,
        parallax_factors=factors,
        min_detections=5 if motion != "none" else 2,
    )
    found, _ = expand(problem, theta, NO_FALSE, stars)
    dense = _dense(problem, theta)
    assert np.abs(found.curvature - dense).max() < 1e-9 * np.abs(dense).max()


def test_covariances_of_detections_weigh_distortion_and_stars():
    """Errors of all shapes: the weights are those of numpy, and stars are at weighted means."""
    simulated = with_ellipses(field(3, 8, 150, n_chips=2, sigma=1e-9), 3)
    theta = simulated.theta
    problem, stars = problem_of(simulated)
    covariances = simulated.detections.covariances[problem.rows]
    found, modes = expand(problem, theta, NO_FALSE, stars)
    dense = _dense(problem, theta, covariances)
    # pixels are not quite parallelograms over the step of the differences
    assert np.abs(found.curvature - dense).max() < 1e-5 * np.abs(dense).max()
    # quoted errors without their correlations would be wrong by much more
    bare = covariances * np.eye(2)
    assert np.abs(found.curvature - _dense(problem, theta, bare)).max() > 0.1 * dense.max()
    H = problem.W[:, [0, 1, 1, 2]].reshape(-1, 2, 2) / problem.var[:, None, None]
    z = problem.places(theta)
    sums = [np.add.reduceat(v, problem.starts[:-1]) for v in (H, np.einsum("nab,nb->na", H, z))]
    mean = np.linalg.solve(sums[0], sums[1][..., None])[..., 0]
    np.testing.assert_allclose(modes, mean, atol=1e-6)


def test_the_density_is_that_of_bivariate_normals():
    """Integrated over the stars, in closed form, with differences between parameters."""
    simulated = with_ellipses(field(4, 5, 40, order=2, sigma=1e-9), 4)
    theta, rng = simulated.theta, np.random.default_rng(4)
    problem, stars = problem_of(simulated)
    C = simulated.detections.covariances[problem.rows]
    modes = StarModes.at(problem, theta, NO_FALSE, expand(problem, theta, NO_FALSE, stars)[1])
    tried = theta + 1e-4 * rng.standard_normal((3, len(theta)))
    found = log_marginal(problem, tried, np.tile([0.0, 1e-300], (3, 1)), modes)
    J = problem.jacobians(theta, slice(0, len(problem)))
    on_sky = J @ C @ np.swapaxes(J, 1, 2)
    expected = []
    for one in tried:
        z, total = problem.places(one), 0.0
        for a, b in zip(problem.starts[:-1], problem.starts[1:], strict=True):
            # a prior of one pixel, 50 times the errors, of the place of the star
            cov = block_diag(*on_sky[a:b]) + np.kron(np.ones((b - a, b - a)), np.eye(2))
            total += multivariate_normal.logpdf((z[a:b] - z[a:b].mean(axis=0)).ravel(), cov=cov)
        expected.append(total)
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-3, atol=1e-2)


def test_few_matrices_of_all_parameters_are_in_memory_at_a_time(monkeypatch):
    """One thread has the curvature, the sum of its stars, and nothing else as large."""
    simulated = field(1, 150, 60, frames="affine")
    problem, stars = problem_of(simulated)
    monkeypatch.setattr(elimination, "STARS", 8)
    monkeypatch.setattr(elimination, "ELIMINATION", 0)  # too little for a second thread
    matrix = 8 * problem.model.n_params**2
    assert matrix > 5e6
    expand(problem, simulated.theta, NO_FALSE, stars)
    tracemalloc.start()
    try:
        expand(problem, simulated.theta, NO_FALSE, stars)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2.7 * matrix


def test_gradient_is_that_of_the_density():
    simulated = field(2, 8, 150)
    problem, stars = problem_of(simulated)
    theta = simulated.theta
    found, modes = expand(problem, theta, NO_FALSE, stars)
    rng, scale = np.random.default_rng(0), 1 / np.sqrt(np.diag(found.curvature))
    anchor = StarModes.at(problem, theta, NO_FALSE, modes)
    for _ in range(4):
        step = scale * rng.normal(size=len(theta))
        near = theta + np.outer([0.03, -0.03], step)
        value = log_marginal(problem, near, np.tile([0.0, 1e-300], (2, 1)), anchor)
        slope = (value[0] - value[1]) / 0.06
        assert slope == pytest.approx(found.gradient @ step, rel=1e-4, abs=1e-3)
        bend = (2 * found.value - value.sum()) / 0.03**2
        assert bend == pytest.approx(step @ found.curvature @ step, rel=1e-3)


def test_expansion_and_density_agree():
    simulated = field(3, 8, 150, disturbed=0.03)
    problem, stars = problem_of(simulated)
    theta, mixture = simulated.theta, Mixture(0.01, 0.03)
    found, modes = expand(problem, theta, mixture, stars)
    anchor = StarModes.at(problem, theta, mixture, modes)
    # where it is doubtful who is a member the expansion knows one choice, the density all of them
    assert (anchor.state == kernel.DOUBTFUL).any()
    anchor = replace(anchor, state=np.full(len(problem), kernel.MEMBER, np.int8))
    value = log_marginal(problem, theta[None], np.array([[0.01, 0.03]]), anchor)
    assert value[0] == pytest.approx(found.value, abs=1e-8)


def _alone(problem, s):
    """The problem of one star."""
    rows = slice(problem.starts[s], problem.starts[s + 1])
    return replace(
        problem,
        starts=np.array([0, rows.stop - rows.start]),
        groups=replace(problem.groups, index=problem.groups.index[rows]),
        **{k: getattr(problem, k)[rows] for k in ("X", "Y", "offset", "W", "var", "rows")},
        seen=problem.seen[:, rows],
        priors=replace(
            problem.priors,
            centre=problem.priors.centre[s : s + 1],
            precision=problem.priors.precision[s : s + 1],
        ),
    )


def _quadrature(one, theta, mixture, low, high, n=401):
    """Log of the integral over the place of the star of a problem, on a grid of places."""
    j2, log_core, log_out = mixture.constants(one.log_outlier)
    s2, W, z = one.var + j2, one.W, one.places(theta)
    u, v = (np.linspace(a, b, n) for a, b in zip(low, high, strict=True))
    r = z[:, None, None] - np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
    square = np.einsum("i,iuv->iuv", W[:, 0], r[..., 0] ** 2)
    square += np.einsum("i,iuv->iuv", W[:, 2], r[..., 1] ** 2)
    square += 2 * np.einsum("i,iuv,iuv->iuv", W[:, 1], r[..., 0], r[..., 1])
    norm = (log_core - np.log(2 * np.pi * s2))[:, None, None]
    value = np.logaddexp(norm - 0.5 * square / s2[:, None, None], log_out).sum(axis=0)
    return logsumexp(value) + np.log((u[1] - u[0]) * (v[1] - v[0]))


def test_star_integral():
    """The mixture integrated over the place of one star, against quadrature."""
    simulated = field(4, 6, 60, disturbed=0.1)
    problem, _ = problem_of(simulated, min_detections=4)
    theta, mixture = simulated.theta, Mixture(0.005, 0.05)
    checked, rough, exact = 0, [], []
    for s in range(0, problem.n_stars, 3):
        one = _alone(problem, s)
        true = simulated.detections.star[one.rows[0]]
        found, modes = expand(one, theta, mixture, simulated.sky[true][None])
        width = 8 * np.sqrt(one.var.max() + mixture.jitter**2)
        want = _quadrature(one, theta, mixture, modes[0] - width, modes[0] + width)
        anchor = StarModes.at(one, theta, mixture, modes)
        [value] = log_marginal(
            one, theta[None], np.array([[mixture.jitter, mixture.fraction]]), anchor
        )
        rough.append(found.value + np.log(2 * np.pi) - want)
        exact.append(value + np.log(2 * np.pi) - want)
        checked += 1
    assert checked > 5
    # detections that are neither clearly true nor clearly false skew the integrand
    assert np.abs(rough).max() < 0.05
    assert np.abs(exact).max() < 0.01


@pytest.mark.parametrize("n", [3, case_in_full(8, instead="stars of three are run")])
def test_a_detection_that_goes_away_from_its_star(n, full):
    """From 5 to 11 errors off: modes come and go, and the integral over the place follows.

    What is doubtful is told at one solution, at 8: no draw carries a detection as far from there.
    """
    simulated = field(4, n, 60)
    problem, _ = problem_of(simulated, min_detections=n)
    one, theta, mixture = _alone(problem, 0), simulated.theta, Mixture(0.0, 0.02)
    place = simulated.sky[simulated.detections.star[one.rows[0]]][None]
    sigma = np.sqrt(one.var[0])
    given = np.array([[mixture.jitter, mixture.fraction]])
    reach = np.array([20.0, 8.0]) * sigma

    def moved(away):
        offset = one.offset.copy()
        offset[0, 0] += away * sigma
        return replace(one, offset=offset)

    # all of them false: the star may then be anywhere in the match circle, not in the grid's window
    none = len(one) * mixture.constants(one.log_outlier)[2]
    room = 2 * np.pi / one.least_root**2 - 4 * reach.prod()
    at = moved(8.0)
    anchor = StarModes.at(at, theta, mixture, expand(at, theta, mixture, place)[1])
    for away in np.linspace(5.0, 11.0, 25 if full else 13):
        here = moved(away)
        value = log_marginal(here, theta[None], given, anchor)[0] + np.log(2 * np.pi)
        want = _quadrature(here, theta, mixture, place[0] - reach, place[0] + reach, 801)
        want = logsumexp([want, none], b=[1.0, room])
        # a detection that counts as a member for sure might be false with a chance of a hundredth
        # at most, and is far from that in general
        assert value == pytest.approx(want, abs=1e-3 * n), away


def test_a_larger_sky_is_no_better_than_a_smaller_one():
    """Scale is no parameter that detections know: errors are those on the detector."""
    simulated = field(5, 8, 200)
    problem, stars = problem_of(simulated)
    theta, model = simulated.theta, simulated.model
    _, modes = expand(problem, theta, Mixture(0.0, 0.01), stars)
    grown = theta.copy()
    for e in range(1, len(model.exposures)):
        shift = model.frame_slice(e).start
        grown[shift : shift + 2] *= 1.001
    o = np.asarray(model.origin)
    for axis in range(2):
        at = model.coefficient_slice(1, axis)
        grown[at] *= 1.001
        grown[at.start] -= 0.001 * o[axis]
    values = log_marginal(
        problem,
        np.stack([theta, grown]),
        np.tile([0.0, 0.01], (2, 1)),
        StarModes.at(problem, theta, Mixture(0.0, 0.01), modes),
    )
    # of 2 n squared residuals a thousandth would be 2; what is left is of second order
    assert len(problem) > 500
    assert abs(values[1] - values[0]) < 0.2


def test_aberration_is_undone():
    """Exposures whose sky is dilated by known factors have the same residuals as the others."""
    simulated = field(7, 8, 150, sigma=0.001)
    model, theta, d = simulated.model, simulated.theta, simulated.detections
    dilation = 1.0 + 1e-4 * np.random.default_rng(1).normal(size=8)
    dilation /= dilation[0]
    # the telescope points where it did and the sky about the frames' origin is larger
    o, moved = np.asarray(model.origin), theta.copy()
    sky = o + (simulated.sky - o)
    x, y = d.x.copy(), d.y.copy()
    for e, k in enumerate(dilation):
        rows = d.exposure == e
        stars = sky[d.star[rows]]
        found = pixels_of(model, theta, o + (stars - o) / k, e, model.chips[0])
        x[rows], y[rows] = found[:2]
    seen = replace(simulated, detections=replace(d, x=x, y=y))
    with_factor, stars = problem_of(seen, dilation=dilation)
    without, _ = problem_of(seen)
    found, modes = expand(with_factor, moved, NO_FALSE, stars)
    assert np.sqrt(with_factor.squares(moved, modes).mean()) < 1e-6
    _, other = expand(without, moved, Mixture(1.0, 1e-300), without.mean_places(moved))
    assert np.sqrt(without.squares(moved, other).mean()) > 0.01


def test_stars_that_left_their_detections_are_found_again():
    simulated = field(6, 8, 150)
    problem, stars = problem_of(simulated)
    far = stars.copy()
    some = np.arange(0, problem.n_stars, 7)
    far[some, 0] += 5.0
    again = problem.found_again(simulated.theta, far)
    np.testing.assert_allclose(again[some], problem.middles(simulated.theta)[some])
    others = np.setdiff1d(np.arange(problem.n_stars), some)
    assert np.array_equal(again[others], stars[others])


@pytest.mark.parametrize("distance", [0.1, 0.2, 0.3, 0.5, 1.0, 3.0])
def test_information_is_never_negative(distance):
    """Wherever the search for a star begins: with EM weights the curvature is a sum of squares."""
    simulated = field(6, 8, 150)
    problem, stars = problem_of(simulated)
    mixture = Mixture(0.0, 0.01)
    angle = np.random.default_rng(0).uniform(0, 2 * np.pi, problem.n_stars)
    far = stars + distance * np.column_stack([np.cos(angle), np.sin(angle)])
    H = expand(problem, simulated.theta, mixture, far, observed=False)[0].curvature
    best = expand(problem, simulated.theta, mixture, stars, observed=False)[0].curvature
    scale = np.sqrt(np.diag(best))
    assert np.linalg.eigvalsh(H / np.outer(scale, scale))[0] > -1e-9


def test_information_is_not_negative_where_a_star_is_hardly_curved():
    """Three detections in a row, whose curvatures along it almost cancel at the middle one.

    With w the probability that a detection at a distance r is a true one, and s its error, its
    curvature is w (1 - (1 - w) r^2 / s^2) / s^2; the outer two are negative.
    """
    simulated = field(6, 8, 150)
    problem, stars = problem_of(simulated)
    mixture, theta = Mixture(0.1, 0.01), simulated.theta
    star = int(np.flatnonzero(problem.counts == 3)[0])
    rows = problem.starts[star] + np.arange(3)
    var, W = problem.var.copy(), problem.W.copy()
    var[rows], W[rows] = var[rows[0]], W[rows[0]]
    s2, uu = var[rows[0]] + mixture.jitter**2, W[rows[0], 0]
    odds = 2 * np.pi * s2 * np.exp(problem.log_outlier) * mixture.fraction / (1 - mixture.fraction)

    def curvature(r: float) -> float:
        w = 1 / (1 + odds * np.exp([0.0, uu * r * r / (2 * s2)]))
        outer = uu - (1 - w[1]) * (uu * r) ** 2 / s2
        return (w[0] * uu + 2 * w[1] * outer) / s2 - 0.1 * problem.least_root**2

    apart = brentq(curvature, 0.2, 0.4)
    places, middle = problem.places(theta)[rows], stars[star]
    offset = problem.offset.copy()
    offset[rows] += middle + np.array([[0.0, 0.0], [apart, 0.0], [-apart, 0.0]]) - places
    row = replace(problem, var=var, W=W, offset=offset)
    H = expand(row, theta, mixture, stars, observed=False)[0].curvature
    best = expand(problem, theta, mixture, stars, observed=False)[0].curvature
    scale = np.sqrt(np.diag(best))
    assert np.linalg.eigvalsh(H / np.outer(scale, scale))[0] > -1e-9
