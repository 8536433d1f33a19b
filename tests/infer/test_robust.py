"""Clusters of stars that err together: against dense formulas, null cases and known patterns."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from bayesdist.errors import InputError
from bayesdist.infer import GaussianPriors, fit_linear, with_star_errors
from bayesdist.infer.kernel import cluster_moments, products_of
from bayesdist.infer.robust import robust_covariance
from bayesdist.infer.robust.bootstrap import resampled_cells, wild_cells
from bayesdist.infer.robust.cells import Cells, recommended_cells
from bayesdist.infer.robust.gains import gains
from bayesdist.infer.robust.level import level_of
from bayesdist.infer.robust.leverage import FrameShare
from bayesdist.infer.robust.scores import scores_of
from bayesdist.infer.robust.sums import cluster_sums
from bayesdist.model import Chip, DistortionModel
from bayesdist.simulate import simulate_matches

from .patterned import CHIP, blocks, mode_of, moved, patterned
from .support import (
    TWO_CHIPS,
    UNCLIPPED,
    columns_of,
    exposures,
    legendre_design,
    residual_of,
    simulated,
    stars_of,
    truth_of,
)

pytestmark = pytest.mark.usefixtures("one_thread")

PLACES = np.array([(1024, 1024), (300, 1500), (1800, 400), (60, 70), (2000, 1100), (1000, 2040)])
LEVELS = (0.683, 0.954)


def band(level: float, n: int, tests: int = 1) -> tuple[float, float]:
    """Binomial band of a share that holds in all of so many tests with 99 % probability."""
    tail = 0.005 / tests
    low, high = stats.binom.ppf([tail, 1 - tail], n, level)
    return low / n, high / n


def close(a, b, tolerance=1e-8):
    """Covariances, in units of the sigmas of the second."""
    unit = np.sqrt(np.abs(np.outer(np.diag(b), np.diag(b))))
    np.testing.assert_allclose(a / unit, b / unit, atol=tolerance)


# -- the pieces ------------------------------------------------------------------------------------


@pytest.mark.parametrize("tied", [True, False])
def test_sums_of_clusters_are_those_of_their_stars(tied):
    """Empty clusters, and some with more stars than a block has."""
    rng = np.random.default_rng(1)
    n, order, C = 1500, 3, 7
    X, Y = rng.uniform(-1, 1, (2, n))
    cluster = rng.choice(C, n, p=[0.4, 0, 0.3, 0.1, 0.001, 0.199, 0])
    columns = rng.standard_normal((5, n))
    columns[3] *= tied
    phi = legendre_design(order, X + 1.5, Y + 1.5, (2.0, 2.0))
    right, weight = cluster_moments(X, Y, cluster, columns, order, C)
    weight = products_of(weight, order)
    for c in range(C):
        rows = cluster == c
        np.testing.assert_allclose(right[c], columns[:2, rows] @ phi[rows], atol=1e-10)
        for pair in range(3):
            expected = (phi[rows].T * columns[2 + pair, rows]) @ phi[rows]
            np.testing.assert_allclose(weight[c, pair], expected, atol=1e-10)


def test_what_a_star_says_is_the_derivative_of_its_log_likelihood():
    """A mixture by scipy, true matches, doubtful and false ones."""
    p = patterned(1, 400, order=1, fraction=0.2)
    posterior, _ = mode_of(p.matches, p.model)
    r = residual_of(p.model, posterior.mean, p.matches)
    f, j, s = (float(posterior.hyper[k][0, 0]) for k in ("f", "j", "s_out"))
    core = np.hypot(p.matches.sigma_u, j)

    def log_density(du, dv):
        parts = [
            stats.norm.logpdf(r[:, 0] - du, 0, scale) + stats.norm.logpdf(r[:, 1] - dv, 0, scale)
            for scale in (core, s)
        ]
        return logsumexp(parts, axis=0, b=np.array([[1 - f], [f]]))

    h = 1e-4
    at = {(a, b): log_density(a * h, b * h) for a in (-1, 0, 1) for b in (-1, 0, 1)}
    found = scores_of(posterior).of(stars_of(p.model, p.matches))
    expected = np.stack(
        [
            (at[1, 0] - at[-1, 0]) / (2 * h),
            (at[0, 1] - at[0, -1]) / (2 * h),
            -(at[1, 0] - 2 * at[0, 0] + at[-1, 0]) / h**2,
            -(at[1, 1] - at[1, -1] - at[-1, 1] + at[-1, -1]) / (4 * h**2),
            -(at[0, 1] - 2 * at[0, 0] + at[0, -1]) / h**2,
        ]
    )
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_pieces_of_the_data_add():
    """Also where they hold different exposures and chips."""
    model, matches, _ = simulated(
        2, 400, frames="affine", n_exposures=3, chips=TWO_CHIPS, fraction=0.05
    )
    fit = fit_linear(matches, model)
    scores, cells = scores_of(fit), Cells(((5, 4), (4, 6)))
    whole = cluster_sums(stars_of(model, matches), scores, cells)
    parts = [
        cluster_sums(stars_of(model, matches.select(rows)), scores, cells)
        for rows in (np.arange(400) // 140 == k for k in range(3))
    ]
    assert len({len(part.groups) for part in parts}) > 1
    added = parts[0] + parts[1] + parts[2]
    assert added.groups.same(whole.groups)
    np.testing.assert_allclose(added.score, whole.score, atol=1e-7)
    np.testing.assert_allclose(added.weight, whole.weight, atol=1e-7)
    np.testing.assert_allclose(added.equations.right, whole.equations.right, atol=1e-6)


def test_cells_cover_the_chip_and_follow_the_reach():
    model = DistortionModel(1, (Chip(1, "A", (2048.0, 1024.0), (1.0, 1.0)),))
    assert recommended_cells(model).shapes == ((45, 22),)  # 45 pixels: 1024 on the chip at most
    assert recommended_cells(model, 64.0).shapes == ((32, 16),)
    assert recommended_cells(model, 1e4).shapes == ((4, 4),)
    cells = Cells(((5, 4),))
    X, Y = np.meshgrid(np.linspace(-1, 1, 11)[:-1] + 0.1, np.linspace(-1, 1, 9)[:-1] + 0.125)
    code = cells.codes(X.ravel(), Y.ravel(), 0).reshape(8, 10)
    np.testing.assert_array_equal(code[::2, ::2], np.arange(20).reshape(4, 5))
    np.testing.assert_array_equal(code, np.repeat(np.repeat(code[::2, ::2], 2, 0), 2, 1))
    shapes, into = cells.merged(2)
    assert shapes == [(3, 2)]
    np.testing.assert_array_equal(into[0][:10], [0, 0, 1, 1, 2, 0, 0, 1, 1, 2])


# -- the sandwich ----------------------------------------------------------------------------------


def small(seed=3, n=260, order=2):
    model, matches, _ = simulated(seed, n, order=order)
    rng = np.random.default_rng(seed)
    matches = matches.with_sigma(*rng.uniform(0.02, 0.2, (2, n)))
    return model, matches, fit_linear(matches, model, **UNCLIPPED)


def dense_cells(model, matches, shape):
    """Cell of each star by its pixel."""
    ix, iy = (
        ((z - 0.5) / side * n).astype(int)
        for z, side, n in zip((matches.x, matches.y), model.chips[0].size, shape, strict=True)
    )
    return iy * shape[0] + ix


def dense_sandwich(model, matches, fit, shape):
    """Covariance by whole clusters after Bell and McCaffrey, star by star, and tr M, tr M^2."""
    code = np.repeat(dense_cells(model, matches, shape), 2)
    J = model.jacobian(fit.mean, matches.x, matches.y).reshape(-1, model.n_params)
    sigma = np.column_stack([matches.sigma_u, matches.sigma_v]).ravel()
    X, e = J / sigma[:, None], residual_of(model, fit.mean, matches).ravel() / sigma
    inverse = np.linalg.inv(X.T @ X)
    left = np.eye(len(e)) - X @ inverse @ X.T
    influence, carriers = [], []
    for c in np.unique(code):
        rows = code == c
        values, vectors = np.linalg.eigh(left[np.ix_(rows, rows)])
        root = (vectors / np.sqrt(values)) @ vectors.T
        carrier = inverse @ X[rows].T @ root @ left[rows]
        influence.append(carrier @ e)
        carriers.append(carrier)
    influence = np.array(influence)
    return influence.T @ influence, carriers


def test_the_sandwich_is_that_of_all_stars_with_dense_matrices():
    model, matches, fit = small()
    found = robust_covariance(matches, fit, Cells(((8, 8),)))
    close(found.formal, fit.cov, 1e-9)
    covariances = {}
    for factor, shape in ((1, (8, 8)), (2, (4, 4))):
        covariances[factor], carriers = dense_sandwich(model, matches, fit, shape)
        level = found.levels[factor - 1]
        close(level.influence.T @ level.influence, covariances[factor])
        # independent unit errors: the cells' quantities have covariance M
        J = model.jacobian(fit.mean, [100.0, 990.0], [700.0, 30.0]).reshape(1, 4, -1)
        for rows in (J[:, :1], J):
            z = np.concatenate([rows[0] @ carrier for carrier in carriers])
            M = z @ z.T
            mean, variance, _ = level.moments(rows)[:, 0]
            assert mean == pytest.approx(np.trace(M), rel=1e-8)
            assert variance == pytest.approx(2 * (M**2).sum(), rel=1e-8)
    close(found.from_cells(), 2 * covariances[2] - covariances[1])


def test_it_is_unbiased_where_errors_are_independent():
    """Exactly: its expectation by the dense carriers is the formal covariance."""
    model, matches, fit = small()
    for shape in ((8, 8), (4, 4)):
        _, carriers = dense_sandwich(model, matches, fit, shape)
        close(sum(c @ c.T for c in carriers), fit.cov)


def test_exposures_and_cells_within_them_are_those_of_dense_matrices():
    """What an exposure's own shift takes upon itself is not held against the exposure."""
    model, matches, _ = simulated(5, 300, frames="shift", n_exposures=4)
    fit = fit_linear(matches, model, **UNCLIPPED)
    found = robust_covariance(matches, fit, Cells(((8, 8),)), exposures=True)
    J = model.jacobian(fit.mean, matches.x, matches.y, **columns_of(matches))
    r = residual_of(model, fit.mean, matches) / matches.sigma_u[:, None] ** 2
    scores = np.einsum("nad,na->nd", J, r)
    for e in range(4):
        expected = fit.cov @ scores[matches.exposure == e].sum(axis=0)
        np.testing.assert_allclose(found.exposures[e] / fit.sigma, expected / fit.sigma, atol=1e-7)
    w = matches.sigma_u**-2.0
    sums = cluster_sums(stars_of(model, matches), scores_of(fit), found.cells)
    gain = gains(sums, model, fit.mean, fit.cov, GaussianPriors.none(model))
    gain = replace(gain, frame=[])  # as they are, before what the frames took is given back
    for factor, shape in ((1, (8, 8)), (2, (4, 4))):
        level = level_of(sums, found.cells, factor, gain, within=True)
        within = np.zeros_like(fit.cov)
        cell = dense_cells(model, matches, shape)
        for e in range(4):
            here = matches.exposure == e
            shift_to_all = np.einsum("nad,n->da", J[here], w[here]) / w[here].sum()
            for c in np.unique(cell[here]):
                rows = here & (cell == c)
                u = fit.cov @ (scores[rows].sum(axis=0) - shift_to_all @ r[rows].sum(axis=0))
                within += np.outer(u, u)
        scale = np.outer(fit.sigma, fit.sigma)
        np.testing.assert_allclose(level.within / scale, within / scale, atol=1e-7)
    cells = robust_covariance(matches, fit, Cells(((8, 8),)))
    by_hand = cells.from_cells() + 4 / 3 * found.exposures.T @ found.exposures
    by_hand -= 2 * found.levels[1].within - found.levels[0].within
    close(found.from_cells(), by_hand)


