"""Checks of columns for equal lengths and finite values; incomplete rows are counted or refused."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Container, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.tables.names import NO_MOTION
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Bool

log = logging.getLogger("bayesdist")

MOTION_KEYS = ("pm_ra", "pm_dec", "pm_u", "pm_v")  # in tables of matches, and in catalogues
ZERO_MOTION = "proper motion of exactly 0"
NOT_FINITE = ("refuse", "reject")
# limits for a value and for an error, so that the ratio of their squares can be represented
LARGEST, SMALLEST = 1e30, 1e-100
Place = Callable[[int], str]  # name of a row in error messages, given its index in the arrays
# default of columns that a class fills in itself, so that they are never None afterwards
COMPLETED: Any = None


def row_number(index: int) -> str:
    """Name of a row, counted from 1."""
    return f"row {index + 1}"


def one_length(
    columns: Mapping[str, Any], *, integers: Collection[str] = (), where: str
) -> dict[str, NDArray[Any]]:
    """Convert columns to contiguous float64 arrays (N,), or int64 for those named in `integers`.

    Arrays are converted to native byte order, which columns of FITS tables do not have.  Raises
    InputError if the columns have different lengths.
    """
    arrays = {
        name: np.ascontiguousarray(values, np.int64 if name in integers else np.float64)
        for name, values in columns.items()
    }
    first = next(iter(arrays))
    for name, values in arrays.items():
        if values.shape != (arrays[first].size,):
            raise InputError(
                f"column {name!r} has shape {values.shape}, but {first!r} has "
                f"{arrays[first].size} rows",
                where=where,
                do="give columns of one length",
            )
    return arrays


def columns_of(table: Any, names: Sequence[str]) -> dict[str, Any]:
    """Columns of a table that are not None, by name.

    `table` has the columns as attributes.
    """
    values = {name: getattr(table, name) for name in names}
    return {name: value for name, value in values.items() if value is not None}


def check_columns(
    table: Any,
    names: Sequence[str],
    *,
    integers: Collection[str] = (),
    where: str,
    place: Callable[[int], str] | None = None,
    positive: Collection[str] = (),
    not_negative: Collection[str] = (),
) -> None:
    """Convert the columns of a frozen dataclass to equal lengths and types, and check their values.

    See `one_length` and `check_values`. Without `place`, rows are named by their number.
    """
    columns = one_length(columns_of(table, names), integers=integers, where=where)
    for name, values in columns.items():
        object.__setattr__(table, name, values)
    check_values(
        columns,
        place=place or (lambda row: f"{where}, row {row + 1}"),
        positive=positive,
        not_negative=not_negative,
    )


def check_values(
    columns: Mapping[str, NDArray[Any]],
    *,
    place: Callable[[int], str],
    positive: Collection[str] = (),
    not_negative: Collection[str] = (),
) -> None:
    """Raise InputError for columns with values that are not finite, or out of the allowed range.

    Columns named in `positive` must be positive, and those in `not_negative` must not be negative.
    `place` returns the name of a row, given its index, for the message.
    """
    for name, values in columns.items():
        good, must = np.abs(values) < LARGEST, "finite"
        if name in positive:
            good, must = good & (values > SMALLEST), "finite and positive"
        elif name in not_negative:
            good, must = good & (values >= 0), "finite and not negative"
        if not good.all():
            bad = int(np.argmin(good))
            if LARGEST <= abs(values[bad]) < np.inf:
                must = f"below {LARGEST:g}"
            elif 0 < values[bad] <= SMALLEST:
                must = f"above {SMALLEST:g}"
            raise InputError(
                f"value is {values[bad]:g}, but must be {must}",
                where=f"{place(bad)}, column {name!r}",
                do="correct the row or drop it",
            )


def refuse_half(pair: tuple[str, str], present: Container[str], *, where: str, what: str) -> None:
    """Raise InputError if only one column of a pair is present."""
    for name, partner in (pair, pair[::-1]):
        if partner in present and name not in present:
            raise InputError(
                f"column {name!r} is given without its partner",
                where=where,
                do=f"give {what} in both axes or in none",
            )


def check_not_finite(value: str) -> None:
    """Raise InputError if the option `not_finite` is invalid."""
    if value not in NOT_FINITE:
        raise InputError(
            f"not_finite is {value!r}",
            where="data.not_finite",
            do="set it to 'refuse' or 'reject'",
        )


def absent(column: Any, *, not_finite: bool) -> Bool:
    """Boolean mask (N,) of rows without a value: masked or, with `not_finite`, NaN or infinite."""
    mask = np.array(np.broadcast_to(getattr(column, "mask", False), np.shape(column)), bool)
    if mask.ndim > 1:  # a column of arrays, which is rejected elsewhere
        return np.zeros(len(mask), bool)
    if not_finite:
        plain = getattr(column, "unmasked", column)
        values = np.asarray(getattr(plain, "value", plain))
        if values.dtype.kind == "f":
            mask |= ~np.isfinite(values)
    return mask


def zero_motions(first: Any, second: Any) -> Bool:
    """Boolean mask (N,) of stars with a proper motion of exactly 0 on both axes.

    The arguments are the columns of both components.  A measured motion is never exactly 0 on both
    axes; such rows come from tables in which missing values were filled with 0.
    """
    zero = np.ones(len(first), bool)
    for column in (first, second):
        plain = getattr(column, "unmasked", column)
        values = np.asarray(getattr(plain, "value", plain))
        if values.ndim != 1 or values.dtype.kind not in "iuf":
            return np.zeros(len(first), bool)  # strings are rejected elsewhere
        zero &= (values == 0) & ~absent(column, not_finite=False)
    return zero


def counted(reasons: Sequence[tuple[str, Bool]], n: int) -> tuple[Bool, dict[str, int]]:
    """Boolean mask (n,) of the rows that remain, and numbers of the others by their first reason.

    `reasons` are pairs of a name and the mask (n,) of the rows to which it applies.
    """
    stay, counts = np.ones(n, bool), dict[str, int]()
    for reason, gone in reasons:
        new = int((stay & gone).sum())
        if new:
            counts[reason] = counts.get(reason, 0) + new
            stay &= ~gone
    return stay, counts


def without_missing(
    table: Any,
    found: Mapping[str, str],
    *,
    source: str,
    reject: bool,
    spared: frozenset[str],
    motions: frozenset[str],
) -> tuple[Bool, dict[str, int]]:
    """Boolean mask (N,) of rows with a value in every column that is read, and counts by reason.

    The counts are those of the other rows. With `reject`, values that are not finite count as
    missing. `found` has the column of each quantity, and missing values of `spared` quantities are
    allowed. For `motions`, NaN means that a star has no measured motion, as in catalogues; so do
    proper motions of exactly 0 on both axes, with a warning. Raises InputError if no row remains.
    """
    reasons = []
    motion_names = [found[key] for key in MOTION_KEYS if key in found and key not in spared]
    if len(motion_names) == 2:
        zero = zero_motions(*(table[name] for name in motion_names))
        if zero.any():
            log.warning(
                "%s: WARNING: %d of %d stars have %s and %s of exactly 0: taken as missing values",
                *(source, np.count_nonzero(zero), len(table), *motion_names),
            )
        reasons.append((ZERO_MOTION, zero))
    for key, name in found.items():
        if key in spared:
            continue
        reason = NO_MOTION if key in motions else f"no value in column {name!r}"
        gone = absent(table[name], not_finite=reject or key in motions)
        reasons.append((reason, gone))
    stay, counts = counted(reasons, len(table))
    if not stay.any():
        text = ", ".join(f"{reason} ({n} rows)" for reason, n in counts.items())
        raise InputError(
            f"no row has a value in every column that is read: {text}",
            where=source,
            do="leave out such a column by an empty name in the option 'columns'",
        )
    return stay, counts
