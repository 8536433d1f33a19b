"""The statistics, against formulas that build every matrix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bayesdist.diagnose.score.exposures import exposure_tests
from bayesdist.diagnose.score.projection import Projection, projection_of, regressor_tests
from bayesdist.diagnose.score.questions import CONSTANT, Products, Question, functions_for
from bayesdist.diagnose.score.result import Family
from bayesdist.diagnose.score.sample import scored_sample
from bayesdist.infer import GaussianPriors, Rejection, fit_linear
from bayesdist.infer.solution.solution import likelihood_of
from bayesdist.infer.stars.stars import in_table_order, prepare
from bayesdist.model import DistortionModel

from ..infer.support import CHIP, TWO_CHIPS, columns_of, exposures, legendre_design, truth_of
from .support import SIGMA, TIME, Scene, student, terms_of

pytestmark = pytest.mark.usefixtures("one_thread")


def projected(table, solution, priors=None) -> Projection:
    return projection_of(
        functions_for(scored_sample(table, solution)),
        np.asarray(solution.mean),
        priors or GaussianPriors.none(solution.model),
    )


def added(table, model, theta, columns) -> np.ndarray:
    """Columns on both axes of each chip, turned with the frames: (N, 2, q)."""
    out = []
    turn = np.stack([model.frame(theta, e)[0] for e in range(len(model.exposures))])
    turn = turn[table.exposure]
    for chip in range(len(model.chips)):
        here = table.chip == chip
        for column in columns.T:
            out += [turn[:, :, axis] * (column * here)[:, None] for axis in (0, 1)]
    return np.stack(out, axis=2)


class Dense:
    """All of it, star by star."""

    def __init__(self, table, solution, priors=None):
        model, theta = solution.model, np.asarray(solution.mean)
        self.theta = theta
        stars, order = prepare(model, table)
        g_u, g_v, uu, uv, vv = in_table_order(likelihood_of(solution).scores(stars).T, order).T
        self.g = np.stack([g_u, g_v], 1)
        self.H = np.stack([np.stack([uu, uv], 1), np.stack([uv, vv], 1)], 2)
        self.J = model.jacobian(theta, table.x, table.y, **columns_of(table))
        priors = priors or GaussianPriors.none(model)
        self.P, pull = np.diag(priors.precision), priors.pull(theta)
        self.C = self.information(self.J, self.J) + self.P
        self.nuisance_score = np.einsum("nad,na->d", self.J, self.g) + pull
        self.inverse = np.linalg.inv(self.C)
        self.star = np.arange(len(table)) if table.star is None else table.star

    def information(self, A, B):
        return np.einsum("nap,nab,nbq->pq", A, self.H, B, optimize=True)

    def of(self, A):
        """Effect of a parameter's direction on itself, as a fraction, along each axis."""
        return np.stack([self.H[:, a, a] * A[:, a, a] for a in (0, 1)], 1)

    def leverage(self, extra=None):
        out = self.of(np.einsum("nad,de,nbe->nab", self.J, self.inverse, self.J, optimize=True))
        out = np.maximum(out, 0)
        if extra is not None:
            out += np.maximum(self.of(extra), 0)
        return np.minimum(out, 0.95)

    def projected(self, Z):
        follows = self.inverse @ self.information(self.J, Z)
        U = np.einsum("naq,na->q", Z, self.g) - follows.T @ self.nuisance_score
        return Z - self.J @ follows, follows, U

    def summed(self, psi):
        return np.stack([np.bincount(self.star, column) for column in psi.T], axis=1)

    def statistic(self, Z):
        """T and its degrees of freedom."""
        Z, follows, U = self.projected(Z)
        S = self.information(Z, Z) + follows.T @ self.P @ follows
        assert np.linalg.eigvalsh(S / np.sqrt(np.outer(np.diag(S), np.diag(S))))[0] > 1e-3
        inverse = np.linalg.inv(S)
        left = self.g - np.einsum("nab,nbq,q->na", self.H, Z, inverse @ U)
        each = np.einsum("naq,qr,nbr->nab", Z, inverse, Z)
        left = left / (1 - self.leverage(each)) ** 0.75
        psi = self.summed(np.einsum("naq,na->nq", Z, left))
        V = psi.T @ psi + follows.T @ self.P @ follows
        size = np.sqrt(np.abs(np.einsum("naa->na", self.H)))
        G = size[:, :, None] * size[:, None] * each
        trace = np.bincount(self.star, np.einsum("naa->n", G))
        norm = np.bincount(self.star, np.sqrt((G**2).sum((1, 2))))
        q = len(U)
        # what the quoted errors say of the scatter of V, and what scores do: E|psi|^4 of normal
        # ones is trace^2 + 2 norm^2, in directions of unit information
        root = np.linalg.cholesky(inverse)
        fourth = ((psi @ root) ** 2).sum(axis=1) ** 2
        quoted, normal = trace**2 + norm**2, trace**2 + 2 * norm**2
        found = (quoted / normal * fourth).sum() / (np.trace(root.T @ V @ root) / q) ** 2
        dof = min(q * (q + 1) / quoted.sum(), max(q * (q + 1) / found, q + 2))
        T = (dof - q + 1) / dof * U @ np.linalg.solve(V, U)
        return T, q, dof - q + 1


