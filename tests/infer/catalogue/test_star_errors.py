"""One star, one error: against dense formulas, closed forms and repeated catalogues."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats
from threadpoolctl import threadpool_limits

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer import GaussianPriors, Rejection, fit_linear
from bayesdist.infer.catalogue.star_covariance import star_covariance, star_influence
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.exposures.hierarchy import fit_hierarchical
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.solution.transforms import linear_terms, reference_gauge
from bayesdist.model import DistortionModel
from tests.reduced import only_in_full

from ..small_campaign import campaign, shared_stars, with_star_errors
from ..support import CHIP, SIZE, UNCLIPPED, columns_of, legendre_design, simulated

pytestmark = pytest.mark.usefixtures("one_thread")


def alike(sigma_u, sigma_v, n_stars):
    """Errors of positions that are those of all stars."""
    return StarErrors(np.tile([sigma_u, sigma_v], (n_stars, 1)))


def some(seed=1, n_stars=70):
    """Frames, drift, two chips, uneven errors; any star may be anywhere."""
    model, matches, _ = campaign(seed, 4, 80, order=2)
    rng = np.random.default_rng(seed)
    n, code = len(matches), rng.integers(n_stars, size=len(matches))
    position, motion = (rng.uniform(0.0, most, (2, n_stars)).T for most in (0.02, 0.01))
    catalogue = StarErrors(position, motion, rng.uniform(2003.0, 2006.0, n_stars))
    dt = matches.epoch - catalogue.epoch[code]
    matches = matches.with_errors(
        tuple(
            np.sqrt(
                rng.uniform(0.01, 0.05, n) ** 2
                + catalogue.position[code, a] ** 2
                + (dt * catalogue.motion[code, a]) ** 2
            )
            for a in (0, 1)
        )
    )
    return model, matches.with_columns(star=code), fitted(matches, model), code, catalogue


def fitted(matches, model):
    """Fit that leaves some matches out, with priors of the exposures' scales and shears."""
    named = {
        f"{e}.{kind}": (0.0, 1e-5)
        for e in model.exposures
        for kind in ("scale", "shear_plus", "shear_cross")
    }
    priors = GaussianPriors.of(model, named)
    return fit_linear(matches, model, priors=priors, rejection=Rejection(clip_chi2=4.0))


def factors(epoch):
    """Displacements along u and v by parallaxes, a year long and of different size."""
    phase = 2 * np.pi * np.asarray(epoch)
    return np.stack([np.cos(phase), 0.4 * np.sin(phase)], axis=1)


def correlated(seed=1, *, parallax=False):
    """The same, with correlations of positions and motions, and of the remaining errors."""
    model, matches, _, code, catalogue = some(seed)
    rng = np.random.default_rng([seed, 46])
    n, n_stars = 5 if parallax else 4, len(catalogue.position)
    root = rng.standard_normal((n_stars, n, n))
    cov = root @ np.swapaxes(root, 1, 2)
    size = 1 / np.sqrt(np.einsum("nii->ni", cov))
    catalogue = replace(catalogue, correlations=cov * size[:, :, None] * size[:, None])
    if parallax:
        sizes = rng.uniform(0.0, 0.03, n_stars)
        catalogue = replace(catalogue, parallax=sizes, factors=factors)
    S = joint_covariances(catalogue)[code]
    A = np.zeros((len(code), 2, n))
    A[:, :, 4:] = factors(matches.epoch)[:, :, None]
    A[:, [0, 1], [0, 1]] = 1.0
    A[:, [0, 1], [2, 3]] = (matches.epoch - catalogue.epoch[code])[:, None]
    root = rng.normal(0.0, 0.03, (len(code), 2, 2))
    own = root @ np.swapaxes(root, 1, 2) + 1e-4 * np.eye(2)
    matches = matches.with_covariances(A @ S @ np.swapaxes(A, 1, 2) + own)
    return matches, fitted(matches, model), code, catalogue, A


def joint_covariances(catalogue):
    """Covariances (S, 4, 4) or (S, 5, 5) of u, v, the motions in both, and parallaxes."""
    sigma = np.hstack([catalogue.position, catalogue.motion])
    if catalogue.parallax is not None:
        sigma = np.column_stack([sigma, catalogue.parallax])
    return catalogue.correlations * sigma[:, :, None] * sigma[:, None]


