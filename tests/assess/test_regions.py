import numpy as np
import pytest

from bayesdist.assess.domain import check_region, in_region, region_words
from bayesdist.errors import InputError

SIZE = (101.0, 51.0)
X, Y = (a.ravel() for a in np.meshgrid(np.arange(1.0, 102.0), np.arange(1.0, 52.0)))


@pytest.mark.parametrize(
    ("region", "expected"),
    [
        ("whole", X > 0),
        ("inner 80 %", (X >= 11) & (X <= 91) & (Y >= 6) & (Y <= 46)),
        ("Inner  50%", (X >= 26) & (X <= 76) & (Y >= 13.5) & (Y <= 38.5)),
        ("lower left", (X <= 51) & (Y <= 26)),
        ("upper right", (X >= 51) & (Y >= 26)),
        ("upper left", (X <= 51) & (Y >= 26)),
        ("lower right", (X >= 51) & (Y <= 26)),
    ],
)
def test_named_regions_hold_the_pixels_that_their_names_say(region, expected):
    found = in_region(check_region(region, ""), SIZE, X, Y)
    assert (found == expected).all()


def test_a_polygon_is_the_inside_of_its_corners():
    """A triangle by its half planes, and an L by its two rectangles; corners between pixels."""
    triangle = check_region([[10.5, 5.5], [60.5, 5.5], [10.5, 45.5]], "")
    below = (X - 10.5) / 50 + (Y - 5.5) / 40 < 1
    # no pixel lies on the slanted side: 40 X + 50 Y is a multiple of 10, the line at 2695 is not
    assert (in_region(triangle, SIZE, X, Y) == ((X > 10.5) & (Y > 5.5) & below)).all()
    corner = [[5.5, 5.5], [40.5, 5.5], [40.5, 20.5], [20.5, 20.5], [20.5, 40.5], [5.5, 40.5]]
    expected = (X > 5.5) & (Y > 5.5) & (((X < 40.5) & (Y < 20.5)) | ((X < 20.5) & (Y < 40.5)))
    for corners in (corner, corner[::-1], corner[3:] + corner[:3]):
        assert (in_region(check_region(corners, ""), SIZE, X, Y) == expected).all()


@pytest.mark.parametrize(
    ("region", "message"),
    [
        ("middle", "no region 'middle'"),
        ("inner 0 %", "no region"),
        ("inner 120 %", "no region"),
        ([[1, 1], [2, 2]], "2 corners"),
        ([[1, 1], [2, 2], [3, float("nan")]], "not two numbers"),
        ([[1, 1], [2, 2], [3, 4, 5]], "not two numbers"),
    ],
)
def test_what_is_no_region_is_refused(region, message):
    with pytest.raises(InputError, match=message):
        check_region(region, "requirement 'r'")


def test_words_of_regions():
    assert region_words("whole") == ""
    assert region_words("inner 80 %") == " over the inner 80 %"
    assert region_words("upper left") == " over the upper left quadrant"
    assert region_words(((1, 1), (5, 1), (1, 5))) == " over a polygon of 3 corners"


def test_a_circle_is_the_pixels_within_its_radius():
    circle = check_region({"centre": [51, 26.0], "radius": 20}, "")
    assert (in_region(circle, SIZE, X, Y) == (np.hypot(X - 51, Y - 26) <= 20)).all()
    assert check_region(circle, "") == circle  # as files keep it
    assert region_words(circle) == " over the circle of radius 20 about (51, 26)"


@pytest.mark.parametrize(
    "wrong",
    [{"centre": [1, 2]}, {"centre": [1, 2], "radius": 0}, {"centre": [1], "radius": 1},
     {"centre": [1, 2], "radius": "wide"}, {"centre": [1, 2], "radius": 3, "unit": "mm"}],
)  # fmt: skip
def test_what_is_no_circle_is_refused(wrong):
    with pytest.raises(InputError, match=r"is no circle; give \{centre = \[x, y\], radius = r\}"):
        check_region(wrong, "detector.field")
