"""The passes over the stars against the same sums in plain numpy."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable

import numba
import numpy as np
import pytest
from scipy import stats

from bayesdist.infer import kernel
from bayesdist.infer.kernel import Constants, blocks, mixture
from bayesdist.model.basis import polynomial_terms

KINDS = {
    "none": kernel.NO_OUTLIERS,
    "gaussian": kernel.GAUSSIAN,
    "uniform": kernel.UNIFORM,
}

NO_TURN = (np.zeros(0), np.zeros(0))  # errors that are not correlated


def problem(kind: str, *, order=4, counts=(700, 1, 256, 333), draws=5, seed=1, far=0.0):
    """Stars of several groups, some blocks full, some not; and what they are in numpy."""
    rng = np.random.default_rng(seed)
    n, K = sum(counts), len(polynomial_terms(order))
    starts = np.concatenate([[0], np.cumsum(counts)])
    X, Y = rng.uniform(-1, 1, (2, n))
    coef = rng.standard_normal((draws, len(counts), 2, K))
    var_u, var_v = rng.uniform(0.01, 0.5, (2, n))
    terms = polynomial_terms(order)
    phi = np.array([X**i * Y**j for i, j in terms]).T
    group = np.repeat(np.arange(len(counts)), counts)
    middle = np.einsum("nk,nak->na", phi, coef[0][group])
    error = np.sqrt(np.column_stack([var_u, var_v])) * rng.standard_normal((n, 2))
    error *= rng.choice([1, 8], (n, 1), p=[0.9, 0.1])
    error[::17] *= 1 + far
    u, v = (middle + error).T
    coef[1:] = coef[0] + 0.05 * rng.standard_normal(coef[1:].shape)
    j2 = rng.uniform(0, 0.1, draws)
    j2[0] = 0.0
    f = rng.uniform(0.01, 0.3, draws) if kind != "none" else np.zeros(draws)
    out = rng.uniform(1, 20, draws) if kind == "gaussian" else np.full(draws, np.pi * 3.0**2)
    with np.errstate(divide="ignore"):
        constants = Constants(j2, np.log(f), np.log1p(-f), out, KINDS[kind], 0.2)
    columns = tuple(np.ascontiguousarray(c) for c in (X, Y, u, v, var_u, var_v, *NO_TURN))
    return starts, columns, coef, order, constants, phi, group


def plain(columns, coef, constants: Constants, phi, group) -> tuple[np.ndarray, np.ndarray]:
    """Log-likelihood and probability of being an outlier (D, N), each with a function of scipy."""
    _, _, u, v, var_u, var_v, *_ = columns
    loglik, p = [], []
    for c, j2, lf, l1f, out in zip(coef, *constants[:4], strict=True):
        ru, rv = (np.column_stack([u, v]) - np.einsum("nk,nak->na", phi, c[group])).T
        good = l1f + stats.norm.logpdf(ru, scale=np.sqrt(var_u + j2))
        good += stats.norm.logpdf(rv, scale=np.sqrt(var_v + j2))
        if constants.kind == kernel.NO_OUTLIERS:
            bad = np.full(len(u), -np.inf)
        elif constants.kind == kernel.GAUSSIAN:
            bad = stats.norm.logpdf(ru, scale=out**0.5) + stats.norm.logpdf(rv, scale=out**0.5)
        else:
            bad = np.full(len(u), -np.log(out))
        loglik.append(np.logaddexp(good, lf + bad))
        p.append(np.exp(lf + bad - loglik[-1]))
    return np.array(loglik), np.array(p)


def run(starts, columns, coef, order, constants, unit2=None):
    constants = constants if unit2 is None else constants._replace(unit2=unit2)
    pieces = kernel.pieces_of(starts, kernel.BLOCK)
    return kernel.log_likelihood(pieces, columns, coef, order, constants)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("order", [1, 4, 9])
def test_it_is_the_plain_sum(kind, order):
    *arguments, constants, phi, group = problem(kind, order=order)
    expected = plain(arguments[1], arguments[2], constants, phi, group)[0].sum(axis=1)
    np.testing.assert_allclose(run(*arguments, constants), expected, rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_residuals_of_a_million_sigma(kind):
    *arguments, constants, phi, group = problem(kind, far=1e6)
    value = run(*arguments, constants)
    assert np.isfinite(value).all()
    expected = plain(arguments[1], arguments[2], constants, phi, group)[0].sum(axis=1)
    np.testing.assert_allclose(value, expected, rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("unit2", [1e-8, 1e8, 1e-60, 1e60])
def test_the_unit_does_not_matter(kind, unit2):
    """It only keeps the product of eight densities within the range of doubles."""
    *arguments, constants, _, _ = problem(kind)
    np.testing.assert_allclose(
        run(*arguments, constants, unit2), run(*arguments, constants), rtol=1e-12
    )


@pytest.mark.parametrize("kind", KINDS)
def test_errors_that_differ_by_sixty_orders_of_magnitude(kind):
    """Eight densities multiplied over- or underflow, in the end or on the way.

    The model is zero, as in a sum of order one no digits of the small residuals would be left.
    """
    starts, columns, coef, order, constants, phi, group = problem(kind, order=1)
    rng = np.random.default_rng(8)
    n = len(phi)
    sigma = 10.0 ** rng.choice([-30.0, 0.0, 30.0], n) * rng.uniform(0.5, 2, (2, n))
    columns = (*columns[:2], *(sigma * rng.standard_normal((2, n))), *sigma**2, *NO_TURN)
    coef, constants = np.zeros_like(coef), constants._replace(j2=np.zeros(len(coef)))
    expected = plain(columns, coef, constants, phi, group)[0]
    found = run(starts, columns, coef, order, constants)
    np.testing.assert_allclose(found, expected.sum(axis=1), atol=1e-12 * np.abs(expected).sum() / 5)


@pytest.mark.parametrize("kind", ["gaussian", "uniform"])
@pytest.mark.parametrize("logit", [-660.0, -350.0, -40.0, 30.0])
def test_fractions_close_to_none_and_all(kind, logit):
    """f = 1e-287: an outlier's density is that small, and the product of two is none."""
    *arguments, constants, phi, group = problem(kind, far=3.0)
    some = np.full(len(constants.j2), logit)
    constants = constants._replace(log_f=-np.logaddexp(0, -some), log_1_f=-np.logaddexp(0, some))
    expected = plain(arguments[1], arguments[2], constants, phi, group)[0].sum(axis=1)
    np.testing.assert_allclose(run(*arguments, constants), expected, rtol=1e-12)