CASES = {
    "plain": Scene(300, 2),
    "mixture": Scene(400, 2, noise=student, fraction=0.1, mixture=True),
    "frames": Scene(300, 2, "shift_rotation_scale", 4),
    "chips": Scene(500, 1, "shift_rotation", 3, TWO_CHIPS),
    "mixture of exposures": Scene(400, 1, "affine", 3, fraction=0.1, mixture=True),
    "time": Scene(300, 1, "shift", 5, time=TIME),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("shared", [False, True])
def test_regressor_tests_are_those_of_dense_matrices(case, shared):
    scene = CASES[case]
    model, table = scene.data(5)
    if shared:
        table = table.with_columns(star=np.arange(len(table)) % (len(table) // 3))
    solution = scene.solve(model, table)
    found = {one.name: one for one in regressor_tests(projected(table, solution))}
    dense, n = Dense(table, solution), model.order
    one = np.ones(len(table))
    X, Y = (np.empty(len(table)) for _ in "xy")
    for chip in range(len(model.chips)):
        rows = table.chip == chip
        X[rows], Y[rows] = model.basis(model.chips[chip].number).scaled(
            table.x[rows], table.y[rows]
        )
    linear = np.stack([one, X, Y], 1)
    mag = np.clip(table.mag, *np.percentile(table.mag, [0.5, 99.5]))
    columns = {
        "magnitude": linear * (mag - mag.mean())[:, None],
        f"order {n + 1}": np.polynomial.legendre.legvander2d(X, Y, [n + 1, n + 1])[
            :, [(n + 1 - j) * (n + 2) + j for j in range(n + 2)]
        ],
    }
    for name, z in columns.items():
        T, q, dof = dense.statistic(added(table, model, solution.mean, z))
        p = stats.f.sf(T / q, q, dof)
        if name == "magnitude":
            p = with_patterns(p, dense, table, model, X, Y)
            T = stats.f.isf(p, q, dof) * q
        assert found[name].dof == q
        assert found[name].statistic == pytest.approx(T, rel=1e-5)
        assert found[name].dof_residual == pytest.approx(dof, rel=1e-6)
        assert found[name].p_value == pytest.approx(p, rel=1e-5)


def with_patterns(p: float, dense: Dense, table, model, X, Y) -> float:
    """The p-value of six directions combined with those of trails and of bright stars.

    Trails along each axis, from either end, in proportion to the magnitude or the flux.
    """
    turn = np.stack([model.frame(dense.theta, e)[0] for e in range(len(model.exposures))])
    low, high = np.percentile(table.mag, [0.5, 99.5])
    flux = np.minimum(10 ** (-0.4 * (table.mag - low)), 1.0)
    values = [np.clip(table.mag, low, high), np.clip(flux, *np.percentile(flux, [0.5, 99.5]))]
    each = []
    for value in values:
        for axis, z in enumerate((X, Y)):
            for sign in (1, -1):
                column = (value - value.mean()) * (1 + sign * z)
                Z = [
                    turn[table.exposure][:, :, axis] * (column * (table.chip == chip))[:, None]
                    for chip in range(len(model.chips))
                ]
                T, q, dof = dense.statistic(np.stack(Z, axis=2))
                each.append(stats.f.sf(T / q, q, dof))
    half = stats.cauchy.isf(p) / 2 + stats.cauchy.isf(np.minimum(each, 0.99)).mean() / 2
    return float(stats.cauchy.sf(half))


def test_patterns_along_a_direction_are_those_of_dense_matrices():
    """Along the diagonal of the detector, and of the sky, with the fourth power of the radius."""
    table, fit = CASES["chips"].fitted(5)
    model, sample, dense = fit.model, scored_sample(table, fit), Dense(table, fit)
    diagonal, radius4 = np.array([0.6, 0.8]), (sample.X**2 + sample.Y**2) ** 2
    X, Y = np.empty((2, len(table)))
    for code, chip in enumerate(model.chips):
        here = table.chip == code
        X[here], Y[here] = model.basis(chip.number).scaled(table.x[here], table.y[here])
    turn = np.stack([model.frame(fit.mean, e)[0] for e in range(len(model.exposures))])
    statistics = []
    for along, moved in (
        (diagonal, turn[table.exposure] @ diagonal),
        (sample.along_detector(diagonal), np.tile(diagonal, (len(table), 1))),
    ):
        asked = Question(Family("diagonal", "", "", ""), (Products(CONSTANT, radius4, along),))
        projection = projection_of(
            functions_for(sample, [asked]), fit.mean, GaussianPriors.none(model)
        )
        [found] = regressor_tests(projection)
        Z = [((X**2 + Y**2) ** 2 * (table.chip == c))[:, None] * moved for c in (0, 1)]
        T, q, dof = dense.statistic(np.stack(Z, axis=2))
        assert found.dof == q == 2  # one amplitude on each chip
        assert found.statistic == pytest.approx(T, rel=1e-6)
        assert found.dof_residual == pytest.approx(dof, rel=1e-6)
        statistics.append(T)
    assert statistics[0] != pytest.approx(statistics[1], rel=1e-4)


def test_curvature_in_time_is_what_the_lines_leave():
    scene = CASES["time"]
    table, fit = scene.fitted(5)
    found = {one.name: one for one in regressor_tests(projected(table, fit))}
    t = table.epoch - table.epoch.mean()
    X, Y = terms_of(1, table)[0].T
    square = t**2 - np.polyval(np.polyfit(t, t**2, 1), t)
    # shifts are those of the exposures
    z = np.stack([X * square, Y * square], 1)
    T, q, _ = Dense(table, fit).statistic(added(table, fit.model, fit.mean, z))
    assert found["curvature in time"].dof == q == 4
    assert found["curvature in time"].statistic == pytest.approx(T, rel=1e-6)
    # u_1_0 and v_0_1 have their drift
    z = added(table, fit.model, fit.mean, np.stack([X * t, Y * t], 1))[:, :, [1, 2]]
    T, q, _ = Dense(table, fit).statistic(z)
    assert found["drift"].dof == q == 2
    assert found["drift"].statistic == pytest.approx(T, rel=1e-6)


@pytest.mark.parametrize("solved_before", [False, True])
def test_priors_are_data_of_their_own(solved_before):
    """With wide and narrow priors; a step is made to the solution if it is not given."""
    model, table, priors = with_priors()
    fit = fit_linear(
        table, model, priors=priors if solved_before else None, rejection=Rejection(clip_abs=None)
    )
    assert solved_before or np.abs(priors.pull(fit.mean)).max() > 1
    found = {one.name: one for one in regressor_tests(projected(table, fit, priors))}
    z = added(table, model, fit.mean, terms_of(3, table)[0])
    T = Dense(table, fit, priors).statistic(z)[0]
    assert found["order 3"].statistic == pytest.approx(T, rel=1e-6)


def with_priors():
    model = DistortionModel(
        2, (CHIP,), frames="shift", exposures=exposures(3), origin=(500.0, 400.0)
    )
    theta = truth_of(model, np.random.default_rng(2))
    table = Scene(300, 2, "shift", 3).data(2)[1]
    uv = model.predict(theta, table.x, table.y, **columns_of(table))
    uv += SIGMA * np.random.default_rng(1).standard_normal(uv.shape)
    names = {"u_1_1": (theta[4], 1e-3), "v_0_2": (theta[11], 1e-2), "e2.shift_u": (theta[12], 1e-3)}
    return model, table.with_columns(u=uv[:, 0], v=uv[:, 1]), GaussianPriors.of(model, names)


@pytest.mark.parametrize(
    ("case", "shared"),
    [("frames", False), ("frames", True), ("chips", False), ("none", False), ("none", True)],
)
def test_deviations_of_exposures_are_those_of_dense_matrices(case, shared):
    scene = CASES.get(case, Scene(300, 2, "none", 4))
    model, table = scene.data(5)
    if shared:
        table = table.with_columns(star=np.arange(len(table)) % (len(table) // 3))
    fit = scene.solve(model, table)
    found = exposure_tests(projected(table, fit), fit.mean, GaussianPriors.none(model))[0]
    dense = Dense(table, fit)
    w = model.predict(fit.mean, table.x, table.y, **columns_of(table)) - model.origin
    shapes = {
        "scale": w, "rotation": w[:, ::-1] * [-1, 1],
        "shear_plus": w * [1, -1], "shear_cross": w[:, ::-1],
        "shift_u": np.ones_like(w) * [1, 0], "shift_v": np.ones_like(w) * [0, 1],
    }  # fmt: skip
    kept = {
        "none": [], "shift_rotation": ["shift_u", "shift_v", "rotation"],
        "shift_rotation_scale": ["shift_u", "shift_v", "rotation", "scale"],
    }[model.frames]  # fmt: skip
    fields = np.stack([f for name, f in shapes.items() if name not in kept], axis=2)
    n = fields.shape[2]
    T, whitened = 0.0, []
    whole = dense.g / np.sqrt(1 - dense.leverage())
    for e in range(len(model.exposures)):
        Z, _, U = dense.projected(fields * (table.exposure == e)[:, None, None])
        psi = dense.summed(np.einsum("naq,na->nq", Z, whole))
        V, own = psi.T @ psi, psi[np.unique(dense.star[table.exposure == e])]
        share = np.trace(np.linalg.solve(V, own.T @ own)) / n
        here = int((table.exposure == e).sum())
        N = 1 / (share**2 / here + (1 - share) ** 2 / (len(table) - here))
        p = stats.beta.sf(U @ np.linalg.solve(V, U) / N, len(U) / 2, (N - len(U)) / 2)
        T += stats.chi2.isf(p, len(U))
        S = dense.information(Z, Z)
        whitened.append(Z @ np.linalg.inv(np.linalg.cholesky(S)).T)
    every = np.concatenate(whitened, axis=2)
    R = dense.information(every, every)
    dof = (n * len(whitened)) ** 2 / (R**2).sum()
    assert found.dof == pytest.approx(dof, rel=1e-6)
    assert found.statistic == pytest.approx(T * dof / (n * len(whitened)), rel=1e-6)
    assert found.p_value == pytest.approx(stats.chi2.sf(found.statistic, dof), rel=1e-9)


def test_deviations_of_exposures_do_not_depend_on_the_unit_of_positions():
    """Shifts have it, and scales have none."""
    scene = Scene(300, 2, "none", 4)
    model, table = scene.data(5)
    p = []
    for unit in (1.0, 1e-3):
        there = {name: unit * getattr(table, name) for name in ("u", "v", "sigma_u", "sigma_v")}
        origin = (unit * model.origin[0], unit * model.origin[1])
        part = table.with_columns(**there)
        fit = scene.solve(replace(model, origin=origin), part)
        none = GaussianPriors.none(fit.model)
        p.append(exposure_tests(projected(part, fit), fit.mean, none)[0].p_value)
    assert p[1] == pytest.approx(p[0], rel=1e-6)


@pytest.mark.parametrize("order", [1, 3])
def test_equal_errors_give_nearly_the_f_test_of_least_squares(order):
    """numpy's least squares of both axes, without and with the terms of the next order.

    They differ by what single stars scatter.
    """
    scene = Scene(200, order)
    model, table = scene.data(7)
    fit = fit_linear(table, model, rejection=Rejection(np.inf, None))
    found = {one.name: one for one in regressor_tests(projected(table, fit))}
    for total in (order + 1, order + 2):
        small = legendre_design(order, table.x, table.y)
        large = np.column_stack([small, terms_of(total, table)[0]])

        def rss(A):
            return sum(((y - A @ np.linalg.lstsq(A, y)[0]) ** 2).sum() for y in (table.u, table.v))

        q, dof = 2 * (total + 1), 2 * (200 - large.shape[1])
        F = (rss(small) - rss(large)) / q / (rss(large) / dof)
        one = found[f"order {total}"]
        assert one.dof == q
        assert one.statistic / q == pytest.approx(F, rel=0.25)


def test_where_the_solution_stands_does_not_matter():
    """One step leads to the fit of the sample: from half a sigma away, and from all the stars."""
    scene = Scene(400, 2, "shift_rotation", 3)
    model, table = scene.data(9)
    fit = fit_linear(table, model, rejection=Rejection(np.inf, None))
    there = {one.name: one for one in regressor_tests(projected(table, fit))}
    away = type(fit)(**(vars(fit) | {"mean": fit.mean + 0.5 * fit.sigma}))
    here = {one.name: one for one in regressor_tests(projected(table, away))}
    assert here["order 3"].statistic == pytest.approx(there["order 3"].statistic, rel=0.1)
    # the score itself would have seen the missing step
    g = Dense(table, away)
    Z = added(table, model, away.mean, terms_of(3, table)[0])
    Z = Z[:, :, :1]
    assert abs(np.einsum("naq,na->q", Z, g.g)[0] - g.projected(Z)[2][0]) > 0.1 * abs(
        g.projected(Z)[2][0]
    )