def test_what_a_frame_takes_of_the_scores_of_cells_is_given_back():
    """Scores of covariance W - W F F^T W have W again, also where a cell holds nearly all."""
    rng = np.random.default_rng(2)
    C, width, q = 6, 12, 4
    roots = rng.standard_normal((C, width, 3)) * np.array([1, 1, 1, 0.3, 0.3, 3])[:, None, None]
    information = roots @ np.swapaxes(roots, 1, 2)
    M = rng.standard_normal((width, q))
    F = M @ np.linalg.inv(np.linalg.cholesky(M.T @ information.sum(axis=0) @ M)).T
    share = FrameShare.of(SimpleNamespace(information=information), F)
    for c in range(C):
        W = information[c]
        left = W - W @ F @ F.T @ W
        B = share.given_back(np.broadcast_to(np.eye(width)[:, None], (width, C, width)))[:, c].T
        np.testing.assert_allclose(B @ left @ B.T, W, atol=1e-9 * np.abs(W).max())


def test_priors_keep_their_part():
    """A parameter that only its prior knows has the prior's variance."""
    model, matches, _ = small()
    priors = GaussianPriors.of(model, {"u_1_0": (500.0, 1e-6)})
    fit = fit_linear(matches, model, priors=priors, **UNCLIPPED)
    found = robust_covariance(matches, fit, Cells(((8, 8),)), priors=priors)
    close(found.formal, fit.cov, 1e-7)
    k = model.names.index("u_1_0")
    assert np.sqrt(found.from_cells()[k, k]) == pytest.approx(1e-6, rel=1e-3)


