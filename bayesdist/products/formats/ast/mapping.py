"""Polynomials of AST mappings: rows (coefficient, output, power of input 1, power of input 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import FormatError, InputError
from bayesdist.model.basis import MAX_ORDER
from bayesdist.products.formats.ast.dump import AstObject

__all__ = ["PolyMap", "Step", "steps_of"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PolyMap:
    """Polynomial of two inputs to two outputs."""

    rows: Float  # (N, 4): coefficient, output (1 or 2), powers of the inputs
    inverse_rows: Float  # the same of an explicit inverse; none where there is none
    iter_inverse: bool = False
    n_iter: int | None = None
    tolerance: float | None = None

    @property
    def order(self) -> int:
        """Largest total power with a coefficient that is not zero, at least 1."""
        used = self.rows[self.rows[:, 0] != 0]
        return int(max(1, used[:, 2:].sum(axis=1).max(initial=0)))

    def at(self, x: Float, y: Float) -> tuple[Float, Float]:
        """Outputs (N,) of inputs (N,)."""
        out = np.zeros((2, np.size(x)))
        for c, k, i, j in self.rows:
            out[int(k) - 1] += c * x ** int(i) * y ** int(j)
        return out[0], out[1]

    @property
    def linear(self) -> Float:
        """Coefficients (2, 2) of the first powers."""
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
    """Mappings of a dump, one after the other.

    InputError for a mapping that is neither a polynomial nor linear, or is inverted.
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
        f"has a {found.kind}, which is no polynomial of pixels",
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
                raise FormatError(f"row {n} of the PolyMap is no term", do="write it again")
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
