"""Turned models against the turned positions that they predict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.model.alignment import turned, turned_model

CHIPS = tuple(Chip(n, f"WFC{n}", (4096.0, 2048.0), (2048.0, 1024.0)) for n in (2, 1))
ONE_AXIS = TimeDependence((("u", 1, 0), ("v", 1, 1)), (2004.5, 2012.5), (2009.4,))
BOTH_AXES = TimeDependence((("v", 0, 1), ("u", 1, 0), ("u", 0, 1)), (2004.5,))
EPOCHS = (2003.0, 2009.3, 2014.0)


@pytest.mark.parametrize("time", [None, ONE_AXIS, BOTH_AXES])
def test_positions_turn_with_the_model_at_every_epoch(time):
    rng = np.random.default_rng(3)
    model = DistortionModel(3, CHIPS, "mas", time)
    theta = rng.normal(size=model.n_params)
    turn, shift = 0.05 * np.exp(0.7j), 3.0 - 40.0j
    new, moved = turned_model(model), turned(model, theta, turn, shift)
    x, y = rng.uniform(1, 4096, 40), rng.uniform(1, 2048, 40)
    for chip in (1, 2):
        for epoch in EPOCHS:
            u, v = model.predict(theta, x, y, epoch=epoch, chip=chip).T
            expected = shift + turn * (u + 1j * v)
            found = new.predict(moved, x, y, epoch=epoch, chip=chip)
            assert_allclose(found @ [1, 1j], expected, rtol=0, atol=1e-11)


def test_each_draw_has_a_turn_of_its_own():
    rng = np.random.default_rng(4)
    model = DistortionModel(2, CHIPS, "mas", ONE_AXIS)
    theta = rng.normal(size=(5, model.n_params))
    turn = np.exp(1j * rng.normal(size=5))
    shift = rng.normal(size=(2, 5)).T @ [1, 1j]
    together = turned(model, theta, turn, shift)
    alone = [turned(model, *each) for each in zip(theta, turn, shift, strict=True)]
    assert_allclose(together, alone, rtol=1e-14, atol=1e-15)


def test_turning_back_gives_the_model_again():
    """What one axis has taken over from the other is gone: only the names of zeros are left."""
    rng = np.random.default_rng(5)
    model = DistortionModel(2, CHIPS, "mas", ONE_AXIS)
    theta = rng.normal(size=model.n_params)
    turn, shift = 2.0 * np.exp(-1.1j), 5.0 + 1.0j
    once = turned_model(model)
    back = turned(once, turned(model, theta, turn, shift), 1 / turn, -shift / turn)
    assert turned_model(once) == once
    named = dict(zip(once.names, back, strict=True))
    for name, value in zip(model.names, theta, strict=True):
        assert named.pop(name) == pytest.approx(value, abs=1e-13)
    assert_allclose(list(named.values()), 0.0, atol=1e-13)
    assert replace(once, time=model.time) == model
