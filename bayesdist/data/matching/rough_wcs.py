"""Match a table of detections with a catalogue on the sky, using a rough WCS.

The rough positions of the detections are brought onto the catalogue by a shift, rotation and scale
and, with enough pairs, a cubic. If the WCS is too inaccurate, the shift, rotation and scale are
found from the patterns of the stars. Pairs are then mutual nearest neighbours within the match
radius.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Column, MaskedColumn, QTable, Table
from scipy.spatial import cKDTree

from bayesdist.data.catalog import ReferenceCatalog
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
from bayesdist.data.matching.similarity import (
    brightest,
    find_similarity,
    grown_map,
    pattern_index,
)
from bayesdist.data.reading.centroids import check_ellipses, with_variances
from bayesdist.data.reading.columns import CENTROIDS, present_columns
from bayesdist.data.reading.motions import NEEDED, with_prior_motions
from bayesdist.data.reading.options import ReadOptions
from bayesdist.data.reading.table import (
    SKY_COLUMN,
    as_table,
    icrs_of,
    match_arguments,
    own_epoch,
    with_sky_columns,
)
from bayesdist.data.sky import (
    MOTIONS,
    PARAMETERS,
    SKY_QUANTITIES,
    mean_direction,
    reference_sky,
    separation,
    sky_columns,
    sky_of_plane,
    tangent_jacobian,
    tangent_plane,
)
from bayesdist.data.tables.checks import without_missing
from bayesdist.data.tables.column import Quantities, unit_of
from bayesdist.data.tables.names import ALIASES, ASSUMED, PAIRS, find_columns, origin_of
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import Direction, Epoch, Number, value_in

DETECTIONS, CATALOGUE = "detections", "catalogue"
UNMATCHED = "no counterpart in the catalogue"
OUTSIDE = "outside the field of the WCS"
CATALOGUE_ERRORS_ALONE = (
    "the errors are those of the catalogue alone, because the detections have none; give "
    "sigma = 'by_magnitude' to estimate them from the residuals"
)
_FROM_DETECTIONS = (
    *(
        "exposure",
        "chip",
        "filter",
        "epoch",
        "mag",
        "flux",
        "colour",
        "sigma_u",
        "sigma_v",
        "rho_uv",
        *CENTROIDS,
    ),
)
_FROM_CATALOGUE = ("ra", "dec", *SKY_QUANTITIES, "mag", "flux", "colour", "star", ASSUMED)
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
    rough_detections = _detections(detections, columns, wcs, options)
    grows = options.read_sigma and "sigma_u" not in rough_detections.columns
    stars = _reference(catalogue, catalogue_columns, options, fill_motions=grows)
    point = options.tangent_point or mean_direction(rough_detections.ra, rough_detections.dec)
    collected = _Found(rough_detections, stars)
    for group in rough_detections.groups():
        collected.add(group, point, reach)
    return collected.matches(point, reach, options)


# -- the two tables -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Stars:
    """Catalogue stars with a position, and with a motion if the catalogue has motions."""

    columns: Quantities
    rows: Int  # (M,), rows in the catalogue
    moving: bool
    epoch: float | None  # epoch of the positions, if it is not a column
    mag: Float | None  # (M,), infinite if unknown
    notes: tuple[str, ...]
    n_unmoved: int = 0  # stars that are left out because they have no motion

    def failure(self, error: InputError) -> InputError:
        """Error of matching that names missing motions if most stars are left out for them."""
        if self.n_unmoved <= len(self.rows):
            return error
        return InputError(
            f"{error.cause}; {self.n_unmoved} of {self.n_unmoved + len(self.rows)} catalogue stars "
            "are left out, as they have no proper motion",
            where=error.where,
            do="give errors of positions and motions and motion_prior, a catalogue with more "
            'motions, or leave out the motions: catalogue_columns={"pm_ra": "", "pm_dec": ""}',
        )

    def at(self, epoch: float | None) -> tuple[Float, Float]:
        """Right ascension and declination (M,) in degrees at an epoch."""
        if not self.moving:
            return sky_columns(self.columns)
        if epoch is None:
            raise InputError(
                "has proper motions, but the epoch of the detections is not given",
                where=CATALOGUE,
                do="give epoch, or leave out the motions: "
                'catalogue_columns={"pm_ra": "", "pm_dec": ""}',
            )
        dates = np.full(len(self.rows), epoch)
        sky = reference_sky(self.columns, epoch=dates, catalogue_epoch=self.epoch)
        return sky.ra, sky.dec


@dataclass(frozen=True, eq=False)
class _Group:
    """Detections on one chip of one exposure."""

    rows: Int
    name: str
    epoch: float | None


@dataclass(frozen=True, eq=False)
class _Seen:
    """Detections with a rough position on the sky."""

    columns: Quantities
    rows: Int  # (N,), rows in the table
    n_rows: int
    rejected: dict[str, int]
    ra: Float  # (N,), degrees, from the rough WCS
    dec: Float
    mag: Float | None
    epoch: Float | None  # (N,), decimal years
    exposure: Int  # (N,), codes
    chip: Int
    # names of exposures and chips; empty without such columns
    names: tuple[tuple[str, ...], tuple[str, ...]]
    origin: int
    notes: tuple[str, ...]

    def groups(self) -> Iterator[_Group]:
        """Groups of detections, one for each chip of each exposure."""
        for exposure in np.unique(self.exposure):
            for chip in np.unique(self.chip[self.exposure == exposure]):
                rows = np.flatnonzero((self.exposure == exposure) & (self.chip == chip))
                words = [
                    f"{key} {names[code]}"
                    for key, names, code in zip(
                        ("exposure", "chip"), self.names, (exposure, chip), strict=True
                    )
                    if names
                ]
                epoch = None if self.epoch is None else float(self.epoch[rows].mean())
                yield _Group(rows, ", ".join((DETECTIONS, *words)), epoch)


def _table_of(data: Any, source: str) -> Table:
    """Table with at least one row, from an object or a file."""
    if isinstance(data, str | os.PathLike):
        data = read_table(Path(data))
    if isinstance(data, Matches):
        data = data.to_table()
    table = with_sky_columns(as_table(data, source))
    if not len(table):
        raise InputError("holds no rows", where=source, do="give a table with stars")
    return table


def _catalogue_table(catalogue: Any) -> Table:
    from astropy.coordinates import SkyCoord

    if isinstance(catalogue, SkyCoord):
        return _table_of(QTable({SKY_COLUMN: icrs_of(catalogue, None, where=CATALOGUE)}), CATALOGUE)
    if isinstance(catalogue, ReferenceCatalog):
        return _table_of(_sky_table_of(catalogue), CATALOGUE)
    return _table_of(catalogue, CATALOGUE)


def _sky_table_of(catalogue: ReferenceCatalog) -> QTable:
    """Table with sky coordinates of a catalogue on a tangent plane."""
    from astropy import units as apu

    if catalogue.tangent_point is None or catalogue.unit == "pix":
        raise InputError(
            "does not lie on the sky: its tangent point or its angles are not known",
            where=catalogue.source,
            do="read it from ra and dec, or match positions on a plane with match_table",
        )
    catalogue = catalogue.rescaled(float(apu.Unit(catalogue.unit).to("arcsec")), "arcsec")
    point = catalogue.tangent_point or (0.0, 0.0)
    ra, dec = sky_of_plane(catalogue.u, catalogue.v, point)
    if catalogue.correlations is not None:
        from_plane = np.asarray(np.linalg.inv(tangent_jacobian(ra, dec, point)), float)
        catalogue = catalogue.with_errors_of(catalogue.covariances, from_plane)
    table = QTable({"ra": ra * apu.deg, "dec": dec * apu.deg, "star": catalogue.star})
    names = {"ra_error": "sigma_u", "dec_error": "sigma_v", "parallax": "parallax",
             "parallax_error": "sigma_parallax"}  # fmt: skip
    motions = {"pmra": "pm_u", "pmdec": "pm_v", "pmra_error": "sigma_pm_u",
               "pmdec_error": "sigma_pm_v"}  # fmt: skip
    for columns, unit in ((names, apu.arcsec), (motions, apu.arcsec / apu.yr)):
        for name, key in columns.items():
            if getattr(catalogue, key) is not None:
                table[name] = getattr(catalogue, key) * unit
    if catalogue.correlations is not None:
        for (i, first), (j, second) in combinations(enumerate(PARAMETERS), 2):
            name = ALIASES[f"corr_{first}_{second}"][0]
            table[name] = catalogue.correlations[:, i, j]
    if catalogue.mag is not None:
        table["mag"] = catalogue.mag
    if catalogue.epoch is not None:
        table["ref_epoch"] = np.broadcast_to(catalogue.epoch, len(catalogue))
    return table


def _reference(
    catalogue: Any,
    columns: Mapping[str, str] | None,
    options: ReadOptions,
    *,
    fill_motions: bool,
) -> _Stars:
    """Catalogue stars with the quantities that are used.

    With `fill_motions`, stars without a motion keep the assumed one of a `ReferenceCatalog`, with
    its error, or get one from a prior if one can be made; otherwise they are left out.
    """
    table = _catalogue_table(catalogue)
    column_names = find_columns(
        table.colnames, columns, ALIASES, source=CATALOGUE, pairs=PAIRS, needed=("ra", "dec")
    )
    if "epoch" in column_names:
        column_names.setdefault("catalogue_epoch", column_names["epoch"])
    column_names = {key: name for key, name in column_names.items() if key in _FROM_CATALOGUE}
    epoch = options.catalogue_epoch if "catalogue_epoch" not in column_names else None
    moving = "pm_ra" in column_names
    if moving and "catalogue_epoch" not in column_names and epoch is None:
        raise InputError(
            "has proper motions, but the epoch of its positions is not given",
            where=CATALOGUE,
            do="give catalogue_epoch, or leave out the motions: "
            'catalogue_columns={"pm_ra": "", "pm_dec": ""}',
        )
    of_motions: tuple[str, ...] = ()
    assumed = catalogue.assumed_motion if isinstance(catalogue, ReferenceCatalog) else None
    if moving and assumed is not None:
        if fill_motions and options.motion_prior is None and column_names.keys() >= NEEDED:
            of_motions = (
                f"{np.count_nonzero(assumed)} of {len(table)} stars of the catalogue have a motion "
                "that is not measured but assumed, with its error",
            )
        else:
            for key in MOTIONS[:2]:
                table[column_names[key]][assumed] = np.nan
    if moving and fill_motions:
        filled = with_prior_motions(
            table, column_names, source=CATALOGUE, sigma_mas_yr=options.motion_prior, reject=True
        )
        table, of_motions = filled.table, (*of_motions, *filled.notes)
        prior = filled.assumed if assumed is None else filled.assumed | assumed
        if prior.any():
            table = table.copy(copy_data=False)
            table[ASSUMED] = prior.astype(int)
            column_names[ASSUMED] = ASSUMED
    elif options.motion_prior is not None:
        raise InputError(
            "motion_prior is given, but no errors of matches include those of motions",
            where="match",
            do="leave it out, or read motions, and errors from columns of the catalogue",
        )
    read = {key: name for key, name in column_names.items() if key in ("ra", "dec", *MOTIONS)}
    stay, counts = without_missing(
        table,
        read,
        source=CATALOGUE,
        reject=options.not_finite == "reject",
        spared=frozenset(),
        motions=frozenset(MOTIONS),
    )
    rows = np.flatnonzero(stay)
    left_out = [f"{n} catalogue stars are left out: {reason}" for reason, n in counts.items()]
    notes = (*of_motions, *left_out)
    quantities = Quantities(table[rows], column_names, CATALOGUE, names=table.colnames)
    mag = None
    if "mag" in column_names:
        mag = np.nan_to_num(quantities["mag"].known_numbers(), nan=np.inf)
    n_unmoved = counts.get("no proper motion", 0)
    return _Stars(quantities, rows, moving, epoch, mag, notes, n_unmoved)


def _detections(
    detections: Any, columns: Mapping[str, str] | None, wcs: Any, options: ReadOptions
) -> _Seen:
    """Detections with rough positions from the WCS, or from columns of ra and dec."""
    original = _table_of(detections, DETECTIONS)
    table = with_variances(original)
    if isinstance(detections, Matches) and detections.tangent_point is not None:
        _add_sky(table, detections)
    column_names = find_columns(
        table.colnames, columns, ALIASES, source=DETECTIONS, pairs=PAIRS, needed=("x", "y")
    )
    if wcs is None and not {"ra", "dec"} <= column_names.keys():
        raise InputError(
            "has no columns of ra and dec, and no WCS is given",
            where=DETECTIONS,
            do="give wcs, for example astropy.wcs.WCS(header)",
        )
    if options.read_sigma and "sigma_u" not in column_names:
        check_ellipses(original, column_names, DETECTIONS)
    rough = () if wcs is not None else ("ra", "dec")
    column_names = {
        k: name for k, name in column_names.items() if k in ("x", "y", *rough, *_FROM_DETECTIONS)
    }
    stay, rejected = without_missing(
        table,
        column_names,
        source=DETECTIONS,
        reject=options.not_finite == "reject",
        spared=frozenset(("colour", "flux")),
        motions=frozenset(),
    )
    rows = np.flatnonzero(stay)
    origin = options.pixel_origin
    notes: tuple[str, ...] = ()
    if origin is None:
        origin, why = origin_of(column_names["x"], table.colnames, table.meta)
        notes = (f"the first pixel is taken as {origin}: {why}",) if why else ()
    quantities = Quantities(table[rows], column_names, DETECTIONS, names=table.colnames)
    codes = {
        key: quantities[key].labels()
        if key in column_names
        else (np.zeros(len(rows), np.int64), ())
        for key in ("exposure", "chip")
    }
    if wcs is None:
        ra, dec = sky_columns(quantities)
    else:
        x, y = (quantities[key].numbers() - origin for key in ("x", "y"))
        ra, dec = _by_wcs(wcs, x, y, codes)
    inside = np.isfinite(ra) & np.isfinite(dec)
    if not inside.any():
        raise InputError(
            "all positions lie outside the field of the WCS",
            where=DETECTIONS,
            do="give the WCS of this image",
        )
    if not inside.all():
        rejected = rejected | {OUTSIDE: int((~inside).sum())}
        quantities = Quantities(table[rows[inside]], column_names, DETECTIONS, names=table.colnames)
    mag = None
    if "mag" in column_names:
        mag = quantities["mag"].numbers()
    elif "flux" in column_names:
        mag = quantities["flux"].magnitudes_of_fluxes()
    return _Seen(
        columns=quantities,
        rows=rows[inside],
        n_rows=len(table),
        rejected=rejected,
        ra=ra[inside],
        dec=dec[inside],
        mag=mag,
        epoch=_epochs(quantities, table.meta, options),
        exposure=codes["exposure"][0][inside],
        chip=codes["chip"][0][inside],
        names=(codes["exposure"][1], codes["chip"][1]),
        origin=origin,
        notes=notes,
    )


def _epochs(
    quantities: Quantities, header: Mapping[str, Any], options: ReadOptions
) -> Float | None:
    """Epochs (N,) of the detections: from the option, the column, or the header."""
    if options.epoch is not None and "epoch" in quantities:
        raise InputError(
            "an epoch of the exposures is given, but the table also has an epoch column",
            where=quantities["epoch"].where,
            do='leave one of them out (columns={"epoch": ""})',
        )
    if options.epoch is not None:
        return np.full(len(quantities), options.epoch)
    if "epoch" in quantities:
        return quantities["epoch"].years()
    stated = ReadOptions(epoch=own_epoch(header)).epoch
    return None if stated is None else np.full(len(quantities), stated)


def _add_sky(table: Table, matches: Matches) -> None:
    """Add ra and dec of matches on a tangent plane to their table."""
    from astropy import units as apu

    factor = float(apu.Unit(matches.unit).to("arcsec"))
    point = matches.tangent_point or (0.0, 0.0)
    ra, dec = sky_of_plane(factor * matches.u, factor * matches.v, point)
    table["ra"], table["dec"] = ra * apu.deg, dec * apu.deg


# -- rough positions ------------------------------------------------------------------------------


def _by_wcs(
    wcs: Any, x: Float, y: Float, codes: Mapping[str, tuple[Int, tuple[str, ...]]]
) -> tuple[Float, Float]:
    """Rough positions (N,) in degrees at 0-based pixels (N,)."""
    if not isinstance(wcs, Mapping) or hasattr(wcs, "cards"):  # a FITS header is a mapping as well
        if len(codes["chip"][1]) > 1:
            raise InputError(
                f"has {len(codes['chip'][1])} chips, but only one WCS is given",
                where=DETECTIONS,
                do="give wcs as a mapping from chip number to WCS",
            )
        return sky_of_pixels(wcs, x, y)
    ra, dec = np.full(len(x), np.nan), np.full(len(x), np.nan)
    by_name = {str(key): value for key, value in wcs.items()}
    key = next((k for k, (_, names) in codes.items() if by_name.keys() & set(names)), None)
    if key is None:
        raise InputError(
            f"wcs has the keys {', '.join(by_name)}, which are neither exposures nor chips of the "
            "detections",
            where=DETECTIONS,
            do="give a WCS for each exposure, or for each chip number",
        )
    code, names = codes[key]
    for number, name in enumerate(names):
        rows = np.flatnonzero(code == number)
        if len(rows) and name not in by_name:
            raise InputError(
                f"wcs has no key for {key} {name}", where=DETECTIONS, do="add its WCS to wcs"
            )
        if len(rows):
            ra[rows], dec[rows] = sky_of_pixels(by_name[name], x[rows], y[rows])
    return ra, dec


def sky_of_pixels(wcs: Any, x: Float, y: Float) -> tuple[Float, Float]:
    """Right ascension and declination (ICRS, degrees) at 0-based pixels, by any APE 14 WCS.

    NaN where the WCS gives no position. Raises InputError for other objects, and for a WCS that
    does not map two pixel axes to the sky.
    """
    low = getattr(wcs, "low_level_wcs", wcs)
    if not hasattr(low, "pixel_to_world_values"):
        raise InputError(
            f"is a {type(wcs).__name__}, which has no pixel_to_world",
            where="wcs",
            do="give a WCS object, for example astropy.wcs.WCS(header)",
        )
    if low.pixel_n_dim != 2:
        raise InputError(
            f"has {low.pixel_n_dim} pixel axes",
            where="wcs",
            do="give its two celestial axes, for example wcs.celestial",
        )
    from astropy.coordinates import SkyCoord
    from astropy.wcs.wcsapi import HighLevelWCSWrapper

    high = wcs if hasattr(wcs, "pixel_to_world") else HighLevelWCSWrapper(low)
    try:
        world = high.pixel_to_world(x, y)
    except Exception as error:  # every WCS class raises different exceptions
        raise InputError(
            f"gives no positions of the detections ({error})",
            where="wcs",
            do="check that it is the WCS of this image",
        ) from error
    world = world if isinstance(world, list | tuple) else [world]
    sky = next((coordinate for coordinate in world if isinstance(coordinate, SkyCoord)), None)
    if sky is None:
        raise InputError(
            "has no celestial axes", where="wcs", do="give a WCS that maps pixels to the sky"
        )
    icrs = sky.icrs
    return np.asarray(icrs.ra.deg, float), np.asarray(icrs.dec.deg, float)


# -- pairs ----------------------------------------------------------------------------------------


class _Found:
    """Pairs of all groups of detections, collected group by group."""

    def __init__(self, seen: _Seen, stars: _Stars) -> None:
        self.seen, self.stars = seen, stars
        self.index: list[Int] = []  # rows among the detections
        self.partner: list[Int] = []  # rows among the catalogue stars
        self.nominal: list[Float] = []  # (n, 2), arcsec
        self.notes: list[str] = []

    def add(self, group: _Group, point: tuple[float, float], radius: float) -> None:
        """Find the pairs of one group."""
        rough_detections = self.seen
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
        rough_detections, stars = self.seen, self.stars
        index, partner = np.concatenate(self.index), np.concatenate(self.partner)
        nominal = np.concatenate(self.nominal)
        order = np.argsort(index, kind="stable")
        index, partner, nominal = index[order], partner[order], nominal[order]
        table = Table()
        sources = {
            key: rough_detections.columns
            for key in ("x", "y", *_FROM_DETECTIONS)
            if key in rough_detections.columns
        }
        for key in _FROM_CATALOGUE:
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


def _words(group: _Group, points: Float, reference: Float, pairs: Pairs, radius: float) -> str:
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
