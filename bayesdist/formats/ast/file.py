"""Text file with an AST mapping from pixels to intermediate coordinates, and its calibration.

Inputs are pixels counted from 0, as in Rubin's pipelines, and outputs are degrees on the tangent
plane. Comments of the form ``# bayesdist KEY VALUE``, which AST ignores, hold further information.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import fitted_map
from bayesdist.calibration.plane import ARCSEC, Plane
from bayesdist.errors import FormatError, InputError
from bayesdist.formats.ast.mapping import Step, parse_dump, steps_of
from bayesdist.model.basis import MAX_ORDER
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import Choice, required_size
from bayesdist.products.common.parameters import with_parameters
from bayesdist.utils.arrays import Float
from bayesdist.utils.text import number_of

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
