"""AST mappings: polynomials as text dumps, one per chip, as written by starlink-pyast and Rubin.

A dump consists of lines ``Begin CLASS``, ``Name = value``, ``IsA CLASS`` (the lines before it
belong to this class) and ``End CLASS``. Text after a # is a comment. If the value of an attribute
is an object, nothing follows the equals sign.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import comb
from pathlib import Path

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import fitted_map
from bayesdist.calibration.plane import ARCSEC, Plane, arcsec_per
from bayesdist.errors import FormatError, InputError
from bayesdist.model.basis import MAX_ORDER
from bayesdist.products.common.coefficients import require_regular, substitution
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import (
    PARAMETERS,
    BuildOptions,
    Built,
    Choice,
    Finding,
    Format,
    FormatSettings,
    finding_lines,
    required_size,
)
from bayesdist.products.common.parameters import parameters_content, with_parameters
from bayesdist.products.common.rules import is_skewed, no_side_file, too_wide
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import ascii_of, number_of

_BEGIN = re.compile(r"\s*Begin\s+(\w+)\s*(#.*)?$")
_END = re.compile(r"\s*End\s+(\w+)\s*(#.*)?$")
_VALUE = re.compile(r"\s*(\w+)\s*=\s*(\"(?:[^\"]|\"\")*\"|[^#\s]*)\s*(#.*)?$")


@dataclass
class AstObject:
    """One object of a dump."""

    kind: str
    values: dict[str, str] = field(default_factory=dict)
    parts: dict[str, AstObject] = field(default_factory=dict)

    def number(self, name: str, default: float | None = None) -> float:
        """Numerical value of an attribute; FormatError if it is missing or not a number."""
        text = self.values.get(name)
        if text is None and default is not None:
            return default
        try:
            return number_of(str(text).strip('"'))
        except ValueError:
            problem = "is missing" if text is None else f"is {text}, not a number"
            raise FormatError(f"{name} of the {self.kind} {problem}", do="write it again") from None


def parse_dump(text: str, where: str) -> AstObject:
    """First object of a dump; FormatError if the dump is invalid."""
    lines = iter(enumerate(text.splitlines(), start=1))
    for _, line in lines:
        if (match := _BEGIN.match(line)) is not None:
            return _object(match[1], lines, where)
    raise FormatError("holds no AST object", where=where, do="give a dump of a mapping")


def _object(kind: str, lines: Iterator[tuple[int, str]], where: str) -> AstObject:
    parsed, waiting = AstObject(kind), ""
    for number, line in lines:
        at = f"{where}, line {number}"
        text = line.strip()
        if not text or text.startswith(("#", "!", "IsA ")):
            continue
        if (match := _BEGIN.match(line)) is not None:
            if not waiting:
                raise FormatError(
                    f"a {match[1]} belongs to no object", where=at, do="write it again"
                )
            parsed.parts[waiting], waiting = _object(match[1], lines, where), ""
        elif (match := _END.match(line)) is not None:
            if match[1] != kind:
                raise FormatError(f"ends a {match[1]} but not the {kind}", where=at, do="check it")
            return parsed
        elif (match := _VALUE.match(line)) is not None:
            waiting = match[1] if not match[2] else ""
            if match[2]:
                parsed.values[match[1]] = match[2]
        else:
            raise FormatError("is not a line of a dump", where=at, do="write it again")
    raise FormatError(
        f"the {kind} does not end: the file is truncated", where=where, do="fetch it again"
    )


@dataclass(frozen=True, eq=False)
class PolyMap:
    """Polynomial from two inputs to two outputs."""

    rows: Float  # (N, 4): coefficient, output (1 or 2), powers of the inputs
    inverse_rows: Float  # rows of an explicit inverse in the same form; empty if there is none
    iter_inverse: bool = False
    n_iter: int | None = None
    tolerance: float | None = None

    @property
    def order(self) -> int:
        """Largest total power with a non-zero coefficient, at least 1."""
        used = self.rows[self.rows[:, 0] != 0]
        return int(max(1, used[:, 2:].sum(axis=1).max(initial=0)))

    def at(self, x: Float, y: Float) -> tuple[Float, Float]:
        """Outputs (N,) at inputs (N,)."""
        out = np.zeros((2, np.size(x)))
        for c, k, i, j in self.rows:
            out[int(k) - 1] += c * x ** int(i) * y ** int(j)
        return out[0], out[1]

    @property
    def linear(self) -> Float:
        """Coefficients (2, 2) of the linear terms."""
        out = np.zeros((2, 2))
        for c, k, i, j in self.rows:
            if i + j == 1:
                out[int(k) - 1, int(j)] += c
        return out


@dataclass(frozen=True, eq=False)
class Step:
    """One mapping of a chain."""

    kind: str
    poly: PolyMap


def steps_of(found: AstObject, where: str) -> tuple[Step, ...]:
    """Mappings of a dump in the order in which they are applied.

    InputError for a mapping that is neither polynomial nor linear, or that is inverted.
    """
    if found.values.get("Invert", "0") == "1":
        raise InputError(f"the {found.kind} is inverted", where=where, do="write it forwards")
    if found.kind == "CmpMap":
        if found.values.get("Series", "1") == "0":
            raise InputError("its mappings are side by side", where=where, do="give a chain")
        parts = [found.parts.get(name) for name in ("MapA", "MapB")]
        if None in parts:
            raise FormatError("a CmpMap lacks a mapping", where=where, do="write it again")
        return tuple(step for part in parts if part for step in steps_of(part, where))
    if found.kind in _READERS:
        try:
            return (Step(found.kind, _READERS[found.kind](found)),)
        except FormatError as error:
            raise FormatError(error.cause, where=where, do=error.do) from None
    raise InputError(
        f"has a {found.kind}, which is not a polynomial of pixels",
        where=where,
        do="give the mapping from pixels to intermediate coordinates alone: a PolyMap, or a chain "
        "of them and of linear mappings",
    )


def _poly_map(found: AstObject) -> PolyMap:
    n_in, n_out = int(found.number("Nin", 2)), int(found.number("Nout", found.number("Nin", 2)))
    if (n_in, n_out) != (2, 2):
        raise FormatError(f"the PolyMap has {n_in} inputs and {n_out} outputs", do="give one of 2")
    return PolyMap(
        _rows(found, "F"),
        _rows(found, "I"),
        found.values.get("IterInv", "0") not in ("0", ""),
        int(found.number("NiterInv")) if "NiterInv" in found.values else None,
        found.number("TolInv") if "TolInv" in found.values else None,
    )


def _rows(found: AstObject, kind: str) -> Float:
    """Rows of the forward (F) or inverse (I) polynomials.

    Coefficients are numbered through both outputs, and powers through these coefficients.
    """
    counts = [int(found.number(f"NC{kind}{k}", 0)) for k in (1, 2)]
    rows, n = [], 0
    for output, count in enumerate(counts, start=1):
        for _ in range(count):
            n += 1
            if f"C{kind}{n}" not in found.values:
                raise FormatError(f"C{kind}{n} of the PolyMap is missing", do="write it again")
            powers = [found.number(f"P{kind}{2 * (n - 1) + a}", 0) for a in (1, 2)]
            coefficient = found.number(f"C{kind}{n}")
            if not (np.isfinite(coefficient) and all(p == int(p) >= 0 for p in powers)):
                raise FormatError(f"row {n} of the PolyMap is not a term", do="write it again")
            if sum(powers) > MAX_ORDER and coefficient:
                raise InputError(
                    f"the PolyMap has order {sum(powers):g}", do=f"give one up to {MAX_ORDER}"
                )
            rows.append((coefficient, output, *powers))
    return np.array(rows, float).reshape(-1, 4)


def _linear(matrix: Float, shift: Float) -> PolyMap:
    rows = []
    for k in (0, 1):
        terms = ((0, 0, shift[k]), (1, 0, matrix[k, 0]), (0, 1, matrix[k, 1]))
        rows += [(value, k + 1, i, j) for i, j, value in terms]
    return PolyMap(np.array(rows, float), np.zeros((0, 4)))


def _matrix(found: AstObject) -> PolyMap:
    form = found.values.get("Form", '"Full"').strip('"').lower()
    if form == "unit":
        matrix = np.eye(2)
    elif form == "diagonal":
        matrix = np.diag([found.number(f"M{k}", 0.0) for k in (0, 1)])
    else:
        matrix = np.array([found.number(f"M{k}", 0.0) for k in range(4)]).reshape(2, 2)
    return _linear(matrix, np.zeros(2))


def _pair(found: AstObject, name: str, default: float) -> Float:
    return np.array([found.number(f"{name}{k}", default) for k in (1, 2)])


_READERS = {
    "PolyMap": _poly_map,
    "UnitMap": lambda _: _linear(np.eye(2), np.zeros(2)),
    "ZoomMap": lambda m: _linear(m.number("Zoom", 1.0) * np.eye(2), np.zeros(2)),
    "ShiftMap": lambda m: _linear(np.eye(2), _pair(m, "Sft", 0.0)),
    "WinMap": lambda m: _linear(np.diag(_pair(m, "Scl", 1.0)), _pair(m, "Sft", 0.0)),
    "MatrixMap": _matrix,
}


class AstSettings(FormatSettings):
    """Configuration of an AST mapping and its iterative inverse."""

    n_iter: PositiveInt = 20
    tolerance: PositiveFloat = 1e-12


def build(
    calibration: Calibration, settings: AstSettings, options: BuildOptions
) -> tuple[Built, ...]:
    """Build for each chip the mapping and the file with its covariance."""
    if calibration.before or calibration.after:
        raise InputError(
            "a PolyMap has no look-up tables",
            where="products.ast",
            do="give the order of a polynomial that replaces them",
        )
    out = []
    for number in calibration.numbers:
        several = len(calibration.numbers) > 1
        name = options.named(f"ast_{number}.txt" if several else "ast.txt", several=several)
        chip_calibration = calibration.only(number, options.epoch)
        side = f"{Path(name).stem}_parameters.fits"
        text = _text(chip_calibration, settings, options.scale_arcsec, side)
        out += [
            Built(side, PARAMETERS, parameters_content(chip_calibration), chip_calibration, number),
            Built(name, "AST", text.encode("ascii"), chip_calibration, number),
        ]
    return tuple(out)


def _text(
    calibration: Calibration, settings: AstSettings, scale_arcsec: float | None, side: str
) -> str:
    """Dump of a chain: scaling of 0-based pixels to -1 .. 1 over the detector, and a polynomial."""
    [(number, chip_map)] = calibration.at(origin="stated").items()
    arcsec = arcsec_per(chip_map.unit, scale_arcsec)
    poly = chip_map.monomials()
    require_regular(poly.linear, number)
    nx, ny = chip_map.basis.size
    x, y = chip_map.basis.reference_pixel
    # convert powers of x - xref to powers of w, where x - xref = half (w - zero)
    half = np.diag([nx / 2, ny / 2])
    zero = np.array([(x - 1) * 2 / nx - 1, (y - 1) * 2 / ny - 1])
    scaled = poly.values @ substitution(chip_map.basis.order, half).T * arcsec / 3600.0
    values = scaled @ _moved(poly.terms, zero).T
    rows = [(c, k, i, j) for k in (0, 1) for c, (i, j) in zip(values[k], poly.terms, strict=True)]
    remarks = {
        "unit": chip_map.unit,
        "arcsec": repr(float(arcsec)),
        "plane": calibration.plane.kind,
        "size": f"{nx!r} {ny!r}",
        "reference": f"{float(x)!r} {float(y)!r}",
        "parameters": side,
    }
    if calibration.numbered:
        remarks["chip"] = str(number)
    if calibration.plane.point is not None:
        remarks["point"] = " ".join(repr(float(v)) for v in calibration.plane.point)
    lines = [
        "# Pixels, counted from 0, to degrees on the tangent plane, by bayesdist",
        *(f"# {ascii_of(note)}" for note in calibration.remarks),
        *(f"# bayesdist {key} {value}" for key, value in remarks.items()),
        " Begin CmpMap",
        "    Nin = 2",
        " IsA Mapping",
        "    MapA =",
        "       Begin WinMap",
        "          Nin = 2",
        "       IsA Mapping",
        *(
            f"          {name}{k} = {value!r}"
            for k, n in ((1, nx), (2, ny))
            for name, value in (("Sft", -1.0), ("Scl", 2.0 / float(n)))
        ),
        "       End WinMap",
        "    MapB =",
        "       Begin PolyMap",
        *(f"          {line}" for line in _poly_lines(rows, settings)),
        "       End PolyMap",
        " End CmpMap",
    ]
    return "\n".join(lines) + "\n"


def _moved(terms: tuple[tuple[int, int], ...], zero: Float) -> Float:
    """Matrix (K, K) that converts powers of w - zero (column k: term k) to powers of w."""
    index = {term: k for k, term in enumerate(terms)}
    out = np.zeros((len(terms), len(terms)))
    for k, (i, j) in enumerate(terms):
        for a in range(i + 1):
            for b in range(j + 1):
                by = comb(i, a) * (-zero[0]) ** (i - a) * comb(j, b) * (-zero[1]) ** (j - b)
                out[index[a, b], k] += by
    return out


def _poly_lines(rows: list[tuple[float, int, int, int]], settings: AstSettings) -> list[str]:
    highest = [max(row[2 + a] for row in rows) for a in (0, 1)]
    half = len(rows) // 2
    lines = ["   Nin = 2", "IsA Mapping"]
    lines += [f"   MPF{k} = {n}" for k, n in enumerate(highest, start=1)]
    lines += [f"   NCF{k} = {half}" for k in (1, 2)]
    lines += [f"   CF{n} = {float(row[0])!r}" for n, row in enumerate(rows, start=1)]
    lines += [
        f"   PF{2 * n - 1 + a} = {row[2 + a]}"
        for n, row in enumerate(rows, start=1)
        for a in (0, 1)
        if row[2 + a]
    ]
    return [
        *lines,
        "   IterInv = 1",
        f"   NiterInv = {settings.n_iter}",
        f"   TolInv = {settings.tolerance!r}",
    ]


# -- checks ---------------------------------------------------------------------------------------
def lint_ast(file: AstFile) -> tuple[Finding, ...]:
    """Findings in a mapping."""
    out = [f for step in file.steps for f in _inverse(step.kind, step.poly)]
    out += list(_shape(file))
    if file.side_file and file.content.path and file.content.beside(file.side_file) is None:
        out.append(no_side_file("parameters", file.side_file))
    return tuple(out)


def _inverse(kind: str, poly: PolyMap) -> Iterator[Finding]:
    if kind != "PolyMap":
        return
    counts = [int((poly.rows[:, 1] == k).sum()) for k in (1, 2)]
    if 0 in counts:
        yield Finding("error", "NCF", "one output has no term")
    pairs = [tuple(row[1:]) for row in poly.rows]
    if len(set(pairs)) < len(pairs):
        yield Finding("warning", "PF", "a term occurs twice, and both are added")
    if not poly.iter_inverse and not len(poly.inverse_rows):
        yield Finding(
            "error", "IterInv",
            "is missing, as is an explicit inverse: the sky cannot be transformed back to pixels",
        )  # fmt: skip


def _shape(file: AstFile) -> Iterator[Finding]:
    """Findings on the derivatives at the middle of the detector."""
    nx, ny = file.size or (2.0, 2.0)
    x, y = (nx + 1) / 2, (ny + 1) / 2
    dx, dy = np.array([[0.5, -0.5, 0.0, 0.0], [0.0, 0.0, 0.5, -0.5]])
    u, v = file.degrees(x + dx, y + dy)
    slope = np.array([[u[0] - u[1], u[2] - u[3]], [v[0] - v[1], v[2] - v[3]]])
    across, up = np.hypot(*slope)
    det = float(np.linalg.det(slope))
    if is_skewed(slope):
        yield Finding(
            "error", "PF", f"the axes are {across:.3g} and {up:.3g} a pixel and not perpendicular: "
            "the powers of the inputs may be exchanged in one output",
        )  # fmt: skip
    elif det > 0 and file.remarks.get("plane") == "sky":
        yield Finding("note", "CF", "has the parity of a mirror image of the sky")
    width = max(across, up) * max(nx, ny)
    if file.size is not None:
        yield from too_wide(
            width, "CF", "makes the detector {width:.3g} degrees wide: outputs are in degrees"
        )


# -- text -----------------------------------------------------------------------------------------
def _describe(file: AstFile) -> list[str]:
    """Lines of text on the chain of mappings, followed by its findings."""
    lines = [f"{file.content.name}: AST mapping of order {file.order}, of {len(file.steps)} steps"]
    for step in file.steps:
        text = f"  {step.kind:<9}"
        if step.kind == "PolyMap":
            text += f" order {step.poly.order}, {len(step.poly.rows)} terms"
            if step.poly.iter_inverse:
                text += f"; iterative inverse, {step.poly.n_iter} steps, to {step.poly.tolerance}"
        lines.append(text)
    if file.size is not None:
        lines.append(f"  detector  {file.size[0]:g} x {file.size[1]:g} px")
    if file.side_file:
        lines.append(f"  covariance in {file.side_file}")
    return [*lines, "", *finding_lines(lint_ast(file))]


# -- files ----------------------------------------------------------------------------------------
_REMARK = re.compile(r"#\s*bayesdist\s+(\w+)\s+(.*?)\s*$", re.MULTILINE)
_FIRST_OBJECT = re.compile(r"(#.*\n|\s*\n)*\s*Begin\s+\w+")


@dataclass(frozen=True, eq=False)
class AstFile:
    """Chain of mappings stored in a file."""

    content: Content
    steps: tuple[Step, ...]
    remarks: dict[str, str]  # values of the bayesdist comments, by key

    @property
    def order(self) -> int:
        """Total polynomial order of the chain."""
        return int(np.prod([step.poly.order for step in self.steps]))

    @property
    def side_file(self) -> str:
        """Name of the file with the parameters; empty if none is named."""
        return self.remarks.get("parameters", "")

    @property
    def size(self) -> tuple[float, float] | None:
        """Columns and rows; None if the file does not state them."""
        return self._pair("size")

    def _pair(self, key: str) -> tuple[float, float] | None:
        if key not in self.remarks:
            return None
        try:
            a, b = (number_of(v) for v in self.remarks[key].split())
        except ValueError:
            raise FormatError(
                f"the remark {key} is {self.remarks[key]!r}", where=self.content.name,
                do="give two numbers",
            ) from None  # fmt: skip
        return a, b

    def degrees(self, x: Float, y: Float) -> tuple[Float, Float]:
        """Intermediate coordinates (N,) in degrees at FITS 1-based pixels (N,)."""
        u, v = np.asarray(x, float) - 1.0, np.asarray(y, float) - 1.0
        for step in self.steps:
            u, v = step.poly.at(u, v)
        return u, v


def ast_of(content: Content) -> AstFile | None:
    """AST mapping in a text file; None for any other content."""
    if not _FIRST_OBJECT.match(content.text):
        return None
    steps = steps_of(parse_dump(content.text, content.name), content.name)
    remarks = {match[1]: match[2] for match in _REMARK.finditer(content.text)}
    return AstFile(content, steps, remarks)


def ast_calibration(file: AstFile, name: str, choice: Choice) -> Calibration:
    """Calibration of the mapping, with the covariance of its parameter file if that exists.

    With ``choice.as_used``, only the mapping is used. MissingSizeError if neither the comments nor
    `choice` give the size.
    """
    order = file.order
    if order > MAX_ORDER:
        raise InputError(
            f"its mappings make a polynomial of order {order}",
            where=name,
            do=f"give those up to order {MAX_ORDER} by themselves",
        )
    size = required_size(file.size, choice.size, name, "detector")
    unit = file.remarks.get("unit", "arcsec")
    factor = 3600.0 / float(file.remarks.get("arcsec", ARCSEC.get(unit, 1.0)))
    reference = file._pair("reference") or ((size[0] + 1) / 2, (size[1] + 1) / 2)
    chip_map = fitted_map(
        lambda x, y: factor * np.stack(file.degrees(x, y)),
        name,
        order=order,
        size=size,
        reference_pixel=reference,
        unit=unit,
    )
    kind, point = file.remarks.get("plane", "free"), file._pair("point")
    calibration = calibration_of_maps(
        {int(file.remarks.get("chip", 1)): chip_map},
        name,
        plane=Plane(kind, point=point),
        numbered="chip" in file.remarks,
        notes=() if file.remarks else ("pixels are counted from 0, positions in degrees",),
    )
    if choice.as_used:
        return calibration
    return with_parameters(calibration, file.content.beside(file.side_file), file.side_file)


FORMAT = Format(
    "ast", "an AST mapping", 34, ast_of, _describe, lint_ast, ast_calibration, AstSettings, build,
    needs_scale=lambda settings: True, asks=("size",),
)  # fmt: skip
