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
    new, old, alone = (
        {
            kind: np.concatenate([one[f"alignment {name} {kind}"] for one in runs])
            for kind in ("all", "bright")
        }
        for name in ("new", "old", "centroids")
    )
    beyond = {k: np.sqrt(np.maximum(new[k] ** 2 - alone[k] ** 2, 0)) for k in new}
    with capsys.disabled():
        for kind in new:
            print(
                f"\n{kind} stars of {new[kind].size} pairs of exposures: rms per axis "
                f"{np.median(new[kind]):.4f} px (at most {new[kind].max():.4f}), beyond the "
                f"centroids {np.median(beyond[kind]):.4f} ({beyond[kind].max():.4f}); "
                f"without drift and tables {np.median(old[kind]):.4f} ({old[kind].max():.4f})"
            )
    assert new["all"].max() < CLAIMED
    # two exposures that both deviate by three sigma are not the calibration's: of hundreds of pairs
    # one in a hundred may be beyond
    assert np.quantile(beyond["bright"], 0.99) < CLAIMED_BRIGHT
    assert np.median(old["all"]) > CLAIMED
    assert (new["all"] < old["all"]).all()
