import numpy as np
import pytest

from bayesdist.assess import uncertainty_map
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel, basis
from bayesdist.model.grid import grid_pixels


def mesh_of(m):
    X, Y = np.meshgrid(m.x, m.y)
    return X.ravel(), Y.ravel()


def test_grid_runs_evenly_from_the_first_pixel_to_the_last():
    x, y = grid_pixels((4096, 2048), (33, 17))
    assert (x[0], x[-1], x.size) == (1.0, 4096.0, 33)
    assert (y[0], y[-1], y.size) == (1.0, 2048.0, 17)
    np.testing.assert_allclose(np.diff(x), 4095 / 32, rtol=1e-13)


@pytest.mark.parametrize("grid", [(1, 5), (5, 0), (5.5, 4), (3, 3, 3)])
def test_bad_grids_are_refused(grid):
    with pytest.raises(InputError, match=r"assess\.grid"):
        grid_pixels((100, 100), grid)


@pytest.mark.parametrize("exposure", [None, "c", 3])
@pytest.mark.parametrize("chip", [1, 2])
def test_sigma_is_the_propagated_covariance(rich, chip, exposure):
    where = dict(epoch=2011.3, chip=chip, exposure=exposure)
    m = uncertainty_map(rich, grid=(5, 4), **where)
    J = rich.model.jacobian(rich.mean, *mesh_of(m), **where)
    full = np.einsum("nad,de,nbe->nab", J, rich.cov, J)
    np.testing.assert_allclose(m.sigma_u.ravel() ** 2, full[:, 0, 0], rtol=1e-10)
    np.testing.assert_allclose(m.sigma_v.ravel() ** 2, full[:, 1, 1], rtol=1e-10)
    np.testing.assert_allclose(
        (m.correlation * m.sigma_u * m.sigma_v).ravel(), full[:, 0, 1], rtol=1e-8, atol=1e-14
    )
    assert (m.chip, m.epoch, m.unit, m.kind) == (chip, 2011.3, "pix", "least squares")


def test_sigma_is_the_scatter_of_predictions(rich):
    n = 4000
    where = dict(epoch=2006.0, chip=2, exposure="b")
    m = uncertainty_map(rich, grid=(4, 3), **where)
    theta = rich.draws(n, np.random.default_rng(1))
    scatter = rich.model.predict(theta, *mesh_of(m), **where).std(axis=0)
    tolerance = 5 / np.sqrt(2 * n)
    np.testing.assert_allclose(m.sigma_u.ravel(), scatter[:, 0], rtol=tolerance)
    np.testing.assert_allclose(m.sigma_v.ravel(), scatter[:, 1], rtol=tolerance)


@pytest.mark.parametrize("order", [1, 4, 9])
def test_variances_at_the_stars_of_a_least_squares_fit_sum_to_the_number_of_terms(
    solution_of, order
):
    """The trace of the hat matrix is its rank, whatever the stars."""
    model = DistortionModel(order, (Chip(1, "A", (200.0, 100.0), (30.0, 70.0)),))
    x, y = (a.ravel() for a in np.meshgrid(*grid_pixels((200, 100), (15, 12))))
    phi, sigma, k = model.basis().evaluate(x, y), (0.02, 0.03), model.n_terms
    inverse = np.linalg.inv(phi.T @ phi)
    cov = np.zeros((2 * k, 2 * k))
    cov[:k, :k], cov[k:, k:] = sigma[0] ** 2 * inverse, sigma[1] ** 2 * inverse
    m = uncertainty_map(solution_of(model, cov=cov), grid=(15, 12))
    assert np.sum(m.sigma_u**2) == pytest.approx(sigma[0] ** 2 * k, rel=1e-10)
    assert np.sum(m.sigma_v**2) == pytest.approx(sigma[1] ** 2 * k, rel=1e-10)
    assert np.abs(m.correlation).max() == 0


def test_correlation_is_one_where_both_axes_share_their_error(solution_of):
    model = DistortionModel(2, (Chip(1, "A", (50.0, 50.0), (25.0, 25.0)),))
    k = model.n_terms
    a = np.random.default_rng(3).normal(size=(k, k))
    same = np.tile(a @ a.T, (2, 2))
    sign = np.repeat([1.0, -1.0], k)
    for cov, expected in ((same, 1.0), (same * np.outer(sign, sign), -1.0)):
        m = uncertainty_map(solution_of(model, cov=cov), grid=(4, 4))
        np.testing.assert_allclose(m.correlation, expected, rtol=1e-12)


def test_an_exactly_known_solution_has_no_uncertainty_and_no_nan(solution_of):
    model = DistortionModel(2, (Chip(1, "A", (50.0, 50.0), (25.0, 25.0)),))
    m = uncertainty_map(solution_of(model, converged=True))
    assert m.radius_max == 0 and not m.correlation.any()
    assert m.kind == "posterior"


def test_largest_radius_and_its_place(rich):
    m = uncertainty_map(rich, grid=(9, 7), epoch=2005.0)
    x, y = m.position_of_max
    ix, iy = list(m.x).index(x), list(m.y).index(y)
    assert m.radius_max == np.hypot(m.sigma_u[iy, ix], m.sigma_v[iy, ix]) == m.radius.max()
    assert m.sigma_u_max == m.sigma_u.max() and m.sigma_v_max == m.sigma_v.max()


def test_blocks_of_points_do_not_change_the_map(rich, monkeypatch):
    whole = uncertainty_map(rich, epoch=2005.0)
    monkeypatch.setattr(basis, "BLOCK", 7)
    np.testing.assert_allclose(
        uncertainty_map(rich, epoch=2005.0).sigma_u, whole.sigma_u, rtol=1e-13
    )


def test_places_that_do_not_exist_are_refused(rich):
    with pytest.raises(InputError, match="no epoch"):
        uncertainty_map(rich)
    with pytest.raises(InputError, match="epoch is nan"):
        uncertainty_map(rich, epoch=float("nan"))
    with pytest.raises(InputError, match="no chip 7"):
        uncertainty_map(rich, epoch=2005.0, chip=7)
    with pytest.raises(InputError, match="no exposure 'z'"):
        uncertainty_map(rich, epoch=2005.0, exposure="z")


def test_a_single_chip_is_asked_for_by_its_number(solution_of):
    model = DistortionModel(1, (Chip(4, "A", (50.0, 50.0), (25.0, 25.0)),))
    assert uncertainty_map(solution_of(model)).chip == 4
    with pytest.raises(InputError, match="no chip 1"):
        uncertainty_map(solution_of(model), chip=1)
