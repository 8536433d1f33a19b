"""Detections and catalogue stars with positions on the sky, as input of the matching.

The positions of the detections are rough: from a WCS, or from columns of ra and dec.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import QTable, Table

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.matches import Matches
from bayesdist.data.reading.centroids import check_ellipses, with_variances
from bayesdist.data.reading.columns import CENTROIDS
from bayesdist.data.reading.motions import NEEDED, with_prior_motions
from bayesdist.data.reading.options import ReadOptions
from bayesdist.data.reading.table import SKY_COLUMN, as_table, icrs_of, own_epoch, with_sky_columns
from bayesdist.data.sky import MOTIONS, PARAMETERS, SKY_QUANTITIES, reference_sky, sky_columns
from bayesdist.data.tables.checks import without_missing
from bayesdist.data.tables.column import Quantities
from bayesdist.data.tables.names import ALIASES, ASSUMED, NO_MOTION, PAIRS, find_columns, origin_of
from bayesdist.data.tangent import sky_of_plane, tangent_jacobian
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.utils.arrays import Float, Int

DETECTIONS, CATALOGUE = "detections", "catalogue"
OUTSIDE = "outside the field of the WCS"
FROM_DETECTIONS = (
    *("exposure", "chip", "filter", "epoch", "mag", "flux", "colour"),
    *("sigma_u", "sigma_v", "rho_uv", *CENTROIDS),
)
FROM_CATALOGUE = ("ra", "dec", *SKY_QUANTITIES, "mag", "flux", "colour", "star", ASSUMED)


@dataclass(frozen=True, eq=False)
class StarsOnSky:
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
class ChipExposure:
    """Detections on one chip of one exposure."""

    rows: Int
    name: str
    epoch: float | None


@dataclass(frozen=True, eq=False)
class RoughDetections:
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

    def groups(self) -> Iterator[ChipExposure]:
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
                yield ChipExposure(rows, ", ".join((DETECTIONS, *words)), epoch)


def detections_on_sky(
    detections: Any, columns: Mapping[str, str] | None, wcs: Any, options: ReadOptions
) -> RoughDetections:
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
        k: name for k, name in column_names.items() if k in ("x", "y", *rough, *FROM_DETECTIONS)
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
    return RoughDetections(
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


def catalogue_stars(
    catalogue: Any,
    columns: Mapping[str, str] | None,
    options: ReadOptions,
    *,
    fill_motions: bool,
) -> StarsOnSky:
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
    column_names = {key: name for key, name in column_names.items() if key in FROM_CATALOGUE}
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
    n_unmoved = counts.get(NO_MOTION, 0)
    return StarsOnSky(quantities, rows, moving, epoch, mag, notes, n_unmoved)


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
        return _sky_of_pixels(wcs, x, y)
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
            ra[rows], dec[rows] = _sky_of_pixels(by_name[name], x[rows], y[rows])
    return ra, dec


def _sky_of_pixels(wcs: Any, x: Float, y: Float) -> tuple[Float, Float]:
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
