"""Checks of a SIAF table against the behaviour of pysiaf."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from bayesdist.errors import BayesdistError
from bayesdist.formats.siaf.table import (
    AGREEMENT,
    Row,
    SiafTable,
    departure,
    side_name,
)
from bayesdist.model.basis import polynomial_terms
from bayesdist.products.common.document import Finding
from bayesdist.products.common.record import calibration_from

# Pixels: closure of a good inverse, and a closure that only a wrong coefficient explains.
_CLOSURE_GOOD, _CLOSURE_BAD = 0.05, 1.0
# Pixels of imagers are 0.03 to 0.2 arcsec wide; much smaller ones are in degrees or radians.
_SMALLEST_PIXEL = 5e-3


def lint_siaf(table: SiafTable) -> list[Finding]:
    """Findings in a table and its covariance file."""
    if not table.rows:
        return []
    return [*_rows(table), *_linear(table), *_inverse(table), *_record(table)]


def _rows(table: SiafTable) -> Iterator[Finding]:
    wrong = [row for row in table.rows if row.index != _index(row.powers)]
    if wrong:
        mirrored = all(row.index == _index(row.powers[::-1]) for row in wrong)
        yield Finding(
            "error", ", ".join(f"line {row.line}" for row in wrong),
            "the order of coefficients: siaf_index nj goes with x^(n-j) y^j, and "
            + ("the powers of x and y are exchanged" if mirrored else "the powers are others"),
        )  # fmt: skip
    counts = Counter(row.powers for row in table.rows)
    repeated = [_index(powers) for powers, n in counts.items() if n > 1]
    if repeated:
        yield Finding("error", ", ".join(repeated), "there is more than one row")
    gone = [_index(powers) for powers in polynomial_terms(table.order) if powers not in counts]
    if gone:
        yield Finding("error", ", ".join(gone), "there is no row, and pysiaf counts on all of them")


def _index(powers: tuple[int, int]) -> str:
    return f"{sum(powers)}{powers[1]}"


def _linear(table: SiafTable) -> Iterator[Finding]:
    x, y = (table.terms(name) for name in ("Sci2IdlX", "Sci2IdlY"))
    linear = np.array([[t.get((1, 0), 0.0), t.get((0, 1), 0.0)] for t in (x, y)])
    area = float(np.linalg.det(linear))
    if area == 0:
        yield Finding("error", "Sci2IdlX, Sci2IdlY", "the linear part is singular")
    elif area < 0 and not table.aperture.endswith("_OSS"):
        yield Finding(
            "error", "Sci2IdlX, Sci2IdlY",
            "parity: Ideal coordinates are mirrored against x, y, which no aperture has but those "
            "of OSS (that of V2, V3 is VIdlParity)",
        )  # fmt: skip
    pixel = float(np.sqrt(abs(area)))
    if 0 < pixel < _SMALLEST_PIXEL:
        yield Finding(
            "error", "Sci2IdlX, Sci2IdlY",
            f"a pixel is {pixel:.4g} wide, which are no arcsec (in degrees: {3600 * pixel:.4g} "
            "arcsec)",
        )  # fmt: skip
    constant = float(np.hypot(x.get((0, 0), 0.0), y.get((0, 0), 0.0)))
    if constant > 0:
        yield Finding(
            "note", "00", f"the reference pixel is {constant:.4g} arcsec from the Ideal origin, "
            "where V2Ref and V3Ref are",
        )  # fmt: skip


def _inverse(table: SiafTable) -> Iterator[Finding]:
    closure = table.closure()
    location = "Idl2SciX, Idl2SciY"
    if table.inverse is None and table.size is not None:
        yield Finding("error", location, "the inverse is missing: all its coefficients are zero")
        return
    if closure is None:
        yield Finding("note", location, "the size of the detector is not known: it is not checked")
        return
    if closure <= _CLOSURE_GOOD:
        return
    closures = {
        blamed: replace(table, rows=tuple(_exchanged(table, columns))).closure() or 0.0
        for columns, blamed in (((2, 3), location), ((0, 1), "Sci2IdlX, Sci2IdlY"))
    }
    # if powers are exchanged in both they nearly agree again, so the better one is right
    best = min(closures, key=lambda blamed: closures[blamed])
    if closures[best] < closure / 10:
        yield Finding(
            "error", best, "the order of coefficients: powers of x and y are exchanged "
            f"(closure {closure:.3g} px)",
        )  # fmt: skip
        return
    residual = table.closure_residuals()
    if residual is not None:
        shift = residual.mean(axis=1)
        without = float(np.hypot(*(residual - shift[:, None])).max())
        if without < closure / 10:
            yield Finding(
                "error", location,
                f"the constant terms are off by {shift[0]:.4g} and {shift[1]:.4g} "
                f"px (closure {closure:.3g} px, without this shift {without:.2g} px)",
            )  # fmt: skip
            return
    if closure > _CLOSURE_BAD:
        yield Finding(
            "error", location, f"they miss the inverse of Sci2Idl by up to {closure:.3g} px: a "
            "coefficient of one or the other is wrong",
        )  # fmt: skip
    else:
        yield Finding(
            "warning", location, f"the inverse is wrong by up to {closure:.3g} px; raise the order"
        )


def _exchanged(table: SiafTable, columns: tuple[int, int]) -> Iterator[Row]:
    """Rows with the powers of x and y exchanged in two columns, for terms above the linear ones."""
    by: Mapping[tuple[int, int], Row] = {row.powers: row for row in table.rows}
    for row in table.rows:
        mirror_row = by.get(row.powers[::-1])
        if mirror_row is None or sum(row.powers) < 2:
            yield row
            continue
        values = [(mirror_row if k in columns else row).values[k] for k in range(4)]
        yield replace(row, values=(values[0], values[1], values[2], values[3]))


def _record(table: SiafTable) -> Iterator[Finding]:
    if table.record is None:
        if table.names_side_file:
            missing = f"{side_name(table.name)}, the covariance, is not here"
            yield Finding("warning", "covariance", missing)
        else:
            yield Finding("note", "covariance", "there is no side file: no uncertainty is stated")
        return
    try:
        far = departure(table, calibration_from(table.record, table.name))
    except BayesdistError as error:
        yield Finding("error", "covariance", error.cause)
        return
    if not far <= AGREEMENT:
        yield Finding(
            "error", "covariance", f"the side file is of another table, by up to {far:.3g} px"
        )
