"""Epochs that are wrong show in the residuals of stars that move."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.data import MatchTable
from bayesdist.diagnose.epoch_shift import epoch_shift
from bayesdist.infer import build_model, fit_linear

SIGMA, PM = 0.02, 0.012  # arcsec, and arcsec per year


def stars(years, seed, n=400, exposures=1):
    """Matches on a plane with a distortion of second order, `years` away from the catalogue."""
    rng = np.random.default_rng(seed)
    xi, eta = rng.uniform(-100, 100, (2, n))
    pm = rng.normal(0, PM, (2, n))
    parts = []
    for k in range(exposures):
        u = np.array([xi, eta]) + years * pm + rng.normal(0, SIGMA, (2, n))
        u[0, : n // 20] += rng.normal(0, 3.0, n // 20)  # false matches
        x = 500 + 4 * u[0] + 1e-4 * u[1] ** 2
        y = 500 + 4 * u[1] - 2e-4 * u[0] * u[1]
        parts.append((x, y, np.full(n, k)))
    x, y, exposure = (np.concatenate(column) for column in zip(*parts, strict=True))
    many = np.tile([xi, eta, *pm], exposures)
    return MatchTable(x, y, many[0], many[1], np.full(len(x), SIGMA), np.full(len(x), SIGMA),
                      unit="arcsec", pm_u=many[2], pm_v=many[3], exposure=exposure,
                      exposure_names=tuple(map(str, range(exposures))))  # fmt: skip


def found(table):
    model = build_model(table, order=3, size=(1000, 1000))
    return epoch_shift(table, fit_linear(table, model))


@pytest.mark.parametrize("exposures", [1, 3])
def test_the_shift_is_found_with_its_error(exposures):
    """Pulls over many fields of stars; the errors of a field's stars differ between exposures."""
    results = [found(stars(-9.9, seed, exposures=exposures)) for seed in range(40)]
    pull = np.array([(one.years + 9.9) / one.sigma for one in results])
    assert abs(pull.mean()) < 3.5 / np.sqrt(40) and 0.7 < pull.std() < 1.4
    assert all(one.significant for one in results)
    one = results[0]
    # sigma from the motions alone: a closed form
    expected = SIGMA / PM / np.sqrt(2 * 0.95 * 400 * exposures)
    assert one.sigma == pytest.approx(expected, rel=0.2)
    assert one.after == pytest.approx(SIGMA, rel=0.15)
    assert one.before == pytest.approx(np.hypot(SIGMA, 9.9 * PM), rel=0.3)
    assert "before the epoch that the reference positions have" in one.sentence


def test_right_epochs_are_left_alone():
    assert not any(found(stars(0.0, seed)).significant for seed in range(40))


def test_without_motions_there_is_nothing_to_find():
    table = stars(-9.9, 1)
    no = {name: None for name in ("pm_u", "pm_v")}
    assert found(table._with(**no)) is None
    still = table._with(pm_u=np.zeros(400), pm_v=np.zeros(400))
    assert found(still) is None
