"""Conversion of table columns to the arrays of `Matches`; chip names are replaced by numbers."""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayesdist.data.covariances import LARGEST_RHO
from bayesdist.data.reading.centroids import with_centroid_errors
from bayesdist.data.reading.motions import refuse_unused_prior
from bayesdist.data.reading.options import ReadOptions
from bayesdist.data.sky import SKY_QUANTITIES, reference_sky
from bayesdist.data.tables.checks import refuse_half
from bayesdist.data.tables.column import EncodedColumn, Quantities, SourceColumn, check_unit
from bayesdist.data.tables.names import ALIASES, ASSUMED, PAIRS, find_columns, origin_of
from bayesdist.data.tangent import onto_plane
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int

CENTROIDS = ("sigma_x", "sigma_y", "rho_xy")  # errors of the centroids, in pixels
ERRORS = ("sigma_u", "sigma_v", "rho_uv", "sigma_ra", "sigma_dec", *CENTROIDS)


def position_unit(pair: tuple[SourceColumn, SourceColumn], unit: str | None) -> str:
    """Unit ('pix', 'arcsec', 'mas' or 'deg') of two columns, from the file or the option `unit`.

    `pair` has the columns u and v.  Raises InputError if both are missing, or if the file, the
    option or the two columns disagree.
    """
    if unit is not None:
        check_unit(unit, where="unit")
    stated: list[str | None] = []
    for column in pair:
        column_unit = column.unit
        stated.append(
            None if column_unit is None else check_unit(str(column_unit), where=column.where)
        )
    first, second = stated
    if first is not None and second is not None and first != second:
        raise InputError(
            f"unit is {second}, but {first} in column {pair[0].name!r}",
            where=pair[1].where,
            do="give both columns one unit",
        )
    own_unit = first or second
    if own_unit is None and unit is None:
        raise InputError(
            "has no unit",
            where=pair[0].where,
            do="set the unit option to pix, arcsec, mas or deg, or write the unit into the file",
        )
    if own_unit is not None and unit is not None and own_unit != unit:
        raise InputError(
            f"unit is {own_unit} in the file, but {unit} in the options",
            where=pair[0].where,
            do="correct one of the two",
        )
    return own_unit or unit or ""


def is_on_sky(
    names: Iterable[str],
    found: Mapping[str, str],
    columns: Mapping[str, str] | None,
    source: str,
) -> bool:
    """True if the reference positions are ra and dec rather than u and v.

    `found` is the column of each quantity, and `columns` are those named by the user.  Raises
    InputError if the user names both ra, dec and u, v.
    """
    named = {key for key, column in (columns or {}).items() if column}
    plane, sky = named & {"u", "v"}, named & {"ra", "dec"}
    if plane and sky:
        raise InputError(
            "columns names both u, v and ra, dec", where=source, do="name one of the two pairs"
        )
    on_sky, on_plane = {"ra", "dec"} <= set(found), {"u", "v"} <= set(found)
    if plane or not on_sky:
        return False
    # if there is a magnitude B, columns U and V are magnitudes as well
    return bool(sky) or not on_plane or "b" in {name.lower() for name in names}


def present_columns(
    names: Iterable[str],
    columns: Mapping[str, str] | None,
    *,
    source: str,
    read_sigma: bool = True,
) -> dict[str, str]:
    """Names of the columns by quantity: x, y, either u, v or ra, dec, and optional ones.

    `names` are the columns that the table has, and `columns` those chosen by the user, by quantity.
    Errors are omitted unless `read_sigma` is True.  Raises InputError if a column chosen by the
    user is not in the table.
    """
    names = list(names)
    present = find_columns(names, columns, ALIASES, source=source, pairs=PAIRS)
    on_sky = is_on_sky(names, present, columns, source)
    unread = {"u", "v"} if on_sky else {"ra", "dec", *SKY_QUANTITIES}
    if not read_sigma:
        unread |= {"sigma_u", "sigma_v", "rho_uv"}
    if not read_sigma or "sigma_u" in present:  # errors of the match include those of the catalogue
        unread |= {"sigma_ra", "sigma_dec", *CENTROIDS}
    if "mag" in present:
        unread.add("flux")
    return {key: name for key, name in present.items() if key not in unread}


def lacking_columns(found: Container[str]) -> list[str]:
    """Quantities that matches need and that `present_columns` has not found."""
    return [key for key in ("x", "y") if key not in found] + [
        key for key in ("u", "v") if key not in found and "ra" not in found
    ]


