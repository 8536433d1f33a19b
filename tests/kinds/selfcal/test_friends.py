"""Friends of friends against all pairs."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from bayesdist.data.detections import NO_STAR
from bayesdist.errors import InputError
from bayesdist.kinds.selfcal.grouping import (
    FINE,
    MIN_SIDE,
    Friends,
    cells,
    friends_of_friends,
    grouped,
)


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


@pytest.mark.parametrize("along", [[1, 0], [0, 1], [1, 1]], ids=str)
@pytest.mark.parametrize("distance", [2**20, 2**26, 2**31 // FINE - 1])
def test_stars_as_far_apart_as_can_be_numbered(along, distance):
    """A cell with the usual number of detections is then larger than the grid of squares."""
    star = np.array([[0.0, 0.0], [0.1, 0.1], distance * np.array(along)])
    found = friends_of_friends(np.tile(star, (2, 1)), np.repeat([0, 1], 3), 1.0, per_cell=10**6)
    assert found.star.tolist() == [0, NO_STAR, 1, 0, NO_STAR, 1]
    with pytest.raises(InputError, match="too far from the others"):
        friends_of_friends(star * 4 * 2**31 / distance, np.zeros(3, int), 1.0)


def test_rounding_does_not_choose_among_two():
    """Both are as far from their mean: the first stays, wherever the last digit is rounded."""
    rng = np.random.default_rng(3)
    middle = rng.uniform(0, 3000, (500, 2))
    half = 0.3 * rng.uniform(-1, 1, (500, 2))
    found = friends_of_friends(
        np.concatenate([middle + half, middle - half]), np.zeros(1000, int), 1
    )
    pairs = found.star[:500], found.star[500:]
    alone = (pairs[0] == NO_STAR) | (pairs[1] == NO_STAR)
    assert alone.sum() > 400
    assert (pairs[0][alone] != NO_STAR).all()


def test_chains_are_given_up():
    places = np.stack([np.arange(20) * 0.8, np.zeros(20)], axis=1)
    found = friends_of_friends(places, np.arange(20), 1.0)
    assert found.n_chains == found.n_ambiguous == 1
    assert found.n_stars == 0


def field_of_cells(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Detections on a sky of some cells: stars on edges and corners, doubles and chains."""
    rng = np.random.default_rng(seed)
    side = 4.0 * MIN_SIDE
    lattice = np.arange(-side, side, MIN_SIDE / 8)
    # the lowest detection, from where cells of the least size have their edges at rows of stars
    corner = np.full((1, 2), lattice[0] - MIN_SIDE / 8)
    stars = np.stack(np.meshgrid(lattice, lattice), axis=-1).reshape(-1, 2)
    # chains across cells, between the stars: along both axes, side by side, and along a diagonal
    step = np.arange(0, 2.5 * MIN_SIDE, 0.9)[:, None]
    chains = [
        start + step * way
        for start, way in (
            ([7.5, 7.5], [1, 0]),
            ([7.5, 12.5], [1, 0]),
            ([3.3, 3.3], [0, 1]),
            ([-295.0, -300.0], [0.7, 0.7]),
        )
    ]
    places = np.concatenate(
        [stars + rng.normal(0, 0.25, stars.shape) for _ in range(6)] + chains + [corner]
    )
    exposure = rng.integers(0, 5, len(places))
    order = rng.permutation(len(places))
    return places[order], exposure[order]


def assert_same(a: Friends, b: Friends) -> None:
    assert np.array_equal(a.star, b.star)
    for name in ("n_stars", "n_doubled", "n_dropped", "n_chains"):
        assert getattr(a, name) == getattr(b, name), name


@pytest.mark.parametrize("seed", range(3))
def test_groups_do_not_depend_on_the_cells(seed):
    """Nor on the sequence in which these are grouped; codes rise with the first detection."""
    places, exposure = field_of_cells(seed)
    whole = friends_of_friends(places, exposure, 1.0, per_cell=10**9)
    assert whole.n_stars > 1000 and whole.n_doubled > 100 and whole.n_chains == 4
    heads = np.unique(whole.star, return_index=True)[1][1:]
    assert np.all(np.diff(heads) > 0)
    for detections in (1, 1500, 4000):
        parts = list(cells(places, exposure, 1.0, detections))
        assert len(parts) > 3
        inside = np.concatenate([part.rows[part.inside] for part in parts])
        assert np.array_equal(np.sort(inside), np.arange(len(places)))
        # stars that lie in several cells
        cut = sum(len(set(whole.star[part.rows[part.inside]]) - {NO_STAR}) for part in parts)
        assert detections > 1 or cut > whole.n_stars + 500
        in_cells = partial(friends_of_friends, places, exposure, 1.0, per_cell=detections)
        assert_same(in_cells(), whole)
        backwards = in_cells(each=lambda one, many: map(one, reversed(list(many))))
        assert_same(backwards, whole)


def test_many_exposures_and_groups():
    """The product of their numbers needs more than 32 bits."""
    places = np.stack(np.divmod(np.arange(30_000), 200), axis=1) * 3.0
    exposure = np.random.default_rng(3).integers(0, 300_000, len(places))
    found = friends_of_friends(places, exposure, 1.0)
    assert (found.n_stars, found.n_doubled, found.n_dropped) == (len(places), 0, 0)


def test_one_cell_at_a_time_is_in_memory():
    """Those of a sky that is not yet grouped do not exist."""
    places, exposure = field_of_cells(1)
    alive = [0]

    def counted(many):
        for one in many:
            alive[0] += 1
            yield one

    def watched(one):
        assert alive[0] == 1
        alive[0] -= 1
        return grouped(one)

    friends_of_friends(places, exposure, 1.0, each=lambda one, many: map(watched, counted(many)))
