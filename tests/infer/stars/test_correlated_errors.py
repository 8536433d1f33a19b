"""Errors that are correlated between u and v: closed forms of scipy and numpy, and derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.coordinates import get_body_barycentric
from astropy.time import Time
from scipy.special import expit, logsumexp
from scipy.stats import multivariate_normal

import bayesdist as bd
from bayesdist.diagnose.holdout.predictive import frames_for, predictive_of
from bayesdist.diagnose.score.sample import scored_sample
from bayesdist.errors import InputError
from bayesdist.infer import OutlierMixture, fit_linear
from bayesdist.infer.stars.likelihood import MixtureAt
from bayesdist.infer.stars.stars import prepare
from tests.infer.support import (
    MIXTURES,
    UNCLIPPED,
    legendre_design,
    numerical_gradient,
    posterior_at,
    residual_of,
    simulated,
    target_of,
)

pytestmark = pytest.mark.usefixtures("one_thread")
LARGEST = 0.97


def correlated(seed: int = 1, n: int = 300, **more):
    """A model, matches with errors of all shapes and directions, and their covariances."""
    model, matches, truth = simulated(seed, n, **more)
    rng = np.random.default_rng([seed, 46])
    sigma = 0.05 * np.exp(0.5 * rng.standard_normal((2, n)))
    rho = rng.uniform(-LARGEST, LARGEST, n)
    rho[:5] = 0.0
    matches = matches.with_columns(sigma_u=sigma[0], sigma_v=sigma[1], rho_uv=rho)
    mixed = rho * sigma[0] * sigma[1]
    C = np.moveaxis(np.array([[sigma[0] ** 2, mixed], [mixed, sigma[1] ** 2]]), -1, 0)
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(C), rng.standard_normal((n, 2)))
    uv = model.predict(truth.theta, matches.x, matches.y, **exposures_of(model, matches)) + error
    return model, matches.with_columns(u=uv[:, 0], v=uv[:, 1]), C


def exposures_of(model, matches) -> dict[str, np.ndarray]:
    return {} if model.frames == "none" else {"exposure": matches.exposure}


def test_least_squares_is_that_of_full_covariances():
    model, matches, C = correlated(order=3)
    fit = fit_linear(matches, model, **UNCLIPPED)
    phi = legendre_design(3, matches.x, matches.y)
    A = np.einsum("ab,nk->nabk", np.eye(2), phi).reshape(len(phi), 2, -1)
    W = np.linalg.inv(C)
    normal = np.einsum("nak,nab,nbl->kl", A, W, A)
    right = np.einsum("nak,nab,nb->k", A, W, np.stack([matches.u, matches.v], axis=1))
    expected = np.linalg.solve(normal, right)
    np.testing.assert_allclose(fit.mean, expected, atol=1e-8)
    np.testing.assert_allclose(fit.cov, np.linalg.inv(normal), rtol=1e-7, atol=1e-14)
    r = residual_of(model, fit.mean, matches)
    chi2 = np.einsum("na,nab,nb->", r, W, r)
    assert fit.chi2 == pytest.approx(chi2, rel=1e-9)


def log_likelihood(model, matches, C, theta, h, mixture) -> float:
    j = np.exp(h[0])
    r = residual_of(model, theta, matches)
    core = [
        multivariate_normal.logpdf(x, cov=c + j**2 * np.eye(2)) for x, c in zip(r, C, strict=True)
    ]
    if mixture.model == "none":
        return float(np.sum(core))
    f = expit(h[1])
    if mixture.model == "uniform":
        false = np.full(len(r), -np.log(np.pi * mixture.match_radius**2))
    else:
        median = np.median(np.stack([matches.sigma_u, matches.sigma_v]))
        wide = median**2 + j**2 + np.exp(2 * h[2])
        false = multivariate_normal.logpdf(r, cov=wide * np.eye(2))
    both = np.stack([np.log1p(-f) + np.array(core), np.log(f) + false])
    return float(logsumexp(both, axis=0).sum())


@pytest.mark.parametrize("name", MIXTURES)
def test_the_likelihood_is_that_of_bivariate_normals(name):
    mixture, h = MIXTURES[name]
    model, matches, C = correlated(n=700, order=2, frames="shift_rotation", n_exposures=3)
    target, fit = target_of(model, matches, mixture)
    rng = np.random.default_rng(3)
    found, expected = [], []
    for _ in range(3):
        theta = np.asarray(fit.mean) + 0.02 * rng.standard_normal(model.n_params)
        at = np.array(h) + 0.2 * rng.standard_normal(len(h))
        found.append(target.log_density(np.concatenate([theta, at])[None])[0])
        found[-1] -= target.hyper.log_prior(at[None])[0]
        expected.append(log_likelihood(model, matches, C, theta, at, mixture))
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("name", MIXTURES)
@pytest.mark.parametrize("nominal", [False, True])
def test_derivatives_are_those_of_the_density(name, nominal):
    mixture, h = MIXTURES[name]
    model, matches, _ = correlated(n=200, order=2)
    if nominal:
        mixture = OutlierMixture(mixture.model, match_radius=0.6)
        near = {"u_nominal": matches.u + 0.1, "v_nominal": matches.v - 0.05}
        matches = matches.with_columns(**near)
    target, fit = target_of(model, matches, mixture)
    psi = np.concatenate([fit.mean, h])
    value, gradient, matrix = target.expand(psi)

    def density(points):
        return target.log_density(np.atleast_2d(points))

    assert value == pytest.approx(density(psi)[0], rel=1e-10)
    step = np.full(len(psi), 1e-4)
    np.testing.assert_allclose(
        gradient, numerical_gradient(density, psi, step).ravel(), rtol=2e-5, atol=1e-3
    )
    dense = matrix.dense()
    columns = [
        (target.expand(psi + e)[1] - target.expand(psi - e)[1]) / 2e-4
        for e in 1e-4 * np.eye(len(psi))
    ]
    np.testing.assert_allclose(
        dense, -np.array(columns), rtol=1e-4, atol=0.02 * np.abs(dense).max() * 1e-3
    )


def test_scores_of_single_stars_are_derivatives_with_respect_to_their_position():
    model, matches, _ = correlated(n=50)
    mixture = OutlierMixture()
    target, fit = target_of(model, matches, mixture)
    constants = target.hyper.constants(np.array([MIXTURES["gaussian"][1]]))
    stars, _ = prepare(model, matches)
    at = MixtureAt(np.asarray(fit.mean), constants)
    scores = at.scores(stars)
    sums = [scores[:2] @ phi for phi in legendre_design(2, matches.x, matches.y).T]
    h = np.array(MIXTURES["gaussian"][1])

    def density(points):
        points = np.atleast_2d(points)
        return np.array([target.log_density(np.append(p, h)[None])[0] for p in points])

    numeric = numerical_gradient(density, np.asarray(fit.mean), np.full(model.n_params, 1e-4))
    np.testing.assert_allclose(np.array(sums).T.ravel(), numeric.ravel(), rtol=1e-4, atol=1e-3)


def test_residuals_in_units_of_their_errors_are_independent():
    n = 20_000
    model, matches, _ = correlated(n=n)
    fit = fit_linear(matches, model, **UNCLIPPED)
    sample = scored_sample(matches, fit)
    # correlations are even about zero, and products are compared by their sign
    sign = np.sign(matches.rho_uv)
    z, raw = sample.whitened, sample.residual / np.sqrt(sample.variance)
    np.testing.assert_allclose((z**2).mean(axis=1), 1.0, atol=4 * np.sqrt(2 / n))
    assert abs(np.mean(sign * z[0] * z[1])) < 4 / np.sqrt(n)
    assert np.mean(sign * raw[0] * raw[1]) > 0.4


def test_errors_are_scaled_and_added_with_their_correlation(rng):
    _, matches, C = correlated(n=40)
    np.testing.assert_allclose(matches.covariances(), C)
    np.testing.assert_allclose(matches.with_scaled_errors(3.0).covariances(), 9 * C)
    more = matches.with_errors((0.03, 0.04), in_quadrature=True).covariances()
    np.testing.assert_allclose(more, C + np.diag([0.0009, 0.0016]))
    np.testing.assert_allclose(matches.with_covariances(2 * C).covariances(), 2 * C)
    assert matches.with_errors(0.05).rho_uv is None


@pytest.mark.parametrize("rho", [-0.97, 0.9])
@pytest.mark.parametrize("mixture", ["none", "gaussian"])
def test_the_frame_of_a_held_out_exposure_is_found(rho, mixture):
    """Steps that take the variances alone diverge."""
    model, matches, _ = correlated(n=900, frames="shift", n_exposures=2)
    C, rng = matches.covariances(), np.random.default_rng(5)
    C[:, 0, 1] = C[:, 1, 0] = rho * matches.sigma_u * matches.sigma_v
    target, fit = target_of(model, matches, MIXTURES[mixture][0])
    truth = np.asarray(fit.mean)
    uv = model.predict(truth, matches.x, matches.y, exposure=matches.exposure)
    uv += np.einsum("nij,nj->ni", np.linalg.cholesky(C), rng.standard_normal((900, 2)))
    matches = matches.with_covariances(C).with_columns(u=uv[:, 0], v=uv[:, 1])
    draws = rng.multivariate_normal(truth, fit.cov, 200)
    hyper = np.array(MIXTURES[mixture][1])
    hyper[0] = np.log(1e-3)  # no jitter to speak of
    rows = np.concatenate([draws, np.tile(hyper, (200, 1))], axis=1)
    held = matches.select(matches.exposure == 1)
    held = held.with_columns(exposure=np.zeros(len(held), int), exposure_names=("new",))
    found = frames_for(predictive_of(posterior_at(target, rows)), held, ("new",))["new"]
    # the shift of the second exposure, within the errors of some 450 stars
    np.testing.assert_allclose(found.values, truth[-2:], atol=4 * 0.06 / np.sqrt(450))


@pytest.mark.parametrize("rho", [1.0, -1.2, np.nan])
def test_impossible_correlations_are_refused(rho):
    _, matches, _ = correlated(n=20)
    with pytest.raises(InputError, match="rho_uv"):
        matches.with_columns(rho_uv=np.full(20, rho))


# -- few stars of Gaia, with motions and parallaxes, ten years later -------------------------------

N_FEW, FEW_PIXEL, FEW_POINT, FEW_EPOCH = 8, 50.0, (150.0, 2.0), 2026.0  # mas, degrees, years
GAIA = ("ra", "dec", "parallax", "pmra", "pmdec")
# Version 2.0.0 of bp3m (BP3MSolver._solve_one_pass, iterated four times) for `few_stars`: the map
# a x + b y + w, c x + d y + z from x - 2048, y - 2048 to pixels to the west and north, a to z in
# this order, and its covariance.  The prior on the map is flat, Gaia's covariances and the errors
# of centroids are as given (bp3m enlarges both), and the sign of the parallax factors is reversed:
# that version displaces stars in the direction of the Earth.
BP3M = [0.8389215178, 0.544795887, -0.5447954417, 0.8390239653, 2.972841774, -5.010299809]
BP3M_COVARIANCE = [
    [1.082853e-10, -3.866658e-11, 3.746602e-11, -3.023564e-11, -2.687794e-09, -8.152239e-09],
    [-3.866658e-11, 3.171024e-10, -2.506417e-11, -9.708169e-13, -2.262864e-07, 2.61135e-08],
    [3.746602e-11, -2.506417e-11, 1.166215e-10, -5.688823e-11, -1.089558e-08, -1.494726e-09],
    [-3.023564e-11, -9.708169e-13, -5.688823e-11, 2.235671e-10, 3.165208e-08, -1.067976e-07],
    [-2.687794e-09, -2.262864e-07, -1.089558e-08, 3.165208e-08, 0.0003011778, -1.418862e-05],
    [-8.152239e-09, 2.61135e-08, -1.494726e-09, -1.067976e-07, -1.418862e-05, 0.0001757205],
]


def few_stars() -> dict[str, np.ndarray]:
    """Columns of pixels, their errors and Gaia's five parameters with all correlations."""
    rng = np.random.default_rng(46)
    x, y = rng.uniform(200, 3900, (2, N_FEW))
    a, b = 1.0003 * np.cos(np.radians(33.0)), 1.0003 * np.sin(np.radians(33.0))
    west = a * (x - 2048) + b * (y - 2048) + 3.0
    north = -b * (x - 2048) + (a + 1e-4) * (y - 2048) - 5.0
    pmra, pmdec = rng.normal(0, 6, (2, N_FEW))
    parallax = rng.uniform(0.1, 3, N_FEW)
    typical = {"ra": 0.1, "dec": 0.08, "parallax": 0.12, "pmra": 0.15, "pmdec": 0.12}
    sigma = {name: size * rng.uniform(0.5, 2, N_FEW) for name, size in typical.items()}
    root = np.eye(5) + 0.5 * rng.standard_normal((N_FEW, 5, 5))
    C = root @ np.swapaxes(root, 1, 2)
    d = 1 / np.sqrt(np.einsum("nii->ni", C))
    C = C * d[:, :, None] * d[:, None]
    xi, eta = np.array([-west, north]) * FEW_PIXEL / 1e3 / 206264.80625
    r0, d0 = np.radians(FEW_POINT)
    away = np.arctan2(xi, np.cos(d0) - eta * np.sin(d0))
    ra = np.degrees(r0 + away)
    dec = np.degrees(
        np.arctan2((np.sin(d0) + eta * np.cos(d0)) * np.cos(away), np.cos(d0) - eta * np.sin(d0))
    )
    out = {"x": x, "y": y}
    out["ra"] = ra - (10 * pmra + rng.normal(0, 1, N_FEW)) / 3.6e6 / np.cos(np.radians(dec))
    out["dec"] = dec - (10 * pmdec + rng.normal(0, 1, N_FEW)) / 3.6e6
    out |= {"pmra": pmra, "pmdec": pmdec, "parallax": parallax}
    for i, name in enumerate(GAIA):
        out[f"{name}_error"] = sigma[name]
        out |= {f"{GAIA[j]}_{name}_corr": C[:, i, j] for j in range(i)}
    out["x_err"], out["y_err"] = rng.uniform(0.005, 0.02, (2, N_FEW))
    out["rho_xy"] = rng.uniform(-0.8, 0.8, N_FEW)
    return out


