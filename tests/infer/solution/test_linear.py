"""The linear fit against numpy and scipy, and its covariance against repeated experiments."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares

from bayesdist.data import Matches
from bayesdist.errors import InputError
from bayesdist.infer import GaussianPriors, Rejection, build_model, fit_linear, residuals
from bayesdist.model import FRAME_KINDS, DistortionModel, TimeDependence
from tests.reduced import only_in_full

from ..support import (
    CHIP,
    SIZE,
    TWO_CHIPS,
    UNCLIPPED,
    exposures,
    legendre_design,
    simulated,
    table,
    truth_of,
)

ORDERS = range(1, 10)


def by_lstsq(order, matches, rows=slice(None)):
    """Mean and covariance of both axes by numpy.linalg.lstsq on the weighted dense design."""
    A = legendre_design(order, matches.x, matches.y)[rows]
    means, covs = [], []
    for value, sigma in ((matches.u, matches.sigma_u), (matches.v, matches.sigma_v)):
        w = 1 / sigma[rows]
        means.append(np.linalg.lstsq(A * w[:, None], value[rows] * w)[0])
        inverse = np.linalg.inv(np.linalg.qr(A * w[:, None]).R)
        covs.append(inverse @ inverse.T)
    zero = np.zeros_like(covs[0])
    return np.concatenate(means), np.block([[covs[0], zero], [zero, covs[1]]])


def assert_same(fit, mean, cov, rtol=1e-9):
    sigma = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(fit.mean, mean, rtol=0, atol=rtol * np.abs(mean).max())
    np.testing.assert_allclose(
        fit.cov / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), rtol=0, atol=rtol
    )


def uneven_sigma(rng, n):
    return rng.uniform(0.02, 0.2, n), rng.uniform(0.02, 0.2, n)


@pytest.mark.parametrize("order", ORDERS)
def test_without_frames_it_is_lstsq(order):
    rng = np.random.default_rng(order)
    model, matches, _ = simulated(order, 400, order=order, sigma=uneven_sigma(rng, 400))
    fit = fit_linear(matches, model, **UNCLIPPED)
    assert_same(fit, *by_lstsq(order, matches))
    A = legendre_design(order, matches.x, matches.y)
    mean = by_lstsq(order, matches)[0].reshape(2, -1)
    residual = np.column_stack([matches.u, matches.v]) - A @ mean.T
    np.testing.assert_allclose(residuals(fit, matches), residual, atol=1e-9)
    quoted = np.column_stack([matches.sigma_u, matches.sigma_v])
    assert fit.chi2 == pytest.approx(((residual / quoted) ** 2).sum(), rel=1e-9)
    assert fit.dof == 800 - model.n_params
    assert fit.uses(matches).all() and sum(fit.rejected.values()) == 0
    assert (fit.n_rows, fit.n_used, fit.n_rejected) == (400, 400, 0) and fit.rms_rejected == 0
    rms = np.sqrt(np.mean(residual**2, axis=0))
    assert (fit.rms_u, fit.rms_v) == pytest.approx(tuple(rms), rel=1e-9)


def test_condition_is_that_of_the_unit_diagonal_normal_matrix():
    model, matches, _ = simulated(3, 400, order=3)
    fit = fit_linear(matches, model, **UNCLIPPED)
    A = legendre_design(3, matches.x, matches.y)
    A = A / np.sqrt((A**2).sum(axis=0))
    assert fit.condition == pytest.approx(np.linalg.cond(A) ** 2, rel=1e-6)


def position(theta, model, phi, exposure):
    """(u, v) from coefficients and frames, in formulas of this test."""
    K = phi.shape[1]
    w = np.stack([phi @ theta[:K], phi @ theta[K : 2 * K]], axis=1)
    local = theta[2 * K :].reshape(len(model.exposures) - 1, -1)
    o = np.asarray(model.origin)
    out = w.copy()
    for e, p in enumerate(local, start=1):
        rows = exposure == e
        if model.frames == "shift":
            M = np.eye(2)
        elif model.frames == "shift_rotation":
            c, s = np.cos(p[2]), np.sin(p[2])
            M = np.array([[c, -s], [s, c]])
        else:
            plus, cross = p[4:] if model.frames == "affine" else (0.0, 0.0)
            c, s = np.cos(p[3]), np.sin(p[3])
            M = np.array([[c, -s], [s, c]]) @ [
                [1 + p[2] + plus, cross],
                [cross, 1 + p[2] - plus],
            ]
        out[rows] = o + p[:2] + (w[rows] - o) @ M.T
    return out


@pytest.mark.parametrize("frames", [kind for kind in FRAME_KINDS if kind != "none"])
def test_with_frames_it_is_scipys_nonlinear_least_squares(frames):
    rng = np.random.default_rng(4)
    model, matches, truth = simulated(
        4, 240, order=2, frames=frames, n_exposures=3, sigma=uneven_sigma(rng, 240)
    )
    fit = fit_linear(matches, model, **UNCLIPPED)
    phi = legendre_design(2, matches.x, matches.y)
    data = np.column_stack([matches.u, matches.v])
    quoted = np.column_stack([matches.sigma_u, matches.sigma_v])

    def residual(theta):
        return ((data - position(theta, model, phi, matches.exposure)) / quoted).ravel()

    best = least_squares(
        residual, truth.theta, jac="3-point", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    cov = np.linalg.inv(best.jac.T @ best.jac)
    sigma = np.sqrt(np.diag(cov))
    # the library stops when positions move by less than 1e-7 px: 5e-6 of the smallest error here
    np.testing.assert_array_less(np.abs(fit.mean - best.x) / sigma, 2e-5)
    np.testing.assert_allclose(
        fit.cov / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), atol=1e-6
    )
    assert fit.chi2 == pytest.approx(2 * best.cost, rel=1e-9)


@pytest.mark.slow
@only_in_full("the covariance is that of numpy")
def test_formal_covariance_describes_repeated_experiments(full):
    """Squared Mahalanobis distances to the truth, of 100 or 300 of them, are chi-square ones."""
    rng = np.random.default_rng(11)
    model = DistortionModel(
        2, (CHIP,), frames="shift_rotation", exposures=exposures(2), origin=(500.0, 400.0)
    )
    theta = truth_of(model, rng)
    distance, chi2 = [], []
    for k in range(300 if full else 100):
        _, matches, _ = simulated(
            1000 + k, 120, order=2, frames="shift_rotation", n_exposures=2, theta=theta
        )
        fit = fit_linear(matches, model, **UNCLIPPED)
        d = fit.mean - theta
        distance.append(d @ np.linalg.solve(fit.cov, d))
        chi2.append(fit.chi2)
    assert stats.kstest(distance, stats.chi2(model.n_params).cdf).pvalue > 1e-3
    assert stats.kstest(chi2, stats.chi2(240 - model.n_params).cdf).pvalue > 1e-3


def test_two_passes_reject_by_reason_and_refit_the_rest():
    model, matches, _ = simulated(6, 500, order=2)
    u, v = matches.u.copy(), matches.v.copy()
    u[10] += 0.6  # 12 sigma, and less than the absolute limit
    v[20] -= 30.0
    u[[30, 40]] += 5.0
    bad = table(matches.x, matches.y, u, v)
    fit = fit_linear(bad, model, rejection=Rejection(25.0, 2.0))
    used = fit.uses(bad)
    np.testing.assert_array_equal(np.flatnonzero(~used), [10, 20, 30, 40])
    assert fit.rejected == {"chi-square": 1, "absolute residual": 3}
    assert (fit.n_rows, fit.n_used, fit.n_rejected) == (500, 496, 4)
    assert_same(fit, *by_lstsq(2, bad, used))
    assert fit.dof == 2 * 496 - 12
    # rows left out have residuals too
    residual = residuals(fit, bad)
    assert residual[20, 1] == pytest.approx(-30, abs=0.3)
    assert fit.rms_rejected == pytest.approx(np.sqrt(np.mean(residual[~used] ** 2)), rel=1e-9)
    rms = np.sqrt(np.mean(residual[used] ** 2, axis=0))
    assert (fit.rms_u, fit.rms_v) == pytest.approx(tuple(rms), rel=1e-9)
    assert fit.chi2 == pytest.approx((residual[used] ** 2).sum() / 0.05**2, rel=1e-9)


def test_the_absolute_limit_counts_in_pixels_whatever_the_unit():
    _, matches, _ = simulated(6, 500, order=2)
    scale = 50.0  # mas per pixel
    bad = np.zeros(500)
    bad[[3, 4]] = [2.5, 1.5]
    mas = table(
        matches.x, matches.y, (matches.u + bad) * scale, matches.v * scale, sigma=50.0, unit="mas"
    )
    fit = fit_linear(mas, DistortionModel(2, (CHIP,), unit="mas"), rejection=Rejection(np.inf, 2.0))
    np.testing.assert_array_equal(np.flatnonzero(~fit.uses(mas)), [3])


def test_the_absolute_limit_does_not_truncate_stars_with_large_errors():
    """A third has errors of 2 px, as by assumed motions; chi-square is that of all stars."""
    rng = np.random.default_rng(31)
    large = np.arange(3000) % 3 == 0
    sigma = np.where(large, 2.0, 0.05)
    model, matches, _ = simulated(31, 3000, order=2, sigma=(sigma, sigma))
    bad = np.flatnonzero(~large)[rng.choice(2000, 40, replace=False)]
    u = matches.u.copy()
    u[bad] += 2.5  # false matches of stars with small errors
    matches = table(matches.x, matches.y, u, matches.v, sigma=sigma)
    fit = fit_linear(matches, model, rejection=Rejection(clip_chi2=1e9))
    far = np.flatnonzero(~fit.uses(matches))
    assert set(bad) <= set(far) and len(far) <= len(bad) + 4  # 1000 exp(-8) lie beyond four errors
    # chi-square has this mean and scatter; all residuals within 2 px would give 0.81
    assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=4 * np.sqrt(2 / fit.dof))


def test_errors_that_are_too_small_as_a_whole_do_not_reject_everything():
    model, matches, _ = simulated(7, 500, order=2, sigma=0.05)
    small = matches.with_errors((0.002, 0.002))
    fit = fit_linear(small, model)
    # a chi-square above 25 with two degrees of freedom has probability 4e-6
    assert fit.uses(small).all() and fit.n_rejected == 0
    assert fit.chi2 / fit.dof == pytest.approx(25**2, rel=0.2)


def test_wrong_errors_as_a_whole_are_refused():
    rng = np.random.default_rng(8)
    x, y = rng.uniform(1, 800, (2, 200))
    scrambled = table(x, y, rng.uniform(0, 1000, 200), rng.uniform(0, 1000, 200))
    # in a square of side a, half of the points are within a / sqrt(2 pi) of its centre: 399
    said = r"rejection limits: half of the residuals exceed (3[5-9]|4[0-4])\d px; .*another field"
    with pytest.raises(InputError, match=said):
        fit_linear(scrambled, DistortionModel(2, (CHIP,)), rejection=Rejection(clip_abs=2.0))


def corner_weights(matches, factor):
    X, Y = ((2 * p - n - 1) / n for p, n in zip((matches.x, matches.y), SIZE, strict=True))
    return 1 + (factor - 1) * (X**2 + Y**2) / 2


def test_corner_weights_give_the_sandwich_covariance():
    """Closed form of a weighted mean whose weights are not the inverse variances."""
    model, matches, _ = simulated(9, 300, order=2)
    fit = fit_linear(matches, model, rejection=Rejection(np.inf, None, 4.0))
    A = legendre_design(2, matches.x, matches.y)
    w = corner_weights(matches, 4.0) / 0.05**2
    gain = np.linalg.solve(A.T @ (w[:, None] * A), A.T * w)
    one = gain @ gain.T * 0.05**2
    zero = np.zeros_like(one)
    mean = np.concatenate([gain @ matches.u, gain @ matches.v])
    assert_same(fit, mean, np.block([[one, zero], [zero, one]]))


def test_corner_weights_with_frames_and_priors_give_the_sandwich_covariance():
    """H^-1 M H^-1 with the model's full Jacobian: H has the weights, M their squares.

    A prior is an observation with its own error, whose weight is the inverse variance.
    """
    rng = np.random.default_rng(24)
    model, matches, _ = simulated(
        24, 300, frames="affine", n_exposures=3, sigma=uneven_sigma(rng, 300), fraction=0.03
    )
    priors = GaussianPriors.of(model, {"u_2_0": (0.5, 0.002), "e3.shift_u": (0.0, 5.0)})
    fit = fit_linear(matches, model, rejection=Rejection(radial_weight=4.0), priors=priors)
    used = fit.uses(matches)
    assert 0 < (~used).sum() < 30
    J = model.jacobian(fit.mean, matches.x, matches.y, exposure=matches.exposure)[used]
    w = (np.column_stack([matches.sigma_u, matches.sigma_v]) ** -2.0)[used]
    extra = corner_weights(matches, 4.0)[used, None]
    prior = np.diag(priors.precision)
    H = np.einsum("nap,na,naq->pq", J, extra * w, J) + prior
    M = np.einsum("nap,na,naq->pq", J, extra**2 * w, J) + prior
    cov = np.linalg.solve(H, np.linalg.solve(H, M).T)
    sigma = np.sqrt(np.diag(cov))
    unit = np.outer(sigma, sigma)
    np.testing.assert_allclose(fit.cov / unit, cov / unit, rtol=0, atol=1e-8)
    # and the gradient vanishes at the solution
    pull = np.einsum("nap,na->p", J, extra * w * residuals(fit, matches)[used])
    pull += priors.pull(fit.mean)
    assert np.sqrt(pull @ np.linalg.solve(H, pull)) < 1e-4
    # statistics are those of the quoted errors, without the extra weight
    chi2 = (w * residuals(fit, matches)[used] ** 2).sum()
    assert fit.chi2 == pytest.approx(chi2, rel=1e-9)
    assert fit.dof == 2 * used.sum() + 2 - model.n_params


def test_who_is_used_is_decided_by_the_first_pass():
    """The rule, worked out by hand on the first pass; it says the same of any part of the table."""
    rng = np.random.default_rng(25)
    model, matches, _ = simulated(
        25, 600, frames="shift", n_exposures=2, sigma=uneven_sigma(rng, 600), fraction=0.1
    )
    fit = fit_linear(matches, model, rejection=Rejection(20.0, 1.5))
    first = fit_linear(matches, model, **UNCLIPPED)
    # the first pass clips nothing
    np.testing.assert_allclose(fit.clip.theta / first.sigma, first.mean / first.sigma, atol=1e-3)
    quoted = np.column_stack([matches.sigma_u, matches.sigma_v])
    r = residuals(first, matches)
    chi2 = ((r / quoted) ** 2).sum(axis=1)
    # the limit is scaled by the median chi-square where the errors are too small as a whole
    limit = 20.0 * max(1.0, np.median(chi2) / (2 * np.log(2)))
    assert fit.clip.chi2_limit == pytest.approx(limit, rel=1e-6) and fit.clip.abs_limit == 1.5
    used = (chi2 <= limit) & (np.hypot(*r.T) <= 1.5)
    np.testing.assert_array_equal(fit.uses(matches), used)
    assert fit.n_used == used.sum() and 0 < fit.n_rejected < 100
    far = np.hypot(*r.T) > 1.5
    assert fit.rejected == {
        "chi-square": (~used & ~far).sum(),
        "absolute residual": far.sum(),
    }
    some = rng.permutation(600)[:100]
    np.testing.assert_array_equal(fit.uses(matches.select(some)), used[some])


@pytest.mark.slow
@only_in_full("the formal covariance is compared")
def test_corner_weights_in_repeated_experiments():
    """The sandwich predicts the scatter of 400 experiments; the naive inverse would not."""
    model, matches, truth = simulated(9, 80, order=1)
    true = model.predict(truth.theta, matches.x, matches.y)
    rng = np.random.default_rng(10)
    estimates = []
    for _ in range(400):
        u, v = (true + 0.05 * rng.standard_normal(true.shape)).T
        one = table(matches.x, matches.y, u, v)
        fit = fit_linear(one, model, rejection=Rejection(np.inf, None, 20.0))
        estimates.append(fit.mean)
    d = np.array(estimates) - truth.theta
    ratio = (d**2).mean(axis=0) / np.diag(fit.cov)  # chi-square_400 / 400
    assert (np.abs(ratio - 1) < 4 * np.sqrt(2 / 400)).all()
    A = legendre_design(1, matches.x, matches.y)
    naive = np.linalg.inv(A.T @ ((corner_weights(matches, 20.0) / 0.05**2)[:, None] * A))
    assert np.diag(fit.cov)[0] > 3 * naive[0, 0]


@pytest.mark.parametrize("frames", ["shift_rotation", "shift_rotation_scale", "affine"])
@pytest.mark.parametrize("degrees", [40.0, 175.0])
def test_frames_are_found_from_large_rotations(frames, degrees):
    a = np.radians(degrees)
    linear = {
        "shift_rotation": [[a], [-a]],
        "shift_rotation_scale": [[0.001, a], [0.0, -a]],
        "affine": [[0.005, a, -0.005, 0.0], [0.0, -a, 0.0, 0.01]],
    }[frames]
    model = DistortionModel(
        4, (CHIP,), frames=frames, exposures=exposures(3), origin=(500.0, 400.0)
    )
    theta = truth_of(model, np.random.default_rng(12))
    for e in (1, 2):
        theta[model.frame_slice(e)] = [30.0 * e, -20.0, *linear[e - 1]]
    _, matches, _ = simulated(13, 900, order=4, frames=frames, n_exposures=3, theta=theta)
    fit = fit_linear(matches, model)
    d = fit.mean - theta
    assert stats.chi2(model.n_params).sf(d @ np.linalg.solve(fit.cov, d)) > 1e-3
    assert fit.n_used > 0.99 * fit.n_rows


def test_time_dependence_with_a_break_and_two_chips_is_recovered():
    time = TimeDependence((("u", 1, 0), ("v", 1, 0), ("v", 0, 1)), (2004.5, 2012.5), (2009.4,))
    epochs = [2002.5, 2003.5, 2005.0, 2007.0, 2009.8, 2010.5, 2012.0, 2014.0]
    options = {
        "order": 3,
        "frames": "shift_rotation",
        "n_exposures": 8,
        "chips": TWO_CHIPS,
        "time": time,
        "epochs": epochs,
    }
    model, matches, truth = simulated(14, 4000, **options)
    fit = fit_linear(matches, model)
    d = fit.mean - truth.theta
    assert stats.chi2(model.n_params).sf(d @ np.linalg.solve(fit.cov, d)) > 1e-3
    tdd = np.concatenate([np.arange(model.n_params)[model.tdd_slice(c)] for c in (1, 2)])
    assert (np.abs(d[tdd]) < 5 * fit.sigma[tdd]).all()
    # the drift is measured, not merely allowed
    assert (fit.sigma[tdd] < 0.05).all() and np.abs(truth.theta[tdd]).max() > 0.2


def test_draws_have_the_mean_and_covariance():
    model, matches, _ = simulated(15, 200, order=2, frames="affine", n_exposures=2)
    fit = fit_linear(matches, model)
    draws = fit.draws(4000, np.random.default_rng(0))
    white = np.linalg.solve(np.linalg.cholesky(fit.cov), (draws - fit.mean).T)
    assert stats.kstest((white**2).sum(axis=0), stats.chi2(model.n_params).cdf).pvalue > 1e-3
    assert stats.kstest(white.ravel(), "norm").pvalue > 1e-3
    again = fit.draws(4000, np.random.default_rng(0))
    np.testing.assert_array_equal(draws, again)


def test_gaussian_priors_are_pseudo_observations():
    """A prior is one more row of the design with its own sigma."""
    model, matches, _ = simulated(16, 60, order=2)
    named = {"u_1_1": (0.3, 0.01), "v_0_0": (451.0, 0.004), "v_2_0": (0.0, 1e-4)}
    fit = fit_linear(matches, model, priors=GaussianPriors.of(model, named), **UNCLIPPED)
    A = legendre_design(2, matches.x, matches.y) / 0.05
    zero = np.zeros_like(A)
    rows = np.zeros((3, 12))
    values = []
    for row, (name, (centre, sigma)) in zip(rows, named.items(), strict=True):
        row[model.names.index(name)] = 1 / sigma
        values.append(centre / sigma)
    big = np.vstack([np.hstack([A, zero]), np.hstack([zero, A]), rows])
    data = np.concatenate([matches.u / 0.05, matches.v / 0.05, values])
    mean = np.linalg.lstsq(big, data)[0]
    assert_same(fit, mean, np.linalg.inv(big.T @ big))
    assert fit.dof == 120 + 3 - 12


def test_priors_on_frames_are_pseudo_observations():
    """Linear frames about the solution: the gradient of chi-square plus prior vanishes there."""
    model, matches, _ = simulated(17, 200, order=2, frames="shift_rotation", n_exposures=2)
    named = {"e2.rotation": (0.0, 1e-5), "e2.shift_u": (0.0, 0.01)}
    priors = GaussianPriors.of(model, named)
    fit = fit_linear(matches, model, priors=priors, **UNCLIPPED)
    J = model.jacobian(fit.mean, matches.x, matches.y, exposure=matches.exposure)
    pull = np.einsum("nap,na->p", J, residuals(fit, matches)) / 0.05**2
    precision = np.einsum("nap,naq->pq", J, J) / 0.05**2
    for name, (centre, sigma) in named.items():
        k = model.names.index(name)
        pull[k] += (centre - fit.mean[k]) / sigma**2
        precision[k, k] += sigma**-2
    cov = np.linalg.inv(precision)
    assert np.sqrt(pull @ cov @ pull) < 1e-4
    sigma = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(
        fit.cov / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), atol=1e-8
    )


def test_priors_by_wrong_names_or_widths_are_refused():
    model = DistortionModel(2, (CHIP,))
    with pytest.raises(InputError, match=r"no parameter 'u_1_4'.*did you mean 'u_1_"):
        GaussianPriors.of(model, {"u_1_4": (0.0, 1.0)})
    for bad in ((0.0, 0.0), (0.0, -1.0), (np.nan, 1.0), (0.0, np.inf)):
        with pytest.raises(InputError, match="prior of u_1_0"):
            GaussianPriors.of(model, {"u_1_0": bad})


def test_build_model_takes_chips_exposures_and_unit_from_the_table():
    _, matches, _ = simulated(18, 90, frames="shift", n_exposures=3)
    model = build_model(matches, order=4, size=(1000, 800), frames="affine")
    assert model.exposures == matches.exposure_names and model.unit == "pix"
    assert model.chips[0].reference_pixel == (500.5, 400.5)  # the middle of 1..1000, 1..800
    assert model.origin == (np.median(matches.u), np.median(matches.v))
    with pytest.raises(InputError, match=r"detector\.size"):
        build_model(matches, order=4)
    time = TimeDependence((("u", 1, 0),), (2005.0,))
    with pytest.raises(InputError, match="epoch for every star"):
        build_model(matches, order=4, size=(1000, 800), time=time)
    _, two, _ = simulated(19, 90, chips=TWO_CHIPS)
    with pytest.raises(InputError, match="chips 1, 2 but only one chip"):
        build_model(two, order=4, size=(1000, 800))


@pytest.mark.parametrize("radius", [2000.0, 1500.0, 1300.0])
@pytest.mark.parametrize("frames", ["none", "affine"])
def test_high_orders_on_a_round_field(radius, frames):
    """Corners without stars: coefficients are known badly, positions of the stars well.

    Against numpy's least squares by SVD with orthogonal columns, at the stars, in formal errors.
    """
    rng = np.random.default_rng(3)
    n, size = 6000, 4096
    r, phi = radius * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    x, y = (size + 1) / 2 + r * np.cos(phi), (size + 1) / 2 + r * np.sin(phi)
    e = rng.integers(0, 3, n) if frames == "affine" else np.zeros(n, int)
    X, Y = (2 * z / (size + 1) - 1 for z in (x, y))
    u = x + 20 * X**3 + 5 * X * Y**2 + 100 * e + rng.normal(0, 0.01, n)
    v = y + 20 * Y**3 - 5 * X**2 * Y - 50 * e + rng.normal(0, 0.01, n)
    some = np.full(n, 0.01)
    field = Matches(
        x=x, y=y, u=u, v=v, sigma_u=some, sigma_v=some, unit="pix",
        exposure=e, exposure_names=("a", "b", "c")[: e.max() + 1],
    )  # fmt: skip
    for order in (8, 9):
        model = build_model(field, order=order, size=(size, size), frames=frames)
        fit = fit_linear(field, model, **UNCLIPPED)
        assert 0.95 < fit.chi2 / fit.dof < 1.05
        if frames == "none":
            X, Y = (z / np.abs(z).max() for z in (x - x.mean(), y - y.mean()))
            A = np.stack(
                [X**i * Y**j for i in range(order + 1) for j in range(order + 1 - i)], axis=1
            )
            Q = np.linalg.qr(A)[0]
            predicted = model.predict(fit.mean, x, y)
            for data, found in zip((u, v), predicted.T, strict=True):
                assert np.abs(found - data.mean() - Q @ (Q.T @ (data - data.mean()))).max() < 1e-6


def test_draws_take_a_seed_as_well_as_a_generator():
    model, matches, _ = simulated(7, 100, order=1)
    fit = fit_linear(matches, model)
    by_seed, by_generator = fit.draws(5, 1), fit.draws(5, np.random.default_rng(1))
    np.testing.assert_array_equal(by_seed, by_generator)
    with pytest.raises(InputError, match="neither a seed nor a generator"):
        fit.draws(5, "one")