# -- the bootstrap ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shared():
    p = patterned(11, 3000, order=2, fraction=0.0)
    fit = fit_linear(p.matches, p.model, **UNCLIPPED)
    return p, fit, robust_covariance(p.matches, fit, recommended_cells(p.model, 64.0))


def test_resampled_cells_agree_with_the_sandwich(shared):
    """Between the sandwich of the residuals as they are and the jackknife's, which is above it."""
    _, _, found = shared
    rng = np.random.default_rng(1)
    n = 4000
    draws = resampled_cells(found, n, rng)
    level = found.levels[1]
    ends = []
    for power in (0.0, 1.0):
        leverage, score = level.leverage[0], level.score[0]
        white = np.linalg.solve(leverage.root, score.T).T
        turned = np.einsum("ck,ckl->cl", white, leverage.vectors) * (1 - leverage.values) ** -power
        u = np.einsum("cl,ckl,jk->cj", turned, leverage.vectors, leverage.root) @ level.gain[0].T
        ends.append(np.diag(u.T @ u))
    noise = stats.norm.ppf(1 - 1e-4) * np.sqrt(2 / n)
    variance = draws.var(axis=0)
    assert (variance > ends[0] * (1 - 2 * noise)).all()
    assert (variance < ends[1] * (1 + 2 * noise)).all()