def dense_correlated(fit, matches, code, S, A, weight):
    """The covariance of all matches' catalogue errors (S of stars), carried through the fit."""
    J = fit.model.jacobian(fit.mean, matches.x, matches.y, **columns_of(matches))
    W = weight[:, None, None] * np.linalg.inv(matches.covariances())
    response = np.einsum("pq,naq,nab->pnb", fit.cov, J, W)
    by_star = np.zeros((len(fit.cov), *S.shape[:2]))
    np.add.at(by_star.transpose(1, 0, 2), code, np.einsum("pnb,nbk->npk", response, A))
    total = np.einsum("psk,skl,qsl->pq", by_star, S, by_star)
    each = A @ S[code] @ np.swapaxes(A, 1, 2)
    return total, np.einsum("pna,nab,qnb->pq", response, each, response)


@pytest.mark.parametrize("parallax", [False, True])
@pytest.mark.parametrize("scratch", [64_000_000, 32 * 100 * 14])
def test_with_correlations_it_is_the_dense_formula(scratch, parallax):
    matches, fit, code, catalogue, A = correlated(parallax=parallax)
    used = fit.uses(matches)
    found = star_covariance(fit, matches.with_columns(star=code), catalogue, scratch=scratch)
    S = joint_covariances(catalogue)
    total, counted = dense_correlated(fit, matches, code, S, A, used.astype(float))
    unit = np.sqrt(np.outer(np.diag(total), np.diag(total)))
    np.testing.assert_allclose(found.total / unit, total / unit, atol=1e-9)
    np.testing.assert_allclose(found.counted / unit, counted / unit, atol=1e-9)
    # positions as they were at the date when they and the motions were independent
    still = S - S[:, :, 2:4] @ np.linalg.solve(S[:, 2:4, 2:4], S[:, 2:4, :])
    still[:, 2:4] = still[:, :, 2:4] = 0.0
    alone, _ = dense_correlated(fit, matches, code, still, A, used.astype(float))
    np.testing.assert_allclose((found.total - found.motions) / unit, alone / unit, atol=1e-9)
    assert np.linalg.eigvalsh(found.motions / unit).min() > -1e-9


@pytest.mark.parametrize("parallax", [False, True])
def test_the_influence_of_stars_has_their_correlations(parallax):
    """Of stars in another exposure: sum of Sigma_s (H^-1 G_s)^T over positions and motions."""
    matches, fit, code, catalogue, A = correlated(2, parallax=parallax)
    codes = np.unique(code)[::2]
    found = star_influence(fit, matches.with_columns(star=code), catalogue, codes)
    J = fit.model.jacobian(fit.mean, matches.x, matches.y, **columns_of(matches))
    W = fit.uses(matches)[:, None, None] * np.linalg.inv(matches.covariances())
    response = np.einsum("pq,naq,nab,nbk->npk", fit.cov, J, W, A)
    D, S = fit.model.n_distortion, joint_covariances(catalogue)
    for star, epoch in ((codes[3], 2001.5), (codes[5], 2009.0)):
        G = response[code == star].sum(axis=0)[:D]
        lever = epoch - catalogue.epoch[star]
        levers = [np.eye(2), lever * np.eye(2), *([factors([epoch]).T] if parallax else [])]
        expected = np.hstack(levers) @ S[star] @ G.T
        given = found.with_solution(np.array([star]), np.array([epoch]))[0]
        np.testing.assert_allclose(given, expected, atol=1e-9 * np.abs(expected).max())


def test_errors_contained_in_all_matches_are_the_largest_along_one_direction(rng):
    """No match of a star has a smaller error along any direction, and one is as large along one."""
    n, code = 200, np.arange(200) % 40
    root = rng.standard_normal((n, 2, 2))
    C = root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(2)
    C[code == 7] = C[7]
    place = np.arange(float(n))
    matches = Matches(place, place, place, place, star=code).with_covariances(C)
    found = StarErrors.contained_in(matches).covariances(code, 1).reshape(n, 2, 2)
    left = np.array([np.linalg.eigvalsh(a - b)[0] for a, b in zip(C, found, strict=True)])
    smallest = np.array([left[code == star].min() for star in range(40)])
    np.testing.assert_allclose(smallest, 0.0, atol=1e-9)
    np.testing.assert_allclose(found[7], C[7])


