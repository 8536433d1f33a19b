"""What a series refuses, and what it keeps."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import DegenerateError, InputError
from bayesdist.kinds.campaign.series import Series

EPOCH = np.array([2003.0, 2004.0, 2005.0, 2006.0])
VALUES = np.array([[1.0, 5.0], [2.0, 4.0], [3.0, 7.0], [5.0, 5.0]])


def of(epoch=EPOCH, values=VALUES, sigma=0.1, **options) -> Series:
    options = {"coefficients": ("A_2", "A_3"), **options}
    return Series.of(epoch, values, sigma, **options)


def changed(array, place, value):
    out = np.array(array)
    out[place] = value
    return out


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"values": changed(VALUES, (2, 1), np.nan)}, InputError, r"row 3 \(exposure j3\)"),
        ({"epoch": changed(EPOCH, 1, np.inf)}, InputError, r"row 2 \(exposure j2\): epoch"),
        ({"sigma": changed(np.full((4, 2), 0.1), (3, 0), -1)}, InputError, "row 4: formal error"),
        ({"epoch": EPOCH[:3]}, InputError, "values has shape"),
        ({"names": ("j1", "j2", "j2", "j4")}, InputError, "exposure 'j2' is repeated"),
        ({"coefficients": ("A_2", "A_2")}, InputError, "coefficient 'A_2' is repeated"),
        ({"group": ("F606W",)}, InputError, "1 group for 4 exposures"),
        ({"epoch": EPOCH[:2], "values": VALUES[:2], "names": ()}, DegenerateError, "2 exposures"),
        (
            {"values": VALUES * [1, 0], "sigma": [0.1, 0.0]},
            DegenerateError,
            "'A_3' does not vary",
        ),
    ],
)
def test_wrong_series(options, error, says):
    with pytest.raises(error, match=says):
        of(**{"names": ("j1", "j2", "j3", "j4"), **options})


def test_covariance_must_be_one():
    cov = np.tile(np.array([[1.0, 2.0], [2.0, 1.0]]), (4, 1, 1))
    with pytest.raises(InputError, match=r"row 1 .*negative eigenvalue"):
        Series(EPOCH, VALUES, cov, ("a", "b"))


def test_parts_of_a_series():
    whole = of(group=("F606W", "F606W", "F814W", "F606W"))
    some = whole.take(whole.epoch > 2003.5).only("A_3")
    assert some.names == ("2", "3", "4") and some.coefficients == ("A_3",)
    np.testing.assert_array_equal(some.values[:, 0], VALUES[1:, 1])
    assert some.group == ("F606W", "F814W", "F606W") and whole.group_names == ("F606W", "F814W")
    with pytest.raises(InputError, match="no coefficient 'B_2'"):
        whole.only("B_2")


def test_the_spread_does_not_see_what_lies_off(rng):
    values = rng.standard_normal(500)
    values[:20] = 1e4
    spread = Series.of(np.arange(500.0), values, coefficients=("a",)).spread
    assert spread[0] == pytest.approx(1, abs=0.15)