def test_signs_of_cells_give_the_sandwich(shared):
    _, _, found = shared
    n = 4000
    for level in (0, 1):
        draws = wild_cells(found, n, np.random.default_rng(2), level=level)
        u = found.levels[level].influence
        low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], n) / n
        ratio = (draws**2).mean(axis=0) / (u**2).sum(axis=0)
        assert (ratio > low).all() and (ratio < high).all()


# -- what is said ----------------------------------------------------------------------------------


def test_independent_errors_raise_no_alarm():
    """100 detectors: the ratio is 1 within its error, and alarms are as rare as they should be."""
    ratios = []
    for seed in range(100):
        model, matches, _ = simulated(1000 + seed, 1500, order=2)
        fit = fit_linear(matches, model, **UNCLIPPED)
        ratios.append(robust_covariance(matches, fit, Cells(((16, 16),))).ratio)
    value, error = (np.array([getattr(r, name) for r in ratios]) for name in ("value", "error"))
    expected = np.sqrt(np.mean(error**2))
    assert abs(value.mean() - 1) < 4 * expected / 10
    # a variance of 100 ratios, of 30 degrees of freedom each, is known to about a sixth
    assert 0.6 < value.std() / expected < 1.5
    p = np.array([r.p_value for r in ratios])
    assert (p < 0.01).sum() <= stats.binom.ppf(0.999, 100, 0.01)
    assert (p < 0.1).sum() <= stats.binom.ppf(0.999, 100, 0.1)
    assert (p > 0.9).sum() <= stats.binom.ppf(0.999, 100, 0.1)


