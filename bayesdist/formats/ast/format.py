"""Format of AST mappings, read, built and checked as one text dump per chip."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from math import comb
from pathlib import Path

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import fitted_map
from bayesdist.calibration.plane import ARCSEC, Plane, arcsec_per
from bayesdist.errors import FormatError, InputError
from bayesdist.formats.ast.mapping import PolyMap, Step, parse_dump, steps_of
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
_BEGIN = re.compile(r"(#.*\n|\s*\n)*\s*Begin\s+\w+")


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
    if not _BEGIN.match(content.text):
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
