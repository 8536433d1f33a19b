"""Arrow-shaped matrices against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.infer.equations.arrow import Arrow

SHAPES = [(5, 0, 0, 0), (5, 2, 0, 0), (4, 0, 3, 2), (4, 2, 5, 3), (3, 1, 1, 6)]  # g, tail, n, q


def some_arrow(shape: tuple[int, int, int, int], seed: int = 3) -> Arrow:
    """Positive definite by diagonal dominance."""
    g, tail, n, q = shape
    rng = np.random.default_rng(seed)
    b = g + tail
    border = rng.standard_normal((b, b))
    blocks = rng.standard_normal((n, q, q))
    edge = 0.5 * rng.standard_normal((n, b, q))
    return Arrow(
        border + border.T + (6 + 3 * b + n * q) * np.eye(b),
        edge,
        blocks + np.swapaxes(blocks, 1, 2) + (6 + 3 * b) * np.eye(q),
        n_tail=tail,
    )


@pytest.fixture(params=SHAPES, ids=str)
def arrow(request) -> Arrow:
    return some_arrow(request.param)


def test_dense_has_the_documented_layout():
    arrow = some_arrow((3, 1, 2, 2))
    dense = arrow.dense()
    assert dense.shape == (8, 8) == (arrow.size, arrow.size)
    # (global 3, block 2, block 2, tail 1)
    np.testing.assert_array_equal(dense[:3, :3], arrow.border[:3, :3])
    np.testing.assert_array_equal(dense[3:5, 3:5], arrow.blocks[0])
    np.testing.assert_array_equal(dense[5:7, 5:7], arrow.blocks[1])
    np.testing.assert_array_equal(dense[3:5, 5:7], 0)
    np.testing.assert_array_equal(dense[:3, 5:7], arrow.edge[1, :3])
    np.testing.assert_array_equal(dense[7, 5:7], arrow.edge[1, 3])
    np.testing.assert_array_equal(dense[7, :3], arrow.border[3, :3])
    np.testing.assert_array_equal(dense, dense.T)


def test_sums_and_parts(arrow):
    rng = np.random.default_rng(0)
    v = rng.standard_normal((4, 2, arrow.size))
    np.testing.assert_array_equal(arrow.join(*arrow.split(v)), v)
    np.testing.assert_array_equal(arrow.diagonal(), np.diag(arrow.dense()))
    np.testing.assert_allclose((arrow + arrow).dense(), 2 * arrow.dense(), rtol=1e-15)
    keep = np.arange(arrow.size - arrow.n_tail)
    np.testing.assert_array_equal(arrow.without_tail().dense(), arrow.dense()[np.ix_(keep, keep)])


def test_solve_logdet_and_covariance(arrow):
    dense, factor = arrow.dense(), arrow.factor()
    rng = np.random.default_rng(1)
    right = rng.standard_normal((3, 5, arrow.size))
    solved = np.linalg.solve(dense, right.reshape(-1, arrow.size).T).T.reshape(right.shape)
    np.testing.assert_allclose(factor.solve(right), solved, atol=1e-14)
    np.testing.assert_allclose(factor.solve(right[0, 0]), solved[0, 0], atol=1e-14)
    sign, logdet = np.linalg.slogdet(dense)
    assert sign == 1
    assert factor.logdet == pytest.approx(logdet, rel=1e-13)
    np.testing.assert_allclose(factor.covariance(), np.linalg.inv(dense), atol=1e-14)


def test_colouring_gives_the_covariance_and_whitening_undoes_it(arrow):
    factor = arrow.factor()
    # x = z A with A = colour(identity): the covariance of x is A^T A
    A = factor.colour(np.eye(arrow.size))
    np.testing.assert_allclose(A.T @ A, np.linalg.inv(arrow.dense()), atol=1e-14)
    z = np.random.default_rng(2).standard_normal((6, arrow.size))
    x = factor.colour(z)
    np.testing.assert_allclose(x, z @ A, atol=1e-13)
    np.testing.assert_allclose(factor.whiten(x), z, atol=1e-12)
    np.testing.assert_allclose(
        (z**2).sum(1), np.einsum("ni,ij,nj->n", x, arrow.dense(), x), rtol=1e-12
    )


@pytest.mark.parametrize("where", ["border", "blocks", "schur"])
def test_indefinite_matrices_are_refused(where):
    arrow = some_arrow((4, 1, 3, 2))
    border, edge, blocks = arrow.border.copy(), arrow.edge.copy(), arrow.blocks.copy()
    if where == "border":
        border[0, 0] = -1.0
    elif where == "blocks":
        blocks[1] = -blocks[1]
    else:  # border and blocks are fine by themselves, the whole is not
        edge *= 20
    bad = Arrow(border, edge, blocks, n_tail=1)
    assert np.linalg.eigvalsh(bad.dense())[0] < 0
    with pytest.raises(np.linalg.LinAlgError):
        bad.factor()
