"""Format of SIAF coefficient tables, their checks, and the companion file for the covariance."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap, Monomials
from bayesdist.calibration.inverse import fit_inverse
from bayesdist.errors import InputError, required
from bayesdist.formats.siaf.table import (
    AGREEMENT,
    COLUMNS,
    COVARIANCE,
    HIGHEST,
    KEYWORDS,
    NAMES,
    SIDE,
    SiafRow,
    SiafTable,
    departure,
    holds_table,
    siaf_calibration,
    siaf_read_back,
    side_name,
    table_of,
)
from bayesdist.model.basis import polynomial_terms
from bayesdist.products.common.coefficients import require_regular
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import (
    PARAMETERS,
    BuildOptions,
    Built,
    Finding,
    Format,
    FormatSettings,
    ReadBack,
    finding_lines,
    of_chips,
)
from bayesdist.products.common.record import (
    at_date,
    calibration_from,
    error_lines,
    record_of,
)
from bayesdist.products.common.rules import Inverse, LinearPart, no_side_file, record
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import ascii_of

WHERE = "products.siaf"


class SiafSettings(FormatSettings):
    """Configuration of a SIAF coefficient table."""

    aperture: str | None = None  # default: the names of the chips, or of the detector
    order: Annotated[int, Field(ge=1, le=HIGHEST)] | None = None


def build(
    calibration: Calibration, settings: SiafSettings, options: BuildOptions
) -> tuple[Built, ...]:
    """Build a covariance file and a table for each chip, in this order.

    The covariance file comes first so that it exists when a program reads the table.
    """
    several = len(calibration.numbers) > 1
    out: list[Built] = []
    for chip in calibration.model.chips:
        aperture = (chip.name if several else settings.aperture) or calibration.detector
        if not aperture:
            raise InputError(
                "the aperture has no name",
                where=WHERE,
                do="give aperture, as in 'NIS_CEN' (--option aperture=NIS_CEN of convert)",
            )
        name = options.named(f"siaf_distortion_{aperture}.txt".lower(), several=several)
        out += _files(calibration, chip.number, aperture, settings.order, options, name)
    return tuple(out)


def _files(
    calibration: Calibration,
    chip: int,
    aperture: str,
    order: int | None,
    options: BuildOptions,
    name: str,
) -> tuple[Built, Built]:
    """Covariance file and table of one chip at one date; `name` is that of the table.

    (u, v) are taken as Ideal coordinates of the aperture. Look-up tables are left out. `order` is
    the order of the table rows and therefore of the inverse; the default is the order of the
    polynomial. Errors as for `at_date` and `fit_inverse`.
    """
    dated = at_date(calibration, chip, options.epoch, options.scale_arcsec, where=WHERE)
    dated = replace(dated, before=())
    chip_map = dated.chip(chip, origin="stated")
    poly = chip_map.monomials()
    require_regular(poly.linear, chip)
    rows_order = max(order or 0, chip_map.basis.order)
    columns = [*_forward(poly), *_inverse(chip_map, rows_order)]
    date = options.epoch if calibration.model.time is not None else None
    side = side_name(name)
    size, reference = chip_map.basis.size, chip_map.basis.reference_pixel
    tables = any(table.chip == chip for table in calibration.before)
    head = [
        f"{aperture} distortion coefficients by bayesdist",
        f"from {calibration.name}" + ("" if date is None else f", at {date:g}"),
        *calibration.notes,
        *(["Look-up tables are left out."] if tables else []),
        f"{COVARIANCE} {side}.",
        *(f"{k} = {v!r}" for k, v in zip(KEYWORDS, (*size, *reference), strict=True)),
    ]
    lines = _lines(aperture, rows_order, columns)
    table = table_of(Content("new table", _joined(head, lines)))
    closure = required(table.closure(), "a new table states no size")
    head.append(f"Idl2Sci of Sci2Idl misses a pixel by {closure:.2g} pixels at worst.")
    record = record_of(dated, calibration, epoch=date, closure=closure)
    record["provenance"]["detector"] = aperture
    values = {SIDE: 1, "table": name, **_covariance(poly), "bayesdist": record}
    text = json.dumps(_listed(values), indent=1, allow_nan=False) + "\n"
    return (
        Built(side, PARAMETERS, text.encode("ascii"), record),
        Built(name, "SIAF table", _joined(head, lines), table, chip, {"closure_pix": closure}),
    )


def _forward(poly: Monomials) -> list[dict[tuple[int, int], float]]:
    return [dict(zip(poly.terms, c.tolist(), strict=True)) for c in poly.values]


def _inverse(chip: ChipMap, order: int) -> list[dict[tuple[int, int], float]]:
    """Terms of the inverse, by powers of the Ideal coordinates."""
    # `fit_inverse` needs axes that are not mirrored
    sign = float(np.sign(np.linalg.det(chip.linear)))

    def forward(x: Float, y: Float) -> tuple[Float, Float]:
        u, v = chip.at(x, y)
        return u, sign * v

    reference, size = chip.basis.reference_pixel, chip.basis.size
    out = []
    for axis, terms in enumerate(fit_inverse(forward, reference, size, order)):
        power = (1, 0) if axis == 0 else (0, 1)
        with_identity = dict(terms) | {power: terms.get(power, 0.0) + 1.0}
        out.append({(i, j): c * sign**j for (i, j), c in with_identity.items()})
    return out


def _lines(aperture: str, order: int, columns: Sequence[dict[tuple[int, int], float]]) -> list[str]:
    width = max(len(aperture), len(COLUMNS[0]))
    lines = [" , ".join([COLUMNS[0].rjust(width), *COLUMNS[1:4], *(n.rjust(24) for n in NAMES)])]
    for i, j in polynomial_terms(order):
        numbers = [f"{float(column.get((i, j), 0.0))!r:>24}" for column in columns]
        cells = [aperture.rjust(width), f"{i + j}{j}".rjust(10), f"{i:>10}", f"{j:>10}"]
        lines.append(" , ".join([*cells, *numbers]))
    return lines


def _joined(head: Sequence[str], lines: Sequence[str]) -> bytes:
    plain = (f"# {ascii_of(line)}" for text in head for line in text.splitlines())
    return ("\n".join([*plain, "#", *lines]) + "\n").encode("ascii")


def _covariance(poly: Monomials) -> dict[str, list[str] | Float]:
    """Coefficients of Sci2Idl with sigmas and covariance, u before v, under their SIAF names."""
    names = [f"Sci2Idl{axis}{i + j}{j}" for axis in "XY" for i, j in poly.terms]
    out: dict[str, list[str] | Float] = {"names": names, "values": poly.values.ravel()}
    if poly.cov is not None:
        out["sigma"] = np.sqrt(np.maximum(np.diag(poly.cov), 0.0))
        out["covariance"] = poly.cov
    return out


def _listed(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _listed(element) for key, element in value.items()}
    if isinstance(value, (list, tuple)):
        return [_listed(element) for element in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


def describe_siaf(table: SiafTable) -> list[str]:
    """Lines of text on a table or covariance file, with the findings at the end."""
    if not table.rows:
        lines = [f"{table.name}: covariance of the SIAF table of {table.aperture}"]
        return [*lines, *_uncertainty(table), "", *finding_lines(lint_siaf(table))]
    size = table.size
    extent = "unknown" if size is None else f"{size[0]:g} x {size[1]:g} px"
    lines = [
        f"{table.name}: SIAF table of {table.aperture}, order {table.order}",
        f"  detector  {extent}",
    ]
    if size is not None:
        x, y = table.reference_pixel(size)
        source = "" if "XSciRef" in table.stated else ", assumed: the middle"
        lines.append(f"  zero      pixel ({x:g}, {y:g}){source}")
    linear = np.array(
        [[table.terms(name).get(k, 0.0) for k in ((1, 0), (0, 1))] for name in NAMES[:2]]
    )
    lines.append(f"  pixel     {np.sqrt(abs(np.linalg.det(linear))):.8f} arcsec")
    closure = table.closure()
    if closure is not None:
        lines.append(f"  inverse   {closure:.2g} px at worst")
    lines += [*_uncertainty(table), "", f"  nj {' '.join(name.rjust(15) for name in NAMES)}"]
    for row in table.rows:
        lines.append(f"  {row.index} {' '.join(f'{value:15.7g}' for value in row.values)}")
    return [*lines, "", *finding_lines(lint_siaf(table))]


def _uncertainty(table: SiafTable) -> list[str]:
    record = table.record
    read = None if record is None else lambda: calibration_from(record, table.name)
    return error_lines(read, "a side file")


def _parse(content: Content) -> SiafTable | None:
    return table_of(content) if holds_table(content) else None


def _read_back(files: Sequence[Built], *_: Any) -> list[ReadBack]:
    """Positions and inverse computed from the tables alone, as in pysiaf."""
    parts = {
        built.chip: siaf_read_back(table_of(Content(built.file_name, built.content)))
        for built in files
        if built.chip is not None
    }
    return [of_chips(parts)]


# -- checks ---------------------------------------------------------------------------------------


_LINEAR = LinearPart(
    "Sci2IdlX, Sci2IdlY",
    "parity: Ideal coordinates are mirrored against x, y, which no aperture has but those of OSS "
    "(that of V2, V3 is VIdlParity)",
    level="error",
    singular="the linear part is singular",
)
_INVERSE = Inverse(
    "Idl2SciX, Idl2SciY",
    good=0.05,
    bad=1.0,
    misses="they miss the inverse of Sci2Idl",
    poor="the inverse is wrong by up to {closure:.3g} px; raise the order",
)
# Pixels of imagers are 0.03 to 0.2 arcsec wide; much smaller ones are in degrees or radians.
_SMALLEST_PIXEL = 5e-3


def lint_siaf(table: SiafTable) -> list[Finding]:
    """Findings in a table and its covariance file."""
    if not table.rows:
        return []
    return [*_rows(table), *_linear(table), *_inverse_checks(table), *_record(table)]


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
    yield from _LINEAR.findings(area, mirror=0 if table.aperture.endswith("_OSS") else -1)
    pixel = float(np.sqrt(abs(area)))
    if 0 < pixel < _SMALLEST_PIXEL:
        yield Finding(
            "error", "Sci2IdlX, Sci2IdlY",
            f"a pixel is {pixel:.4g} wide, which cannot be arcsec (in degrees: {3600 * pixel:.4g} "
            "arcsec)",
        )  # fmt: skip
    constant = float(np.hypot(x.get((0, 0), 0.0), y.get((0, 0), 0.0)))
    if constant > 0:
        yield Finding(
            "note", "00", f"the reference pixel is {constant:.4g} arcsec from the Ideal origin, "
            "where V2Ref and V3Ref are",
        )  # fmt: skip


def _inverse_checks(table: SiafTable) -> Iterator[Finding]:
    closure = table.closure()
    location = _INVERSE.where
    if table.inverse is None and table.size is not None:
        yield Finding("error", location, "the inverse is missing: all its coefficients are zero")
        return
    if closure is None:
        yield Finding(
            "note", location, "the size of the detector is unknown: the inverse is not checked"
        )
        return
    yield from _INVERSE.findings(
        closure,
        (
            (part, replace(table, rows=tuple(_exchanged(table, columns))).closure() or 0.0)
            for columns, part in (((2, 3), location), ((0, 1), "Sci2IdlX, Sci2IdlY"))
        ),
        lambda: _shift(table, closure),
        conclusive=True,
    )


def _shift(table: SiafTable, closure: float) -> Iterator[Finding]:
    """Finding on constant terms that explain the closure."""
    residual = table.closure_residuals()
    if residual is None:
        return
    shift = residual.mean(axis=1)
    without = float(np.hypot(*(residual - shift[:, None])).max())
    if without < closure / 10:
        yield Finding(
            "error", _INVERSE.where,
            f"the constant terms are off by {shift[0]:.4g} and {shift[1]:.4g} "
            f"px (closure {closure:.3g} px, without this shift {without:.2g} px)",
        )  # fmt: skip


def _exchanged(table: SiafTable, columns: tuple[int, int]) -> Iterator[SiafRow]:
    """Rows with the powers of x and y exchanged in two columns, for terms above the linear ones."""
    by: Mapping[tuple[int, int], SiafRow] = {row.powers: row for row in table.rows}
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
            yield no_side_file("covariance", side_name(table.name))
        else:
            yield Finding("note", "covariance", "there is no side file: no uncertainty is stated")
        return
    stored = table.record
    yield from record(
        "covariance",
        lambda: departure(table, calibration_from(stored, table.name)),
        AGREEMENT,
        "the side file is of another table, by up to {far:.3g} px",
    )


FORMAT = Format(
    "siaf",
    "a SIAF table of coefficients",
    8,
    _parse,
    describe_siaf,
    lint_siaf,
    siaf_calibration,
    SiafSettings,
    build,
    _read_back,
    highest_order=HIGHEST,
    asks=("size",),
)
