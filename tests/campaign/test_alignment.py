"""Exposures laid on each other by the solution: the claim of ACS ISR 2015-06, sections 6 and 7.

The same through files and stwcs is shown in tests/products/test_tweak.py.
"""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.slow

CLAIMED, CLAIMED_BRIGHT = 0.05, 0.02  # pixels, each axis


def test_exposures_align(runs, capsys):
    """Stars of consecutive exposures after shift, rotation and scale; the stale start beside it."""
    new, true, old, own = (
        {
            kind: np.concatenate([one[f"alignment {name} {kind}"] for one in runs])
            for kind in ("all", "bright")
        }
        for name in ("new", "true", "old", "own")
    )
    beyond = {k: np.sqrt(np.maximum(new[k] ** 2 - true[k] ** 2, 0)) for k in new}
    with capsys.disabled():
        for kind in new:
            print(f"\n{kind} stars of {new[kind].size} pairs, rms per axis in px (most):")
            for what, of in (
                ("solution", new),
                ("true distortion", true),
                ("beyond the true distortion", beyond),
                ("solution less true distortion, star by star", own),
                ("without drift and tables", old),
            ):
                print(f"  {what}: {np.median(of[kind]):.4f} ({of[kind].max():.4f})")
    assert new["all"].max() < CLAIMED
    assert beyond["bright"].max() < CLAIMED_BRIGHT
    assert own["bright"].max() < CLAIMED_BRIGHT
    assert np.median(old["all"]) > CLAIMED
    assert (new["all"] < old["all"]).all()