@pytest.mark.parametrize("kind", ["gaussian", "uniform"])
def test_a_fraction_as_small_as_the_end_of_exp(kind):
    """f = 1e-300: the core of a hopeless star counts for exp(-700) at least, 1e-4 of that."""
    *arguments, constants, phi, group = problem(kind, far=3.0)
    f = 1e-300
    constants = constants._replace(log_f=constants.log_f * 0 + np.log(f), log_1_f=constants.j2 * 0)
    value = run(*arguments, constants)
    expected = plain(arguments[1], arguments[2], constants, phi, group)[0].sum(axis=1)
    sigma2 = arguments[1][4].min()
    most = len(phi) * np.exp(-700) / f * np.max(constants.out) / sigma2
    assert (value >= expected * (1 + 1e-12)).all() and (value < expected + most).all()


@pytest.mark.parametrize("kind", KINDS)
def test_each_draw_is_by_itself(kind, monkeypatch):
    """Bit for bit, however many are evaluated together: chains depend on that."""
    starts, columns, coef, order, constants, *_ = problem(kind, counts=(9000, 1, 300), draws=7)
    together = run(starts, columns, coef, order, constants)
    for step in (1, 2, 3):
        n_blocks = len(kernel.pieces_of(starts, kernel.BLOCK))
        monkeypatch.setattr(mixture, "SCRATCH", 8 * n_blocks * step)
        np.testing.assert_array_equal(run(starts, columns, coef, order, constants), together)
    for d in range(7):
        one = slice(d, d + 1)
        alone = run(starts, columns, coef[one], order, constants.of(one))
        np.testing.assert_array_equal(alone, together[one])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("far", [0.0, 1e6])
