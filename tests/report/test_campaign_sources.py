"""What is put together for the report of a campaign, from data of known truth."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bayesdist.app.parts import StoredLookupTables
from bayesdist.app.stars import ErrorLaw
from bayesdist.data import Matches
from bayesdist.diagnose.overlap import _at_first_epoch, align, chosen_exposures
from bayesdist.infer.nodes.residuals import inside_chips
from bayesdist.kinds.campaign.report.prepared import _residuals
from bayesdist.model import Chip, DistortionModel, LookupTable, corrected

SIZE = (1024.0, 512.0)
SIGMA = 0.004


def turned(xy, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return xy @ np.array([[c, -s], [s, c]]).T


def rolled_pairs(tables, n=4000, rolls=(0.0, 100.0, 190.0, 275.0), seed=3, margin=0.5):
    """One detector with a pattern, seen at several rolls."""
    rng = np.random.default_rng(seed)
    exposure = np.repeat(np.arange(len(rolls)), n)
    x, y = (rng.uniform(0.5 + margin, s + 0.5 - margin, exposure.size) for s in SIZE)
    flat = np.column_stack(corrected(tables, x, y, chip=1))
    uv = np.concatenate([turned(flat[exposure == k], roll) for k, roll in enumerate(rolls)])
    uv += SIGMA * rng.standard_normal(uv.shape)
    sigma = np.full(exposure.size, SIGMA)
    return Matches(
        x, y, *uv.T, sigma_u=sigma, sigma_v=sigma, unit="pix", exposure=exposure,
        exposure_names=tuple(f"e{k}" for k in range(len(rolls))), chip_numbers=(1,),
    )  # fmt: skip


@pytest.mark.parametrize("margin", [0.5, 0.0], ids=["inside", "up to the edges"])
def test_residuals_show_the_pattern_of_the_detector_whatever_the_roll(margin):
    rng = np.random.default_rng(1)
    values = 0.08 * rng.standard_normal((2, 8, 16))
    gx, gy = np.meshgrid(np.linspace(-1, 1, 16), np.linspace(-1, 1, 8))
    A = np.stack([np.ones_like(gx), gx, gy, gx**2, gx * gy, gy**2], -1).reshape(-1, 6)
    flat = values.reshape(2, -1)
    # without what a polynomial of order 2 could follow
    values = (flat - (A @ np.linalg.lstsq(A, flat.T)[0]).T).reshape(values.shape)
    table = LookupTable(1, values)
    pairs = rolled_pairs([table], margin=margin)
    x, y = corrected([table], pairs.x, pairs.y, chip=1)
    chip = Chip(1, "CCD", SIZE, (512.0, 256.0))
    model = DistortionModel(2, (chip,), frames="affine", exposures=pairs.exposure_names)
    moved = pairs.with_columns(x=x, y=y)
    kept = inside_chips(moved, model)
    assert kept.all() == (margin > 0)
    config = SimpleNamespace(
        fit=SimpleNamespace(clip_abs=2.0), model=SimpleNamespace(order=2), chips=lambda: (chip,)
    )
    run = SimpleNamespace(
        inputs=SimpleNamespace(config=config),
        stars=pairs,
        matches=moved.select(kept),
        tables=StoredLookupTables((table,)),
        errors=ErrorLaw(),
        model=model,
    )
    (found,) = _residuals(run)
    pairs = pairs.select(kept)
    without, after = found.binned_without, found.binned_with
    shift = table.evaluate(pairs.x, pairs.y)
    column, row = (np.floor((a - 0.5) / 64).astype(int) for a in (pairs.x, pairs.y))
    cells = row * 16 + column
    count = np.bincount(cells, minlength=128)
    for k, mean in enumerate((without.mean_u, without.mean_v)):
        expected = (np.bincount(cells, shift[:, k], 128) / count).reshape(8, 16)
        # the polynomial follows a little of the pattern, as stars do not stand at the nodes
        assert np.corrcoef(mean.ravel(), expected.ravel())[0, 1] > 0.98
        assert np.std(mean - expected) < 0.15 * np.std(expected)
    pull = np.stack([after.mean_u / after.sem_u, after.mean_v / after.sem_v])
    assert abs(np.mean(pull**2) - 1) < 5 * np.sqrt(2 / pull.size)
    assert found.with_tables is not None
    assert found.with_tables.std() == pytest.approx(SIGMA, rel=0.05)


def shared_pairs(stars, epochs):
    """Exposures that see the stars of the given numbers."""
    exposure = np.repeat(np.arange(len(stars)), [len(s) for s in stars])
    star = np.concatenate(stars)
    here = 0.0 * star
    names = tuple(f"e{k}" for k in range(len(stars)))
    return Matches(
        here + 1, here + 1, star + 0.0, here, unit="pix", exposure=exposure, star=star,
        exposure_names=names, epoch=np.asarray(epochs)[exposure],
    )  # fmt: skip


def test_the_two_exposures_farthest_apart_that_overlap_well_are_chosen():
    every = np.arange(400)
    pairs = shared_pairs(
        [every[:300], every[:250], every[100:], every[350:]], [2010.0, 2003.0, 2012.0, 2014.0]
    )
    # e3 lies farthest off but shares 50 stars at most; e1 and e2 share 150 of 250
    assert chosen_exposures(pairs) == (1, 2)


def test_exposures_that_share_too_little_are_not_laid_on_each_other():
    assert (
        chosen_exposures(shared_pairs([np.arange(200), np.arange(150, 350)], [2003.0, 2010.0]))
        is None
    )
    one_date = shared_pairs([np.arange(200), np.arange(200)], [2003.0, 2003.0])
    assert chosen_exposures(one_date) is None


def test_motions_of_the_catalogue_are_taken_out_along_the_axes_of_the_exposure():
    rng = np.random.default_rng(7)
    first = rng.uniform(0, 4000, (500, 2))  # catalogue, pixels
    motion = 0.3 * rng.standard_normal((500, 2))
    then = first + motion
    plane_a, plane_b = turned(first, 20.0) * 0.05, turned(then, 250.0) * 0.05  # arcseconds
    pairs = Matches(then[:, 0], then[:, 1], then[:, 0], then[:, 1], unit="pix")
    moved = _at_first_epoch(plane_b, pairs, np.arange(500), motion)
    assert np.sqrt(np.mean(align(plane_a / 0.05, plane_b / 0.05).rms ** 2)) > 0.2
    assert np.abs(align(plane_a / 0.05, moved / 0.05).residual).max() < 1e-8
