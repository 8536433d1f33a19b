import numpy as np
import pytest

from bayesdist.assess import STATISTICS, field_statistic
from bayesdist.errors import InputError

RADIAL = [s for s in STATISTICS if s[:2] not in ("u_", "v_")]


@pytest.fixture
def error():
    return np.random.default_rng(0).normal(size=(6, 40, 2))


def test_the_statistics_are_those_of_the_configuration():
    base = {"max", "rms", "mean", "p50", "p68", "p90", "p95", "p99"}
    assert set(STATISTICS) == base | {f"{a}_{s}" for a in "uv" for s in base}


@pytest.mark.parametrize("name", STATISTICS)
def test_a_constant_field_has_its_size_as_every_statistic(name):
    size = {"u": 3.0, "v": 4.0}.get(name[0] if "_" in name else "", 5.0)
    field = np.tile([-3.0, 4.0], (2, 7, 1))
    np.testing.assert_allclose(field_statistic(name, field), size, rtol=1e-14)


@pytest.mark.parametrize("name", STATISTICS)
def test_statistics_scale_with_the_field_and_ignore_the_order_of_points(name, error):
    value = field_statistic(name, error)
    assert value.shape == (6,)
    np.testing.assert_allclose(field_statistic(name, -2.5 * error), 2.5 * value, rtol=1e-13)
    np.testing.assert_allclose(field_statistic(name, error[:, ::-1]), value, rtol=1e-13)


@pytest.mark.parametrize("name", RADIAL)
def test_radial_statistics_ignore_rotations_and_axes_exchange(name, error):
    c, s = np.cos(1.1), np.sin(1.1)
    turned = error @ np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(
        field_statistic(name, turned), field_statistic(name, error), rtol=1e-12
    )
    np.testing.assert_allclose(
        field_statistic(f"u_{name}", error), field_statistic(f"v_{name}", error[..., ::-1])
    )


def test_the_mean_square_of_the_radial_error_is_that_of_both_axes(error):
    u, v, both = (field_statistic(s, error) ** 2 for s in ("u_rms", "v_rms", "rms"))
    np.testing.assert_allclose(both, u + v, rtol=1e-13)


def test_percentiles_rise_to_the_maximum(error):
    values = [field_statistic(s, error) for s in ("p50", "p68", "p90", "p95", "p99", "max")]
    assert (np.diff(values, axis=0) > 0).all()


@pytest.mark.parametrize(
    ("wrong", "right"), [("p96", "p95"), ("maximum", "max"), ("u_rsm", "u_rms"), ("RMS", "rms")]
)
def test_an_unknown_statistic_is_refused_with_the_nearest(wrong, right, error):
    with pytest.raises(InputError, match=rf"unknown statistic '{wrong}'.*'\w+' if that is meant"):
        field_statistic(wrong, error)
    if wrong != "p96":  # p95, p90 and p99 are equally near to it
        with pytest.raises(InputError, match=f"'{right}'"):
            field_statistic(wrong, error)


def test_a_name_near_to_none_lists_all(error):
    with pytest.raises(InputError, match="choose one of max, rms, mean"):
        field_statistic("chi-square", error)
