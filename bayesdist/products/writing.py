"""Write calibrations to files of any format, from Python and by `bayesdist convert`.

A calibration is refused if the format cannot represent all of it. The caller must then choose: an
epoch for a calibration that depends on time, an order for a polynomial that replaces look-up
tables.
"""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.errors import BayesdistWarning, InputError, require_known
from bayesdist.files.atomic import atomic_path
from bayesdist.products.common.document import (
    PARAMETERS,
    BuildOptions,
    Built,
    Format,
    FormatSettings,
)
from bayesdist.products.registry import build, format_of, product_settings
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import Epoch, Number, value_in, year_of

log = logging.getLogger("bayesdist")

CALLER = 3  # stack frames from here to the caller of `Calibration.write`
# characters; names in headers are derived from the file name, and a card holds 68
LONGEST_NAME = 40


def write_calibration(
    calibration: Calibration,
    format: str,
    file: str | os.PathLike[str],
    *,
    epoch: Epoch | None = None,
    scale_mas: Number | None = None,
    order: int | None = None,
    overwrite: bool = False,
    **settings: Any,
) -> list[Path]:
    """Write a calibration in a format; arguments and errors as for `Calibration.write`."""
    target = format_of(format)
    chosen = settings_of(format, settings)
    year = None if epoch is None else year_of(epoch)
    if calibration.model.time is not None:
        if year is None and (order is not None or not target.holds_time):
            with_order = "" if order is None else f" of order {order}"
            raise InputError(
                f"depends on time, and {target.title}{with_order} cannot hold that",
                where=calibration.name,
                do="give the epoch at which it is written, in decimal years, or choose idctab",
            )
        if year is not None and target.holds_time:
            calibration = calibration.at_date(year)
    if order is None and (calibration.before or calibration.after) and not target.holds_tables:
        raise InputError(
            f"has look-up tables, and {target.title} cannot hold them",
            where=calibration.name,
            do="give the order of a polynomial that is fitted to them, at most "
            f"{target.highest_order}, or choose one of {', '.join(_formats_with_tables())}",
        )
    calibration, notes = representable(calibration, target, order, year)
    scale = _mas(scale_mas)
    if scale is None:
        scale = calibration.pixel_mas
    refuse_unknown_scale(calibration, target, chosen, scale)
    path = Path(file)
    if not (path if path.is_dir() else path.parent).is_dir():
        raise InputError(
            "the folder does not exist", where=str(path.parent), do="make it, or choose another"
        )
    arcsec = None if scale is None else scale / 1000
    built = built_for(format, calibration, chosen, BuildOptions(year, arcsec), path)
    places = places_of(built, path)
    for place in places:
        if place.exists() and not overwrite:
            raise InputError(
                "this file exists", where=str(place), do="replace it with overwrite=True"
            )
    write_built(built, places)
    remarks = (*notes, *(w for part in built for w in part.warnings))
    for text in dict.fromkeys(remarks):
        warnings.warn(f"{places[-1]}: {text}", BayesdistWarning, stacklevel=CALLER)
    for text in dict.fromkeys(note for part in built for note in part.notes):
        log.info("%s: %s", places[-1], text)
    return places


def settings_of(key: str, values: Mapping[str, Any]) -> FormatSettings:
    """Validated settings of a format that can be built; `values` are its configuration keys.

    Raises InputError for unknown keys, invalid values and missing values.
    """
    kind = product_settings()[key]
    keys = list(kind.model_fields)
    for name in values:
        if not keys:
            raise InputError(f"{key} has no settings", where=f"products.{key}.{name}", do="omit it")
        require_known(name, keys, f"setting of {key}", where=f"products.{key}")
    try:
        return kind(**values)
    except ValidationError as error:
        faults = error.errors()
        names = [".".join(str(part) for part in fault["loc"]) or key for fault in faults]
        missing = [
            name for name, fault in zip(names, faults, strict=True) if fault["type"] == "missing"
        ]
        problem, location = faults[0]["msg"].lower(), f"products.{key}.{names[0]}"
        if missing:
            problem, location = f"needs {', '.join(missing)}", f"products.{key}"
        raise InputError(
            problem, where=location, do=f"the settings of {key} are {', '.join(keys) or 'none'}"
        ) from None


