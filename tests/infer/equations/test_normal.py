"""Normal equations: those of the full Jacobian; sums add, and they move without the data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesdist.infer import OutlierMixture
from bayesdist.infer.equations.normal import NormalEquations, least_squares, mixture
from bayesdist.infer.stars.likelihood import Clip
from bayesdist.model import TimeDependence

from ..oracle import star_terms
from ..support import TWO_CHIPS, columns_of, pieces, residual_of, simulated, stars_of

SUMS = ("weight", "right", "cross", "scalars")


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
        fraction=0.05,
    )
    return model, stars_of(model, matches), matches, truth.theta


def dense_of(model, matches, theta):
    """Normal matrix and right-hand side from the model's full Jacobian."""
    J = model.jacobian(theta, matches.x, matches.y, **columns_of(matches))
    r = residual_of(model, theta, matches)
    w = np.column_stack([matches.sigma_u, matches.sigma_v]) ** -2.0
    H = np.einsum("nap,na,naq->pq", J, w, J)
    return H, np.einsum("nap,na->p", J, w * r), (w * r**2).sum()


def close(a, b, rtol=1e-10):
    np.testing.assert_allclose(a, b, rtol=0, atol=rtol * np.abs(b).max())


def total(parts):
    out = parts[0]
    for part in parts[1:]:
        out = out + part
    return out


def test_assembled_equations_are_those_of_the_full_jacobian(problem):
    model, stars, matches, theta = problem
    theta = theta + 1e-3
    equations = least_squares(stars, theta)
    matrix, right = equations.assemble(model, theta)
    H, g, chi2 = dense_of(model, matches, theta)
    close(matrix.dense(), H)
    close(right, g, 1e-8)
    assert equations.chi2 == pytest.approx(chi2, rel=1e-10)
    assert equations.scalars[0] == len(matches)
    close(equations.about, model.effective(theta, stars.groups), 1e-15)


def test_about_nothing_is_about_zero(problem):
    """Where no parameters are given the data themselves are the residuals."""
    model, stars, matches, theta = problem
    equations = least_squares(stars, None)
    assert (equations.about == 0).all()
    w = np.column_stack([matches.sigma_u, matches.sigma_v]) ** -2.0
    uv = np.column_stack([matches.u, matches.v])
    assert equations.chi2 == pytest.approx((w * uv**2).sum(), rel=1e-12)
    close(
        equations.moved(model.effective(theta, stars.groups)).right,
        least_squares(stars, theta).right,
        1e-8,
    )


@pytest.mark.parametrize(("limit", "spared", "least"), [(0.5, 0.0, 700), (0.06, 9.0, 300)])
def test_rejection_is_decided_at_other_parameters(problem, limit, spared, least):
    """About one theta, tested at another: the dense sums over the stars that stay."""
    model, stars, matches, theta = problem
    test = theta + 1e-4
    clip = Clip(test, 20.0, limit, spared)
    found = least_squares(stars, theta, clip)
    r = residual_of(model, test, matches)
    chi2 = ((r / np.column_stack([matches.sigma_u, matches.sigma_v])) ** 2).sum(axis=1)
    near = (r**2).sum(axis=1) <= limit**2
    used = (chi2 <= 20.0) & (near | (chi2 <= spared))
    assert least < used.sum() < 900
    assert (used & ~near).any() == (spared > 0)
    np.testing.assert_array_equal(clip.keeps(model, matches), used)
    H, g, chi2 = dense_of(model, matches.select(used), theta)
    matrix, right = found.assemble(model, theta)
    close(matrix.dense(), H)
    close(right, g, 1e-8)
    assert found.chi2 == pytest.approx(chi2, rel=1e-9) and found.scalars[0] == used.sum()


def test_exposures_of_several_dates_are_assembled_by_the_full_jacobian(problem):
    """Groups of one exposure that differ by their date alone share its block."""
    model, _, matches, theta = problem
    dates = matches.epoch + 0.25 * (np.arange(len(matches)) % 3) * (matches.exposure > 0)
    several = matches.with_columns(epoch=dates)
    equations = least_squares(stars_of(model, several), theta)
    assert len(equations.groups) > 2 * len(model.exposures)
    matrix, right = equations.assemble(model, theta)
    H, g, _ = dense_of(model, several, theta)
    close(matrix.dense(), H)
    close(right, g, 1e-8)


