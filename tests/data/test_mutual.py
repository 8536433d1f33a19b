"""Exposures brought onto the first one: shifts and rolls that were put in, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.data.mutual import mutual_frames, refuse_duplicates
from bayesdist.errors import InputError


def _lists(rng, pointings, n=6000, half=300.0):
    """Stars of one field seen through square windows at some pointings (x, y, roll)."""
    stars = rng.uniform(-1500, 1500, (n, 2))
    mag = rng.uniform(10, 18, n)
    planes, mags = [], []
    for x, y, roll in pointings:
        c, s = np.cos(roll), np.sin(roll)
        own = (stars - [x, y]) @ np.array([[c, -s], [s, c]])
        seen = (np.abs(own) < half).all(axis=1)
        planes.append(own[seen] + 0.02 * rng.normal(size=(seen.sum(), 2)))
        mags.append(mag[seen])
    return planes, mags


def test_shift_and_roll_are_found(rng):
    pointings = [(0, 0, 0), (150, -80, 1.0), (330, 60, np.pi), (-40, 500, -0.7)]
    planes, mags = _lists(rng, pointings)
    found = mutual_frames(planes, mags, ["a", "b", "c", "d"])
    for e, (x, y, roll) in enumerate(pointings):
        turned = np.angle(np.exp(1j * (found.rotations[e] - roll)))
        assert abs(turned) < 1e-4
        # good enough to link detections within a pixel, wherever the overlap lies
        assert np.hypot(*(found.shifts[e] - [x, y])) < 0.2


def test_groups_without_common_stars_are_named(rng):
    pointings = [(0, 0, 0), (1100, 1100, 0), (100, 0, 0.3), (1000, 1050, 0)]
    planes, mags = _lists(rng, pointings)
    with pytest.raises(InputError, match=r"2 groups .*\(a, c\); \(b, d\)"):
        mutual_frames(planes, mags, ["a", "b", "c", "d"])


def test_a_duplicated_exposure_is_named(rng):
    planes, _ = _lists(rng, [(0, 0, 0), (50, 0, 0)])
    with pytest.raises(InputError, match="a and c have the same detections"):
        refuse_duplicates([planes[0], planes[1], planes[0][:-3]], ["a", "b", "c"])
    refuse_duplicates(planes, ["a", "b"])