def representable(
    calibration: Calibration, target: Format, order: int | None, epoch: float | None
) -> tuple[Calibration, list[str]]:
    """Calibration that a format can represent, and notes on what was changed.

    Look-up tables that the format cannot hold are absorbed into a polynomial of order `order`, by
    default the highest order of the format. The polynomial of the calibration is converted to that
    order as well. Raises InputError if the format has no such order.
    """
    tables = bool(calibration.before or calibration.after)
    if order is None and (not tables or target.holds_tables):
        return calibration, []
    wanted = target.highest_order if order is None else order
    if not 1 <= wanted <= target.highest_order:
        raise InputError(
            f"the order is {wanted}",
            where="order",
            do=f"choose one from 1 to {target.highest_order} for {target.title}",
        )
    maps, worst, rms = {}, 0.0, 0.0
    for chip, chip_map in calibration.with_tables(calibration.at(epoch, origin="stated")).items():
        maps[chip], largest, mean = chip_map.polynomial(wanted)
        worst, rms = max(worst, largest), max(rms, mean)
    n_coefficients = 2 * next(iter(maps.values())).basis.n_terms
    cov = _joint_covariance(calibration, epoch, n_coefficients)
    fitted = calibration_of_maps(maps, calibration.name, cov=cov, errors=calibration.errors)
    source = "its look-up tables go" if tables else f"its order {calibration.model.order} goes"
    note = f"{source} into a polynomial of order {wanted}: {worst:.3g} pix off at worst"
    note += f", {rms:.3g} rms"
    return replace(
        calibration, solution=fitted.solution, before=(), after=(), inverses={},
        reference_date=None, undated="",
    ), [note]  # fmt: skip


def _joint_covariance(calibration: Calibration, epoch: float | None, size: int) -> Float | None:
    """Joint covariance of all chips for polynomials with `size` coefficients per chip."""
    cov = calibration.joint_covariance(calibration.numbers, epoch, origin="stated")
    if cov is None:
        return None
    n, K = len(calibration.numbers), calibration.model.n_terms
    out = np.zeros((n, 2, size // 2, n, 2, size // 2))
    n_common = min(K, size // 2)
    parts = cov.reshape(n, 2, K, n, 2, K)
    out[:, :, :n_common, :, :, :n_common] = parts[:, :, :n_common, :, :, :n_common]
    return out.reshape(n * size, n * size)


def refuse_unknown_scale(
    calibration: Calibration, target: Format, settings: FormatSettings, scale: float | None
) -> None:
    """Raise InputError if u and v are in pixels of unknown scale and the file states angles."""
    if calibration.unit == "pix" and scale is None and target.needs_scale(settings):
        raise InputError(
            f"is in pixels of unknown size, but writing {target.title} requires angles",
            where=calibration.name,
            do="give the pixel scale (scale_mas in Python, --scale of convert)",
        )


def built_for(
    key: str,
    calibration: Calibration,
    settings: FormatSettings,
    options: BuildOptions,
    target: Path,
) -> tuple[Built, ...]:
    """Files of a format, named after the target if it is a file name that a header can state."""
    name = target.name
    if not target.is_dir() and len(name) <= LONGEST_NAME and name.isascii() and name.isprintable():
        options = replace(options, file_name=name)
    return build(key, calibration, settings, options)


def places_of(built: Sequence[Built], target: Path) -> list[Path]:
    """Output paths: inside `target` if it is a folder, else `target` and its companion files.

    Raises InputError if `target` is a file name but there are several files that hold no
    parameters.
    """
    if target.is_dir():
        return [target / part.file_name for part in built]
    names = [part.file_name for part in built if part.kind != PARAMETERS]
    if len(names) > 1:
        raise InputError(
            f"{len(names)} files would be written ({', '.join(names)})",
            where=str(target),
            do="name an existing folder",
        )
    return [target.parent / part.file_name if part.kind == PARAMETERS else target for part in built]


def write_built(built: Sequence[Built], places: Sequence[Path]) -> None:
    """Write built files to temporary names, then rename them to the paths `places`."""
    with ExitStack() as stack:
        # contexts exit in reverse order: each file is renamed after its companions are in place
        for place, part in reversed(list(zip(places, built, strict=True))):
            stack.enter_context(atomic_path(place)).write_bytes(part.content)


def _formats_with_tables() -> list[str]:
    return [key for key in product_settings() if format_of(key).holds_tables]


def _mas(scale: Number | None) -> float | None:
    """Scale in mas; InputError if it is not an angle or not positive."""
    if scale is None:
        return None
    value = value_in(scale, "mas", "scale_mas")
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"scale_mas is {value}", do="give a positive number")
    return value
