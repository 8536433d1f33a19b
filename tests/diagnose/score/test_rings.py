"""Rings about a centre inside or outside the detector."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.diagnose.checks import score_checks
from tests.diagnose.support import assert_no_smaller_than_chance

from .shaped import SIDE, examined, matches_of, scaled, scene, student, unequal

pytestmark = pytest.mark.usefixtures("one_thread")


def rings(centre: tuple[float, float], unit: float, size: float):
    """Radial displacements, whose n-th ring lies at the radius unit * sqrt(2 n)."""

    def displaced(rng, x, y):
        away = np.stack([x, y], axis=1) - centre
        r = np.hypot(*away.T)[:, None]
        return size * np.sin(np.pi * (r / unit) ** 2 + 1.0) * away / r

    return displaced


@pytest.mark.parametrize(
    ("centre", "unit", "size"), [((-200.0, -300.0), 400.0, 0.006), ((900.0, 1200.0), 300.0, 0.007)]
)
def test_rings_are_found_with_their_centre_and_size(centre, unit, size):
    found = examined(scene(np.random.default_rng(4), 3000, rings(centre, unit, size), false=0.0))
    test = found["rings"]
    assert test.significant and test.p_value < 1e-5
    named = test.finding.split("pixel (")[1].split(")")[0].split(", ")
    assert np.hypot(*(np.array(named, float) - centre)) < 120
    closest, widest = (
        float(word) for word in test.finding.split("), ")[1].split(" pixels")[0].split(" to ")
    )
    # at the radius r rings are unit^2 / r apart
    at = np.random.default_rng(1).uniform(0.5, SIDE, (2000, 2))
    apart = unit**2 / np.hypot(*(at - centre).T)
    assert [closest, widest] == pytest.approx(np.percentile(apart, [5, 95]), rel=0.15)
    assert 0.6 * size / np.sqrt(2) < test.size < 1.3 * size / np.sqrt(2)
    check = next(check for check in score_checks(list(found.values())) if "rings" in check.name)
    assert check.doubt and "a higher order does not help" in check.sentence


NOISE = {
    "even": {"false": 0.04},
    "false": {"false": 0.35},
    "tails": {"noise": student, "false": 0.0},
    "unequal": {"noise": unequal},
}


@pytest.mark.parametrize("shape", [*NOISE, "repeated"])
def test_noise_alone_forms_no_rings(shape, full):
    n, p = 100 if full else 2, []
    for seed in range(n):
        rng = np.random.default_rng([17, seed])
        table = scene(rng, 400, **NOISE.get(shape, {}))
        if shape == "repeated":  # each star four times: its rows are no news of each other
            rows = np.tile(np.arange(400), 4)
            x, y = np.stack([table.x, table.y])[:, rows] + rng.normal(0, 0.005, (2, len(rows)))
            x, y = np.clip([x, y], 1, SIDE)
            table = matches_of(x, y, np.stack([table.u, table.v], axis=1)[rows], star=rows)
        p.append(examined(table)["rings"].p_value)
    assert_no_smaller_than_chance("rings", np.array(p))


def test_a_missing_order_forms_no_rings():
    def displaced(rng, x, y):
        return 0.05 * np.stack([scaled(x) ** 5, scaled(x) ** 4], axis=1)

    found = examined(scene(np.random.default_rng(5), 3000, displaced))
    assert not found["rings"].significant
