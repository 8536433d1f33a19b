"""Structure in residuals is found where it is, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.stats import binom

from bayesdist.data import Matches
from bayesdist.diagnose.residuals.binned import binned_sums
from bayesdist.diagnose.residuals.misfit import (
    Misfit,
    misfit_of,
    misfits_of,
    partitions_for,
    residual_sums,
    worst_misfit,
)
from bayesdist.infer import OutlierMixture, Rejection, fit_linear, load, sample
from bayesdist.model import Chip, DistortionModel
from tests.reduced import case_in_full

SIZE = (1000.0, 800.0)


def _stars(n, rng):
    x, y = rng.uniform(0.5, 1000.5, n), rng.uniform(0.5, 800.5, n)
    return x, y, 0.05 * rng.standard_normal((n, 2)) * np.exp(0.5 * rng.normal(size=(n, 1)))


def _misfit(x, y, r, order=None):
    partitions = partitions_for(len(x))
    sums = {k: binned_sums(x, y, *r.T, bins=b, size=SIZE) for k, b in partitions.items()}
    return misfit_of(sums, order=order, unit="pix")


def test_noise_is_no_structure():
    """200 data sets of noise: no more than chance falls below one per cent."""
    rng = np.random.default_rng(1)
    p = []
    for _ in range(200):
        x, y, r = _stars(3000, rng)
        p.append(_misfit(x, y, r).p_value)
    p = np.array(p)
    assert (p < 0.01).sum() <= binom.ppf(0.999, 200, 0.01)
    assert p.min() > 1e-4


@pytest.mark.parametrize(
    "order", [case_in_full(k, instead="the highest is run") for k in (1, 4)] + [7]
)
def test_what_a_polynomial_leaves_of_noise_is_no_structure(order, full):
    """Data sets fitted by numpy: p-values are those of chance, in no partition too small."""
    rng, n = np.random.default_rng(order), 200 if full else 80
    p = []
    for _ in range(n):
        x, y, r = _stars(3000, rng)
        X, Y = (x - 500.5) / 500, (y - 400.5) / 400
        i, j = np.array([(i, j) for i in range(order + 1) for j in range(order + 1 - i)]).T
        design = legendre.legvander2d(X, Y, [order, order])[:, i * (order + 1) + j]
        left = r - design @ np.linalg.lstsq(design, r, rcond=None)[0]
        p.append(_misfit(x, y, left, order).p_value)
    p = np.array(p)
    for level in (0.01, 0.1, 0.3):
        # three tests share the probability: Bonferroni leaves them a little too careful
        assert (p < level).sum() <= binom.ppf(0.999, n, level)
    assert (p < 0.3).sum() >= binom.ppf(0.001, n, 0.2)


def test_structure_beside_noisy_cells_has_its_size():
    """A step of 4 mas either way in the quiet half of the detector, in arcsec; 20 data sets.

    In about half of them the cells of the noisy half scatter by less than their noise.
    """
    rng = np.random.default_rng(11)
    step, found = 0.004, []
    for _ in range(20):
        x, y = rng.uniform(0.5, 1000.5, 3000), rng.uniform(0.5, 800.5, 3000)
        noise = np.where(x < 500, 50.0, 0.01)[:, None]
        r = noise * rng.standard_normal((3000, 2)) + step * np.sign(y - 400)[:, None]
        found.append(replace(_misfit(x, y, r), unit="arcsec"))
    assert all(one.significant for one in found)
    hidden = [one for one in found if one.structure < 0.1]
    assert len(hidden) >= 3
    for one in hidden:
        assert one.structure == pytest.approx(np.sqrt(2) * step, rel=0.2)
        assert f" mas rms in {one.partition} of the detector, p = " in one.sentence


def test_a_step_in_a_column_is_found_with_its_size():
    rng = np.random.default_rng(2)
    x, y, r = _stars(6000, rng)
    r[:, 0] += np.where(np.abs(x - 700) < 20, 0.08, 0.0)
    found = _misfit(x, y, r)
    assert found.significant and found.partition == "columns"
    assert abs(found.structure - 0.08 * np.sqrt(0.04)) < 0.004  # 4 % of the columns
    assert "columns" in found.sentence and "pix" in found.sentence


def test_a_wave_over_the_field_is_found_in_cells():
    rng = np.random.default_rng(3)
    x, y, r = _stars(6000, rng)
    r[:, 1] += 0.03 * np.sin(x / 60) * np.sin(y / 60)
    found = _misfit(x, y, r)
    assert found.significant and found.partition == "cells"


@pytest.mark.parametrize("wave", [0.0, 0.1])
def test_false_pairs_within_the_clip_hide_nothing_from_a_posterior(rng, wave):
    """As of a ground-based camera: most pairs are false, and lie within 8 of the true position."""
    n, radius = 6000, 8.0
    model = DistortionModel(2, (Chip(1, "A", SIZE, (500.5, 400.5)),))
    x, y = rng.uniform(0.5, 1000.5, n), rng.uniform(0.5, 800.5, n)
    r = 0.1 * rng.standard_normal((n, 2))
    r[:, 1] += wave * np.sin(y / 15)
    false = rng.random(n) < 0.55
    turn, far = rng.uniform(0, 2 * np.pi, n), radius * np.sqrt(rng.random(n))
    r[false] = (far[:, None] * np.column_stack([np.cos(turn), np.sin(turn)]))[false]
    sigma = np.full(n, 0.1)
    table = Matches(x, y, x + r[:, 0], y + r[:, 1], sigma_u=sigma, sigma_v=sigma)
    fit = fit_linear(table, model, rejection=Rejection(1e6, clip_abs=6.0))
    mixture = OutlierMixture(model="uniform", match_radius=radius)
    posterior = sample(fit, table, outliers=mixture, target_ess=50, target_rhat=1.1)
    shards = load(model, table)
    (of_fit,), (found,) = (
        misfits_of(fit, *residual_sums(fit, shards, solution.likelihood))
        for solution in (fit, posterior)
    )
    shards.close()
    assert not of_fit.significant
    assert found.significant is bool(wave)
    if wave:
        assert found.structure == pytest.approx(wave / np.sqrt(2), rel=0.15)


def test_the_worst_of_several_chips_pays_for_their_number():
    """The smallest of n uniform probabilities is below p / n with probability p, about."""
    a, b = (Chip(k, name, SIZE, (1.0, 1.0)) for k, name in ((1, "A"), (2, "B")))
    found = [Misfit(0.3, "cells", 0.01, "pix", a), Misfit(2e-5, "rows", 0.02, "pix", b)]
    worst = worst_misfit(found)
    assert (worst.chip, worst.p_value, worst.partition) == (b, 4e-5, "rows")
    assert worst.significant and "of chip B" in worst.sentence
    assert worst_misfit(found[:1]) == found[0]
    # both beyond what a double holds: the larger structure is named
    gone = [Misfit(0.0, "cells", 0.01, "pix", a), Misfit(0.0, "cells", 0.03, "pix", b)]
    assert worst_misfit(gone).chip == b
    rng = np.random.default_rng(4)
    p = [
        worst_misfit([Misfit(q, "cells", 0.0, "pix", a) for q in rng.uniform(size=5)]).p_value
        for _ in range(2000)
    ]
    low, high = binom.ppf([0.001, 0.999], 2000, 0.1)
    # 1 - (1 - p / n)^n: a little less than p
    assert low - 0.005 * 2000 <= (np.array(p) < 0.1).sum() <= high


def test_the_detector_is_named_where_there_is_one_chip():
    assert "of the detector," in Misfit(0.0, "cells", 0.1, "pix").sentence
