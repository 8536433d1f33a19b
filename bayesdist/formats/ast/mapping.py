"""Parser of AST object dumps, and the mappings that they hold.

A dump consists of lines ``Begin CLASS``, ``Name = value``, ``IsA CLASS`` (the lines before it
belong to this class) and ``End CLASS``. Text after a # is a comment. If the value of an attribute
is an object, nothing follows the equals sign.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from bayesdist.errors import FormatError, InputError
from bayesdist.model.basis import MAX_ORDER
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import number_of

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