def test_a_pattern_raises_the_covariance_by_what_theory_says(shared):
    """n stars share a block's offset: 1 + n rms^2 / sigma^2, the mean of n over blocks."""
    p, fit, found = shared
    n = 3000 * 64**2 / 2048**2
    expected = 1 + n * 0.1**2 / 0.05**2
    assert found.exceeds and not found.doubts
    assert "stars err together" in found.statement and "do not cover" in found.statement
    assert abs(found.ratio.value - expected) < 3 * found.ratio.error
    relative = np.linalg.eigvals(np.linalg.solve(found.formal, found.cov)).real
    assert relative.min() > 1 - 1e-9
    solution = with_star_errors(fit, found.shared)
    close(solution.cov, found.cov, 1e-9)
    draws = solution.draws(4000, np.random.default_rng(0))
    spread = draws.var(axis=0) / np.diag(found.cov)
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], 3999) / 3999
    assert (spread > low).all() and (spread < high).all()
    errors = found.at(*PLACES.T.astype(float))
    J = p.model.jacobian(fit.mean, *PLACES.T.astype(float))
    np.testing.assert_allclose(
        errors.sigma**2, np.einsum("nad,de,nae->na", J, found.measured, J), rtol=1e-9
    )
    np.testing.assert_allclose(
        errors.formal**2, np.einsum("nad,de,nae->na", J, fit.cov, J), rtol=1e-6
    )
    assert (errors.half_width(0.683) > errors.sigma).all()


def test_without_an_excess_the_formal_covariance_stays():
    _, matches, fit = small(n=1500)
    found = robust_covariance(matches, fit, Cells(((16, 16),)))
    assert not found.exceeds
    np.testing.assert_array_equal(found.cov, found.formal)
    assert not found.shared.extra.any()
    assert "as far as can be seen" in found.statement


def test_structure_larger_than_the_cells_is_doubted():
    """And the ratio grows with the cells, as the table by size shows."""
    p = patterned(4, 20_000, order=2, side=500.0, rms=0.05, fraction=0.0)
    fit = fit_linear(p.matches, p.model, **UNCLIPPED)
    small_cells = robust_covariance(p.matches, fit, Cells(((64, 64),)))
    assert small_cells.exceeds
    assert any("beyond the cells" in doubt for doubt in small_cells.doubts)
    sizes = [one.pixels for one in small_cells.by_size]
    assert sizes == [64.0, 128.0, 256.0, 512.0]
    alone = [one.alone for one in small_cells.by_size]
    assert alone == sorted(alone)
    few = robust_covariance(p.matches, fit, recommended_cells(p.model, 500.0))
    assert any("too few clusters" in doubt for doubt in few.doubts)


def test_frames_drift_and_chips_are_taken():
    model, matches, _ = simulated(
        9, 3000, frames="shift_rotation_scale", n_exposures=5, chips=TWO_CHIPS, fraction=0.02
    )
    fit = fit_linear(matches, model)
    found = robust_covariance(matches, fit, Cells(((16, 16), (16, 16))), exposures=True)
    close(found.formal, fit.cov, 1e-6)
    assert not found.exceeds
    assert found.at([10.0], [20.0], chip=2, exposure=3).sigma.shape == (1, 2)


def test_what_cannot_be_is_refused(shared):
    p, fit, found = shared
    with pytest.raises(InputError, match="does not say how it was fitted"):
        robust_covariance(p.matches, with_star_errors(fit, found.shared), found.cells)
    with pytest.raises(InputError, match="2 chips"):
        robust_covariance(p.matches, fit, Cells(((8, 8), (8, 8))))
    with pytest.raises(InputError, match="no exposures apart"):
        robust_covariance(p.matches, fit, found.cells, exposures=True)
    with pytest.raises(InputError, match="3 x 8 cells"):
        Cells(((3, 8),))
    with pytest.raises(InputError, match="the reach is -1"):
        recommended_cells(p.model, -1.0)
    with pytest.raises(InputError, match="too many"):
        robust_covariance(p.matches, fit, Cells(((4000, 4000),)))
    model, matches, _ = simulated(9, 300, frames="shift", n_exposures=2)
    framed = robust_covariance(matches, fit_linear(matches, model), Cells(((8, 8),)))
    with pytest.raises(InputError, match="polynomials alone"):
        resampled_cells(framed, 10, np.random.default_rng(0))