def test_impossible_correlations_are_refused():
    matches, fit, code, catalogue, _ = correlated()
    matches = matches.with_columns(star=code)
    for wrong in (2 * catalogue.correlations, np.ones((70, 4, 4)) - 2 * np.eye(4)):
        with pytest.raises(InputError, match="correlation matrices"):
            star_covariance(fit, matches, replace(catalogue, correlations=wrong))
    with pytest.raises(InputError, match="shape"):
        star_covariance(fit, matches, replace(catalogue, correlations=np.ones((70, 2, 2))))
    turned = matches.with_columns(rho_uv=-matches.rho_uv)
    with pytest.raises(InputError, match="smaller than the error"):
        star_covariance(fit, turned, catalogue)


def dense(fit, matches, code, catalogue, weight):
    """The covariance of all matches' catalogue errors, carried through the fit."""
    J = fit.model.jacobian(fit.mean, matches.x, matches.y, **columns_of(matches))
    W = np.stack([weight / matches.sigma_u**2, weight / matches.sigma_v**2], axis=1)
    response = np.einsum("pq,naq,na->pna", fit.cov, J, W)  # of the parameters to each match
    same = code[:, None] == code
    dt = matches.epoch - catalogue.epoch[code]
    total, counted = np.zeros_like(fit.cov), np.zeros_like(fit.cov)
    for axis in (0, 1):
        position, motion = catalogue.position[code, axis] ** 2, catalogue.motion[code, axis] ** 2
        C = same * (position + motion * np.outer(dt, dt))
        R = response[:, :, axis]
        total += R @ C @ R.T
        counted += R @ np.diag(np.diag(C)) @ R.T
    return total, counted


@pytest.mark.parametrize("scratch", [64_000_000, 16 * 100 * 7])
def test_it_is_the_dense_formula(scratch):
    """Also in pieces of a few stars, and with one star several times in one exposure."""
    _, matches, fit, code, catalogue = some()
    used = fit.uses(matches)
    assert 0 < (~used).sum() < 100
    pairs = {tuple(p) for p in np.column_stack([code, matches.exposure, matches.chip])}
    assert len(pairs) < len(matches)  # some do stand twice
    found = star_covariance(fit, matches, catalogue, scratch=scratch)
    total, counted = dense(fit, matches, code, catalogue, used.astype(float))
    scale = np.sqrt(np.diag(total))
    unit = np.outer(scale, scale)
    np.testing.assert_allclose(found.total / unit, total / unit, atol=1e-10)
    np.testing.assert_allclose(found.counted / unit, counted / unit, atol=1e-10)
    np.testing.assert_allclose(found.extra / unit, (total - counted) / unit, atol=1e-10)


@pytest.mark.parametrize("frames", [True, False])
def test_motions_are_the_part_that_is_left_without_errors_of_positions(frames):
    _, matches, fit, _, catalogue = some(3)
    found = star_covariance(fit, matches, catalogue, frames=frames)
    exact = replace(catalogue, position=0 * catalogue.position)
    alone = star_covariance(fit, matches, exact, frames=frames).total
    scale = np.sqrt(np.diag(found.total))
    np.testing.assert_allclose(
        found.motions / np.outer(scale, scale), alone / np.outer(scale, scale), atol=1e-10
    )
    still = replace(catalogue, motion=0 * catalogue.motion)
    assert star_covariance(fit, matches, still, frames=frames).motions is None


def test_without_the_frames_the_polynomials_are_the_same():
    """And the frames follow by regression: nothing else is said of them."""
    model, matches, fit, _, catalogue = some(11)
    whole, part = (star_covariance(fit, matches, catalogue, frames=f) for f in (True, False))
    n = model.n_distortion
    for a, b in ((whole.total, part.total), (whole.counted, part.counted)):
        scale = np.sqrt(np.diag(a))
        unit = np.outer(scale, scale)
        np.testing.assert_allclose(b[:n, :n] / unit[:n, :n], a[:n, :n] / unit[:n, :n], atol=1e-10)
        assert b.shape == a.shape
        # what the polynomials do not explain of the frames is left as it was
        cov, gain = fit.cov + b, np.linalg.solve(fit.cov[:n, :n], fit.cov[:n, n:])
        left = cov[n:, n:] - cov[n:, :n] @ gain
        before = fit.cov[n:, n:] - fit.cov[n:, :n] @ gain
        size = np.sqrt(np.diag(before))
        np.testing.assert_allclose(
            left / np.outer(size, size), before / np.outer(size, size), atol=1e-6
        )