def needed_columns(
    names: Iterable[str],
    columns: Mapping[str, str] | None,
    *,
    source: str,
    read_sigma: bool = True,
) -> dict[str, str]:
    """Names of the columns by quantity, as returned by `present_columns`.

    The arguments are those of `present_columns`.  Raises InputError if a needed column is missing.
    """
    names = list(names)
    present = present_columns(names, columns, source=source, read_sigma=read_sigma)
    lacking = lacking_columns(present)
    if lacking:
        do = (
            f"name {'it' if len(lacking) == 1 else 'them'} in the option 'columns' "
            f"(bayesdist init --columns {','.join(f'{key}=NAME' for key in lacking)})"
        )
        if {"u", "v"} <= set(lacking):
            do += ", or positions on the sky as ra and dec"
        if "x" in present and "y" in present:
            do += ", or make the file one of the lists of a [campaign] or [selfcal]"
        raise InputError(
            f"no column for {', '.join(map(repr, lacking))} among {', '.join(names) or 'none'}",
            where=source,
            do=do,
        )
    return present


def columns_read(
    names: Sequence[str], header: Mapping[str, Any], options: ReadOptions, *, source: str
) -> tuple[dict[str, str], ReadOptions, tuple[str, ...]]:
    """Names of the columns by quantity, options with the pixel origin set, and notes on both.

    `names` are the columns of the table, and `header` may state the pixel origin.  Raises
    InputError if a needed column is missing, or an option requires a missing column or contradicts
    one.
    """
    needed = needed_columns(names, options.columns, source=source, read_sigma=options.read_sigma)
    _refuse_unused(options, needed, source)
    _refuse_unread(options, needed, source)
    notes: tuple[str, ...] = ()
    if options.pixel_origin is not None:
        return needed, options, notes
    origin, why = origin_of(needed["x"], names, header)
    if why:
        notes = (f"the first pixel is taken as {origin}: {why}", *notes)
    return needed, replace(options, pixel_origin=origin), notes


def _refuse_unused(options: ReadOptions, found: Mapping[str, str], source: str) -> None:
    """Raise InputError for options that need missing columns or that existing columns replace."""
    if "catalogue_epoch" in found:
        options.refuse(
            source,
            f"column {found['catalogue_epoch']!r} has it",
            "catalogue_epoch",
            do='leave {} out, or the column (columns = {{catalogue_epoch = ""}})',
        )
    elif "pm_ra" not in found:
        options.refuse(
            source,
            "no column of proper motions is read, and it serves them alone",
            "catalogue_epoch",
            do="leave {} out, or name the columns pm_ra and pm_dec",
        )
    if "star" in found:
        options.refuse(
            source,
            f"column {found['star']!r} says which rows are of one star",
            "same_position",
            do='leave {} out, or the column (columns = {{star = ""}})',
        )


def _refuse_unread(options: ReadOptions, found: Mapping[str, str], source: str) -> None:
    """Raise InputError for named columns, and a prior of motions, that would not be read."""
    by_sigma = "" if options.read_sigma else f"data.sigma is {options.sigma!r}"
    refuse_unused_prior(options.motion_prior, found, where=f"{source}, data.motion_prior")
    unread = [key for key, name in (options.columns or {}).items() if name and key not in found]
    if not unread:
        return
    key = unread[0]
    where = "on the sky" if "ra" in found else "u and v"
    why = f"the reference positions are {where}"
    if key == "flux" and "mag" in found:
        why = f"column {found['mag']!r} has magnitudes"
    elif key in ERRORS and by_sigma:
        why = by_sigma
    elif key in ERRORS and "sigma_u" in found:
        why = f"column {found['sigma_u']!r} has the errors of u"
    raise InputError(
        f"column {(options.columns or {})[key]!r} is named for {key!r}, which is not read: {why}",
        where=f"{source}, columns",
        do=f"leave {key!r} out",
    )


def are_moved(options: ReadOptions, found: Mapping[str, str], source: str) -> bool:
    """True if positions are moved from the epoch of the catalogue to that of the exposures.

    `found` are the columns by quantity.  Raises InputError if an option of these motions is given
    and one of the epochs is not known.
    """
    if "pm_ra" not in found:
        return False
    lacking = "" if options.epoch is not None or "epoch" in found else "exposures"
    if options.catalogue_epoch is None and "catalogue_epoch" not in found:
        lacking = "catalogue"
    if lacking:
        options.refuse(
            source,
            f"no motions are applied, since the epoch of the {lacking} is not known",
            *("catalogue_epoch", "motion_prior"),
            do="leave {} out, or give "
            + ("data.epoch" if lacking == "exposures" else "data.catalogue_epoch"),
        )
    return not lacking


