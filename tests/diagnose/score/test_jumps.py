"""Residuals that differ on both sides of a column or a row."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.diagnose.checks import score_checks
from tests.diagnose.support import assert_no_smaller_than_chance

from .shaped import SIDE, examined, matches_of, scene, student, unequal

pytestmark = pytest.mark.usefixtures("one_thread")

STEP = np.array([0.024, -0.018])  # 0.03 pixels


@pytest.mark.parametrize(("axis", "edge"), [(0, 870.0), (1, 1365.0)])
def test_a_jump_is_found_with_its_place_and_size(axis, edge):
    def displaced(rng, x, y):
        return np.where(((x, y)[axis] > edge)[:, None], STEP, 0.0)

    found = examined(scene(np.random.default_rng(4), 3000, displaced))
    jump = found["jumps"]
    assert jump.significant and jump.p_value < 1e-8
    place = "column" if axis == 0 else "row"
    said = float(jump.finding.split(f"near {place} ")[1].split()[0])
    assert abs(said - edge) <= SIDE / 32
    # a step that is off by up to a cell looks smaller, by up to a third
    assert jump.size == pytest.approx(np.hypot(*STEP) / 2, rel=0.4)
    check = next(check for check in score_checks(list(found.values())) if "jumps" in check.name)
    assert check.doubt and "a higher order does not help" in check.sentence


@pytest.mark.parametrize("shape", ["even", "repeated", "tails", "unequal"])
def test_noise_alone_does_not_jump(shape, full):
    n, p = 100 if full else 4, []
    for seed in range(n):
        rng = np.random.default_rng([8, seed])
        noise = {"tails": student, "unequal": unequal}.get(shape)
        table = scene(rng, 500, **({} if noise is None else {"noise": noise}))
        if shape == "repeated":  # each star four times: its rows are no news of each other
            rows = np.tile(np.arange(500), 4)
            x, y = np.stack([table.x, table.y])[:, rows] + rng.normal(0, 0.005, (2, len(rows)))
            x, y = np.clip([x, y], 1, SIDE)
            table = matches_of(x, y, np.stack([table.u, table.v], axis=1)[rows], star=rows)
        p.append(examined(table)["jumps"].p_value)
    assert_no_smaller_than_chance("jumps", np.array(p))


def test_a_missing_order_is_no_jump():
    def displaced(rng, x, y):
        z = 2 * x / SIDE - 1
        return 0.05 * np.stack([z**5, z**4], axis=1)

    assert examined(scene(np.random.default_rng(5), 3000, displaced))["jumps"].p_value > 1e-3