def in_closed_form(stars: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Map in the form of `BP3M` and its covariance, with all motions and parallaxes eliminated.

    Equations 9 to 11 of McKinnon et al. 2024 (ApJ 972, 150): the joint normal distribution of the
    map r and of the parameters v of all stars, whose prior is Gaia, with x' = X r - J U v.
    """
    dec0 = np.radians(FEW_POINT[1])
    da, dec = np.radians(stars["ra"] - FEW_POINT[0]), np.radians(stars["dec"])
    D = np.sin(dec0) * np.sin(dec) + np.cos(dec0) * np.cos(dec) * np.cos(da)
    west = -np.cos(dec) * np.sin(da) / D
    north = (np.cos(dec0) * np.sin(dec) - np.sin(dec0) * np.cos(dec) * np.cos(da)) / D
    seen = np.column_stack([west, north]) * 206264.80625 * 1e3 / FEW_PIXEL
    earth = get_body_barycentric("earth", Time(FEW_EPOCH, format="jyear", scale="tdb"))
    X, Y, Z = earth.xyz.to_value("au")
    a, d = np.radians(stars["ra"]), dec
    of_ra = X * np.sin(a) - Y * np.cos(a)
    of_dec = (X * np.cos(a) + Y * np.sin(a)) * np.sin(d) - Z * np.cos(d)
    years, one = FEW_EPOCH - 2016.0, np.ones(N_FEW)
    # a field of 0.05 degrees: the plane is flat to 4e-7
    U = np.zeros((N_FEW, 2, 5))
    U[:, 0, [0, 2, 3]] = -np.column_stack([one, of_ra, years * one]) / FEW_PIXEL
    U[:, 1, [1, 2, 4]] = np.column_stack([one, of_dec, years * one]) / FEW_PIXEL
    sigma = np.stack([stars[f"{name}_error"] for name in GAIA], axis=1)
    C = np.tile(np.eye(5), (N_FEW, 1, 1))
    for i, name in enumerate(GAIA):
        for j in range(i):
            C[:, i, j] = C[:, j, i] = stars[f"{GAIA[j]}_{name}_corr"]
    C = C * sigma[:, :, None] * sigma[:, None]
    v0 = np.column_stack([np.zeros((N_FEW, 2)), stars["parallax"], stars["pmra"], stars["pmdec"]])
    mixed = stars["rho_xy"] * stars["x_err"] * stars["y_err"]
    P = np.moveaxis(np.array([[stars["x_err"] ** 2, mixed], [mixed, stars["y_err"] ** 2]]), -1, 0)
    A = np.zeros((N_FEW, 2, 6))
    A[:, 0, [0, 1, 4]] = A[:, 1, [2, 3, 5]] = np.column_stack(
        [stars["x"] - 2048, stars["y"] - 2048, one]
    )
    r = np.array([np.cos(np.radians(33.0)), 0.5, -0.5, 0.8, 0.0, 0.0])
    for _ in range(5):  # the errors of the centroids are turned by the map
        turn = np.array([[r[0], r[1]], [r[2], r[3]]])
        W = np.linalg.inv(turn @ P @ turn.T)
        n = 6 + 5 * N_FEW
        H, h = np.zeros((n, n)), np.zeros(n)
        for k in range(N_FEW):
            at = slice(6 + 5 * k, 11 + 5 * k)
            H[:6, :6] += A[k].T @ W[k] @ A[k]
            H[:6, at] -= A[k].T @ W[k] @ U[k]
            H[at, :6] = H[:6, at].T
            H[at, at] = U[k].T @ W[k] @ U[k] + np.linalg.inv(C[k])
            h[:6] += A[k].T @ W[k] @ seen[k]
            h[at] = np.linalg.solve(C[k], v0[k]) - U[k].T @ W[k] @ seen[k]
        scale = 1 / np.sqrt(np.diag(H))
        covariance = np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale)
        r = (covariance @ h)[:6]
    return r, covariance[:6, :6]


@pytest.mark.parametrize("source", ["closed form", "bp3m"])
def test_few_stars_with_motions_agree_with_the_elimination_of_motions_and_with_bp3m(source):
    """Least squares with one covariance for each match eliminates motions and parallaxes, too."""
    stars = few_stars()
    theirs = in_closed_form(stars) if source == "closed form" else (BP3M, BP3M_COVARIANCE)
    r, covariance = (np.asarray(values) for values in theirs)
    table = stars | {"ref_epoch": np.full(N_FEW, 2016.0)}
    matches = bd.Matches.from_table(table, epoch=FEW_EPOCH, tangent_point=FEW_POINT)
    model = bd.build_model(matches, order=1, size=(4096, 4096), reference_pixel=(2048.0, 2048.0))
    fit = fit_linear(matches, model, **UNCLIPPED)
    x, y = np.array([[100.0, 3000, 2048, 500, 4000], [100, 800, 2048, 3900, 4000]])
    B = model.basis().evaluate(x, y)
    J = np.zeros((len(x), 2, fit.mean.size))
    J[:, 0, : B.shape[1]] = J[:, 1, B.shape[1] :] = B
    place = np.column_stack([x - 2048, y - 2048, np.ones_like(x)]) * FEW_PIXEL / 1e3
    D = np.zeros((len(x), 2, 6))
    D[:, 0, [0, 1, 4]], D[:, 1, [2, 3, 5]] = -place, place  # u grows to the east
    ours = np.einsum("nak,kl,nbl->nab", J, fit.cov, J)
    expected = np.einsum("nak,kl,nbl->nab", D, covariance, D)
    sigma = np.sqrt(np.einsum("naa->na", expected))
    assert np.abs(model.predict(fit.mean, x, y) - D @ r).max() < 0.003 * sigma.min()
    off = (ours - expected) / (sigma[:, :, None] * sigma[:, None])
    assert np.abs(off).max() < 2e-4
