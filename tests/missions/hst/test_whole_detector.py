"""Detectors as one field: closed forms of one and of two chips."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bayesdist.calibration.chip_map import fitted_map
from bayesdist.errors import InputError
from bayesdist.missions.hst.geometry import detector_numbers
from bayesdist.missions.hst.whole_detector import WholeDetector

SIZE = (400.0, 200.0)


def chip(positions, number=1, size=SIZE, order=3):
    return fitted_map(
        positions, "made up", order=order, size=size, reference_pixel=(1.0, 1.0),
        unit="arcsec", chip=number,
    )  # fmt: skip


def linear(L, t=(0.0, 0.0)):
    L = np.asarray(L, float)
    return lambda x, y: (L[0, 0] * x + L[0, 1] * y + t[0], L[1, 0] * x + L[1, 1] * y + t[1])


def test_a_linear_detector_has_scales_and_an_angle_and_nothing_else():
    """Axes of 0.2 and 0.1 arcsec, at 30 and 110 degrees."""
    a, b = np.deg2rad([30.0, 110.0])
    L = np.array([[0.2 * np.cos(a), 0.1 * np.cos(b)], [0.2 * np.sin(a), 0.1 * np.sin(b)]])
    found = detector_numbers(WholeDetector({1: chip(linear(L))}, 0.1))
    assert found.non_linear_max < 1e-10
    assert_allclose([found.scale_x, found.mean_scale_x], 0.2, rtol=1e-12)
    assert_allclose([found.scale_y, found.mean_scale_y], 0.1, rtol=1e-12)
    assert found.angle == pytest.approx(80.0, abs=1e-9)
    assert_allclose([found.area_min, found.area_max], 1.0, rtol=1e-12)
    assert found.scale_range == pytest.approx(0.0, abs=1e-11)
    assert_allclose(found.size, (80.0, 20.0), rtol=1e-12)
    ratio = np.linalg.cond(L)
    assert found.elongation == pytest.approx(ratio - 1, rel=1e-9)


def test_a_parabola_leaves_what_legendre_says():
    """u = s (x + a X^2): the best line leaves a (X^2 - h^2 / 3), du/dx is s (1 + 2 a X)."""
    a, s, h = 1e-4, 0.05, 200.0

    def bent(x, y):
        X = x - 200.5
        return s * (x + a * X**2), s * y

    whole = WholeDetector({1: chip(bent)}, 0.025)
    field = whole.non_linear(1, np.array([0.5, 200.5, 400.5]), np.array([1.0, 200.0]))
    wanted = a * (np.array([h, 0.0, h]) ** 2 - h**2 / 3)
    assert_allclose(field.along_x, np.tile(wanted, (2, 1)), atol=1e-10)
    assert_allclose(field.du, 2 * np.tile(wanted, (2, 1)), atol=1e-9)  # of half the pixels' size
    assert_allclose(field.dv, 0.0, atol=1e-10)
    found = detector_numbers(whole)
    edge = h - 0.5  # the outermost pixels' centres
    assert found.non_linear_max == pytest.approx(2 * a * (edge**2 - h**2 / 3), rel=1e-9)
    assert found.non_linear_at[0] in (1.0, 400.0)
    assert_allclose([found.area_min, found.area_max], [1 - 2 * a * edge, 1 + 2 * a * edge])
    assert found.scale_range == pytest.approx(np.sqrt(found.area_max / found.area_min) - 1)
    assert found.mean_scale_x == pytest.approx(s, rel=1e-9)


def test_two_chips_are_one_array_with_the_gap_between_them():
    """The upper chip lies 37 pixels above, 5 to the left, on the same linear map."""
    L = np.array([[0.05, 0.004], [0.002, 0.049]])
    up = L @ (-5.0, 237.0)
    both = WholeDetector({2: chip(linear(L), 2), 1: chip(linear(L, up), 1)}, 0.05)
    assert both.places[2] == (0.0, 0.0)
    assert_allclose(both.places[1], (-5.0, 237.0), atol=1e-9)
    low, high = both.bounds
    assert_allclose([low, high], [(-4.5, 0.5), (400.5, 437.5)], atol=1e-9)
    assert_allclose(both.centre, (198.0, 219.0), atol=1e-9)
    assert detector_numbers(both).non_linear_max < 1e-9
    assert_allclose(both.central_slope, L, rtol=1e-10)


def test_the_gap_follows_a_field_that_bends_across_it():
    """One smooth field cut in two: both halves come back to their places, to the gap cubed."""

    def field(x, y):
        return 0.05 * (x + 2e-5 * x * y), 0.05 * (y + 1e-5 * y**2)

    upper = chip(lambda x, y: field(x, y + 220.0), 1)
    both = WholeDetector({2: chip(field, 2), 1: upper}, 0.05)
    assert_allclose(both.places[1], (0.0, 220.0), atol=2e-3)
    one = detector_numbers(WholeDetector({1: chip(field, size=(400.0, 420.0))}, 0.05))
    two = detector_numbers(both)
    assert two.area_max == pytest.approx(one.area_max, rel=1e-3)
    assert two.angle == pytest.approx(one.angle, abs=0.05)


def test_chips_side_by_side():
    L = 0.1 * np.eye(2)
    both = WholeDetector({1: chip(linear(L)), 5: chip(linear(L, (45.0, 0.3)), 5)}, 0.1)
    assert_allclose(both.places[5], (450.0, 3.0), atol=1e-9)


def test_what_is_no_detector_is_refused():
    with pytest.raises(InputError, match="has no chip"):
        WholeDetector({}, 0.05)
    with pytest.raises(InputError, match="the scale is -1"):
        WholeDetector({1: chip(linear(np.eye(2)))}, -1.0)
    with pytest.raises(InputError, match="singular linear part"):
        WholeDetector({1: chip(linear([[1.0, 1.0], [1.0, 1.0]]))}, 1.0)
