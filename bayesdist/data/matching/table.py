"""Matches of detections that agree with a catalogue up to a shift, a rotation and a small scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.matches import Matches
from bayesdist.data.matching.pairs import (
    NARROW,
    LinearMap,
    are_enough,
    beats_chance,
    chance_radius,
    iterated_map,
    mutual_pairs,
    overlap,
)
from bayesdist.data.matching.similarity import (
    brightest,
    find_similarity,
    grown_map,
    pattern_index,
)
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Int
from bayesdist.utils.quantities import Number, takes, value_in

_FALSE_RATE = 0.02  # probability of a chance match of a detection that the default radius allows


@dataclass(frozen=True, eq=False)
class Matching:
    """Pairs of detections and reference stars, and how they were found.

    Parameters
    ----------
    index, catalog_index : ndarray of int, shape (n_pairs,)
        Rows of the detections and of the catalogue; no row is repeated.
    transformation : LinearMap
        Map from the positions of the detections to those of the catalogue.
    radius : float
        Largest distance of a pair, in the catalogue's unit.
    coincidences : int
        Number of stars that agreed on rotation and shift.
    false_rate : float
        Probability that a detection without counterpart is paired by chance: 1 - exp(-density pi
        radius^2), with the mean density of unpaired reference stars over the detections.
    """

    index: Int
    catalog_index: Int
    transformation: LinearMap
    radius: float
    coincidences: int
    false_rate: float

    def __len__(self) -> int:
        return len(self.index)


def match_to_catalog(
    x: ArrayLike,
    y: ArrayLike,
    catalog: ReferenceCatalog,
    *,
    mag: ArrayLike | None = None,
    radius: Number | None = None,
    max_offset: Number | None = None,
    source: str = "detections",
) -> Matching:
    """Match detections with reference stars, one to one.

    Rotation, scale and shift are found from the patterns of the stars. A linear transformation is
    then iterated while the radius shrinks. The pairs are mutual nearest neighbours within the final
    radius.

    Parameters
    ----------
    x, y : array_like, shape (N,)
        *Corrected* positions, in the catalogue's unit and parity.
    catalog : ReferenceCatalog
        Catalogue at the epoch of the detections.
    mag : array_like, shape (N,), optional
        Magnitudes of the detections with any zero point. If the catalogue has magnitudes too,
        bright stars are tried first.
    radius : float or Quantity, optional
        Final radius; a plain number is in the catalogue's unit. The default is the radius within
        which a detection without counterpart finds a neighbour by chance with probability 0.02.
    max_offset : float or Quantity, optional
        Largest offset of the middle of the detections on either axis; unlimited by default.
    source : str, optional
        Name of the file, for error messages.

    Returns
    -------
    Matching
        Pairs with the transformation and the false-match rate.

    Raises
    ------
    InputError
        If no rotation and shift brings together more stars than chance does, as for a different
        field; the message gives the best number of coincidences.
    """
    if radius is not None:
        radius = value_in(radius, catalog.unit, "radius", where=source)
    if max_offset is not None:
        max_offset = value_in(max_offset, catalog.unit, "max_offset", where=source)
    points = np.column_stack([np.asarray(x, float), np.asarray(y, float)])
    reference = np.column_stack([catalog.u, catalog.v])
    if not len(points) or not np.isfinite(points).all():
        raise InputError(
            "there are no positions to match, or some are not finite",
            where=source,
            do="correct the list",
        )
    if radius is not None and not radius > 0:
        raise InputError(f"match radius is {radius}", where=source, do="give a positive radius")
    ranked = mag is not None and catalog.mag is not None
    magnitudes = np.asarray(mag, float) if ranked else None
    patterns = pattern_index(reference, catalog.mag if ranked else None)
    similarity = find_similarity(
        points, patterns, mag=magnitudes, source=source, reference_name=catalog.source
    )
    failure = InputError(
        f"does not match {catalog.source}: {similarity.coincidences} stars agree on a rotation and "
        "shift, but the others do not follow",
        where=source,
        do="check the field, the scale and the distortion that is taken as known",
    )
    middle = np.median(points, axis=0)
    offset = similarity(middle[None])[0] - middle
    if max_offset is not None and np.abs(offset).max() > max_offset:
        raise InputError(
            f"matches {catalog.source} at an offset of ({offset[0]:.6g}, {offset[1]:.6g}), beyond "
            f"{max_offset:g}",
            where=source,
            do="check the field, or allow a larger offset",
        )
    rough = grown_map(brightest(points, magnitudes), similarity, patterns, narrow=NARROW)
    n_over, area = overlap(rough(points), reference)
    if radius is None:
        radius = chance_radius(_FALSE_RATE, n_over, area)
    reach = max(NARROW * patterns.spacing, radius)
    transformation = iterated_map(points, reference, patterns.tree, rough, reach, radius)
    if transformation is None:
        raise failure
    moved = transformation(points)
    index, catalog_index, distance = mutual_pairs(moved, reference, radius, tree=patterns.tree)
    enough = are_enough(len(index), len(points), n_over)
    if not enough or not beats_chance(moved, reference, patterns.tree, distance):
        raise failure
    return Matching(
        index=index,
        catalog_index=catalog_index,
        transformation=transformation,
        radius=radius,
        coincidences=similarity.coincidences,
        false_rate=float(-np.expm1(-max(n_over - len(index), 0) / area * np.pi * radius**2)),
    )


@takes(table=Matches, catalog=ReferenceCatalog)
def match_table(
    table: Matches,
    catalog: ReferenceCatalog,
    *,
    radius: Number | None = None,
    max_offset: Number | None = None,
) -> Matches:
    """Replace approximate positions by those of a catalogue, exposure by exposure.

    Parameters
    ----------
    table : Matches
        Matches with u, v as approximate corrected positions in the catalogue's unit, as measured by
        a photometry program with a known distortion.
    catalog : ReferenceCatalog
        Catalogue, which is moved to the mean epoch of each exposure if it has proper motions.
    radius, max_offset
        As for `match_to_catalog`.

    Returns
    -------
    Matches
        Matched stars with u, v and star codes of the catalogue; the others are counted as rejected.
        Errors are unchanged, because those of a catalogue are only a part of the error of a match;
        stars of the catalogue whose motion is not measured but assumed are therefore not used.

    Raises
    ------
    InputError
        If the units differ, if an exposure does not match, or if there are proper motions but the
        table has no epoch.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> u, v = rng.uniform(0.0, 1000.0, (2, 60))
    >>> catalog = bd.ReferenceCatalog(u=u, v=v)
    >>> seen = bd.Matches(u + 1.0, v - 2.0, u + 1.0, v - 2.0)  # by a known distortion, shifted
    >>> found = bd.match_table(seen, catalog)
    >>> len(found)
    60
    """
    location = ", ".join(table.sources)
    if table.unit != catalog.unit:
        raise InputError(
            f"positions are in {table.unit}, those of {catalog.source} in {catalog.unit}",
            where=location,
            do="convert both to one unit",
        )
    if catalog.pm_u is not None and table.epoch is None:
        raise InputError(
            f"has no epoch, but {catalog.source} has proper motions",
            where=location,
            do="give the epoch of the exposures",
        )
    catalog = catalog.select(catalog.measured_motion)
    u, v = table.u.copy(), table.v.copy()
    star = np.zeros(len(table), np.int64)
    matched = np.zeros(len(table), bool)
    for code in np.unique(table.exposure):
        rows = np.flatnonzero(table.exposure == code)
        then = catalog
        if catalog.pm_u is not None and table.epoch is not None:
            then = catalog.at(float(table.epoch[rows].mean()))
        matching = match_to_catalog(
            table.u[rows],
            table.v[rows],
            then,
            mag=None if table.mag is None else table.mag[rows],
            radius=radius,
            max_offset=max_offset,
            source=f"{table.sources[table.source[rows[0]]]}, exposure {table.exposure_names[code]}",
        )
        pairs = rows[matching.index]
        u[pairs], v[pairs] = then.u[matching.catalog_index], then.v[matching.catalog_index]
        star[pairs] = then.star[matching.catalog_index]
        matched[pairs] = True
    selected = table.select(matched, reason="no counterpart in the catalogue")
    return selected.with_columns(
        u=u[matched],
        v=v[matched],
        star=star[matched],
        tangent_point=catalog.tangent_point,
    )