def test_stars_that_are_seen_once_add_nothing():
    model, matches, _ = simulated(4, 200, order=2)
    fit = fit_linear(matches, model)
    matches = matches.with_columns(star=np.random.default_rng(0).permutation(200))
    found = star_covariance(fit, matches, alike(0.03, 0.04, 200))
    scale = np.sqrt(np.diag(found.total))
    assert (scale > 0).all()
    np.testing.assert_allclose(found.extra / np.outer(scale, scale), 0, atol=1e-12)


def repeated(n_stars=60, n_exposures=9, order=2):
    """The same stars on the same pixels in every exposure."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(1, SIZE[0], n_stars), rng.uniform(1, SIZE[1], n_stars)
    # a table does not hold a star twice: not quite the same pixel
    x, y = (np.tile(p, n_exposures) + 1e-9 * np.arange(n_stars * n_exposures) for p in (x, y))
    table = Matches(
        x,
        y,
        x,
        y,
        sigma_u=np.full(x.size, np.hypot(0.02, 0.05)),
        sigma_v=np.full(x.size, np.hypot(0.02, 0.03)),
        star=np.tile(np.arange(n_stars), n_exposures),
    )
    return DistortionModel(order, (CHIP,)), table, n_exposures


def test_more_exposures_of_the_same_pixels_do_not_help_against_the_catalogue():
    """Closed form: centroids of 0.02 px average over 9 exposures, the catalogue's errors do not."""
    model, matches, n = repeated()
    fit = fit_linear(matches, model, **UNCLIPPED)
    solution = with_star_errors(fit, star_covariance(fit, matches, alike(0.05, 0.03, 60)))
    A = legendre_design(2, matches.x[:60], matches.y[:60])
    inverse = np.linalg.inv(A.T @ A)
    K = model.n_terms
    for axis, c in enumerate((0.05, 0.03)):
        rows = slice(axis * K, (axis + 1) * K)
        np.testing.assert_allclose(fit.cov[rows, rows], (0.02**2 + c**2) / n * inverse, rtol=1e-5)
        np.testing.assert_allclose(
            solution.cov[rows, rows], (0.02**2 / n + c**2) * inverse, rtol=1e-5
        )


@pytest.mark.slow
@only_in_full("tests/assess/test_shared_stars repeats catalogues")
@threadpool_limits.wrap(limits=1, user_api="blas")
def test_repeated_catalogues():
    """Simulated from the beginning: catalogue, proper motions, centroids, the fit, 200 times."""
    rng = np.random.default_rng(6)
    centroid = 0.01
    epochs = [2002.5, 2003.5, 2004.5, 2005.5, 2006.8]
    shared = shared_stars(rng, 100, epochs, order=2, centroid=centroid, position=0.02, motion=0.01)
    model, matches = shared.model, shared.matches
    fit = fit_linear(matches, model, **UNCLIPPED)
    solution = with_star_errors(fit, shared.covariance(fit))
    distance, naive = [], []
    some = matches.select(np.arange(40))
    J = model.jacobian(shared.theta, some.x, some.y, exposure=some.exposure, chip=some.chip_number)
    far = []
    for _ in range(200):
        error = centroid * rng.standard_normal((len(matches), 2)) + shared.catalogue_errors(rng)
        one = fit_linear(shared.with_errors(error), model, **UNCLIPPED)
        d = one.mean - fit.mean
        distance.append(d @ np.linalg.solve(solution.cov, d))
        naive.append(d @ np.linalg.solve(fit.cov, d))
        far.append(J @ d)
    D = model.n_params
    assert stats.kstest(distance, stats.chi2(D).cdf).pvalue > 1e-3
    assert stats.kstest(naive, stats.chi2(D).cdf).pvalue < 1e-6
    # and of positions: the error of a map over the detector
    rms = np.mean(np.square(far), axis=0)
    expected = np.einsum("nap,pq,naq->na", J, solution.cov, J)
    formal = np.einsum("nap,pq,naq->na", J, fit.cov, J)
    assert rms.sum() == pytest.approx(expected.sum(), rel=0.1)
    assert expected.sum() > 1.15 * formal.sum()


