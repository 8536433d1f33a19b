"""Numbers in the report: units by astropy, digits by their errors, never a NaN."""

from __future__ import annotations

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayesdist.utils.text import (
    MISSING,
    count,
    counted,
    display_scale,
    interval,
    number,
    percent,
    probability,
    rounded,
    with_mas,
)

ANGLES = {"deg": u.deg, "arcsec": u.arcsec, "mas": u.mas, "µas": u.uas}


@given(st.sampled_from(["deg", "arcsec", "mas"]), st.floats(1e-9, 1e6))
def test_display_units_are_the_same_length(unit, value):
    scale = display_scale(unit, value)
    shown = value * scale.factor * ANGLES[scale.unit]
    assert shown.to_value(u.mas) == pytest.approx((value * ANGLES[unit]).to_value(u.mas), rel=1e-12)


def test_rates_keep_their_year():
    scale = display_scale("arcsec/yr", 0.002)
    assert (scale.factor, scale.unit) == (1e3, "mas/yr")


def test_pixels_carry_mas_beside_them():
    # 0.0093 of WISE's 2.75-arcsec pixels
    assert with_mas(0.0093, "pix", 2750.0) == "0.00930\u202fpix (25.6\u202fmas)"
    assert with_mas(0.0093, "pix", None) == "0.00930\u202fpix"
    assert with_mas(float("nan"), "pix", 1.0) == MISSING


def _read(text: str) -> float:
    plain = text.translate(str.maketrans("−⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "--0123456789")).replace("\u202f", "")
    return float(plain.replace("×10", "e"))


@given(st.floats(-1e12, 1e12), st.integers(2, 6))
def test_a_number_is_right_to_its_digits(x, digits):
    assert _read(number(x, digits)) == pytest.approx(x, rel=0.51 * 10.0 ** (1 - digits), abs=0.0)


@given(st.floats(-1e6, 1e6), st.floats(1e-14, 1e3))
def test_a_value_is_rounded_to_the_second_digit_of_its_error(x, sigma):
    # half a unit of that digit is at most 5 % of sigma, and the text of a double has its own limit
    assert abs(_read(rounded(x, sigma)) - x) <= 0.0501 * sigma + 1e-15 * abs(x)


def test_digits_that_the_error_denies_are_not_printed():
    assert rounded(0.7597772, 0.00021) == "0.75978"
    assert rounded(-8.064834e-06, 7.1e-08) == "−8.065\u202f×\u202f10⁻⁶"
    assert rounded(12345.678, 230.0) == "12350"
    assert rounded(-1e-9, 0.1) == "0.00"


@pytest.mark.parametrize("missing", [None, float("nan"), np.ma.masked, "text"])
def test_what_is_missing_is_a_dash(missing):
    assert number(missing) == rounded(missing, 1.0) == count(missing) == percent(missing) == MISSING
    assert interval(missing, 1.0, 0.1) == MISSING


def test_infinite_diagnostics_are_shown_as_such():
    assert number(float("inf")) == "∞"
    assert number(float("-inf")) == "−∞"


def test_counts_are_grouped_in_threes():
    assert count(11213542) == "11\u202f213\u202f542"  # pairs of WISE W2


@pytest.mark.parametrize("p", [0.0, 5e-324, 1e-301])
def test_no_probability_is_said_to_be_zero(p):
    assert probability(p) == "p < 10⁻³⁰⁰"


def test_probabilities_that_a_double_holds_are_said():
    assert probability(0.0123) == "p = 0.012"
    assert probability(1e-300) == "p = 1.0\u202f×\u202f10⁻³⁰⁰"
    assert MISSING in probability(float("nan"))


@pytest.mark.parametrize(
    ("fraction", "n", "text"),
    [
        (0.0, 2000, "< 0.0005"),
        (1.0, 2000, "> 0.9995"),
        (0.0, 1512, "< 0.0007"),
        (1.0, 300, "> 0.996"),
        (0.909, 2000, "0.9090"),
        (0.9995, 2000, "0.99950"),
        (float("nan"), 2000, MISSING),
    ],
)
def test_a_probability_counted_in_draws_is_never_zero_or_one(fraction, n, text):
    """No draw of n leaves probabilities below 1 / n, rounded up."""
    error = np.sqrt(fraction * (1 - fraction) / n)
    assert counted(fraction, error, n) == text
