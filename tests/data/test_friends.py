"""Friends of friends against all pairs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from bayesdist.data.detections import NO_STAR
from bayesdist.data.matching.friends import FINE, friends_of_friends


@pytest.mark.parametrize("seed", range(5))
def test_groups_are_the_connected_components(seed):
    rng = np.random.default_rng(seed)
    stars = rng.uniform(0, 60, (80, 2))
    places = np.concatenate([stars + 0.05 * rng.normal(size=stars.shape) for _ in range(6)])
    exposure = np.repeat(np.arange(6), 80)
    found = friends_of_friends(places, exposure, 1.0)
    distance = cdist(places, places)
    # rounding to cells moves a distance by at most a cell's diagonal on either side
    slack = 2 * np.sqrt(2) / FINE
    together = found.star[:, None] == found.star[None]
    good = (found.star != NO_STAR)[:, None] & (found.star != NO_STAR)[None]
    _, near = connected_components(distance < 1.0 - slack)
    _, far = connected_components(distance < 1.0 + slack)
    assert not np.any(good & together & (far[:, None] != far[None]))
    assert not np.any(good & ~together & (near[:, None] == near[None]))


def test_one_detection_of_an_exposure():
    """A second detection of an exposure is dropped: the one that lies farther out."""
    places = np.array([[0.0, 0.0], [0.1, 0.0], [0.05, 0.05], [0.7, 0.0], [10.0, 0.0]])
    found = friends_of_friends(places, np.array([0, 1, 2, 2, 0]), 1.0)
    assert found.star.tolist() == [0, 0, 0, NO_STAR, 1]
    assert (found.n_stars, found.n_doubled, found.n_dropped) == (2, 1, 1)


def test_chains_are_given_up():
    places = np.stack([np.arange(20) * 0.8, np.zeros(20)], axis=1)
    found = friends_of_friends(places, np.arange(20), 1.0)
    assert found.n_chains == found.n_ambiguous == 1
    assert found.n_stars == 0
