"""What runs claim of truths outside the family; the full table is in docs/validation.md.

One process makes it in an hour or two; pieces that were made before are taken from the file that
BAYESDIST_ADVERSARIAL names, as `python -m tests.adversarial` writes it.
"""

from __future__ import annotations

import pytest

from . import KINDS
from .goals import MOST_FALSE_MET, MOST_MISLED, row_of, rows_of, table_of
from .measure import results_of

pytestmark = pytest.mark.slow

# of all groups, what is quickly made and was called met most often before
REDUCED = {
    "inside_1500": 1,
    "smooth_270": 1,
    "catalogue_unlisted": 1,
    "drift_two_dates": 1,
    "merged_visits_150": 1,
    "second_order_005_single": 1,
}
SEEDS = 20

# Kinds that are known to cover too little while verdicts are given, each explained in
# docs/validation.md: what cannot be seen, what the user states wrongly, errors of one size and
# sign, and what is found and only in part held. No other kind may join them.
TOO_LITTLE = {
    "tree_rings",
    "blends",
    "wrong_epochs",
    "one_order_more_10",
    "selfcal_lithography_300",
    "drift_curved",
    "campaign_curved",
    "lithography_300",
    "edges",
    "campaign_gap",
}


# Kinds of which more than one truth in twenty is called met where it misses: not seen, or believed
# because the user states it. No other kind may join them.
FALSELY_MET = {"tree_rings", "wrong_epochs", "edges", "catalogue_listed"}


@pytest.fixture(scope="module")
def results(full):
    if full:
        return results_of((name, seed) for name in KINDS for seed in range(SEEDS))
    return results_of((name, seed) for name, n in REDUCED.items() for seed in range(n))


def test_nothing_is_met_where_the_truth_misses(results, full, capsys):
    with capsys.disabled():
        print("\n" + table_of(results))
    outside = [one for one in results if not KINDS[one["kind"]].inside]
    assert row_of("all", outside).false_met <= MOST_FALSE_MET
    if full:
        rows = rows_of(results)
        assert [
            row.kind for row in rows if not row.believable and row.kind not in FALSELY_MET
        ] == []


def test_advice_is_not_misleading(results):
    """Of one truth of each kind, and of many."""
    assert [row.kind for row in rows_of(results) if row.misled > MOST_MISLED] == []


def test_intervals_cover_or_verdicts_are_withheld(results, full):
    """Of one or two truths of a kind only the mean over all of them says something."""
    if full:
        assert [r.kind for r in rows_of(results) if not r.honest and r.kind not in TOO_LITTLE] == []
    # what is left of single truths: all that is not withheld for the right reason
    claimed = [one for one in results if row_of(one["kind"], [one]).excused < 1.0]
    every = row_of("all", claimed)
    assert every.within_68 > 0.55 and every.within_95 > 0.85


def test_inside_the_family_verdicts_are_given(results, full):
    inside = [one for one in results if KINDS[one["kind"]].inside]
    row = row_of("inside_1500", inside)
    assert row.met > 0
    if full:
        assert row.of_right_width
    assert all(not one["warnings"] for one in inside) or full


@pytest.mark.xfail(strict=True, reason="ten kinds miss, named in docs/validation.md")
def test_every_kind_covers_or_is_withheld(results, full):
    if not full:
        pytest.skip("20 truths of a kind say something: set BAYESDIST_FULL=1")
    assert [row.kind for row in rows_of(results) if not row.honest] == []


@pytest.mark.xfail(strict=True, reason="0.67 of what exact errors attain, where 0.8 is aimed at")
def test_what_is_clearly_met_inside_the_family_is_called_met(results, full):
    if not full:
        pytest.skip("20 truths of a kind say something: set BAYESDIST_FULL=1")
    inside = [one for one in results if KINDS[one["kind"]].inside]
    assert row_of("inside_1500", inside).decides
