"""Simulation-based calibration of whole runs: with truths from the priors all ranks are even."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.diagnose.correlated import DiscrepancyPriors

from .ranks import half_t, structure
from .runs import all_ranks
from .summary import farthest, simultaneous_band

pytestmark = pytest.mark.slow

SURE = 0.999  # that ranks which are even are not taken for uneven, over all quantities


def test_ranks_are_even(full, capsys):
    found = all_ranks(full=full)
    n, quantities = len(next(iter(found.values()))), len(found)
    most = simultaneous_band(n, 1 - (1 - SURE) / quantities)
    far = {name: farthest(ranks) for name, ranks in found.items()}
    with capsys.disabled():
        worst = max(far, key=far.__getitem__)
        print(
            f"\n{n} truths, {quantities} quantities: {worst} is farthest from even, "
            f"{far[worst]:.2f}, of {most:.2f}"
        )
    assert quantities == 2 * 10 + 10 + 3
    assert max(far.values()) < most, far


def test_ranks_that_are_not_even_are_seen(rng):
    """Errors that are stated a fifth too small, with as many truths as the full suite has."""
    from scipy.stats import norm

    ranks = norm.cdf(1.25 * rng.standard_normal((40, 200)))
    seen = [farthest(r) > simultaneous_band(200, 0.95) for r in ranks]
    assert np.mean(seen) > 0.6
    even = [farthest(r) > simultaneous_band(200, 0.95) for r in rng.uniform(size=(400, 200))]
    assert 0.02 < np.mean(even) < 0.09


def test_structure_has_the_size_of_its_prior(rng):
    """Half of the fields are smaller than the medians of the priors say together, or about so."""
    line = np.linspace(100, 1950, 12)
    x, y = np.meshgrid(line, line)
    rms = [np.sqrt(np.mean(structure(rng)(x, y) ** 2)) for _ in range(60)]
    priors = DiscrepancyPriors()
    assert priors.structure < np.median(rms) < 10 * priors.higher_order
    drawn = [half_t(rng, 1.0, 1e9) for _ in range(2000)]
    assert np.median(drawn) == pytest.approx(1.0, rel=0.12)
