"""The fused kernel against the same sum in plain numpy."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy import stats

from bayesdist.infer import kernel
from bayesdist.model.basis import polynomial_terms

KINDS = {
    "none": kernel.NO_OUTLIERS,
    "gaussian": kernel.GAUSSIAN,
    "uniform": kernel.UNIFORM,
}


def problem(kind: str, *, order=4, counts=(700, 1, 256, 333), draws=5, seed=1, far=0.0):
    """Arguments of `log_likelihood`: stars of several groups, some blocks full, some not."""
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
        constants = (j2, np.log(f), np.log1p(-f), out)
    columns = tuple(np.ascontiguousarray(c) for c in (X, Y, u, v, var_u, var_v))
    return starts, columns, coef, order, constants, phi, group


def plain(kind, columns, coef, constants, phi, group) -> np.ndarray:
    _, _, u, v, var_u, var_v = columns
    out = []
    for c, j2, lf, l1f, area in zip(coef, *constants, strict=True):
        ru, rv = (np.column_stack([u, v]) - np.einsum("nk,nak->na", phi, c[group])).T
        good = stats.norm.logpdf(ru, scale=np.sqrt(var_u + j2))
        good += stats.norm.logpdf(rv, scale=np.sqrt(var_v + j2))
        if kind == "none":
            out.append(good.sum())
            continue
        if kind == "gaussian":
            bad = stats.norm.logpdf(ru, scale=area**0.5) + stats.norm.logpdf(rv, scale=area**0.5)
        else:
            bad = np.full(len(u), -np.log(area))
        out.append(np.logaddexp(l1f + good, lf + bad).sum())
    return np.array(out)


def run(kind, starts, columns, coef, order, constants, unit2=0.2):
    return kernel.log_likelihood(
        kernel.blocks_of(starts), columns, coef, order, constants, KINDS[kind], unit2
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("order", [1, 4, 9])
def test_it_is_the_plain_sum(kind, order):
    starts, columns, coef, order, constants, phi, group = problem(kind, order=order)
    expected = plain(kind, columns, coef, constants, phi, group)
    np.testing.assert_allclose(
        run(kind, starts, columns, coef, order, constants), expected, rtol=1e-12
    )


@pytest.mark.parametrize("kind", KINDS)
def test_residuals_of_a_million_sigma(kind):
    starts, columns, coef, order, constants, phi, group = problem(kind, far=1e6)
    value = run(kind, starts, columns, coef, order, constants)
    assert np.isfinite(value).all()
    expected = plain(kind, columns, coef, constants, phi, group)
    np.testing.assert_allclose(value, expected, rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("unit2", [1e-8, 1e8])
def test_the_unit_does_not_matter(kind, unit2):
    """It only keeps the product of eight densities within the range of doubles."""
    starts, columns, coef, order, constants, *_ = problem(kind)
    np.testing.assert_allclose(
        run(kind, starts, columns, coef, order, constants, unit2),
        run(kind, starts, columns, coef, order, constants),
        rtol=1e-12,
    )


@pytest.mark.parametrize("kind", ["gaussian", "uniform"])
@pytest.mark.parametrize("logit", [-40.0, 30.0])
def test_fractions_close_to_none_and_all(kind, logit):
    starts, columns, coef, order, (j2, _, _, out), phi, group = problem(kind)
    lf = np.full(len(j2), -np.logaddexp(0, -logit))
    l1f = np.full(len(j2), -np.logaddexp(0, logit))
    constants = (j2, lf, l1f, out)
    np.testing.assert_allclose(
        run(kind, starts, columns, coef, order, constants),
        plain(kind, columns, coef, constants, phi, group),
        rtol=1e-12,
    )


@pytest.mark.parametrize("kind", KINDS)
def test_the_number_of_threads_does_not_matter(kind):
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one processor")
    starts, columns, coef, order, constants, *_ = problem(kind, counts=(5000, 900, 3))
    before = numba.get_num_threads()
    try:
        values = []
        for threads in (1, 2):
            numba.set_num_threads(threads)
            values.append(run(kind, starts, columns, coef, order, constants))
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(*values)


def test_blocks_cover_every_star_once_and_stay_in_one_group():
    starts = np.array([0, 700, 700, 701, 957, 1290])
    blocks = kernel.blocks_of(starts)
    covered = np.concatenate([np.arange(a, e) for _, a, e in blocks])
    np.testing.assert_array_equal(covered, np.arange(1290))
    for g, a, e in blocks:
        assert starts[g] <= a < e <= starts[g + 1] and e - a <= kernel.BLOCK
