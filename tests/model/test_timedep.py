"""Drifting terms: Equation 3 of ACS ISR 2015-06, segment by segment."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import InputError
from bayesdist.model import TimeDependence

TERMS = (("u", 1, 0), ("v", 1, 0))


def test_one_segment_is_a_straight_line():
    time = TimeDependence(TERMS, (2004.5,))
    assert time.value_names() == ("rate",)
    np.testing.assert_allclose(time.weights([2004.5, 2006.0, 2002.25])[:, 0], [0, 1.5, -2.25])


def test_segments_have_their_own_rates_dates_and_steps():
    """C(t) = C + step_s + rate_s (t - t0_s), with step_0 = 0."""
    time = TimeDependence(TERMS, (2004.5, 2012.5, 2020.0), (2009.4, 2018.0))
    assert time.n_segments == 3
    assert time.value_names() == ("rate", "step_2", "rate_2", "step_3", "rate_3")
    values = np.array([0.3, 5.0, -0.2, 7.0, 0.9])
    epochs = np.array([2003.0, 2009.39, 2010.0, 2017.9, 2019.0, 2021.0])
    by_hand = [
        0.3 * (2003.0 - 2004.5),
        0.3 * (2009.39 - 2004.5),
        5.0 - 0.2 * (2010.0 - 2012.5),
        5.0 - 0.2 * (2017.9 - 2012.5),
        7.0 + 0.9 * (2019.0 - 2020.0),
        7.0 + 0.9 * (2021.0 - 2020.0),
    ]
    np.testing.assert_allclose(time.weights(epochs) @ values, by_hand, atol=1e-12)


def test_a_segment_begins_at_its_break():
    time = TimeDependence(TERMS, (2004.5,), (2009.4,))
    before, at = time.weights([np.nextafter(2009.4, 0), 2009.4])
    assert before[1] == 0 and before[2] == 0 and before[0] > 0
    assert at[0] == 0 and at[1] == 1 and at[2] > 0


def test_one_date_serves_all_segments():
    assert TimeDependence(TERMS, (2004.5,), (2009.4,)) == TimeDependence(
        TERMS, (2004.5, 2004.5), (2009.4,)
    )


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (((("w", 1, 0),), (2004.5,)), r"model\.tdd\.terms"),
        (((("u", -1, 0),), (2004.5,)), r"model\.tdd\.terms"),
        (((("u", 1, 0), ("u", 1, 0)), (2004.5,)), "a term is repeated"),
        ((TERMS, (2004.5,), (2010.0, 2009.0)), "not in ascending order"),
        ((TERMS, (2004.5,), (2009.0, 2009.0)), "not in ascending order"),
        ((TERMS, (2004.5, 2005.5)), "2 reference dates for 1 segments"),
        ((TERMS, (), (2009.4,)), "0 reference dates for 2 segments"),
    ],
)
def test_errors(arguments, says):
    with pytest.raises(InputError, match=says):
        TimeDependence(*arguments)
