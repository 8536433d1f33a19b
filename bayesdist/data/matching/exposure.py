"""Match one exposure of a campaign with the catalogue at its epoch.

The search radius for pairs depends on the distance from the centre of the detections and is derived
from the distances of the pairs. In regions with a less well known distortion, usually the corners,
pairs need a larger radius than in the middle. A radius that is large everywhere includes false
matches (the distortion report, Section 3, item 1: criteria that depend on the radial distance from
the centre).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.exposures import Exposure
from bayesdist.data.matching.pairs import (
    MIN_PAIRS,
    LinearMap,
    beats_chance,
    best_similarity,
    chance_radius,
    chance_rate,
    hull_of,
    inside_hull,
    iterated_map,
    mutual_pairs,
    overlap,
    smooth_map,
)
from bayesdist.data.matching.reports import ExposureReport
from bayesdist.data.matching.similarity import (
    PatternIndex,
    Similarity,
    brightest,
    find_similarity,
    grown_map,
)
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Bool, Float, Int

_ASTRAY_FRACTION = 0.2  # of the matched fraction of the best chip; a chip below this is misplaced
_MIN_DETECTIONS_ON_CHIP = 20  # smallest number of detections on a chip for that comparison
_CHANCE_RATE = 0.1  # chance matches per detection within the largest radius that is considered
_DISPLACEMENT = 10.0  # search radii by which detections are displaced to count chance matches
_MAX_CHECKED = 2000  # largest number of detections in the final check
_MARGIN = 0.1  # margin around the field, as a fraction of its size
_MAX_ROUNDS = 12  # largest number of rounds in which the cubics and the radius are updated
_MIN_UNPAIRED = 100  # smallest number of unpaired detections that represent their distribution
_MAX_FALSE_FRACTION = 0.1  # largest fraction of chance pairs; with more, the match is rejected
# increase of the number of pairs per round above which the cubics are still improving
_GROWTH_FACTOR = 1.01
_MAG_PERCENTILES = (1.0, 99.0)  # percentiles that define the range of magnitudes of a list
_MIN_PAIRS_IN_RING = 100
_MAX_RINGS = 8
_TRUE_PAIRS_WITHIN = 0.98  # fraction of the true pairs within half the radius
_RADIUS_MARGIN = 2.0
_MIN_RADIUS = 1e-3  # of the largest radius; pairs without scatter still have rounding errors


@dataclass(frozen=True, eq=False)
class ExposureMatch:
    """Matches of an exposure: row indices in list and catalogue, and catalogue positions (n,)."""

    report: ExposureReport
    index: Int
    catalog_index: Int
    u: Float
    v: Float
    # errors (n,) of the catalogue positions as columns of `Matches`; empty if they have none
    errors: Mapping[str, Float]


def match_exposure(
    stars: Detections,
    good: Bool,
    plane: Float,
    catalog: ReferenceCatalog,
    patterns: PatternIndex,
    *,
    exposure: Exposure,
    chips: Sequence[int],
    rejected: Mapping[str, int],
    radius: float | None,
    source: str,
) -> ExposureMatch:
    """Match the detections of an exposure with the catalogue at its epoch.

    Parameters
    ----------
    stars : Detections
        Detections of the exposure.
    good : ndarray of bool, shape (N,)
        Mask of the detections that may be matched.
    plane : ndarray, shape (N, 2)
        Positions of the detections after the known distortion.
    catalog : ReferenceCatalog
        Catalogue at the epoch of the exposure.
    patterns : PatternIndex
        Patterns of the catalogue at a similar epoch.
    exposure : Exposure
        Entry of the exposure log.
    chips : sequence of int
        Chips of the campaign.
    rejected : mapping of str to int
        Number of detections that are not good, by reason.
    radius : float or None
        Search radius, as for `match_campaign`.
    source : str
        Name of the list, for error messages.

    Returns
    -------
    ExposureMatch
        Pairs with their report.

    Raises
    ------
    InputError
        If the field is not that of the catalogue.
    """
    rows = np.flatnonzero(good)
    points, chip = plane[rows], stars.chip[rows]
    first, coincidences = _by_patterns(stars, good, plane, catalog, patterns, source)
    nearby = _around(first(points), catalog)
    reference = np.column_stack([catalog.u, catalog.v])[nearby]
    tree = cKDTree(reference)
    n_over, area = overlap(first(points), reference)
    largest = chance_radius(_CHANCE_RATE, n_over, area) if radius is None else radius
    linear = iterated_map(points, reference, tree, first, 2.0 * largest, largest)
    failure = InputError(
        f"does not match {catalog.source}: {coincidences} stars agree on a rotation and shift, but "
        "the others do not follow",
        where=source,
        do="check the field and the distortion that is taken as known",
    )
    if linear is None:
        raise failure
    middle = 0.5 * (plane.min(axis=0) + plane.max(axis=0))
    rho = np.hypot(*(points - middle).T)
    pairs = iterated_pairs(
        linear(points), chip, rho, reference, tree, largest, fixed=radius is not None
    )
    if pairs is None:
        raise failure
    moved, allowed, index, partner = pairs.moved, pairs.allowed, pairs.index, pairs.partner
    false_rate = _false_rate(pairs, rho, reference, _DISPLACEMENT * largest)
    # solved for the true pairs: a fraction `false_rate` of all other detections is matched too
    true = max((len(index) - false_rate * len(points)) / (1.0 - min(false_rate, 0.99)), 0.0)
    false_fraction = float(np.clip(1.0 - true / len(index), 0.0, 1.0))
    if radius is None and false_fraction > _MAX_FALSE_FRACTION:
        raise InputError(
            f"of {len(index)} pairs with {catalog.source} {false_fraction:.0%} are chance "
            "coincidences: their distances do not cluster near zero",
            where=source,
            do="give a better known distortion, or a search radius",
        )
    onto = best_similarity(points[index] - middle, reference[partner])
    turn = complex(*onto.matrix[:, 0])
    centre = onto(np.zeros((1, 2)))[0]
    expected = np.zeros(len(catalog), bool)
    expected[nearby[_footprint(moved, chip, reference)]] = True
    partner = nearby[partner]
    zero_point, within = _range(stars, rows, index, catalog, partner)
    expected &= within
    matched = int(expected[partner].sum())
    errors = {name: values[partner] for name, values in catalog.position_errors.items()}
    asked = {chip_number: int((chip == chip_number).sum()) for chip_number in chips}
    per_chip = {chip_number: int((chip[index] == chip_number).sum()) for chip_number in chips}
    report = ExposureReport(
        exposure=exposure.name,
        filter=exposure.filter,
        epoch=exposure.epoch,
        detected=len(stars),
        rejected=dict(rejected),
        matched=len(index),
        per_chip=per_chip,
        missing_chips=tuple(chip_number for chip_number, n in asked.items() if not n),
        astray=_astray(asked, per_chip),
        expected=int(expected.sum()),
        completeness=matched / max(int(expected.sum()), 1),
        false_rate=false_rate,
        false_fraction=false_fraction,
        rotation=float(np.degrees(np.angle(turn)) % 360.0),
        scale=float(abs(turn)),
        offset=(float(centre[0]), float(centre[1])),
        radius=(float(allowed.radius.min()), float(allowed.radius.max())),
        rms=float(np.sqrt(np.mean(pairs.distance**2))),
        zero_point=zero_point,
        coincidences=coincidences,
    )
    return ExposureMatch(
        report, rows[index], partner, catalog.u[partner], catalog.v[partner], errors
    )


def _astray(asked: Mapping[int, int], matched: Mapping[int, int]) -> tuple[int, ...]:
    """Chips with few matched detections although another chip has many."""
    share = {chip: matched[chip] / n for chip, n in asked.items() if n >= _MIN_DETECTIONS_ON_CHIP}
    best = max(share.values(), default=0.0)
    return tuple(chip for chip, part in share.items() if part < _ASTRAY_FRACTION * best)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs, positions of all detections after the maps, and largest distance of a pair."""

    moved: Float
    allowed: SearchRadius
    index: Int
    partner: Int
    distance: Float


