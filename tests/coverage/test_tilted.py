"""Totals cover what they claim where errors of stars are correlated between u and v.

`python -m tests.coverage.tilted RESULTS.jsonl --truths 200` makes the table of docs/validation.md,
with what diagonal errors give beside it.
"""

from __future__ import annotations

import numpy as np
import pytest

from .tilted import DIRECTIONS, KINDS, covered, fractions, table_of

TRUTHS = {True: 200, False: 6}
BANDS = (0.63, 0.73), (0.93, 0.97)
WIDEST = 0.80, 0.99  # across, where what may be left out is a large part of small errors
SCATTER = 0.13, 0.05  # between truths: the errors of one are correlated over the detector


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_totals_cover_along_all_directions(kind, full, capsys):
    runs = [covered(kind, seed, correlated=True) for seed in range(TRUTHS[full])]
    with capsys.disabled():
        print("\n" + table_of(runs))
    found = {name: fractions(runs, name) for name in DIRECTIONS}
    for name, shares in found.items():
        for k, (low, high) in enumerate(BANDS):
            most, error = WIDEST[k] if name == "across" else high, SCATTER[k] / np.sqrt(len(runs))
            assert low - 3 * error < shares[k] < most + 3 * error, name
    squares = {name: np.mean([run.squares[name] for run in runs]) for name in DIRECTIONS}
    # not twice too wide in area, as by leverages of each axis
    assert np.prod([squares["along"], squares["across"]]) > 0.4, squares
