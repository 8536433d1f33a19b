"""Format entry of AST mappings: their checks, and their description as text."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.products.formats.ast.build import Settings, build
from bayesdist.products.formats.ast.file import AstFile, ast_calibration, ast_of
from bayesdist.products.formats.ast.mapping import PolyMap
from bayesdist.products.formats.common.document import Finding, Format, finding_lines

_SKEW = 0.5  # sine of the angle between the axes, and ratio of their scales: no camera is below


# -- checks ---------------------------------------------------------------------------------------


def lint_ast(file: AstFile) -> tuple[Finding, ...]:
    """Findings in a mapping."""
    out = [f for step in file.steps for f in _inverse(step.kind, step.poly)]
    out += list(_shape(file))
    if file.side_file and file.content.path and file.content.beside(file.side_file) is None:
        out.append(
            Finding("warning", "parameters", f"{file.side_file}, the covariance, is not here")
        )
    return tuple(out)


def _inverse(kind: str, poly: PolyMap) -> Iterator[Finding]:
    if kind != "PolyMap":
        return
    counts = [int((poly.rows[:, 1] == k).sum()) for k in (1, 2)]
    if 0 in counts:
        yield Finding("error", "NCF", "one output has no term")
    pairs = [tuple(row[1:]) for row in poly.rows]
    if len(set(pairs)) < len(pairs):
        yield Finding("warning", "PF", "a term stands twice, and both are added")
    if not poly.iter_inverse and not len(poly.inverse_rows):
        yield Finding(
            "error", "IterInv", "is missing, as an explicit inverse is: there is no way from the "
            "sky back to pixels",
        )  # fmt: skip


def _shape(file: AstFile) -> Iterator[Finding]:
    """Findings on the derivatives in the middle of the detector."""
    nx, ny = file.size or (2.0, 2.0)
    x, y = (nx + 1) / 2, (ny + 1) / 2
    dx, dy = np.array([[0.5, -0.5, 0.0, 0.0], [0.0, 0.0, 0.5, -0.5]])
    u, v = file.degrees(x + dx, y + dy)
    slope = np.array([[u[0] - u[1], u[2] - u[3]], [v[0] - v[1], v[2] - v[3]]])
    across, up = np.hypot(*slope)
    det = float(np.linalg.det(slope))
    if min(across, up) == 0 or abs(det) < _SKEW * across * up or (
        min(across, up) < _SKEW * max(across, up)
    ):  # fmt: skip
        yield Finding(
            "error", "PF", f"the axes are {across:.3g} and {up:.3g} a pixel and not perpendicular: "
            "the powers of the inputs may be exchanged in one output",
        )  # fmt: skip
    elif det > 0 and file.remarks.get("plane") == "sky":
        yield Finding("note", "CF", "has the parity of a mirror image of the sky")
    width = max(across, up) * max(nx, ny)
    if file.size is not None and width > 180:
        yield Finding(
            "error", "CF", f"makes the detector {width:.3g} degrees wide: outputs are in degrees"
        )


# -- text -----------------------------------------------------------------------------------------


def _describe(file: AstFile) -> list[str]:
    """Lines of text on the chain of mappings, and its findings."""
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


FORMAT = Format(
    "ast", "an AST mapping", 34, ast_of, _describe, lint_ast, ast_calibration, Settings, build
)