def test_memberships_are_bayes_theorem(kind, far):
    starts, columns, coef, order, constants, phi, group = problem(kind, far=far)
    blocks = kernel.pieces_of(starts, kernel.BLOCK)
    found = kernel.memberships(blocks, columns, coef, order, constants, len(coef))[0]
    loglik, p = plain(columns, coef, constants, phi, group)
    np.testing.assert_allclose(found[0], p.mean(axis=0), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found[1], loglik.mean(axis=0), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found[2], (loglik**2).mean(axis=0), rtol=1e-12, atol=1e-12)
    each = kernel.memberships(blocks, columns, coef, order, constants, 1)
    np.testing.assert_allclose(each[:, 0], p, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(each[:, 1], loglik, rtol=1e-12, atol=1e-12)
    if kind == "gaussian":
        assert found[0].min() < 0.02 and found[0].max() > 0.99


@pytest.mark.parametrize("order", [1, 4, 9])
def test_residuals_are_data_minus_model(order):
    starts, columns, coef, _, _, phi, group = problem("none", order=order)
    found = kernel.residuals(kernel.pieces_of(starts, kernel.BLOCK), columns, coef[0], order)
    expected = np.column_stack(columns[2:4]) - np.einsum("nk,nak->na", phi, coef[0][group])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.abs(coef).sum())


@pytest.mark.parametrize("kind", KINDS)
def test_three_ways_to_the_same_likelihood(kind):
    """The sum of all stars, the sum of the stars one by one, and what comes with the Hessian."""
    starts, columns, coef, order, constants, *_ = problem(kind)
    found = run(starts, columns, coef, order, constants)
    for d in range(len(coef)):
        one = constants.of(slice(d, d + 1))
        stars = kernel.memberships(
            kernel.pieces_of(starts, kernel.BLOCK), columns, coef[d : d + 1], order, one, 1
        )[0]
        moments = kernel.mixture_moments(
            kernel.pieces_of(starts, kernel.PIECE), columns, coef[d], order, one
        )
        assert stars[1].sum() == pytest.approx(found[d], rel=1e-13)
        assert moments.scalars[0] == pytest.approx(found[d], rel=1e-13)
        assert moments.scalars[2] == pytest.approx(stars[0].sum(), rel=1e-12)


# -- threads -------------------------------------------------------------------------------------

PASSES: dict[str, Callable] = {
    "log_likelihood": lambda b, p, c, E, o, k: (kernel.log_likelihood(b, c, E, o, k),),
    "memberships": lambda b, p, c, E, o, k: (kernel.memberships(b, c, E, o, k, len(E)),),
    "residuals": lambda b, p, c, E, o, k: (kernel.residuals(b, c, E[0], o),),
    "least squares": lambda b, p, c, E, o, k: as_arrays(
        kernel.least_squares_moments(p, c, E[0], E[1], o, chi2_limit=25.0, abs_limit=1.0)
    ),
    "mixture": lambda b, p, c, E, o, k: as_arrays(
        kernel.mixture_moments(p, c, E[0], o, k.of(slice(1)))
    ),
}


def as_arrays(moments) -> tuple[np.ndarray, ...]:
    return moments.weight, moments.right, moments.cross, moments.scalars


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("which", PASSES)
def test_the_number_of_threads_does_not_matter(kind, which, monkeypatch):
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one processor")
    monkeypatch.setattr(blocks, "THREADS_PAY", 0)
    starts, columns, coef, order, constants, *_ = problem(kind, counts=(9000, 4900, 3))
    small, large = (kernel.pieces_of(starts, n) for n in (kernel.BLOCK, kernel.PIECE))
    before = kernel.get_threads()
    try:
        values = []
        for threads in (1, 2):
            kernel.set_threads(threads)
            with blocks.threads_for(1):
                assert kernel.get_threads() == threads  # the work is shared out in earnest
            values.append(PASSES[which](small, large, columns, coef, order, constants))
            assert kernel.get_threads() == threads
    finally:
        kernel.set_threads(before)
    for one, two in zip(*values, strict=True):
        np.testing.assert_array_equal(one, two)


