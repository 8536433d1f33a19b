"""Exposures made with numpy, each in a frame of its own kind: those frames are named."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.data import Matches
from bayesdist.diagnose.checks import frames_that_help
from bayesdist.model import Chip, DistortionModel, TimeDependence

SIZE, SIGMA = (1000, 800), 0.02
SIZES = {"shift": 20.0, "rotation": 3e-3, "scale": 3e-3, "shear": 3e-3}


def exposures(rng, *kinds, n=60, count=4):
    """Stars of exposures that differ by these; a tenth of the pairs are false."""
    columns = {name: [] for name in ("x", "y", "u", "v")}
    for _ in range(count):
        x, y = rng.uniform(1, SIZE[0], n), rng.uniform(1, SIZE[1], n)
        w = np.stack([x - 500.5, y - 400.5])
        w = w + 4e-6 * np.stack([w[0] * w[1], w[0] ** 2])
        a, s, p, c = (SIZES[k] * rng.normal() if k in kinds else 0.0
                      for k in ("rotation", "scale", "shear", "shear"))  # fmt: skip
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        w = turn @ np.array([[1 + s + p, c], [c, 1 + s - p]]) @ w
        w = w + (SIZES["shift"] * rng.normal(size=(2, 1)) if "shift" in kinds else 0.0)
        w = w + SIGMA * rng.normal(size=w.shape)
        w[:, : n // 10] += rng.uniform(-2, 2, (2, n // 10))
        for name, values in zip(columns, (x, y, *w), strict=True):
            columns[name].append(values)
    table = {name: np.concatenate(parts) for name, parts in columns.items()}
    return Matches(
        **table,
        unit="pix",
        exposure=np.repeat(np.arange(count), n),
        exposure_names=tuple(f"e{k}" for k in range(count)),
        epoch=np.repeat(2010.0 + np.arange(count), n),
    )


def model(matches, frames="none", **options):
    names = matches.exposure_names if frames != "none" else ("1",)
    chip = Chip(1, "A", SIZE, (500.5, 400.5))
    return DistortionModel(2, (chip,), unit="pix", frames=frames, exposures=names, **options)


@pytest.mark.parametrize(
    ("kinds", "frames"),
    [
        (("shift",), "shift"),
        (("shift", "rotation"), "shift_rotation"),
        (("shift", "rotation", "scale"), "shift_rotation_scale"),
        (("scale",), "shift_rotation_scale"),
        (("shift", "shear"), "affine"),
    ],
)
def test_the_frames_that_are_named_are_those_of_the_data(rng, kinds, frames):
    matches = exposures(rng, *kinds)
    found = frames_that_help(matches, model(matches))
    assert found is not None and found.frames == frames
    assert f"set model.frames = '{frames}'" in found.sentence and "'none'" in found.sentence
    # the median length of two normal numbers is 1.18 sigma; a tenth of the pairs are false
    assert found.scatter == pytest.approx(1.18 * SIGMA, rel=0.3)
    assert found.before > 2 * found.scatter
    assert frames_that_help(matches, model(matches, frames)) is None


def test_nothing_is_named_where_nothing_helps(rng):
    alike = exposures(rng)
    assert frames_that_help(alike, model(alike)) is None
    one = exposures(rng, "shift", count=1)
    assert frames_that_help(one, model(one)) is None
    few = exposures(rng, n=4)  # affine frames would take up all of their numbers
    assert frames_that_help(few, model(few)) is None


def test_frames_that_absorb_a_drift_are_not_named(rng):
    matches = exposures(rng, "shift", "rotation", "shear")
    time = TimeDependence((("u", 1, 0),), (2011.0,))
    found = frames_that_help(matches, model(matches, time=time))
    assert found is not None and found.frames in ("shift", "shift_rotation")