def test_draws_are_spread_to_the_covariance():
    _, matches, fit, _, catalogue = some(7)
    solution = with_star_errors(fit, star_covariance(fit, matches, catalogue))
    draws = solution.draws(4000, np.random.default_rng(1))
    white = np.linalg.solve(np.linalg.cholesky(solution.cov), (draws - solution.mean).T)
    assert stats.kstest((white**2).sum(axis=0), stats.chi2(len(fit.mean)).cdf).pvalue > 1e-3
    assert stats.kstest(white.ravel(), "norm").pvalue > 1e-3
    np.testing.assert_array_equal(
        solution.draws(5, np.random.default_rng(1)).shape, (5, fit.mean.size)
    )


@dataclass(frozen=True, eq=False)
class Skewed(Solution):
    """A posterior that is no Gaussian: gamma variables."""

    model: DistortionModel
    mean: np.ndarray
    cov: np.ndarray
    convergence = "judged"

    def draws(self, n, rng):
        z = (rng.gamma(4.0, size=(n, self.mean.size)) - 4.0) / 2.0
        return self.mean + z @ np.linalg.cholesky(self.cov).T


def test_a_posterior_keeps_its_shape_and_stays_one():
    _, matches, fit, _, catalogue = some(8)
    posterior = Skewed(fit.model, fit.mean, fit.cov)
    found = star_covariance(posterior, matches, catalogue)
    solution = with_star_errors(posterior, found)
    assert solution.convergence == "judged"
    assert with_star_errors(fit, found).convergence is None
    first = (solution.draws(20_000, np.random.default_rng(2)) - solution.mean)[:, 0]
    assert first.std() / solution.sigma[0] == pytest.approx(1, abs=0.03)
    assert stats.skew(first) == pytest.approx(1.0, abs=0.15)  # 2 / sqrt(4)


def test_views_carry_it_on():
    """The gauge of the enlarged solution, and a hierarchical fit as its source."""
    model, matches, _ = campaign(9, 10, 150, order=2)
    # what is seen in one place of the detector is one star: errors that add up
    x, y = np.int64(matches.x // 400), np.int64(matches.y // 400)
    code = (matches.chip * 11 + x) * 6 + y
    matches = matches.with_columns(star=code)
    found = fit_hierarchical(matches, model)
    stars = star_covariance(found, matches, alike(0.01, 0.01, code.max() + 1))
    wide = with_star_errors(found, stars)
    a, b = (linear_terms(reference_gauge(s), 1, epoch=2004.5) for s in (wide, found))
    np.testing.assert_array_equal(a.values, b.values)
    few = ("A_1", "A_2", "A_3", "B_1", "B_2")
    assert (a.select(*few).sigma > b.select(*few).sigma).all()
    draws = wide.draws(2000, np.random.default_rng(4))
    np.testing.assert_allclose(draws.std(axis=0) / wide.sigma, 1, atol=0.12)


def test_what_is_wrong_is_said():
    _, matches, fit, code, _ = some(10)
    n = code.max() + 1
    with pytest.raises(InputError, match="have no star codes"):
        star_covariance(fit, matches.with_columns(star=None), alike(0.01, 0.01, n))
    with pytest.raises(InputError, match="position is given for 3 stars, but star codes go up"):
        star_covariance(fit, matches, alike(0.01, 0.01, 3))
    with pytest.raises(InputError, match=r"position is -0\.01"):
        star_covariance(fit, matches, alike(-0.01, 0.01, n))
    moving = replace(alike(0.01, 0.01, n), motion=np.full((n, 2), 0.1))
    with pytest.raises(InputError, match="need the catalogue's epoch"):
        star_covariance(fit, matches, moving)
    dated = replace(moving, epoch=np.full(n, 2004.0))
    with pytest.raises(InputError, match="need the epochs of the matches"):
        star_covariance(fit, replace(matches, epoch=None), dated)
    with pytest.raises(InputError, match="epoch is nan"):
        star_covariance(fit, matches, replace(moving, epoch=np.full(n, np.nan)))
    with pytest.raises(InputError, match=r"sigma_u: the quoted errors of \d+ matches are smaller"):
        star_covariance(fit, matches, alike(0.03, 0.01, n))
