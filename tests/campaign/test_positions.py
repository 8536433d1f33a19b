"""Positions: errors of any at any date are covered, and exposures are laid on each other.

Alignment is the claim of ACS ISR 2015-06, sections 6 and 7; through files and stwcs it is shown in
tests/missions/hst/test_tweak.py.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.campaign.measures import LEVELS

pytestmark = pytest.mark.slow

# the positions of a campaign share its polynomial: so many of the 100 are independent
INDEPENDENT = 25
CLAIMED, CLAIMED_BRIGHT = 0.05, 0.02  # pixels, each axis


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("kind", ["axis", "radial"])
def test_positions_are_covered(runs, kind, level, capsys):
    covered = np.array([one[f"{kind} {level}"] for one in runs])
    n = len(covered)
    error = np.sqrt(level * (1 - level) / INDEPENDENT / n)
    if n > 5:  # enough to see how much campaigns differ
        error = max(error, float(covered.std(ddof=1) / np.sqrt(n)))
    pull = np.concatenate([one["position pull"] for one in runs])
    sigma = np.concatenate([one["position sigma"] for one in runs])
    with capsys.disabled():
        print(
            f"\n{kind}, {level:.1%}: {covered.mean():.3f} +- {error:.3f} ({covered.min():.2f} to "
            f"{covered.max():.2f} in {n} campaigns); rms pull {np.sqrt((pull**2).mean()):.3f}, "
            f"median sigma {np.median(sigma):.4f} px"
        )
    assert abs(covered.mean() - level) < 3.3 * error


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