def test_the_mixture_is_assembled_by_the_full_jacobian(problem):
    """Gradient, Hessian by the parameters, and the mixed part, with the weights of each star."""
    model, stars, matches, theta = problem
    theta = theta + 1e-4
    values = {"j": 0.03, "f": 0.05, "s_out": 0.8}
    hyper = OutlierMixture().bind(0.05)
    for em in (False, True):
        equations = mixture(stars, theta, hyper.constants(hyper.point(values)[None]), em)
        matrix, right = equations.assemble(model, theta)
        r = residual_of(model, theta, matches)
        terms = star_terms("gaussian", r, matches.sigma_u**2, matches.sigma_v**2, **values)
        J = model.jacobian(theta, matches.x, matches.y, **columns_of(matches))
        uu, uv, vv = (terms.safe_weight if em else terms.weight).T
        W = np.stack([np.stack([uu, uv], axis=1), np.stack([uv, vv], axis=1)], axis=1)
        n, tail = model.n_params, 3
        full = np.zeros((n + tail, n + tail))
        full[:n, :n] = np.einsum("nap,nab,nbq->pq", J, W, J)
        if not em:
            # residual = data - model: mixed derivatives by the model have the other sign
            full[n:, :n] = np.einsum("nha,nap->hp", terms.cross, J)
            full[:n, n:] = full[n:, :n].T
        close(right, np.einsum("nap,na->p", J, terms.pull), 1e-9)
        dense = matrix.dense()
        close(dense[:n, :n], full[:n, :n])
        close(dense[n:], full[n:])
        assert equations.scalars[0] == pytest.approx(terms.loglik.sum(), rel=1e-11)


def test_pieces_of_the_table_add_up_to_the_whole(problem):
    """As a stream of files would come: each piece prepared by itself, groups cut anywhere."""
    model, stars, matches, theta = problem
    whole = least_squares(stars, theta)
    cuts = [pieces(900, [130, 131, 600]), [np.arange(k, 900, 2) for k in (0, 1)]]
    for rows in cuts:
        parts = [least_squares(stars_of(model, matches.select(k)), theta) for k in rows]
        added = total(parts)
        assert added.groups.same(whole.groups)
        close(added.weight, whole.weight, 1e-13)
        close(added.right, whole.right, 1e-11)
        close(added.about, whole.about, 0)
        assert added.chi2 == pytest.approx(whole.chi2, rel=1e-12)
        np.testing.assert_allclose(added.scalars, whole.scalars, rtol=1e-12, atol=1e-10)


def test_pieces_about_different_points_do_not_add(problem):
    _, stars, _, theta = problem
    one = least_squares(stars, theta)
    with pytest.raises(ValueError, match="different about do not add"):
        one + least_squares(stars, theta + 1e-9)


def test_pieces_about_different_points_do_not_add_where_one_group_is_common(problem):
    model, _, matches, theta = problem
    one, two = (
        stars_of(model, matches.select(np.isin(matches.exposure, k))) for k in ((0, 1), (0, 2))
    )
    with pytest.raises(ValueError, match="different about do not add"):
        least_squares(one, theta) + least_squares(two, theta + 1e-9)


@pytest.mark.parametrize("theta_is", ["given", "none"])
@pytest.mark.parametrize(
    "pair", [((0, 1), (0, 2)), ((2,), (0, 1)), ((0, 1, 2), (1,)), ((1,), (2,))]
)
def test_pieces_of_different_groups_add_to_the_sum_over_both(problem, pair, theta_is):
    """Exposures 1, 2 and exposures 1, 3 have as many groups, and not the same ones."""
    model, _, matches, theta = problem
    about = theta + 1e-3 if theta_is == "given" else None
    tables = [matches.select(np.isin(matches.exposure, keep)) for keep in pair]
    added = total([least_squares(stars_of(model, t), about) for t in tables])
    keys = {(c, e) for t in tables for c, e in zip(t.chip, t.exposure, strict=True)}
    assert set(zip(added.groups.chip, added.groups.exposure, strict=True)) == keys
    at = model.effective(theta + 1e-3, added.groups)
    matrix, right = added.moved(at).assemble(model, theta + 1e-3)
    dense = [dense_of(model, t, theta + 1e-3) for t in tables]
    close(matrix.dense(), sum(H for H, *_ in dense))
    # from zero the equations move over a thousand pixels of 0.05 each
    close(right, sum(g for _, g, _ in dense), 1e-8 if about is not None else 1e-4)
    assert added.scalars[0] == sum(len(t) for t in tables)


