"""Reading of reference catalogues, with missing proper motions from a prior."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bayesdist.data.catalog import PAIRS, PARALLAX, SIGMAS, ReferenceCatalog
from bayesdist.data.covariances import with_correlations
from bayesdist.data.reading.columns import is_on_sky, plane_unit, position_unit
from bayesdist.data.reading.motions import prior_in_mas, with_prior_motions
from bayesdist.data.reading.table import as_table, with_sky_columns
from bayesdist.data.sky import CORRELATIONS, PARAMETERS, correlation_matrices, sky_columns
from bayesdist.data.tables.checks import refuse_half, row_number, without_missing
from bayesdist.data.tables.column import Quantities, SourceColumn
from bayesdist.data.tables.names import ALIASES, find_columns
from bayesdist.data.tangent import onto_plane, tangent_jacobian
from bayesdist.errors import InputError
from bayesdist.files.fits import MISSING_EXTENSIONS
from bayesdist.files.tables import read_table
from bayesdist.utils.arrays import Bool, Float, Int
from bayesdist.utils.quantities import Direction, Epoch, Number, direction_in, year_of

_ALIASES: dict[str, tuple[str, ...]] = {
    "u": ("u", "x0", "xi"),
    "v": ("v", "y0", "eta"),
    "ra": ALIASES["ra"],
    "dec": ALIASES["dec"],
    "sigma_u": ("sigma_u", "su", "u_error", "x0e", *ALIASES["sigma_ra"], *ALIASES["sigma_u"]),
    "sigma_v": ("sigma_v", "sv", "v_error", "y0e", *ALIASES["sigma_dec"], *ALIASES["sigma_v"]),
    "pm_u": ("pm_u", "vx", *ALIASES["pm_ra"]),
    "pm_v": ("pm_v", "vy", *ALIASES["pm_dec"]),
    "sigma_pm_u": ("sigma_pm_u", "vxe", *ALIASES["sigma_pm_ra"]),
    "sigma_pm_v": ("sigma_pm_v", "vye", *ALIASES["sigma_pm_dec"]),
    "parallax": ALIASES["parallax"],
    "sigma_parallax": ALIASES["sigma_parallax"],
    "epoch": ("epoch", "t0", *ALIASES["catalogue_epoch"]),
    "mag": (*ALIASES["mag"], "g", "m"),
    "star": ALIASES["star"],
    "rho_uv": ALIASES["rho_uv"],
    **{key: ALIASES[key] for key in sorted(CORRELATIONS)},
}
_NAME_PAIRS = (("u", "v"), ("ra", "dec"), *PAIRS)
# keys under which tables of matches know these quantities
_ALSO = {"sigma_ra": "sigma_u", "sigma_dec": "sigma_v", "pm_ra": "pm_u", "pm_dec": "pm_v"}
_ALSO |= {"sigma_pm_ra": "sigma_pm_u", "sigma_pm_dec": "sigma_pm_v", "catalogue_epoch": "epoch"}
_IN_MATCHES = {key: name for name, key in _ALSO.items() if key != "epoch"}
_MOTIONS = frozenset(("pm_u", "pm_v", "sigma_pm_u", "sigma_pm_v"))
# missing values of these quantities count as 0
_SPARED = frozenset(PARALLAX) | CORRELATIONS


def read_catalog(
    path: str | Path,
    columns: Mapping[str, str] | None = None,
    *,
    unit: str | None = None,
    epoch: Epoch | None = None,
    tangent_point: Direction | None = None,
    motion_prior: Number | None = None,
) -> ReferenceCatalog:
    r"""Read a reference catalogue from a table file.

    Parameters
    ----------
    path : path-like
        .ecsv, .csv, .fits or .parquet file.
    columns, unit, epoch, tangent_point, motion_prior
        As for `catalog_from_table`.

    Returns
    -------
    ReferenceCatalog
        Reference stars of the file.

    Raises
    ------
    InputError
        As for `catalog_from_table`, and if the file cannot be read.

    Examples
    --------
    >>> from pathlib import Path
    >>> n = Path("catalog.csv").write_text("u,v,mag\n0,5,18.1\n30,-10,19.4\n")
    >>> bd.read_catalog("catalog.csv", unit="arcsec").mag.tolist()
    [18.1, 19.4]
    """
    path = Path(path)
    return catalog_from_table(
        read_table(path),
        columns,
        source=str(path),
        unit=unit,
        epoch=epoch,
        tangent_point=tangent_point,
        motion_prior=motion_prior,
    )


def catalog_from_table(
    table: Any,
    columns: Mapping[str, str] | None = None,
    *,
    source: str = "catalogue",
    unit: str | None = None,
    epoch: Epoch | None = None,
    tangent_point: Direction | None = None,
    motion_prior: Number | None = None,
) -> ReferenceCatalog:
    """Reference catalogue from the columns of a table.

    Parameters
    ----------
    table : table
        Any object that `Matches.from_table` accepts.
    columns : mapping of str to str, optional
        Column of each quantity: u v ra dec sigma_u sigma_v rho_uv pm_u pm_v sigma_pm_u sigma_pm_v
        parallax sigma_parallax epoch mag star, and the correlations corr_ra_dec and others of
        `ReadOptions`; an empty name omits the quantity. With ra and dec, positions are projected to
        the tangent plane in arcsec. pm_u (pm_ra) is then the motion to the east, which includes the
        factor cos(dec); errors, motions and correlations are rotated to the axes of the plane; and
        stars with a missing value are left out. Missing correlations count as 0.
    source : str, optional
        Name of the file, for error messages.
    unit : str, optional
        Unit of u and v if the table states none. Errors and motions without a unit are in that of u
        and v, per year. With ra and dec they must have a unit, in the file or implied by the names
        of the Gaia archive or VizieR.
    epoch : float, str, Time, date or Quantity, optional
        Epoch of the positions, if the table has no such column.
    tangent_point : SkyCoord, or pair of float or Quantity, optional
        Tangent point. The default is the mean direction of the stars.
    motion_prior : float or Quantity, optional
        Standard deviation on each axis of the motions of stars without a measured one, in mas per
        year if it is a number. The default is the scatter of the other stars, if there are at least
        30; with fewer, and without errors of positions and motions, such stars are left out. With
        fewer than 30, the error of the median of the others is added in quadrature.

    Returns
    -------
    ReferenceCatalog
        Reference stars of the table.

    Raises
    ------
    InputError
        If columns are missing, if values are missing or not numbers, if units are missing or
        contradictory, or if `motion_prior` is not positive or given without errors of positions and
        motions.
    """
    if epoch is not None:
        epoch = year_of(epoch, where=source)
    if motion_prior is not None:
        motion_prior = prior_in_mas(motion_prior, source)
    point = None
    if tangent_point is not None:
        point = direction_in(tangent_point, "tangent_point", where=source)
    table = with_sky_columns(as_table(table, source))
    named = {_ALSO.get(key, key): name for key, name in (columns or {}).items()}
    column_names = find_columns(table.colnames, named, _ALIASES, source=source, pairs=_NAME_PAIRS)
    on_sky = is_on_sky(table.colnames, column_names, named, source)
    first, second = ("ra", "dec") if on_sky else ("u", "v")
    if first not in column_names or second not in column_names:
        raise InputError(
            f"no columns for u, v or ra, dec among {', '.join(table.colnames) or 'none'}",
            where=source,
            do="rename the columns, or name them with the option 'columns'",
        )
    refuse_half(PAIRS[0], column_names, where=source, what="errors")
    unread = _unread(column_names, on_sky=on_sky)
    column_names = {key: name for key, name in column_names.items() if key not in unread}
    if on_sky:
        base = plane_unit(unit, source=source)
    else:
        u, v = (Quantities(table, column_names, source)[key] for key in ("u", "v"))
        base = position_unit((u, v), unit)
    n_rows = len(table)
    stars = _usable(table, column_names, source, base=base, motion_prior=motion_prior)
    cut = table.meta.get(MISSING_EXTENSIONS)
    notes = (*((f"{source}: {cut}",) if cut else ()), *stars.notes)
    table, rows = stars.table, stars.rows
    quantities = Quantities(table, column_names, source, lambda index: row_number(int(rows[index])))
    column = quantities.__getitem__

    def values(key: str, per_year: str = "") -> Float:
        if on_sky and column(key).unit is None:
            # catalogues use degrees for positions and mas for other columns, so no default is safe
            raise InputError(
                "has no unit",
                where=column(key).where,
                do="write mas or mas / yr into the file, or leave out the column by an empty name "
                "in the option 'columns'",
            )
        numbers = column(key).numbers_or(0.0) if key in _SPARED else column(key).numbers()
        return numbers * column(key).factor(base + per_year)

    out: dict[str, Any] = {}
    if not on_sky:
        out |= {key: values(key) for key in ("u", "v")}
    for pair in PAIRS:
        if pair[0] in column_names:
            out |= {key: values(key, " / yr" if "pm" in key else "") for key in pair}
    out |= {key: values(key) for key in PARALLAX if key in column_names}
    if "mag" in column_names:
        out["mag"] = column("mag").numbers()
    if "star" in column_names:
        out["star"] = _identities(column("star"))
    elif len(rows) < n_rows:
        out["star"] = rows
    out["epoch"] = column("epoch").years() if "epoch" in column_names else epoch
    out["assumed_motion"] = stars.assumed if stars.assumed.any() else None
    if not on_sky:
        if "rho_uv" in column_names:
            out["correlations"] = _of_positions(column("rho_uv"))
        return ReferenceCatalog(**out, unit=base, source=source, notes=notes)
    out |= {"unit": base, "source": source, "notes": notes}
    return _on_plane(quantities, out, point)


@dataclass(frozen=True, eq=False)
class _Usable:
    """Rows of a table with all values that are needed."""

    table: Table
    rows: Int  # (N,), rows in the whole table
    assumed: Bool  # (N,), True for motions from a prior
    notes: tuple[str, ...]  # clauses on the others


def _usable(
    table: Table,
    found: Mapping[str, str],
    source: str,
    *,
    base: str,
    motion_prior: float | None,
) -> _Usable:
    """Rows with all values that are needed; missing motions come from a prior if it can be made."""
    on_sky = "ra" in found
    filled = with_prior_motions(
        table,
        {_IN_MATCHES.get(key, key): name for key, name in found.items()},
        source=source,
        sigma_mas_yr=motion_prior,
        reject=True,
        unit=None if on_sky else base,
    )
    rows = np.arange(len(table))
    needed = found if on_sky else {key: found[key] for key in _MOTIONS & found.keys()}
    if not needed or not len(table):
        return _Usable(filled.table, rows, filled.assumed, filled.notes)
    stay, counts = without_missing(
        filled.table, needed, source=source, reject=False, spared=_SPARED, motions=_MOTIONS
    )
    left_out = [f"{n} stars are left out: {reason}" for reason, n in counts.items()]
    return _Usable(filled.table[stay], rows[stay], filled.assumed[stay], (*filled.notes, *left_out))


def _unread(found: Collection[str], *, on_sky: bool) -> set[str]:
    """Quantities that are not read although a table has them, because others are missing."""
    unread = {"u", "v", "rho_uv"} if on_sky else {"ra", "dec", *PARALLAX, *CORRELATIONS}
    unread |= {name for pair in PAIRS for name in pair if not set(pair) <= set(found)}
    if on_sky and "pm_u" in unread:
        unread |= _MOTIONS
    if "sigma_u" in unread:
        unread |= {"rho_uv", *CORRELATIONS}
    return unread


def _on_plane(
    quantities: Quantities, out: dict[str, Any], point: tuple[float, float] | None
) -> ReferenceCatalog:
    """Catalogue on a tangent plane, from arguments of `ReferenceCatalog` along east and north."""
    sky_errors = {
        name: out[key] for name, key in zip(PARAMETERS, SIGMAS, strict=True) if key in out
    }
    sigma, motion, sigma_motion = (
        np.stack([out.pop(key) for key in pair]) if pair[0] in out else None for pair in PAIRS
    )
    ra, dec = sky_columns(quantities)
    source = quantities.source
    out |= onto_plane(
        ra, dec, point, sigma=sigma, motion=motion, sigma_motion=sigma_motion, where=source
    )
    catalog = ReferenceCatalog(**out)
    correlations = correlation_matrices(quantities, sky_errors)
    if correlations is None:
        return catalog
    errors = np.stack([sky_errors.get(name, np.zeros(len(ra))) for name in PARAMETERS], axis=1)
    return catalog.with_errors_of(
        with_correlations(errors, correlations),
        tangent_jacobian(ra, dec, out["tangent_point"], where=source),
    )


def _of_positions(column: SourceColumn) -> Float:
    """Correlation matrices (N, 5, 5) from a column with the correlation of u and v."""
    rho = column.numbers_or(0.0)
    beyond = np.abs(rho) > 1.0
    if beyond.any():
        bad = int(np.argmax(beyond))
        raise column.fail(bad, f"a correlation is {rho[bad]:g}, but must be at most 1")
    out = np.tile(np.eye(len(SIGMAS)), (len(rho), 1, 1))
    out[:, 0, 1] = out[:, 1, 0] = rho
    return out


def _identities(column: SourceColumn) -> Int:
    """Codes of the stars; InputError if a code is repeated."""
    star = column.integers()
    unique, first = np.unique(star, return_index=True)
    if len(unique) < len(star):
        repeated = int(np.setdiff1d(np.arange(len(star)), first)[0])
        raise column.fail(repeated, f"star {star[repeated]} occurs twice")
    return star