@pytest.mark.filterwarnings("ignore:.*fork")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_fork_has_threads_of_its_own():
    """Those that wait for passes are not there any more in a child: it would wait for ever."""
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one processor")
    before = kernel.get_threads()

    def sums() -> np.ndarray:
        out = np.zeros(2)
        blocks.share_out(_fill, 2, out)
        return out

    try:
        kernel.set_threads(2)
        np.testing.assert_array_equal(sums(), [1, 2])
        child = os.fork()
        if child == 0:
            signal.alarm(20)
            os._exit(0 if np.array_equal(sums(), [1, 2]) else 1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    finally:
        kernel.set_threads(before)


def _fill(first: int, end: int, out: np.ndarray) -> None:
    out[first:end] = np.arange(first, end) + 1


def test_little_work_has_one_thread_and_the_number_comes_back():
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one processor")
    before = kernel.get_threads()
    try:
        kernel.set_threads(2)
        with blocks.threads_for(blocks.THREADS_PAY):
            assert kernel.get_threads() == 1
        assert kernel.get_threads() == 2
        with pytest.raises(ZeroDivisionError), blocks.threads_for(1):
            1 / 0  # noqa: B018
        assert kernel.get_threads() == 2
        kernel.set_threads(10_000)
        assert 1 <= kernel.get_threads() <= numba.config.NUMBA_NUM_THREADS
        kernel.set_threads(0)
        assert kernel.get_threads() == 1
    finally:
        kernel.set_threads(before)


# -- pieces --------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 256, 4096])
@pytest.mark.parametrize("starts", [[0, 700, 700, 701, 957, 1290], [0, 0, 5], [0, 256, 512], [0]])
def test_pieces_cover_every_star_once_and_stay_in_one_group(starts, size):
    starts = np.array(starts)
    pieces = kernel.pieces_of(starts, size)
    assert pieces.shape[1] == 3 and pieces.dtype == np.int64
    covered = [s for _, a, e in pieces for s in range(a, e)]
    assert covered == list(range(starts[-1]))
    for g, a, e in pieces:
        assert starts[g] <= a < e <= starts[g + 1] and e - a <= size


BITS = """
import hashlib, numpy as np
from bayesdist.infer import kernel as k
rng = np.random.default_rng(1)
n, order, K = 9000, 5, 21
X, Y = rng.uniform(-1, 1, (2, n))
u, v = rng.normal(size=(2, n))
columns = (X, Y, u, v, rng.uniform(0.1, 1, n), rng.uniform(0.1, 1, n))
coef = rng.normal(size=(4, 1, 2, K))
one = np.ones(4)
c = k.Constants(0.1 * one, np.log(0.1) * one, np.log(0.9) * one, 9 * one, k.GAUSSIAN, 0.5)
blocks, pieces = k.pieces_of(np.array([0, n]), k.BLOCK), k.pieces_of(np.array([0, n]), k.PIECE)
m = k.mixture_moments(pieces, columns, coef[0], order, c.of(slice(0, 1)))
s = k.least_squares_moments(
    pieces, columns, coef[0], coef[0], order, chi2_limit=9.0, abs_limit=3.0
)
found = [k.log_likelihood(blocks, columns, coef, order, c), m.weight, m.right, m.cross, m.scalars]
found += [s.weight, s.right, s.scalars, k.memberships(blocks, columns, coef, order, c, 4)]
found.append(k.residuals(blocks, columns, coef[0], order))
print(hashlib.sha256(b"".join(np.ascontiguousarray(f).tobytes() for f in found)).hexdigest())
"""


@pytest.mark.slow
def test_code_from_the_cache_gives_the_bits_of_code_just_compiled(full, tmp_path):
    """A run killed while it compiled, and resumed, must not differ."""
    if not full:
        pytest.skip("compiles everything anew: set BAYESDIST_FULL=1")
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    cold, warm = (
        subprocess.run(
            [sys.executable, "-c", BITS],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for _ in range(2)
    )
    assert any(tmp_path.rglob("*.nbc"))
    assert cold == warm != ""
