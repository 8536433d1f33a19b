"""Any position at any date: polynomial, drift, catalogue and tables cover together."""

from __future__ import annotations

import numpy as np
import pytest

from tests.campaign.measures import LEVELS

pytestmark = pytest.mark.slow

# the positions of a campaign share its polynomial: so many of the 100 are independent
INDEPENDENT = 25


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
