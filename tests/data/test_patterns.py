from __future__ import annotations

import time

import numpy as np
import pytest

from bayesdist.data.matching.similarity import find_similarity, pattern_index
from bayesdist.errors import InputError
from bayesdist.formats.hst1pass import read_matchup
from tests.data.sky import frame, positions

N, SIDE = 50_000, 10_000.0


@pytest.fixture(scope="module")
def field():
    uv, mag = positions(np.random.default_rng(47), N, SIDE)
    return uv, mag, pattern_index(uv, mag)


def error_of(similarity, p, rows, uv):
    real = rows >= 0
    return np.hypot(*(similarity(p[real]) - uv[rows[real]]).T)


@pytest.mark.parametrize("left", [1.0, 5.0])
@pytest.mark.parametrize("junk", [0.1, 0.3])
def test_any_roll_anywhere(field, rng, left, junk):
    uv, mag, index = field
    for _ in range(8):
        roll, centre = rng.uniform(0, 2 * np.pi), rng.uniform(2500, 7500, 2)
        p, m, rows = frame(rng, uv, mag, roll, centre, junk=junk, left=left)
        found = find_similarity(p, index, mag=m)
        turned = (found.rotation - np.degrees(roll) + 180) % 360 - 180
        assert abs(turned) < 0.3
        assert found.scale == pytest.approx(1.0, abs=0.005)
        # what the distortion leaves, and no more than a few times that
        assert np.median(error_of(found, p, rows, uv)) < 2.0 + left
        assert found.found > 3 * found.expected


def test_a_frame_that_hangs_over_the_edge(field, rng):
    uv, mag, index = field
    p, m, rows = frame(rng, uv, mag, 2.0, np.array([300.0, 5000.0]))
    found = find_similarity(p, index, mag=m)
    assert np.median(error_of(found, p, rows, uv)) < 3.0


@pytest.mark.parametrize("missing", [2000, 6000])
def test_the_brightest_stars_may_all_be_missing(field, rng, missing):
    uv, mag, index = field
    kept = mag > np.sort(mag)[missing]  # saturated stars that cuts have left out
    p, m, _ = frame(rng, uv[kept], mag[kept], 1.0, np.array([5000.0, 5000.0]), junk=0.3)
    found = find_similarity(p, index, mag=m)
    assert found.rotation == pytest.approx(np.degrees(1.0), abs=0.3)


def test_without_magnitudes_all_stars_take_part(field, rng):
    uv, mag, _ = field
    p, _, rows = frame(rng, uv, mag, 4.0, np.array([5000.0, 5000.0]))
    found = find_similarity(p, pattern_index(uv))
    assert np.median(error_of(found, p, rows, uv)) < 3.0


def test_mirror_images_are_found_only_when_they_are_asked_for(field, rng):
    uv, mag, index = field
    p, m, rows = frame(rng, uv, mag, 4.0, np.array([5000.0, 5000.0]))
    turned_over = p * [1.0, -1.0]
    found = find_similarity(turned_over, index, mag=m, mirrored=True)
    assert np.median(error_of(found, turned_over, rows, uv)) < 3.0
    assert np.linalg.det(found.map.matrix) == pytest.approx(-1.0, abs=0.01)


def test_scales_outside_the_range_are_no_match(rng):
    uv, mag = positions(rng, 3000, 3000.0)
    index = pattern_index(uv, mag)
    p, m, _ = frame(rng, uv, mag, 0.7, np.array([1500.0, 1500.0]), left=0.0)
    found = find_similarity(p * 20.0, index, mag=m, scale=(0.045, 0.055))  # mas to pixels
    assert found.scale == pytest.approx(0.05, rel=1e-3)
    with pytest.raises(InputError, match="does not match"):
        find_similarity(p * 1.2, index, mag=m)


def test_a_wrong_field_is_refused_with_the_best_count(rng):
    uv, mag = positions(rng, 3000, 6000.0)
    other, other_mag = positions(rng, 3000, 6000.0)
    p, m, _ = frame(rng, other, other_mag, 1.0, np.array([3000.0, 3000.0]))
    message = r"j1\.list: does not match cat: .* bring together \d+ stars, while chance gives"
    with pytest.raises(InputError, match=message):
        find_similarity(p, pattern_index(uv, mag), mag=m, source="j1.list", reference_name="cat")


def test_few_stars_are_enough(rng):
    uv = rng.uniform(0, 1000, (40, 2))
    found = find_similarity(uv[:25] @ np.array([[0.0, -1.0], [1.0, 0.0]]), pattern_index(uv))
    np.testing.assert_allclose(found(uv[:25] @ np.array([[0.0, -1.0], [1.0, 0.0]])), uv[:25])
    with pytest.raises(InputError, match="fewer than three"):
        find_similarity(uv[:2], pattern_index(uv))
    with pytest.raises(InputError, match="give a range"):
        find_similarity(uv, pattern_index(uv), scale=(1.0, 1.0))


def test_it_takes_tenths_of_a_second(field, rng):
    uv, mag, index = field
    frames = [
        frame(rng, uv, mag, rng.uniform(0, 6), rng.uniform(3000, 7000, 2), left=5.0, junk=0.3)
        for _ in range(5)
    ]
    find_similarity(frames[0][0], index, mag=frames[0][1])  # the index makes its triangles once
    begin = time.process_time()
    for p, m, _ in frames:
        find_similarity(p, index, mag=m)
    assert (time.process_time() - begin) / len(frames) < 0.3


def test_three_rolls_of_a_real_cluster_close_a_triangle(data_dir):
    # observatory-corrected lists of years apart, whose rolls nobody tells
    lists = [
        read_matchup(data_dir / "flystar" / f"{day}_F606W_MATCHUP_XYMEEE_final.calib")
        for day in ("2011_10_31", "2012_09_25", "2013_10_24")
    ]
    p = [np.column_stack([one.u, one.v]) for one in lists]

    def to(a, b):
        return find_similarity(p[a], pattern_index(p[b], lists[b].mag), mag=lists[a].mag)

    grid = np.array([[300.0, 300.0], [1000.0, 1700.0], [1700.0, 900.0]])
    np.testing.assert_allclose(to(1, 2)(to(0, 1)(grid)), to(0, 2)(grid), atol=0.1)
    assert to(0, 1).rotation == pytest.approx(8.0, abs=0.2)
    assert (to(0, 1).rotation + to(1, 0).rotation) % 360 == pytest.approx(0.0, abs=0.01)
