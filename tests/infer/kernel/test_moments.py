"""Sums that second-order steps need: star by star in numpy, with dense design matrices."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import legendre

from bayesdist.infer import kernel
from bayesdist.infer.kernel import Constants
from bayesdist.infer.kernel.moments import product_table
from bayesdist.model import PolynomialBasis
from bayesdist.model.basis import polynomial_terms

from ..oracle import star_terms

HYPER = {"j": 0.03, "f": 0.04, "s_out": 0.6}
RADIUS = 1.5
MIXTURES = {
    "gaussian": ("gaussian", HYPER),
    "uniform": ("uniform", {"j": 0.03, "f": 0.04}),
    "none": ("none", {"j": 0.03}),
    "gaussian, no jitter": ("gaussian", {"f": 0.3, "s_out": 0.2}),
    "gaussian, hardly any": ("gaussian", {"j": 1e-9, "f": 1e-12, "s_out": 0.6}),
    "uniform, hardly anything else": ("uniform", {"j": 0.5, "f": 1 - 1e-9}),
}
NO_TURN = (np.zeros(0), np.zeros(0))  # errors that are not correlated
# full pieces and blocks, remnants of them, and a single star
COUNTS = (9001, 1, 256, 700)


def design(order: int, X, Y) -> np.ndarray:
    """Legendre products, sorted by total order, then falling power of X."""
    full = legendre.legvander2d(X, Y, [order, order]).reshape(len(X), order + 1, order + 1)
    return np.stack([full[:, i, j] for i, j in polynomial_terms(order)], axis=1)


class Stars:
    """Stars in groups, residuals from good to hopeless."""

    def __init__(self, order: int, counts=COUNTS, seed: int = 3) -> None:
        rng = np.random.default_rng(seed)
        n, self.order, self.n_groups = sum(counts), order, len(counts)
        self.group = np.repeat(np.arange(len(counts)), counts)
        self.starts = np.concatenate([[0], np.cumsum(counts)])
        self.X, self.Y = rng.uniform(-1, 1, (2, n))
        self.sigma = rng.uniform(0.02, 0.1, (n, 2))
        self.phi = design(order, self.X, self.Y)
        K = self.phi.shape[1]
        self.E = rng.standard_normal((len(counts), 2, K))
        self.offset = 0.02 * rng.standard_normal((len(counts), 2, K)) / K
        error = self.sigma * rng.standard_normal((n, 2)) * rng.choice([0.5, 3, 10], (n, 1))
        self.data = self.model(self.E) + error

    def model(self, E) -> np.ndarray:
        return np.einsum("nk,nak->na", self.phi, E[self.group])

    def powers(self, E) -> np.ndarray:
        basis = PolynomialBasis(self.order, (10.0, 10.0), (5.0, 5.0))
        return basis.to_scaled_powers(E)

    @property
    def columns(self) -> tuple[np.ndarray, ...]:
        columns = (self.X, self.Y, *self.data.T, *(self.sigma**2).T, *NO_TURN)
        return tuple(np.ascontiguousarray(c) for c in columns)

    @property
    def pieces(self) -> np.ndarray:
        return kernel.pieces_of(self.starts, kernel.PIECE)

    def by_group(self, values) -> np.ndarray:
        """Sum over the stars of each group."""
        out = np.zeros((self.n_groups, *values.shape[1:]))
        np.add.at(out, self.group, values)
        return out

    def matrices(self, weights) -> np.ndarray:
        """Sum of w phi phi^T, (G, c, K, K), of columns (N, c)."""
        out = []
        for g in range(self.n_groups):
            rows = self.group == g
            phi = self.phi[rows]
            out.append([phi.T @ (w[:, None] * phi) for w in weights[rows].T])
        return np.array(out)

    def vectors(self, values) -> np.ndarray:
        """Sum of w phi, (G, ..., K), of columns (N, ...)."""
        flat = values.reshape(len(values), -1)
        out = [flat[self.group == g].T @ self.phi[self.group == g] for g in range(self.n_groups)]
        return np.array(out).reshape(self.n_groups, *values.shape[1:], -1)


def close(found, expected, size, rel=1e-12):
    """Within so much of the sum of absolute values: what the order of a sum may change."""
    assert found.shape == expected.shape
    assert (np.abs(found - expected) <= rel * size).all(), np.max(np.abs(found - expected) / size)


def constants_of(kind, values) -> Constants:
    f = values.get("f", 0.0)
    out = values.get("s_out", 1.0) ** 2
    if kind == "uniform":
        out = np.pi * RADIUS**2
    with np.errstate(divide="ignore"):
        log_f, log_1_f = np.log(f), np.log1p(-f)
    kinds = {"none": kernel.NO_OUTLIERS, "gaussian": kernel.GAUSSIAN, "uniform": kernel.UNIFORM}
    four = (np.array([c]) for c in (values.get("j", 0.0) ** 2, log_f, log_1_f, out))
    return Constants(*four, kinds[kind], 0.05**2)


@pytest.mark.parametrize("em", [False, True], ids=["Hessian", "EM"])
@pytest.mark.parametrize("order", [1, 4, 9])
@pytest.mark.parametrize("name", MIXTURES)
def test_mixture_moments(name, order, em):
    kind, values = MIXTURES[name]
    stars = Stars(order)
    found = kernel.mixture_moments(
        stars.pieces,
        stars.columns,
        stars.powers(stars.E),
        order,
        constants_of(kind, values),
        em=em,
    )
    residual = stars.data - stars.model(stars.E)
    terms = star_terms(kind, residual, *(stars.sigma**2).T, radius=RADIUS, **values)
    which = {"none": [0], "uniform": [0, 1], "gaussian": [0, 1, 2]}[kind]
    # probabilities are known to a rounding of one: errors are measured in what the core would have
    all_core = 1 / (stars.sigma**2 + values.get("j", 0.0) ** 2)
    weight = terms.safe_weight if em else terms.weight
    close(found.weight, stars.matrices(weight), np.abs(weight).sum() + all_core.sum())
    size = np.abs(terms.pull).sum() + (all_core * np.abs(residual)).sum()
    close(found.right, stars.vectors(terms.pull), size)
    if em:
        assert (found.cross == 0).all()
        for matrix in found.weight[:, [0, 2]].reshape(-1, *found.weight.shape[2:]):
            assert np.linalg.eigvalsh(matrix)[0] > -1e-12 * all_core.sum()
    else:
        expected = stars.vectors(terms.cross)[:, which]
        close(found.cross[:, which], expected, np.abs(terms.cross).sum() + size)

    loglik, by_j, n_out, by_s, jj, jf, js, ff, fs, ss = found.scalars
    f = values.get("f", 0.0)
    assert loglik == pytest.approx(terms.loglik.sum(), rel=1e-12)
    assert n_out == pytest.approx(terms.outlier.sum(), rel=1e-12, abs=1e-12)
    gradient = {"j": by_j, "f": n_out - len(residual) * f, "s_out": by_s}
    curvature = np.array([[jj, jf, js], [jf, ff, fs], [js, fs, ss]])
    core = star_terms("none", residual, *(stars.sigma**2).T, j=values.get("j", 0.0))
    by_one = np.abs(terms.gradient).sum(axis=0) + np.abs(core.gradient).sum(axis=0) + len(residual)
    for k in which:
        one = gradient[("j", "f", "s_out")[k]]
        assert one == pytest.approx(terms.gradient[:, k].sum(), abs=1e-12 * by_one[k])
    by_two = np.abs(terms.curvature).sum(axis=0) + np.abs(core.curvature).sum(axis=0)
    close(
        curvature[which][:, which],
        terms.curvature.sum(axis=0)[which][:, which],
        (by_two + len(residual))[which][:, which],
    )


RULES = {
    "nothing is left out": {},
    "chi-square": {"chi2_limit": 30.0},
    "absolute": {"abs_limit": 0.25},
    "both": {"chi2_limit": 30.0, "abs_limit": 0.25},
    "corners": {"corner": 4.0},
    "corners, squared": {"corner": 4.0, "power": 2, "chi2_limit": 30.0},
    "corners down": {"corner": 0.25, "power": 2},
}


@pytest.mark.parametrize("order", [1, 4, 9])
@pytest.mark.parametrize("name", RULES)
def test_least_squares_moments(name, order):
    rule = {"chi2_limit": np.inf, "abs_limit": np.inf} | RULES[name]
    stars = Stars(order)
    test = stars.E + stars.offset  # who is left out is decided elsewhere
    found = kernel.least_squares_moments(
        stars.pieces, stars.columns, stars.powers(stars.E), stars.powers(test), order, **rule
    )
    there = stars.data - stars.model(test)
    far = (there**2).sum(axis=1) > rule["abs_limit"] ** 2
    unlikely = ((there / stars.sigma) ** 2).sum(axis=1) > rule["chi2_limit"]
    used = ~(far | unlikely)
    assert used.all() == (name in ("nothing is left out", "corners", "corners down"))
    extra = 1 + (rule.get("corner", 1.0) - 1) * (stars.X**2 + stars.Y**2) / 2
    factor = used * extra ** rule.get("power", 1)
    w = factor[:, None] / stars.sigma**2
    r = stars.data - stars.model(stars.E)
    expected = stars.matrices(w)
    close(found.weight[:, 0::2], expected, w.sum())
    assert (found.weight[:, 1] == 0).all() and (found.cross == 0).all()
    close(found.right, stars.vectors(w * r), np.abs(w * r).sum())
    chi2 = ((r / stars.sigma) ** 2).sum(axis=1)
    r2 = r**2
    scalars = [
        used.sum(),
        far.sum(),
        chi2[used].sum(),
        *r2[used].sum(axis=0),
        r2[~used].sum(),
        (w * r2).sum(),
        *r[used].sum(axis=0),
    ]
    np.testing.assert_allclose(found.scalars, scalars, rtol=1e-12, atol=1e-12 * np.abs(r).sum())
    np.testing.assert_array_equal(found.scalars[:2], scalars[:2])


def test_the_corner_weight_is_what_it_says():
    """One in the middle, the factor in the corners, the mean of both in the middle of a side."""
    X, Y = np.array([[0.0, 0], [1, 1], [-1, 1], [1, -1], [-1, -1], [1, 0], [0, -1]]).T
    one = np.ones(1)
    for x, y, factor in zip(X, Y, [1, 5, 5, 5, 5, 3, 3], strict=True):
        columns = (np.array([x]), np.array([y]), one, one, 4 * one, 9 * one, *NO_TURN)
        nothing = np.zeros((1, 2, 3))
        found = kernel.least_squares_moments(
            np.array([[0, 0, 1]]),
            columns,
            nothing,
            nothing,
            1,
            chi2_limit=np.inf,
            abs_limit=np.inf,
            corner=5.0,
        )
        np.testing.assert_allclose(
            found.weight[0, :, 0, 0], [factor / 4, 0, factor / 9], rtol=1e-15
        )


@pytest.mark.parametrize("order", [0, 1, 2, 5, 9])
def test_products_of_legendre_functions(order):
    """phi_k phi_l from the table, at places that have nothing to do with its making."""
    X, Y = np.random.default_rng(order).uniform(-1, 1, (2, 50))
    phi, twice = design(order, X, Y), design(2 * order, X, Y)
    table = product_table(order)
    K, M = phi.shape[1], twice.shape[1]
    assert table.shape == (K, K, M)
    np.testing.assert_allclose(
        np.einsum("klm,nm->nkl", table, twice), phi[:, :, None] * phi[:, None, :], atol=1e-13
    )
    # Clebsch-Gordan coefficients: not negative, and they add up to P_i(1) P_j(1) = 1
    assert (table >= 0).all()
    np.testing.assert_allclose(table.sum(axis=2), 1, rtol=1e-13)


def test_moments_do_not_depend_on_how_the_data_are_cut():
    """Pieces of another size give the same sums but for rounding."""
    stars = Stars(4)
    constants = constants_of("gaussian", HYPER)
    found = [
        kernel.mixture_moments(
            kernel.pieces_of(stars.starts, size), stars.columns, stars.powers(stars.E), 4, constants
        )
        for size in (kernel.PIECE, 256, 100, 1_000_000)
    ]
    for other in found[1:]:
        for name in ("weight", "right", "cross", "scalars"):
            one, two = getattr(found[0], name), getattr(other, name)
            np.testing.assert_allclose(two, one, rtol=0, atol=1e-12 * np.abs(one).max())
