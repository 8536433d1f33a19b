"""Arrow-shaped matrices against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.infer.equations.arrow import Arrow

SHAPES = [(5, 0, 0, 0), (5, 2, 0, 0), (4, 0, 3, 2), (4, 2, 5, 3), (3, 1, 1, 6)]  # g, tail, n, q
# the same for global entries of four parts, which are eliminated as blocks
PARTED = [(120, 0, 0, 0), (120, 2, 0, 0), (120, 0, 2, 3), (120, 2, 4, 5)]


def some_arrow(shape: tuple[int, int, int, int], seed: int = 3, n_parts: int = 1) -> Arrow:
    """Positive definite by diagonal dominance; the entries of the parts alternate."""
    g, tail, n, q = shape
    rng = np.random.default_rng(seed)
    b = g + tail
    parts = np.arange(g) % n_parts
    border = rng.standard_normal((b, b))
    border[:g, :g] *= parts[:, None] == parts
    blocks = rng.standard_normal((n, q, q))
    edge = 0.5 * rng.standard_normal((n, b, q))
    return Arrow(
        border + border.T + (6 + 3 * b + n * q) * np.eye(b),
        edge,
        blocks + np.swapaxes(blocks, 1, 2) + (6 + 3 * b) * np.eye(q),
        n_tail=tail,
        parts=parts if n_parts > 1 else None,
    )


@pytest.fixture(params=[*((s, 1) for s in SHAPES), *((s, 4) for s in PARTED)], ids=str)
def arrow(request) -> Arrow:
    shape, n_parts = request.param
    return some_arrow(shape, n_parts=n_parts)


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


@pytest.mark.parametrize("shape", PARTED, ids=str)
def test_independent_parts_are_factored_one_by_one(shape):
    arrow = some_arrow(shape, n_parts=4)
    _, tail, n, q = shape
    found = arrow.factor().matrix
    assert found.blocks.shape == (4, 30, 30)
    assert found.border.shape == (n * q + tail, n * q + tail)
    np.testing.assert_array_equal(found.dense(), arrow.dense())
    np.testing.assert_array_equal(found.without_tail().dense(), arrow.without_tail().dense())


def test_parts_that_a_prior_couples_or_that_many_blocks_join_are_factored_together():
    arrow = some_arrow((120, 2, 0, 0), n_parts=4)
    prior = np.zeros_like(arrow.border)
    prior[3, 4] = prior[4, 3] = 0.1
    coupled = arrow + Arrow(prior, arrow.edge, arrow.blocks, n_tail=2)
    assert len(coupled.factor().matrix.border) == 122
    np.testing.assert_allclose(
        coupled.factor().covariance(), np.linalg.inv(coupled.dense()), atol=1e-14
    )
    joined = some_arrow((120, 2, 20, 3), n_parts=4)
    assert joined.factor().matrix.blocks.shape == (20, 3, 3)


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
