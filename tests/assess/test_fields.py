import numpy as np
import pytest

from bayesdist.assess import uncertainty_map
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel, TimeDependence

from .drawn_fields import drawn_fields

X, Y = (a.ravel() for a in np.meshgrid(np.linspace(1, 4096, 5), np.linspace(1, 2048, 4)))
PARTS = ("coefficients", "time dependence", "exposure frame")


def fields_of(s, n_draws=300, seed=1, **where):
    return drawn_fields(s, X, Y, n_draws=n_draws, rng=np.random.default_rng(seed), **where)


@pytest.mark.parametrize("chip", [1, 2])
def test_the_parts_add_up_to_the_joint_error(rich, chip):
    """To first order: what is left is the product of two errors."""
    f = fields_of(rich, epoch=2013.0, chip=chip)
    assert f.parts == (*PARTS, "model")
    joint = f.field("model")
    rest = joint - sum(f.field(part) for part in PARTS)
    assert np.abs(joint).max() > 1e-3
    assert np.abs(rest).max() < 1e-4 * np.abs(joint).max()


def test_the_parts_of_a_linear_model_add_up_exactly(solution_of):
    model = DistortionModel(
        2,
        (Chip(1, "A", (4096.0, 2048.0), (2048.0, 1024.0)),),
        time=TimeDependence((("v", 0, 1),), (2005.0,)),
        frames="shift",
        exposures=("a", "b", "c"),
    )
    a = np.random.default_rng(5).normal(size=(model.n_params, model.n_params))
    f = fields_of(solution_of(model, cov=a @ a.T), epoch=2008.0)
    total = sum(f.field(part) for part in PARTS)
    np.testing.assert_allclose(f.field("model"), total, atol=1e-12)


def test_without_frames_and_drift_the_coefficients_are_all(solution_of):
    model = DistortionModel(1, (Chip(1, "A", (4096.0, 2048.0), (2048.0, 1024.0)),))
    f = fields_of(solution_of(model, cov=np.eye(6)))
    assert f.parts == ("coefficients", "model")
    np.testing.assert_array_equal(f.field("model"), f.field("coefficients"))


def test_the_joint_error_is_a_draw_minus_the_mean_turned_to_the_gauge(rich):
    """Route through predict, one draw at a time: the exposure is the only one that can fit."""
    n, epoch = 40, 2003.0
    f = fields_of(rich, n_draws=n, epoch=epoch, chip=2)
    theta = rich.draws(n, np.random.default_rng(1))  # drawn first, from the same generator
    field = f.field("model")
    seen = set()
    for k in range(n):
        misfit = {}
        for code in (1, 2, 3):
            where = dict(epoch=epoch, chip=2, exposure=code)
            error = rich.model.predict(theta[k], X, Y, **where) - rich.model.predict(
                rich.mean, X, Y, **where
            )
            turn, _ = rich.model.frame(rich.mean, code)
            misfit[code] = np.abs(field[k] @ turn.T - error).max()
        best = min(misfit, key=misfit.get)
        assert misfit[best] < 1e-9
        seen.add(best)
    assert seen == {1, 2, 3}


def test_correlated_parts_combine_as_the_joint_covariance(solution_of):
    """Two exposures: all draws are in the second one, so J S J^T of the drawn S is exact."""
    model = DistortionModel(
        3,
        (Chip(1, "A", (4096.0, 2048.0), (2048.0, 1024.0)),),
        time=TimeDependence((("u", 1, 0),), (2005.0,)),
        frames="shift",
        exposures=("a", "b"),
    )
    a = 0.01 * np.random.default_rng(6).normal(size=(model.n_params, model.n_params))
    a[model.names.index("u_0_0"), 0] = 1.0  # the zero point and the shift of b nearly cancel
    a[model.names.index("b.shift_u"), 0] = -1.0
    s = solution_of(model, cov=a @ a.T)
    f = fields_of(s, n_draws=500, epoch=2010.0)
    d = s.draws(500, np.random.default_rng(1)) - s.mean
    J = model.jacobian(s.mean, X, Y, epoch=2010.0, exposure=1)
    drawn = np.einsum("nad,de,nae->na", J, d.T @ d / 500, J)
    np.testing.assert_allclose(np.stack(f.sigma("model"), axis=1), np.sqrt(drawn), rtol=1e-10)
    # and within its Monte-Carlo error the covariance that was drawn from
    m = uncertainty_map(s, grid=(5, 4), epoch=2010.0, exposure="b")
    tolerance = 5 / np.sqrt(2 * 500)
    np.testing.assert_allclose(f.sigma("model")[0], m.sigma_u.ravel(), rtol=tolerance)
    np.testing.assert_allclose(f.sigma("model")[1], m.sigma_v.ravel(), rtol=tolerance)
    quadrature = np.sqrt(sum(f.sigma(part)[0] ** 2 for part in PARTS))
    assert (quadrature > 3 * m.sigma_u.ravel()).all()


def test_sigma_is_the_root_mean_square_of_the_field(rich):
    f = fields_of(rich, epoch=2003.0)
    for part in f.parts:
        expected = np.sqrt(np.mean(f.field(part) ** 2, axis=0))
        np.testing.assert_allclose(np.stack(f.sigma(part), axis=1), expected, rtol=1e-9)


def test_drift_grows_from_its_reference_date_and_the_coefficients_stay(rich):
    at = {t: fields_of(rich, epoch=t) for t in (2004.5, 2005.5, 2007.5)}
    assert np.abs(at[2004.5].field("time dependence")).max() < 1e-12
    np.testing.assert_allclose(
        at[2007.5].field("time dependence"), 3 * at[2005.5].field("time dependence"), atol=1e-11
    )
    np.testing.assert_array_equal(
        at[2007.5].field("coefficients"), at[2004.5].field("coefficients")
    )


def test_some_draws_are_those_of_the_same_field(rich):
    f = fields_of(rich, epoch=2003.0)
    whole = f.field("model")
    np.testing.assert_allclose(f.field("model", slice(10, 25)), whole[10:25], rtol=1e-12)


def test_one_draw_is_too_few(rich):
    with pytest.raises(InputError, match="number of draws is 1"):
        fields_of(rich, n_draws=1, epoch=2003.0)
