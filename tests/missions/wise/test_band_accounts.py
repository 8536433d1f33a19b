"""Fields of two bands, histograms of residuals, and what a sigma is made of."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtri

from bayesdist.assess import distortion_vectors
from bayesdist.diagnose.residuals.tables import StatisticsRow
from bayesdist.missions.wise.assess.account import RowAccount
from bayesdist.missions.wise.assess.distortion_field import field_of_solution, histogram
from bayesdist.missions.wise.assess.residual_tables import PrintedRow
from bayesdist.missions.wise.published import LONGEST_VECTORS, WISE_ARRAYS
from bayesdist.missions.wise.simulate import wise_solution
from bayesdist.model import Chip, DistortionModel

PRINT = 0.005  # the report does not say where it looked for maxima: a pixel more is 0.4 %


def solution(model: DistortionModel, theta: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(
        model=model, mean=theta, cov=np.zeros((theta.size,) * 2), convergence=None
    )


def field(band: str):
    return field_of_solution(solution(*wise_solution(band)))


# -- fields ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("band", ["W1", "W2", "W3"])
def test_the_longest_vectors_are_the_printed_ones(band):
    longest = field(band).vectors((33, 33)).length_max
    assert longest == pytest.approx(LONGEST_VECTORS[band], rel=PRINT)


def test_a_field_is_what_distortion_vectors_says():
    model, theta = wise_solution("W3")
    wanted = distortion_vectors(solution(model, theta), grid=(9, 7))
    found = field("W3").vectors((9, 7))
    np.testing.assert_allclose(found.du, wanted.du, atol=1e-12)
    np.testing.assert_allclose(found.dv, wanted.dv, atol=1e-12)


def test_a_field_does_not_depend_on_unit_and_axes_of_u_v():
    """The same distortion, with u and v in arcsec and turned by 40 degrees."""
    model, theta = wise_solution("W1")
    K = model.n_terms
    c, s = 2.75 * np.cos(np.radians(40)), 2.75 * np.sin(np.radians(40))
    turned = np.array([[c, -s], [s, c]]) @ theta.reshape(2, K)
    other = DistortionModel(model.order, model.chips, unit="arcsec")
    found = field_of_solution(solution(other, turned.ravel()))
    # the similarity that fits best takes scale and turn of the distortion itself out as well
    plain = distortion_vectors(solution(other, turned.ravel()), grid=(9, 9)).on_detector
    vectors = found.vectors((9, 9))
    np.testing.assert_allclose(np.stack([vectors.du, vectors.dv]), plain, atol=1e-9)


@pytest.mark.parametrize(("later", "printed"), [("W2", 0.398), ("W3", 0.876), ("W4", 0.940)])
def test_differences_of_bands_are_the_printed_ones(later, printed):
    """WSDC D-T033, section 4: in pixels of W1, of which W4's are two."""
    wide = WISE_ARRAYS[later].scale / 2.75
    less = field(later).minus(field("W1"), 1 / wide)
    side = np.linspace(-1015 / 1016, 1015 / 1016, 33)  # centres of the outermost pixels of W1
    longest = wide * np.hypot(*less.at_scaled(*np.meshgrid(side, side))).max()
    assert longest == pytest.approx(printed, rel=PRINT)


def test_orders_of_two_fields_may_differ():
    chip = Chip(1, "A", (100.0, 80.0), (50.5, 40.5))
    rng = np.random.default_rng(2)
    fields = []
    for order in (2, 5):
        model = DistortionModel(order, (chip,))
        theta = 0.1 * rng.standard_normal(model.n_params)
        fields.append(field_of_solution(solution(model, theta + identity(model))))
    X, Y = rng.uniform(-1, 1, (2, 20))
    for a, b in (fields, fields[::-1]):
        wanted = a.at_scaled(X, Y) - 0.5 * b.at_scaled(X, Y)
        np.testing.assert_allclose(a.minus(b, 0.5).at_scaled(X, Y), wanted, atol=1e-12)


def identity(model: DistortionModel) -> np.ndarray:
    theta = np.zeros((2, model.n_terms))
    basis = model.basis()
    for axis, term in enumerate(((1, 0), (0, 1))):
        theta[axis, basis.terms.index(term)] = basis.half_size[axis]
    return theta.ravel()


# -- histograms -----------------------------------------------------------------------------------


def test_a_histogram_counts_as_numpy_and_loses_nobody():
    r = np.random.default_rng(5).standard_t(3, (2, 10_000))
    one = histogram(r, 2.0, 40)
    for k in (0, 1):
        wanted, _ = np.histogram(r[k], np.linspace(-2, 2, 41))
        np.testing.assert_array_equal(one.counts[k], wanted)
        assert one.counts[k].sum() + one.outside[k] == 10_000
    whole = histogram(r[:, :3000], 2.0, 40) + histogram(r[:, 3000:], 2.0, 40)
    np.testing.assert_array_equal(whole.counts, one.counts)
    np.testing.assert_array_equal(whole.outside, one.outside)


def test_the_half_width_of_normal_residuals_is_sigma():
    n = 20_001
    z = ndtri((np.arange(n) + 0.5) / n)  # the normal distribution without chance
    one = histogram(np.stack([0.3 * z, 0.05 * z]), 3.0, 4001)
    # linear interpolation in bins of 0.0015: what the density bends within one is far below it
    np.testing.assert_allclose(one.half_width(), [0.3, 0.05], atol=2e-4)


def test_a_half_width_that_lies_beyond_the_histogram_is_infinite():
    one = histogram(np.array([[-9.0, 0.0, 9.0], [0.0, 0.1, 0.2]]), 1.0)
    assert np.isinf(one.half_width()[0]) and np.isfinite(one.half_width()[1])


# -- what sigma is made of ------------------------------------------------------------------------


def account(found: float, noise: float, printed: float, there: tuple[float, float]) -> RowAccount:
    """Sigma and noise here and there, the errors of variances 1e-6, digits exact."""
    variance = found**2 - noise**2
    value = {"sigma": found}
    free = {"sigma": float(np.sqrt(max(variance, 0.0)))}
    row = StatisticsRow("W1/X", value, value, free, variance, 1e-6, 961, 0)
    return RowAccount(row, 0.3, PrintedRow("W1/X", {"sigma": printed}, {"sigma": 0.0}), there)


def test_parts_add_in_quadrature():
    one = account(0.7, 0.2, 0.9, (0.1, 0.1))
    assert one.rest == pytest.approx(np.sqrt(0.49 - 0.04 - 0.09))
    assert one.printed_structure == pytest.approx(np.sqrt(0.81 - 0.01))
    assert one.remains == pytest.approx(np.sqrt(0.80 - 0.45))
    assert one.verdict == "print has more" and "published set has 0.59 more" in one.sentence


def test_less_there_and_the_same():
    less = account(0.7, 0.2, 0.5, (0.1, 0.1))
    assert less.verdict == "print has less" and less.remains == pytest.approx(-np.sqrt(0.21))
    # noise there may be 0.1 to 0.3: structure between 0.41 and 0.49 squared off 0.5
    same = account(np.sqrt(0.45), 0.0, np.sqrt(0.5), (0.1, 0.3))
    assert same.verdict == "same" and same.remains == 0


def test_a_printed_sigma_below_its_noise_is_said():
    one = account(0.7, 0.6, 0.3, (0.4, 0.5))
    assert one.verdict == "below noise" and "another distribution" in one.sentence
