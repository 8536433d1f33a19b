import numpy as np
import pytest

from bayesdist.assess import UserTerm, error_budget
from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel, TimeDependence

TERMS = (
    UserTerm("reference catalogue", "systematic", 0.02, 0.01, "pix"),
    UserTerm("centroids", "random", 0.5, 0.25, "mas"),
)


def budget_of(s, **options):
    return error_budget(s, rng=np.random.default_rng(1), **options)


def chip(**options):
    return DistortionModel(1, (Chip(1, "A", (101.0, 51.0), (51.0, 26.0)),), **options)


def test_independent_terms_add_in_quadrature(rich):
    b = budget_of(rich, terms=TERMS, epoch=2006.5, pixel_scale=50.0, n_draws=500, chip=1)
    alone = budget_of(rich, epoch=2006.5, n_draws=500, chip=1).total
    u2 = alone.u**2 + 0.02**2 + (0.5 / 50) ** 2
    v2 = alone.v**2 + 0.01**2 + (0.25 / 50) ** 2
    np.testing.assert_allclose(b.total.u, np.sqrt(u2), rtol=1e-12)
    np.testing.assert_allclose(b.total.v, np.sqrt(v2), rtol=1e-12)
    np.testing.assert_allclose(b.radial, np.sqrt(u2 + v2), rtol=1e-12)
    assert [t.name for t in b.terms] == [
        "coefficients",
        "time dependence",
        "exposure frame",
        "reference catalogue",
        "centroids",
    ]
    assert [t.source for t in b.terms] == ["measured in this run"] * 3 + ["given by the user"] * 2
    assert [t.kind for t in b.terms[3:]] == ["systematic", "random"]
    assert b.on_grid(b.radial).shape == (17, 33) and (b.unit, b.epoch) == ("pix", 2006.5)


def test_constant_terms_alone_give_their_own_sigma_everywhere(solution_of):
    model = chip()
    cov = np.zeros((6, 6))
    cov[0, 0], cov[3, 3] = 0.03**2, 0.04**2
    b = budget_of(solution_of(model, cov=cov), n_draws=20000)
    tolerance = 5 / np.sqrt(2 * 20000)
    np.testing.assert_allclose(b.total.u, 0.03, rtol=tolerance)
    np.testing.assert_allclose(b.total.v, 0.04, rtol=tolerance)
    np.testing.assert_allclose(b.total.u, b.total.u[0], rtol=1e-12)
    assert b.rows()[-1]["radial"] == pytest.approx(0.05, rel=tolerance)


def test_parts_that_cancel_leave_nothing(solution_of):
    """A scale known exactly at 2008, three years after the reference date, and not its history."""
    model = chip(time=TimeDependence((("u", 1, 0),), (2005.0,)))
    direction = np.zeros(model.n_params)
    direction[model.coefficient_slice(1, 0)] = -3.0 * model.basis().from_monomials(
        [0.0, 2 / 101, 0.0]
    )
    direction[model.names.index("tdd.u_1_0.rate")] = 1.0
    s = solution_of(model, cov=np.outer(direction, direction))
    then, later = (budget_of(s, epoch=t, grid=(5, 3)) for t in (2008.0, 2011.0))
    sizes = {t.name: t.u.max() for t in then.terms}
    assert sizes["coefficients"] == pytest.approx(sizes["time dependence"], rel=1e-10)
    assert sizes["coefficients"] > 2
    assert then.total.u.max() < 1e-6
    assert later.total.u.max() == pytest.approx(sizes["coefficients"], rel=1e-7)


def test_rows_are_root_mean_squares_over_the_grid(rich):
    b = budget_of(rich, terms=TERMS, epoch=2006.5, pixel_scale=50.0, n_draws=200)
    rows = b.rows()
    assert [r["name"] for r in rows] == [*(t.name for t in b.terms), "total"]
    for row, u, v in zip(
        rows,
        [*(t.u for t in b.terms), b.total.u],
        [*(t.v for t in b.terms), b.total.v],
        strict=True,
    ):
        assert row["u"] == pytest.approx(np.sqrt(np.mean(u**2)), rel=1e-12)
        assert row["radial"] ** 2 == pytest.approx(row["u"] ** 2 + row["v"] ** 2, rel=1e-12)
        assert row["v"] == pytest.approx(np.sqrt(np.mean(v**2)), rel=1e-12)
    assert rows[3] | {"u": 0.02, "v": 0.01} == rows[3] and rows[3]["kind"] == "systematic"


def test_the_dominant_term_is_the_largest_at_each_place(solution_of):
    """A slope in x against a constant: the slope wins where |x - centre| is large enough."""
    cov = np.zeros((6, 6))
    cov[1, 1] = 1.0  # u = X, from -1 to 1 over the detector
    term = UserTerm("flat", "systematic", 0.3, 0.4, "pix")  # radial 0.5
    b = budget_of(solution_of(chip(), cov=cov), terms=[term], grid=(21, 3), n_draws=20000)
    slope = np.abs(2 * b.axes[0] - 102) / 101
    clear = np.abs(slope - 0.5) > 0.02
    expected = np.tile(np.where(slope > 0.5, 0, 1), (3, 1))
    np.testing.assert_array_equal(b.on_grid(b.dominant)[:, clear], expected[:, clear])


def test_angular_terms_use_the_scale_of_an_angular_solution(from_monomials):
    s = from_monomials(
        {(1, 0): 0.05}, {(0, 1): 0.05}, order=1, size=(64.0, 64.0), reference_pixel=(32.0, 32.0),
        unit="arcsec",
    )  # fmt: skip
    b = budget_of(s, terms=[UserTerm("centroids", "random", 0.1, 0.2, "pix")])
    np.testing.assert_allclose(b.total.u, 0.005, rtol=1e-12)
    np.testing.assert_allclose(b.total.v, 0.010, rtol=1e-12)


def test_angular_terms_need_a_scale_where_u_and_v_are_pixels(solution_of):
    with pytest.raises(InputError, match=r"budget term 'centroids'.*give detector\.scale_mas"):
        budget_of(solution_of(chip()), terms=TERMS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(kind="sistematic"), "'systematic' if that is meant"),
        (dict(sigma_v=-0.1), "sigma_v is -0.1"),
        (dict(sigma_u=float("nan")), "sigma_u is nan"),
        (dict(unit="parsec"), "unknown unit 'parsec'"),
    ],
)
def test_bad_terms_are_refused_by_name(change, message):
    good = dict(name="jitter", kind="random", sigma_u=0.1, sigma_v=0.1, unit="pix")
    with pytest.raises(InputError, match=f"budget term 'jitter': .*{message}"):
        UserTerm(**(good | change))


def test_the_same_seed_gives_the_same_budget(rich):
    a, b = (budget_of(rich, epoch=2003.0, n_draws=50) for _ in range(2))
    np.testing.assert_array_equal(a.total.u, b.total.u)
    assert a.n_draws == 50
