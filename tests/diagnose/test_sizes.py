"""Where the model describes the data: probabilities that are even, and no alarms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesdist.diagnose import score_tests
from bayesdist.diagnose.score.result import corrected

from .. import seeds
from ..infer.support import columns_of, truth_of
from .support import (
    SIGMA,
    Scene,
    assert_even,
    assert_no_smaller_than_chance,
    by_name,
    scenes_of_null,
)
from .test_results import outcome

pytestmark = pytest.mark.usefixtures("one_thread")

NULL = dict(scenes_of_null())
# by construction: those that look at several radii, lengths, columns or centres; one that asks two
# tests to agree (edges alone, and edges beside the orders); one that counts overlapping patches as
# if they were apart; one whose statistic is positive for all noise that is a mixture of Gaussians;
# and one that compares with several kinds of noise
CONSERVATIVE = {"truncation", "edges", "fields of exposures", "jumps"}
CONSERVATIVE |= {"skewness of a patch", "two cores", "displaced group of stars", "rings"}


def p_values(name: str, seed: int) -> tuple[dict[str, float], bool]:
    # a radius that might have cut, and has not
    found = NULL[name].tests(seed, match_radius=2.5 * SIGMA if seed % 2 else None)
    found.pop("match radius", None)  # false matches lie beyond it, so that it is not the right one
    return {k: one.p_value for k, one in found.items()}, any(k.significant for k in found.values())


@pytest.mark.slow
def test_probabilities_are_even_and_alarms_are_rare(full):
    """Over all kinds of data: of 1 % at most 1 %, and one in a thousand has any finding."""
    names, runs = list(NULL), 400 if full else 2
    jobs = [(name, seed) for name in names for seed in range(runs)]
    found = seeds.over(p_values, jobs, lot=10) if full else [p_values(*job) for job in jobs]
    pooled: dict[str, list[float]] = {}
    for (scene, _), (values, _) in zip(jobs, found, strict=True):
        for test, p in values.items():
            pooled.setdefault(test.rstrip("0123456789"), []).append(p)
            if full:
                pooled.setdefault(f"{scene}: {test}", []).append(p)
    for test, values in pooled.items():
        p = np.array(values)
        assert_no_smaller_than_chance(test, p)
        if ":" not in test and test not in CONSERVATIVE:
            # even, not only rare: at 25 stars and 15 parameters a bit less
            assert_even(test, p)
            beyond = int((p < 0.1).sum())
            assert stats.binom.cdf(beyond, len(p), 0.07) > 1e-3, (test, beyond, len(p))
    alarms = sum(alarm for _, alarm in found)
    assert stats.binom.sf(alarms - 1, len(jobs), 1e-3) > 1e-3, alarms


def few(seed: int) -> bool:
    return any(one.significant for one in Scene(25, 1).tests(seed).values())


@pytest.mark.slow
def test_twenty_five_stars_give_no_false_alarm(full):
    runs = 3000 if full else 40
    jobs = [(seed,) for seed in range(1000, 1000 + runs)]
    alarms = sum(seeds.over(few, jobs, lot=100) if full else [few(*job) for job in jobs])
    assert stats.binom.sf(alarms - 1, runs, 1e-3) > 1e-3, alarms


def test_stars_in_many_exposures_share_the_errors_of_their_references():
    """150 stars in 20 exposures are 150 errors of a catalogue, not 3000."""
    said = {"star": [], "none": []}
    for seed in range(5):
        for kind, found in with_catalogue_errors(seed).items():
            said[kind].append(found)
    own = np.array([[one["order 3"].p_value, one["exposures"].p_value] for one in said["star"]])
    assert (own > 1e-3).all()
    assert 0.2 < own[:, 1].mean() < 0.8
    # without their codes: alarms of the first, no power of the other
    blind = np.array([[one["order 3"].p_value, one["exposures"].p_value] for one in said["none"]])
    assert np.median(blind[:, 0]) < 1e-3
    assert blind[:, 1].min() > 0.3


def with_catalogue_errors(seed: int):
    exposures, stars = 20, 150
    scene = Scene(exposures * stars, 2, "shift_rotation", exposures)
    model, table = scene.data(seed)
    rng = np.random.default_rng([19, seed])
    x, y = (np.tile(rng.uniform(5, n - 5, stars), exposures) for n in (1000.0, 800.0))
    x, y = (z + rng.normal(0, 1, len(z)) for z in (x, y))
    table = table.with_columns(x=x, y=y)
    error = SIGMA * rng.standard_normal((stars, 2)) * 0.8
    uv = model.predict(truth_of(model, rng), x, y, **columns_of(table))
    uv += np.tile(error, (exposures, 1)) + 0.6 * SIGMA * rng.standard_normal(uv.shape)
    table = table.with_columns(u=uv[:, 0], v=uv[:, 1], epoch=None, mag=None, colour=None)
    out = {}
    for kind, codes in (("none", None), ("star", np.tile(np.arange(stars), exposures))):
        one = table.with_columns(star=codes)
        out[kind] = by_name(score_tests(one, scene.solve(model, one)))
    return out


def test_false_alarms_of_a_family_are_held_by_holm():
    """Twenty tests of nothing at the family's level, and what single tests would have said."""
    rng = np.random.default_rng(4)
    p = rng.uniform(size=(20_000, 20))
    level = 1e-3
    family = np.mean([any(t.significant for t in corrected([outcome(x) for x in row]))
                      for row in p[:2000] * 0.05])  # fmt: skip
    # 2000 families of p below 0.05: a fraction of 20 * level / 20 / 0.05 has a finding
    assert abs(family - (1 - (1 - level / 20 / 0.05) ** 20)) < 0.01
    assert (p.min(axis=1) < level).mean() > 10 * level
