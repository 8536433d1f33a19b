"""Exposures brought onto the first one: shifts and rolls that were put in, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import InputError
from bayesdist.kinds.selfcal.grouping import mutual_frames, refuse_duplicates

SIGMA = 0.02  # px
DENSITY = 6000 / 3000.0**2  # stars in a square pixel


def _lists(rng, pointings, n=6000, half=300.0):
    """Stars of one field seen through square windows at some pointings (x, y, roll)."""
    stars = rng.uniform(-1500, 1500, (n, 2))
    mag = rng.uniform(10, 18, n)
    planes, mags = [], []
    for x, y, roll in pointings:
        c, s = np.cos(roll), np.sin(roll)
        own = (stars - [x, y]) @ np.array([[c, -s], [s, c]])
        seen = (np.abs(own) < half).all(axis=1)
        planes.append(own[seen] + SIGMA * rng.normal(size=(seen.sum(), 2)))
        mags.append(mag[seen])
    return planes, mags


def _near_first(rng, x, y, roll, half=300.0):
    """Points that the first window, about zero, and another see: on the sky, and in the other."""
    sky = rng.uniform(-half, half, (2000, 2))
    c, s = np.cos(roll), np.sin(roll)
    own = (sky - [x, y]) @ np.array([[c, -s], [s, c]])
    seen = (np.abs(own) < half).all(axis=1)
    return sky[seen], own[seen]


def test_shift_and_roll_are_found(rng):
    pointings = [(0, 0, 0), (150, -80, 1.0), (330, 60, np.pi), (-40, 500, -0.7)]
    planes, mags = _lists(rng, pointings)
    found = mutual_frames(planes, mags, ["a", "b", "c", "d"])
    for e, (x, y, roll) in enumerate(pointings):
        turned = np.angle(np.exp(1j * (found.rotations[e] - roll)))
        assert abs(turned) < 1e-4
        # three numbers for each axis from stars of the overlap that both lists have with their
        # errors: mean square 2 sigma^2 3 / n there; the others' stars it has by way of others
        sky, own = _near_first(rng, x, y, roll)
        off = own @ found.matrices[e].T + found.shifts[e] - sky
        n = DENSITY * 600.0**2 * len(sky) / 2000
        assert np.sqrt((off**2).mean()) < 3 * SIGMA * np.sqrt(6 / n)


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
