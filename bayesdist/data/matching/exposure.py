"""One exposure of a campaign matched with the catalogue at its epoch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.exposures import Exposure
from bayesdist.data.matching.linear_map import (
    MIN_PAIRS,
    LinearMap,
    best_similarity,
    iterated_map,
    smooth_map,
)
from bayesdist.data.matching.pairs import (
    beats_chance,
    chance_radius,
    chance_rate,
    hull_of,
    inside_hull,
    mutual_pairs,
    overlap,
)
from bayesdist.data.matching.reports import ExposureReport
from bayesdist.data.matching.search_radius import SearchRadius, search_radius
from bayesdist.data.matching.similarity import (
    PatternIndex,
    Similarity,
    brightest,
    find_similarity,
    grown_map,
)
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Bool, Float, Int

_ASTRAY_FRACTION = 0.2  # of the matched fraction of the best chip: a chip below lies elsewhere
_MIN_DETECTIONS_ON_CHIP = 20  # detections of a chip for that comparison
_CHANCE_RATE = 0.1  # chance matches of a detection within the largest radius that is looked at
_DISPLACEMENT = 10.0  # radii by which detections are displaced to count chance matches
_MAX_CHECKED = 2000  # detections of the last check
_MARGIN = 0.1  # of the field, around it
_MAX_ROUNDS = 12  # of a cubic for each chip, and then the radius that follows
_MIN_UNPAIRED = 100  # unpaired detections that sample where such detections lie
_MAX_FALSE_FRACTION = 0.1  # of the pairs by chance: more, and the field is not understood
_GROWTH_FACTOR = 1.01  # of the pairs, while the cubic is still reaching out
_MAG_PERCENTILES = (1.0, 99.0)  # percentiles of magnitude that count as the range of a list


@dataclass(frozen=True, eq=False)
class ExposureMatch:
    """Matches of an exposure: rows of list and catalogue, and catalogue positions (n,)."""

    report: ExposureReport
    index: Int
    catalog_index: Int
    u: Float
    v: Float
    sigma: tuple[Float, Float] | None  # errors of the catalogue positions (n,)


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
    """Matches of the detections of an exposure with the catalogue at its epoch.

    `good` (N,) masks the detections that may be matched, `plane` (N, 2) holds their positions after
    the known distortion, `patterns` those of the catalogue at an epoch not far from this, `chips`
    those of the campaign, `rejected` the detections that are not good, by reason; `radius` is as
    for `match_campaign`.  InputError when the field is not that of the catalogue.
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
    # matched = true + rate (all - true)
    true = max((len(index) - false_rate * len(points)) / (1.0 - min(false_rate, 0.99)), 0.0)
    false_fraction = float(np.clip(1.0 - true / len(index), 0.0, 1.0))
    if radius is None and false_fraction > _MAX_FALSE_FRACTION:
        raise InputError(
            f"of {len(index)} pairs with {catalog.source} {false_fraction:.0%} are there by "
            "chance: they do not crowd near zero distance",
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
    sigma = None
    if catalog.sigma_u is not None and catalog.sigma_v is not None:
        sigma = (catalog.sigma_u[partner], catalog.sigma_v[partner])
    asked = {one: int((chip == one).sum()) for one in chips}
    per_chip = {one: int((chip[index] == one).sum()) for one in chips}
    report = ExposureReport(
        exposure=exposure.name,
        filter=exposure.filter,
        epoch=exposure.epoch,
        detected=len(stars),
        rejected=dict(rejected),
        matched=len(index),
        per_chip=per_chip,
        missing_chips=tuple(one for one, n in asked.items() if not n),
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
        report, rows[index], partner, catalog.u[partner], catalog.v[partner], sigma
    )


def _astray(asked: Mapping[int, int], matched: Mapping[int, int]) -> tuple[int, ...]:
    """Chips whose detections hardly match, where those of another chip do."""
    share = {chip: matched[chip] / n for chip, n in asked.items() if n >= _MIN_DETECTIONS_ON_CHIP}
    best = max(share.values(), default=0.0)
    return tuple(chip for chip, part in share.items() if part < _ASTRAY_FRACTION * best)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs, the positions of all detections after the maps, and the largest distance of a pair."""

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
    """Pairs of positions `start` (N, 2) with `reference` (M, 2), after a cubic for each chip.

    `rho` (N,) are distances from the middle of the detections, `tree` is of `reference`, `largest`
    is the largest distance of a pair.  None if there are no pairs but by chance.

    While the cubic brings in more pairs the radius stays at its largest; then it shrinks to that
    which the pairs need, unless it is fixed, and the cubic is fitted once more.
    """
    allowed = SearchRadius(np.zeros(1), np.array([largest]))
    chance = min(chance_rate(start, tree, largest, _DISPLACEMENT * largest), 0.99)
    moved = start
    index, partner, distance = mutual_pairs(moved, reference, largest, tree=tree)
    for left in reversed(range(_MAX_ROUNDS)):
        if len(index) < MIN_PAIRS:
            return None
        before = len(index)
        moved = start + smooth_map(start, chip, reference[partner] - start[index], index)(
            start, chip
        )
        widest = float(allowed.radius.max())
        index, partner, distance = mutual_pairs(moved, reference, widest, tree=tree)
        growing = len(index) > _GROWTH_FACTOR * before and left > 1
        if not fixed and not growing and len(index):
            unpaired = np.ones(len(moved), bool)
            unpaired[index] = False
            # without counterpart a neighbour within r has the probability 1 - exp(-density pi r^2)
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
    """Probability that a detection without counterpart finds a star that is still free.

    Unpaired detections show where such detections lie; where they are few, all detections are used.
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
    """First linear map, and how many stars agreed on it.

    The good detections are tried first; where they are not recognised, all are, for the catalogue
    may hold stars that are saturated in the exposure.
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
        found = recognised(good)
    except InputError:
        if good.all():
            raise
        found = recognised(np.ones(len(stars), bool))
    # a similarity is good in the middle: the map grows outwards from there with the bright stars
    mag = None if stars.mag is None else stars.mag[good]
    rough = grown_map(brightest(plane[good], mag), found, patterns, narrow=0.15)
    return rough, found.coincidences


def _around(points: Float, catalog: ReferenceCatalog) -> Int:
    """Catalogue stars in the box of the points, with a margin for displaced detections."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = _MARGIN * float((high - low).max())
    inside = (catalog.u >= low[0] - margin) & (catalog.u <= high[0] + margin)
    inside &= (catalog.v >= low[1] - margin) & (catalog.v <= high[1] + margin)
    return np.flatnonzero(inside)


def _range(
    stars: Detections, rows: Int, index: Int, catalog: ReferenceCatalog, partner: Int
) -> tuple[float | None, Bool]:
    """Zero point, and a mask of the catalogue stars within the magnitudes of the detections."""
    if stars.mag is None or catalog.mag is None:
        return None, np.ones(len(catalog), bool)
    zero_point = float(np.median(catalog.mag[partner] - stars.mag[rows][index]))
    low, high = np.percentile(stars.mag[rows], _MAG_PERCENTILES) + zero_point
    return zero_point, (catalog.mag >= low) & (catalog.mag <= high)


def _footprint(moved: Float, chip: Int, reference: Float) -> Bool:
    """Boolean mask of the reference stars inside the hull of any chip's detections."""
    covered = np.zeros(len(reference), bool)
    for number in np.unique(chip):
        covered |= inside_hull(reference, hull_of(moved[chip == number])[0])
    return covered
