"""Normal equations: partial sums add, and they move without the data."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.infer.normal import accumulate
from bayesdist.infer.stars import prepare
from bayesdist.model import TimeDependence

from .support import TWO_CHIPS, pieces, simulated


@pytest.fixture(scope="module")
def problem():
    model, matches, truth = simulated(
        1,
        900,
        order=3,
        frames="affine",
        n_exposures=3,
        chips=TWO_CHIPS,
        time=TimeDependence((("u", 1, 0),), (2005.0,)),
        epochs=[2004.0, 2006.0, 2010.0],
    )
    return model, prepare(model, matches), matches, truth.theta


def weights_of(stars) -> np.ndarray:
    return np.column_stack([1 / stars.var_u, 1 / stars.var_v])


def dense_of(model, matches, theta):
    """Normal matrix and right-hand side from the model's full Jacobian."""
    columns = {
        "epoch": matches.epoch,
        "exposure": matches.exposure,
        "chip": np.asarray(matches.chip_numbers)[matches.chip],
    }
    J = model.jacobian(theta, matches.x, matches.y, **columns)
    r = np.column_stack([matches.u, matches.v]) - model.predict(
        theta, matches.x, matches.y, **columns
    )
    w = np.column_stack([matches.sigma_u, matches.sigma_v]) ** -2.0
    H = np.einsum("nap,na,naq->pq", J, w, J)
    return H, np.einsum("nap,na->p", J, w * r), (w * r**2).sum()


def close(a, b, rtol=1e-10):
    np.testing.assert_allclose(a, b, rtol=0, atol=rtol * np.abs(b).max())


def test_assembled_equations_are_those_of_the_full_jacobian(problem):
    model, stars, matches, theta = problem
    theta = theta + 1e-3
    about = model.effective(theta, stars.groups)
    equations = accumulate(stars, about, weights_of(stars))
    matrix, right = equations.assemble(model, theta, stars.groups)
    H, g, chi2 = dense_of(model, matches, theta)
    close(matrix.dense(), H)
    close(right, g, 1e-8)
    assert equations.chi2 == pytest.approx(chi2, rel=1e-10)
    assert equations.n_rows == len(matches)


def test_pieces_add_up_to_the_whole(problem):
    model, stars, _, theta = problem
    about = model.effective(theta, stars.groups)
    weights = weights_of(stars)
    whole = accumulate(stars, about, weights)
    parts = []
    for rows in pieces(len(stars), [130, 131, 600]):
        masked = np.zeros_like(weights)
        masked[rows] = weights[rows]
        parts.append(accumulate(stars, about, masked))
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    close(total.weight, whole.weight, 1e-13)
    close(total.right, whole.right, 1e-12)
    assert total.chi2 == pytest.approx(whole.chi2, rel=1e-13)
    assert total.n_rows == whole.n_rows == len(stars)


def test_pieces_of_the_table_add_up_to_the_whole(problem):
    """As a stream of files would come: each piece prepared by itself."""
    model, stars, matches, theta = problem
    about = model.effective(theta, stars.groups)
    whole = accumulate(stars, about, weights_of(stars))
    halves = []
    for rows in (np.arange(0, 900, 2), np.arange(1, 900, 2)):
        piece = prepare(model, matches.select(rows))
        halves.append(accumulate(piece, about, weights_of(piece)))
    total = halves[0] + halves[1]
    close(total.weight, whole.weight, 1e-13)
    close(total.right, whole.right, 1e-12)


def test_pieces_about_different_points_do_not_add(problem):
    model, stars, _, theta = problem
    about = model.effective(theta, stars.groups)
    one = accumulate(stars, about, weights_of(stars))
    with pytest.raises(ValueError, match="other groups or coefficients"):
        one + accumulate(stars, about + 1e-9, weights_of(stars))


def test_pieces_of_different_groups_do_not_add_silently(problem):
    """Exposures 1, 2 and exposures 1, 3 have as many groups, and not the same ones."""
    model, _, matches, _ = problem
    sums = []
    for keep in ((0, 1), (0, 2)):
        piece = prepare(model, matches.select(np.isin(matches.exposure, keep)))
        zero = np.zeros((len(piece.groups), 2, model.n_terms))
        sums.append(accumulate(piece, zero, weights_of(piece)))
    with pytest.raises(ValueError):
        sums[0] + sums[1]


def test_moving_is_exact(problem):
    model, stars, _, theta = problem
    weights = weights_of(stars)
    here = model.effective(theta, stars.groups)
    there = model.effective(theta + 0.01, stars.groups)
    moved = accumulate(stars, here, weights).moved(there)
    again = accumulate(stars, there, weights)
    close(moved.weight, again.weight, 1e-14)
    close(moved.right, again.right, 1e-10)
    assert moved.chi2 == pytest.approx(again.chi2, rel=1e-9)
    np.testing.assert_array_equal(moved.about, there)


def test_moving_with_correlated_weights_is_exact(problem):
    """Weights uu, uv, vv of each star, as the mixture has them."""
    model, stars, _, theta = problem
    rng = np.random.default_rng(5)
    root = rng.standard_normal((len(stars), 2, 2))
    W = root @ np.swapaxes(root, 1, 2)
    three = np.column_stack([W[:, 0, 0], W[:, 0, 1], W[:, 1, 1]])
    E = [model.effective(theta + d, stars.groups) for d in (0.0, 0.01)]

    def at(about):
        out = np.empty((len(stars), 2))
        for g, rows, phi in stars.chunks():
            out[rows] = phi @ about[g].T
        r = np.column_stack([stars.u, stars.v]) - out
        return accumulate(stars, about, three, gradient=np.einsum("nab,nb->na", W, r))

    close(at(E[0]).moved(E[1]).right, at(E[1]).right, 1e-10)