def iterated_pairs(
    start: Float,
    chip: Int,
    rho: Float,
    reference: Float,
    tree: cKDTree,
    largest: float,
    *,
    fixed: bool,
) -> Pairs | None:
    """Pairs of positions `start` (N, 2) with `reference` (M, 2), after fitting a cubic per chip.

    `chip` (N,) are chip numbers, `rho` (N,) are distances from the middle of the detections, `tree`
    is the k-d tree of `reference`, and `largest` is the largest distance of a pair.  The result is
    None if there are no more pairs than by chance.

    While the cubics bring in more pairs, the radius stays at its largest value.  It then shrinks to
    the radius that the pairs need, unless `fixed` is True, and the cubics are fitted once more.
    """
    allowed = SearchRadius(np.zeros(1), np.array([largest]))
    chance = min(chance_rate(start, tree, largest, _DISPLACEMENT * largest), 0.99)
    moved = start
    index, partner, distance = mutual_pairs(moved, reference, largest, tree=tree)
    for rounds_left in reversed(range(_MAX_ROUNDS)):
        if len(index) < MIN_PAIRS:
            return None
        before = len(index)
        moved = start + smooth_map(start, chip, reference[partner] - start[index], index)(
            start, chip
        )
        widest = float(allowed.radius.max())
        index, partner, distance = mutual_pairs(moved, reference, widest, tree=tree)
        growing = len(index) > _GROWTH_FACTOR * before and rounds_left > 1
        if not fixed and not growing and len(index):
            unpaired = np.ones(len(moved), bool)
            unpaired[index] = False
            # a detection without counterpart has a neighbour within r with probability 1 -
            # exp(-density pi r^2)
            within = float(-np.expm1(np.log1p(-chance) * (widest / largest) ** 2))
            allowed = search_radius(
                rho[index], distance, rho[unpaired], largest=widest, chance=within
            )
        near = distance <= allowed(rho[index])
        index, partner, distance = index[near], partner[near], distance[near]
        if not growing and (fixed or widest < largest):
            break
    sample = moved[:: -(-len(moved) // _MAX_CHECKED)]
    if len(index) < MIN_PAIRS or not beats_chance(sample, reference, tree, distance):
        return None
    return Pairs(moved, allowed, index, partner, distance)


def _false_rate(pairs: Pairs, rho: Float, reference: Float, step: float) -> float:
    """Probability that a detection without counterpart is paired with an unmatched star.

    It is evaluated at the positions of unpaired detections, or of all detections if there are few
    unpaired ones.
    """
    free = np.ones(len(reference), bool)
    free[pairs.partner] = False
    if not free.any():
        return 0.0
    asked = np.ones(len(pairs.moved), bool)
    asked[pairs.index] = False
    if asked.sum() < _MIN_UNPAIRED:
        asked[:] = True
    radius = pairs.allowed(rho[asked])
    return chance_rate(pairs.moved[asked], cKDTree(reference[free]), radius, step)


def _by_patterns(
    stars: Detections,
    good: Bool,
    plane: Float,
    catalog: ReferenceCatalog,
    patterns: PatternIndex,
    source: str,
) -> tuple[LinearMap, int]:
    """First linear map, and the number of stars that agreed on it.

    Good detections are tried first. If they are not recognised, all detections are tried, because
    the catalogue may hold stars that are saturated in the exposure.
    """

    def recognised(which: Bool) -> Similarity:
        return find_similarity(
            plane[which],
            patterns,
            mag=None if stars.mag is None else stars.mag[which],
            source=source,
            reference_name=catalog.source,
        )

    try:
        similarity = recognised(good)
    except InputError:
        if good.all():
            raise
        similarity = recognised(np.ones(len(stars), bool))
    # a similarity is accurate in the middle: extend the map outwards using the bright stars
    mag = None if stars.mag is None else stars.mag[good]
    rough = grown_map(brightest(plane[good], mag), similarity, patterns, narrow=0.15)
    return rough, similarity.coincidences


def _around(points: Float, catalog: ReferenceCatalog) -> Int:
    """Indices of catalogue stars in the box of the points plus a margin."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = _MARGIN * float((high - low).max())
    inside = (catalog.u >= low[0] - margin) & (catalog.u <= high[0] + margin)
    inside &= (catalog.v >= low[1] - margin) & (catalog.v <= high[1] + margin)
    return np.flatnonzero(inside)


def _range(
    stars: Detections, rows: Int, index: Int, catalog: ReferenceCatalog, partner: Int
) -> tuple[float | None, Bool]:
    """Magnitude zero point, and a mask of catalogue stars in the range of the detections."""
    if stars.mag is None or catalog.mag is None:
        return None, np.ones(len(catalog), bool)
    zero_point = float(np.median(catalog.mag[partner] - stars.mag[rows][index]))
    low, high = np.percentile(stars.mag[rows], _MAG_PERCENTILES) + zero_point
    return zero_point, (catalog.mag >= low) & (catalog.mag <= high)


def _footprint(moved: Float, chip: Int, reference: Float) -> Bool:
    """Boolean mask of the reference stars inside the hull of the detections of any chip."""
    covered = np.zeros(len(reference), bool)
    for number in np.unique(chip):
        covered |= inside_hull(reference, hull_of(moved[chip == number])[0])
    return covered


@dataclass(frozen=True, eq=False)
class SearchRadius:
    """Largest distance of a pair, as a function of the distance from the centre of the detections.

    The radius is interpolated linearly between rings and is constant beyond them.

    Parameters
    ----------
    rho : ndarray, shape (R,)
        Median distance of the pairs in each ring from the centre, ascending, in the unit of the
        positions.
    radius : ndarray, shape (R,)
        Largest distance of a pair in each ring, in the same unit.
    """

    rho: Float
    radius: Float

    def __call__(self, rho: Float) -> Float:
        """Radius at given distances from the centre."""
        return np.interp(rho, self.rho, self.radius)


def search_radius(
    rho: Float, distance: Float, unpaired: Float, *, largest: float, chance: float
) -> SearchRadius:
    """Radius that keeps nearly all true pairs and few false ones.

    In each ring, the distances of the pairs are a mixture of those of true pairs, which are
    concentrated near zero, and of chance pairs, with a number within r that grows as r^2. The
    radius is twice that within which 98 % of the true pairs are found. For circular normal errors
    it is 5.6 standard errors, and larger for the wider mixture of bright and faint stars.

    Parameters
    ----------
    rho : ndarray, shape (n,)
        Distances of the pairs from the centre.
    distance : ndarray, shape (n,)
        Distances between the two members of a pair, up to `largest`.
    unpaired : ndarray, shape (m,)
        Distances of the unpaired detections from the centre.
    largest : float
        Radius within which the pairs were searched for.
    chance : float
        Probability that a detection without true counterpart finds a neighbour within that radius.

    Returns
    -------
    SearchRadius
        Search radius, at most `largest`.
    """
    rings = int(np.clip(len(rho) // _MIN_PAIRS_IN_RING, 1, _MAX_RINGS))
    order = np.argsort(rho, kind="stable")
    edges = np.concatenate(
        [[-np.inf], [rho[part[0]] for part in np.array_split(order, rings)[1:]], [np.inf]]
    )
    middles, radii = [], []
    for low, high in pairwise(edges):
        inside = (rho >= low) & (rho < high)
        distances = np.sort(distance[inside])
        if not len(distances):  # an empty ring, if distances from the centre are equal
            continue
        all_detections = len(distances) + int(((unpaired >= low) & (unpaired < high)).sum())
        # solved for the true pairs: a fraction `chance` of all other detections is paired too
        true = max(
            (len(distances) - chance * all_detections) / (1.0 - chance), 0.5 * len(distances)
        )
        false = len(distances) - true
        excess = np.arange(1, len(distances) + 1) - false * (distances / largest) ** 2
        within = distances[int(np.argmax(excess >= _TRUE_PAIRS_WITHIN * true))]
        middles.append(float(np.median(rho[inside])))
        radii.append(float(np.clip(_RADIUS_MARGIN * within, _MIN_RADIUS * largest, largest)))
    return SearchRadius(np.array(middles), np.array(radii))