def match_columns(quantities: Quantities, options: ReadOptions) -> dict[str, Any]:
    """Arguments of `Matches` from the rows of a table, by name.

    The columns are those found by `needed_columns`.  Raises InputError if values are invalid, or if
    an option contradicts the columns.
    """
    present, column = quantities.found, quantities.__getitem__
    out: dict[str, Any] = {}
    out["x"], out["y"] = (_pixels(column(key), options.pixel_origin) for key in ("x", "y"))
    if "epoch" in present:
        if options.epoch is not None:
            raise InputError(
                "an epoch of the exposures is given, but the table also has an epoch column",
                where=column("epoch").where,
                do='leave one of them out (columns = {epoch = ""})',
            )
        out["epoch"] = column("epoch").years()
    elif options.epoch is not None:
        out["epoch"] = np.full(len(quantities), options.epoch)
    if "ra" in present:
        out |= _projected(quantities, options, out.get("epoch"))
    else:
        if options.tangent_point is not None:
            raise InputError(
                "a tangent point is given, but the reference positions are u, v",
                where=quantities.source,
                do="name the columns ra and dec, or leave the tangent point out",
            )
        out["u"], out["v"] = (column(key).numbers() for key in ("u", "v"))
        out["unit"] = position_unit((column("u"), column("v")), options.unit)
    out |= _errors(quantities, out["unit"])
    at = options.tangent_point
    for key in nominal_columns(present, source=quantities.source, tangent_point=at):
        out[key] = column(key).numbers() * column(key).factor(out["unit"])
    if "mag" in present:
        out["mag"] = column("mag").numbers()
    elif "flux" in present:
        mag = column("flux").magnitudes_of_fluxes()
        out |= {} if mag is None else {"mag": mag}
    if "colour" in present:  # it is used only by a diagnostic, so it may be unreadable
        colour = column("colour").numbers_if_readable("a colour")
        out |= {} if colour is None else {"colour": colour}
    if "exposure" in present:
        out["exposure"], out["exposure_names"] = column("exposure").labels()
    if "filter" in present:
        out["filter"], out["filter_names"] = column("filter").labels()
    if "star" in present:
        out["star"] = column("star").integers()
    if ASSUMED in present:
        out[ASSUMED] = column(ASSUMED).integers()
    if "chip" in present:
        out["chip"], out["chip_numbers"], out["chip_names"] = numbered_chips(
            column("chip"), options.chips
        )
    return out | with_centroid_errors(quantities, out)


def _pixels(column: SourceColumn, pixel_origin: int | None) -> Float:
    """Pixels converted to FITS 1-based coordinates."""
    pixel_origin = 1 if pixel_origin is None else pixel_origin
    if pixel_origin not in (0, 1):
        raise InputError(
            f"pixel_origin is {pixel_origin}", where=column.source, do="set it to 0 or 1"
        )
    if column.unit is not None and str(column.unit) != "pix":
        raise InputError(
            f"unit is {column.unit}, but detector positions are in pix",
            where=column.where,
            do="name the columns of raw pixels",
        )
    return column.numbers() + (1 - pixel_origin)


def _projected(quantities: Quantities, options: ReadOptions, epoch: Float | None) -> dict[str, Any]:
    """Positions on the tangent plane, with their errors and motions."""
    source = quantities.source
    unit = plane_unit(options.unit, source=source)
    sky = reference_sky(quantities, epoch=epoch, catalogue_epoch=options.catalogue_epoch)
    if sky.sigma is not None and not (sky.sigma > 0).all():
        bad = int(np.argmin((sky.sigma > 0).all(axis=0)))
        raise quantities["sigma_ra"].fail(bad, "the error of the position is not positive")
    return {"unit": unit, "notes": sky.notes} | onto_plane(
        sky.ra,
        sky.dec,
        options.tangent_point,
        sigma=sky.sigma,
        rho=sky.rho,
        motion=sky.motion,
        sigma_motion=sky.sigma_motion,
        where=source,
        place=quantities.place,
    )


def plane_unit(unit: str | None, *, source: str) -> str:
    """Unit of u and v that are computed from sky positions.

    Raises InputError if `unit` is another one.
    """
    if unit not in (None, "arcsec"):
        raise InputError(
            f"unit is {unit}, but sky positions come to the tangent plane in arcsec",
            where=source,
            do="set the unit to arcsec or leave it out",
        )
    return "arcsec"


