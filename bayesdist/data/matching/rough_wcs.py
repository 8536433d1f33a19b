"""Match a table of detections with a catalogue on the sky, using a rough WCS.

The rough positions of the detections are brought onto the catalogue by a shift, rotation and scale
and, with enough pairs, a cubic. If the WCS is too inaccurate, the shift, rotation and scale are
found from the patterns of the stars. Pairs are then mutual nearest neighbours within the match
radius.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from astropy.table import Column, MaskedColumn, Table
from scipy.spatial import cKDTree

from bayesdist.data.matches import Matches
from bayesdist.data.matching.exposure import Pairs, iterated_pairs
from bayesdist.data.matching.pairs import (
    MIN_PAIRS,
    NARROW,
    LinearMap,
    are_enough,
    beats_chance,
    best_similarity,
    chance_rate,
    iterated_map,
    mutual_pairs,
    overlap,
)
from bayesdist.data.matching.rough_positions import (
    DETECTIONS,
    FROM_CATALOGUE,
    FROM_DETECTIONS,
    ChipExposure,
    RoughDetections,
    StarsOnSky,
    catalogue_stars,
    detections_on_sky,
)
from bayesdist.data.matching.similarity import brightest, find_similarity, grown_map, pattern_index
from bayesdist.data.reading.columns import CENTROIDS, present_columns
from bayesdist.data.reading.options import ReadOptions
from bayesdist.data.reading.table import match_arguments
from bayesdist.data.tables.column import Quantities, unit_of
from bayesdist.data.tables.names import ALIASES
from bayesdist.data.tangent import mean_direction, separation, tangent_plane
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import Direction, Epoch, Number, value_in

UNMATCHED = "no counterpart in the catalogue"
CATALOGUE_ERRORS_ALONE = (
    "the errors are those of the catalogue alone, because the detections have none; give "
    "sigma = 'by_magnitude' to estimate them from the residuals"
)
_MARGIN = 0.5  # field radii around the detections in which catalogue stars are used
_DISPLACEMENT = 10.0  # match radii by which detections are displaced to count chance pairs


def match(
    detections: Any,
    catalogue: Any,
    *,
    radius: Number,
    wcs: Any = None,
    columns: Mapping[str, str] | None = None,
    catalogue_columns: Mapping[str, str] | None = None,
    sigma: str | Number = "columns",
    epoch: Epoch | None = None,
    catalogue_epoch: Epoch | None = None,
    pixel_origin: int | None = None,
    tangent_point: Direction | None = None,
    chips: Mapping[str, int] | None = None,
    not_finite: str = "refuse",
    motion_prior: Number | None = None,
) -> Matches:
    """Match detections with a catalogue on the sky.

    The rough positions of the detections come from a WCS or from columns of ra and dec. They may be
    off by a shift, a rotation and a few per cent of the scale, which are fitted first. With at
    least 200 pairs a cubic is fitted as well, so that a distortion that the rough WCS does not
    include does not lose stars in the corners. Each chip of each exposure is matched separately.

    Parameters
    ----------
    detections : table or path
        Detections with detector positions in pixels: any table that `Matches.from_table` accepts,
        or a file.
    catalogue : table, SkyCoord, ReferenceCatalog or path
        Reference positions on the sky. If they have proper motions they are moved to the epoch of
        the detections.
    radius : Quantity or float
        Match radius: largest distance of a pair; a plain number is in arcsec.
    wcs : WCS, or mapping of WCS, optional
        Any WCS with the common Python interface (APE 14): `astropy.wcs.WCS`, a gwcs, or that of a
        run. A mapping gives one for each exposure or each chip number. By default `detections` must
        have columns of ra and dec.
    columns, catalogue_columns : mapping of str to str, optional
        Column of each quantity in the two tables, as for `ReadOptions`.
    sigma, epoch, catalogue_epoch, pixel_origin, tangent_point, chips, not_finite, motion_prior
        As for `ReadOptions`. Stars without a motion are also left out if the detections have
        sigma_u and sigma_v, which are the whole errors of the matches. The default tangent point is
        the mean direction of the detections.

    Returns
    -------
    Matches
        Magnitudes, fluxes and errors come from the detections if they have them, and otherwise from
        the catalogue, with all its correlations. Errors of centroids in pixels (x_err and others)
        are added to those of the catalogue. `star` is the column of that name in the catalogue, or
        else its row counted from 0. `u_nominal` and `v_nominal` are the positions by the refined
        WCS, and `match_radius` is the radius in arcsec. `notes` state how many detections were
        matched and how the WCS was refined; `rejected` counts the others.

    Raises
    ------
    InputError
        If the radius is not positive, if a table is empty, if there are proper motions without an
        epoch, or if the detections do not match the catalogue; the message then gives the
        separation of the two fields.

    Examples
    --------
    >>> from astropy.wcs import WCS
    >>> wcs = WCS(naxis=2)
    >>> wcs.wcs.ctype, wcs.wcs.crval = ["RA---TAN", "DEC--TAN"], [30.0, 5.0]
    >>> wcs.wcs.crpix, wcs.wcs.cdelt = [500.5, 500.5], [-1e-4, 1e-4]
    >>> x, y = np.random.default_rng(1).uniform(1, 1000, (2, 100))
    >>> sky = wcs.pixel_to_world(x - 1, y - 1)
    >>> seen = {"x": x + 4.0, "y": y - 3.0}  # the pointing is 5 pixels off
    >>> len(bd.match(seen, sky, radius=0.5, wcs=wcs, sigma=0.01))
    100
    """
    reach = value_in(radius, "arcsec", "radius")
    if not (np.isfinite(reach) and reach > 0):
        raise InputError(
            f"radius is {radius}", where="match", do="give a positive number of arcsec or an angle"
        )
    options = ReadOptions(
        None, None, sigma, pixel_origin, tangent_point, epoch, catalogue_epoch, chips, not_finite
    )
    if motion_prior is not None:
        options = replace(options, motion_prior=motion_prior)
    rough_detections = detections_on_sky(detections, columns, wcs, options)
    grows = options.read_sigma and "sigma_u" not in rough_detections.columns
    stars = catalogue_stars(catalogue, catalogue_columns, options, fill_motions=grows)
    point = options.tangent_point or mean_direction(rough_detections.ra, rough_detections.dec)
    collected = _Pairing(rough_detections, stars)
    for group in rough_detections.groups():
        collected.add(group, point, reach)
    return collected.matches(point, reach, options)


class _Pairing:
    """Pairs of all groups of detections, collected group by group."""

    def __init__(self, detections: RoughDetections, stars: StarsOnSky) -> None:
        self.detections, self.stars = detections, stars
        self.index: list[Int] = []  # rows among the detections
        self.partner: list[Int] = []  # rows among the catalogue stars
        self.nominal: list[Float] = []  # (n, 2), arcsec
        self.notes: list[str] = []

    def add(self, group: ChipExposure, point: tuple[float, float], radius: float) -> None:
        """Find the pairs of one group."""
        rough_detections = self.detections
        ra, dec = self.stars.at(group.epoch)
        nearby, place = _nearby(
            rough_detections.ra[group.rows], rough_detections.dec[group.rows], ra, dec
        )
        if len(nearby) < MIN_PAIRS:
            error = InputError(
                f"{len(nearby)} catalogue stars lie in the field of the detections: {place}",
                where=group.name,
                do="give the WCS of this image, or a catalogue of its field",
            )
            raise self.stars.failure(error)
        points = np.column_stack(
            tangent_plane(rough_detections.ra[group.rows], rough_detections.dec[group.rows], point)
        )
        reference = np.column_stack(tangent_plane(ra[nearby], dec[nearby], point))
        mag = None if rough_detections.mag is None else rough_detections.mag[group.rows]
        mags = None if mag is None or self.stars.mag is None else (mag, self.stars.mag[nearby])
        try:
            pairs = _aligned_pairs(points, reference, mags, radius, group.name, place)
        except InputError as error:
            raise self.stars.failure(error) from None
        self.index.append(group.rows[pairs.index])
        self.partner.append(nearby[pairs.partner])
        self.nominal.append(pairs.moved[pairs.index])
        self.notes.append(_words(group, points, reference, pairs, radius))

    def matches(self, point: tuple[float, float], radius: float, options: ReadOptions) -> Matches:
        """Matches of all pairs, in the order of the detections."""
        rough_detections, stars = self.detections, self.stars
        index, partner = np.concatenate(self.index), np.concatenate(self.partner)
        nominal = np.concatenate(self.nominal)
        order = np.argsort(index, kind="stable")
        index, partner, nominal = index[order], partner[order], nominal[order]
        table = Table()
        sources = {
            key: rough_detections.columns
            for key in ("x", "y", *FROM_DETECTIONS)
            if key in rough_detections.columns
        }
        for key in FROM_CATALOGUE:
            if key in stars.columns and not ({key} | _INSTEAD.get(key, set())) & sources.keys():
                sources[key] = stars.columns
        names = {}
        for key, columns in sources.items():
            # names of the errors of centroids tell errors from variances
            names[key] = columns[key].name if key in CENTROIDS else key
            table[names[key]] = _column(
                columns, key, index if columns is rough_detections.columns else partner
            )
        notes = list(self.notes)
        has_own_errors = not {"sigma_u", "sigma_x"}.isdisjoint(sources)
        if options.sigma == "columns" and "sigma_ra" in sources and not has_own_errors:
            notes.append(CATALOGUE_ERRORS_ALONE)
        if "star" not in table.colnames:
            table["star"] = stars.rows[partner]
        table["u_nominal"], table["v_nominal"] = nominal.T
        if rough_detections.epoch is not None and "epoch" not in table.colnames:
            table["epoch"] = rough_detections.epoch[index]
        unused = dict.fromkeys(ALIASES, "")
        unnamed = {name: name for name in table.colnames if name not in names.values()}
        named = unused | unnamed | names
        read = present_columns(
            table.colnames, named, source=DETECTIONS, read_sigma=options.read_sigma
        )
        settings = ReadOptions(
            columns={key: name if key in read else "" for key, name in named.items()},
            sigma=options.sigma,
            pixel_origin=rough_detections.origin,
            tangent_point=point,
            catalogue_epoch=stars.epoch,
            chips=options.chips,
            not_finite=options.not_finite,
        )
        arguments = match_arguments(table, settings, source=DETECTIONS)
        lost = (
            {UNMATCHED: len(rough_detections.rows) - len(index)}
            if len(rough_detections.rows) > len(index)
            else {}
        )
        arguments |= {
            "row": rough_detections.rows[index][arguments["row"]],
            "n_rows": rough_detections.n_rows,
            "rejected": {**rough_detections.rejected, **lost, **arguments["rejected"]},
            "match_radius": radius,
            "notes": (*rough_detections.notes, *stars.notes, *notes, *arguments["notes"]),
        }
        matches = Matches.of_distinct_rows(**arguments).as_read(options.sigma)
        u, v = (matches.column(name) for name in ("u_nominal", "v_nominal"))
        away = np.hypot(matches.u - u, matches.v - v)
        # the dates of individual detections and rounding on the plane may move a star out of the
        # circle
        return (
            matches if (away <= radius).all() else matches.select(away <= radius, reason=UNMATCHED)
        )


# quantities of the catalogue that are not used if the detections have these others
_INSTEAD = {"mag": {"flux"}, "flux": {"mag"}}


def _column(columns: Quantities, key: str, rows: Int) -> Any:
    """Rows of the column of a quantity, with the unit that its name implies."""
    column = columns[key]
    values = column.values[rows]
    if column.usual_unit is None or unit_of(values, where=column.where) is not None:
        return values
    kind = MaskedColumn if hasattr(values, "mask") else Column
    return kind(values, unit=column.usual_unit)


def _nearby(ra: Float, dec: Float, star_ra: Float, star_dec: Float) -> tuple[Int, str]:
    """Indices of catalogue stars in and around the field, and text on both positions."""
    centre = mean_direction(ra, dec)
    size = float(separation(centre, ra, dec).max())
    away = separation(centre, star_ra, star_dec)
    centroid = mean_direction(star_ra, star_dec)
    apart = float(separation(centre, np.array([centroid[0]]), np.array([centroid[1]]))[0])
    place = (
        f"the detections lie around RA {centre[0]:.4f}, Dec {centre[1]:+.4f} by the rough WCS and "
        f"the catalogue around RA {centroid[0]:.4f}, Dec {centroid[1]:+.4f}, {_angle(apart)} away"
    )
    return np.flatnonzero(away <= (1.0 + _MARGIN) * size), place


def _angle(degrees: float) -> str:
    """Angle as text."""
    if degrees >= 1.0:
        return f"{degrees:.3g} degrees"
    return f"{60 * degrees:.3g} arcmin" if degrees >= 1 / 60 else f"{3600 * degrees:.3g} arcsec"


def _aligned_pairs(
    points: Float,
    reference: Float,
    mags: tuple[Float, Float] | None,
    radius: float,
    name: str,
    place: str,
) -> Pairs:
    """Pairs after the rough positions (N, 2) are brought onto the reference positions (M, 2).

    If `mags`, the magnitudes of both, are given, bright stars are tried first.
    """
    failure = InputError(
        f"does not match the catalogue: {place}",
        where=name,
        do="give the WCS of this image or a catalogue of its field, and check that the scale and "
        "the parity are right within 3 per cent",
    )
    tree = cKDTree(reference)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    start = LinearMap(np.eye(2), np.zeros(2), middle)
    reach = radius
    if not _agrees(points, reference, tree, radius):
        mag, star_mag = mags or (None, None)
        patterns = pattern_index(reference, star_mag)
        try:
            similarity = find_similarity(points, patterns, mag=mag, source=name)
        except InputError:
            raise failure from None
        start = grown_map(brightest(points, mag), similarity, patterns, narrow=NARROW)
        reach = max(NARROW * patterns.spacing, radius)
    linear = iterated_map(points, reference, tree, start, reach, radius)
    if linear is None:
        raise failure
    rho = np.hypot(*(points - middle).T)
    chip = np.zeros(len(points), np.int64)
    pairs = iterated_pairs(linear(points), chip, rho, reference, tree, radius, fixed=True)
    if pairs is None or not _enough(len(pairs.index), pairs.moved, reference):
        raise failure
    return pairs


def _agrees(points: Float, reference: Float, tree: cKDTree, radius: float) -> bool:
    """True if the rough positions alone give more pairs than chance."""
    index, _, distance = mutual_pairs(points, reference, radius, tree=tree)
    return _enough(len(index), points, reference) and beats_chance(
        points, reference, tree, distance
    )


def _enough(n: int, points: Float, reference: Float) -> bool:
    """True if n pairs are convincing, given the reference stars in the area of the points."""
    return are_enough(n, len(points), overlap(points, reference)[0])


def _words(
    group: ChipExposure, points: Float, reference: Float, pairs: Pairs, radius: float
) -> str:
    """Clause on the pairs of a group and the refinement of its WCS."""
    tree, n = cKDTree(reference), len(pairs.index)
    stars = tree.query_ball_point(pairs.moved[pairs.index], radius, return_length=True)
    around = cKDTree(pairs.moved).query_ball_point(
        reference[pairs.partner], radius, return_length=True
    )
    ambiguous = int(((stars > 1) | (around > 1)).sum())
    onto = best_similarity(points[pairs.index], reference[pairs.partner])
    turn, shift = complex(*onto.matrix[:, 0]), np.hypot(*onto.shift)
    free = np.ones(len(reference), bool)
    free[pairs.partner] = False
    chance = 0.0
    if free.any():
        lost = cKDTree(reference[free])
        chance = chance_rate(pairs.moved, lost, radius, _DISPLACEMENT * radius)
    return (
        f"{group.name}: {n} of {len(points)} were matched within {radius:.3g} arcsec, "
        f"{len(points) - n} have no counterpart, {ambiguous} matches are ambiguous (another star "
        f"or detection lies within the radius), and a detection without counterpart finds a star "
        f"by chance with probability {chance:.2g}; the rough WCS was refined by "
        f"{shift:.3g} arcsec, {np.degrees(np.angle(turn)):.3g} degrees and a scale of "
        f"{abs(turn):.6g}"
    )