# -- coverage --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_positions_are_covered_with_a_pattern_left_out(full, capsys):
    """Every detector has its own pattern and stars; the formal posterior does not cover."""
    n = 200 if full else 40
    inside: dict[str, list] = {"measured": [], "formal": []}
    for seed in range(n):
        p = patterned(seed, 8000)
        posterior, _ = mode_of(p.matches, p.model)
        found = robust_covariance(p.matches, posterior, recommended_cells(p.model, 64.0))
        x, y = PLACES.T.astype(float)
        miss = np.abs(p.model.predict(posterior.mean, x, y) - p.model.predict(p.theta, x, y))
        errors = found.at(x, y)
        assert found.exceeds
        inside["measured"].append([miss < errors.half_width(q) for q in LEVELS])
        inside["formal"].append(
            [miss < errors.formal * stats.norm.ppf(0.5 + q / 2) for q in LEVELS]
        )
    covered = {k: np.array(v) for k, v in inside.items()}
    for k, level in enumerate(LEVELS):
        each = covered["measured"][:, k].mean(axis=0).ravel()
        formal = covered["formal"][:, k].mean(axis=0).ravel()
        with capsys.disabled():
            print(
                f"\n{level:.1%}: measured {each.mean():.3f} ({each.min():.3f} to {each.max():.3f}),"
                f" formal {formal.mean():.3f}, {n} patterns"
            )
        low, high = band(level, n, len(each))
        assert (each >= low).all() and (each <= high).all()
        # a mean over places scatters less than the share at one of them
        assert formal.mean() < band(level, n)[0]


@pytest.mark.slow
def test_errors_that_exposures_share_are_covered_too(full, capsys):
    """A pattern on the detector and a smooth field in each exposure: both ways, or it fails."""
    n, E = (100 if full else 30), 24
    model = DistortionModel(
        2, (CHIP,), frames="shift", exposures=exposures(E), origin=(1024.0, 1024.0)
    )
    own = [k for k in range(model.n_polynomial) if k % model.n_terms]
    pulls: dict[bool, list] = {True: [], False: []}
    for seed in range(n):
        rng = np.random.default_rng([24, seed])
        theta = truth_of(model, rng)
        matches, _ = simulate_matches(model, theta, 6000, rng=rng, fraction=0.0)
        phi = model.basis().evaluate(matches.x, matches.y)
        of_exposure = rng.normal(0, 0.01, (E, 2, model.n_terms))[matches.exposure]
        by = np.einsum("nak,nk->na", of_exposure, phi)
        by += blocks(rng, 64.0, 0.03)(matches.x, matches.y)
        matches = moved(matches, by)
        fit = fit_linear(matches, model, **UNCLIPPED)
        for both in (True, False):
            found = robust_covariance(matches, fit, recommended_cells(model, 64.0), exposures=both)
            pulls[both].append(((fit.mean - theta) / np.sqrt(np.diag(found.measured)))[own])
    for level in LEVELS:
        z = stats.norm.ppf(0.5 + level / 2)
        share = {both: (np.abs(pulls[both]) < z).mean(axis=0) for both in pulls}
        with capsys.disabled():
            print(f"\n{level:.1%}: both {share[True].mean():.3f}, cells {share[False].mean():.3f}")
        low, high = band(level, n, len(own))
        assert (share[True] >= low).all() and (share[True] <= high).all()
    # the mean of squares of independent pulls of variance 1 or more
    most = stats.chi2.ppf(0.999, n * len(own)) / (n * len(own))
    assert np.mean(np.square(pulls[False])) > most