def nominal_columns(
    found: Mapping[str, str], *, source: str, tangent_point: tuple[float, float] | None
) -> tuple[str, ...]:
    """'u_nominal' and 'v_nominal' if both are among the quantities `found`, otherwise empty.

    Raises InputError if only one is present, or if both are present with sky positions but without
    a tangent point: their plane must not depend on which stars were matched.
    """
    pair = ("u_nominal", "v_nominal")
    refuse_half(pair, found, where=source, what="nominal positions")
    keys = tuple(key for key in pair if key in found)
    if keys and "ra" in found and tangent_point is None:
        raise InputError(
            "nominal positions stand beside ra and dec, and the tangent point of their plane is "
            "not given",
            where=source,
            do="set data.tangent_point to that of the nominal positions",
        )
    return keys


def _errors(quantities: Quantities, unit: str) -> dict[str, Float]:
    """Standard errors in the unit of u, v, and their correlation, as far as the table has them."""
    keys = (key for key in ("sigma_u", "sigma_v") if key in quantities.found)
    out = {key: _sigma(quantities[key], unit) for key in keys}
    if "rho_uv" in quantities.found:
        out["rho_uv"] = _correlation(quantities)
    return out


def _sigma(column: SourceColumn, unit: str) -> Float:
    """Standard errors in the unit of u, v."""
    sigma = column.numbers() * column.factor(unit)
    good = sigma > 0
    if not good.all():
        bad = int(np.argmin(good))
        if not sigma.any():
            raise InputError(
                "sigma is 0 in all rows, but must be positive",
                where=column.where,
                do="leave the column out and set data.sigma to a number, or to 'by_magnitude'; "
                "positions that were computed, as those of a design, have no errors to calibrate: "
                "fit them by bayesdist.fit_linear with sigma = 1",
            )
        raise column.fail(bad, f"sigma is {sigma[bad]:g}, but must be positive")
    return sigma


def _correlation(quantities: Quantities) -> Float:
    """Correlation of the errors in u and v."""
    column = quantities["rho_uv"]
    if "sigma_u" not in quantities:
        raise InputError(
            "is a correlation of errors, and the table has no errors sigma_u and sigma_v",
            where=column.where,
            do="name their columns, or leave the correlation out",
        )
    rho = column.numbers()
    beyond = ~(np.abs(rho) <= LARGEST_RHO)
    if beyond.any():
        bad = int(np.argmax(beyond))
        raise column.fail(bad, f"a correlation is {rho[bad]:g}, but must be {LARGEST_RHO} at most")
    return rho


def text_labels(column: SourceColumn) -> tuple[str, ...]:
    """Names of the chips in a column of text; empty if the column holds numbers."""
    values = column.values
    plain = values.labels if isinstance(values, EncodedColumn) else np.asarray(values)
    if plain.dtype.kind not in "SUO":
        return ()
    names = column.labels()[1]
    return () if all(re.fullmatch(r"[+-]?\d+", name) for name in names) else names


def numbered(names: Iterable[str]) -> dict[str, int]:
    """Numbers from 1 for names in natural order, which places S2 before S10."""

    def key(name: str) -> list[tuple[int, int, str]]:
        parts = re.findall(r"\d+|\D+", name)
        return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts]

    return {name: k for k, name in enumerate(sorted(set(names), key=key), 1)}


def numbered_chips(
    column: SourceColumn, chips: Mapping[str, int] | None
) -> tuple[Int, tuple[int, ...], tuple[str, ...]]:
    """Codes (N,) of the chips, their numbers in ascending order, and their names, if any.

    `chips` gives the number of each name; by default names are numbered from 1 in natural order.
    Raises InputError for numbers that are not integers, and for names without a number.
    """
    names = text_labels(column)
    if not names:
        numbers, codes = np.unique(column.integers(), return_inverse=True)
        return codes, tuple(numbers.tolist()), ()
    number_of = numbered(names) if chips is None else chips
    if not number_of:
        raise InputError(
            f"holds names of chips ({names[0]!r}), and tables on disk need their numbers first",
            where=column.where,
            do="give [[chip]] blocks of these names, or write numbers",
        )
    label_codes, labels = column.labels()
    for name in labels:
        if name not in number_of:
            raise InputError(
                f"chip {name!r} is none of {', '.join(number_of)}",
                where=column.where,
                do="add a [[chip]] block of this name, or leave these rows out",
            )
    numbers_of_labels = np.array([number_of[name] for name in labels], np.int64)
    numbers, codes = np.unique(numbers_of_labels[label_codes], return_inverse=True)
    name_of = {number_of[name]: name for name in labels}
    return codes, tuple(numbers.tolist()), tuple(name_of[number] for number in numbers.tolist())