def test_sums_do_not_depend_on_who_stands_first(problem):
    model, _, matches, theta = problem
    one, two = (
        least_squares(stars_of(model, matches.select(np.isin(matches.exposure, k))), theta)
        for k in ((0, 2), (1, 2))
    )
    here, there = one + two, two + one
    assert here.groups.same(there.groups)
    for name in (*SUMS, "about"):
        np.testing.assert_array_equal(getattr(here, name), getattr(there, name))


def test_adding_changes_neither_part(problem):
    _, stars, _, theta = problem
    one, two = least_squares(stars, theta), least_squares(stars, theta)
    before = {name: getattr(one, name).copy() for name in SUMS}
    _ = one + two
    for name, values in before.items():
        np.testing.assert_array_equal(getattr(one, name), values)


def test_moving_is_exact(problem):
    model, stars, _, theta = problem
    there = theta + 0.01
    at = model.effective(there, stars.groups)
    moved = least_squares(stars, theta).moved(at)
    again = least_squares(stars, there)
    close(moved.weight, again.weight, 1e-14)
    close(moved.right, again.right, 1e-10)
    assert moved.chi2 == pytest.approx(again.chi2, rel=1e-9)
    np.testing.assert_array_equal(moved.about, at)


def test_moving_with_correlated_weights_is_exact(problem):
    """Weights uu, uv, vv of each star, as the mixture has them."""
    model, stars, _, theta = problem
    rng = np.random.default_rng(5)
    n, G = len(stars), len(stars.groups)
    root = rng.standard_normal((n, 2, 2))
    W = root @ np.swapaxes(root, 1, 2)
    group = np.repeat(np.arange(G), np.diff(stars.starts))
    phi = model.basis(1).evaluate_scaled(stars.X, stars.Y)
    empty = replace(least_squares(stars, None), cross=np.zeros((G, 0, 2, phi.shape[1])))

    def at(about) -> NormalEquations:
        model_uv = np.einsum("nk,nak->na", phi, about[group])
        r = np.column_stack([stars.u, stars.v]) - model_uv
        pull = np.einsum("nab,nb->na", W, r)
        weight, right = np.zeros_like(empty.weight), np.zeros_like(empty.right)
        for g in range(G):
            rows = group == g
            for c, (a, b) in enumerate(((0, 0), (0, 1), (1, 1))):
                weight[g, c] = phi[rows].T @ (W[rows, a, b, None] * phi[rows])
            right[g] = pull[rows].T @ phi[rows]
        return replace(empty, weight=weight, right=right, about=about, chi2=float((pull * r).sum()))

    E = [model.effective(theta + d, stars.groups) for d in (0.0, 0.01)]
    moved, again = at(E[0]).moved(E[1]), at(E[1])
    close(moved.right, again.right, 1e-10)
    assert moved.chi2 == pytest.approx(again.chi2, rel=1e-9)


def test_some_of_the_mixed_derivatives(problem):
    model, stars, _, theta = problem
    hyper = OutlierMixture().bind(0.05)
    full = mixture(stars, theta, hyper.constants(np.array([[-3.5, -3.0, -0.2]])))
    some = replace(full, cross=full.cross[:, [0, 2]])
    matrix, _ = some.assemble(model, theta)
    whole, _ = full.assemble(model, theta)
    keep = np.r_[: model.n_params, model.n_params + np.array([0, 2])]
    np.testing.assert_array_equal(matrix.dense(), whole.dense()[np.ix_(keep, keep)])
