"""Checks of distortion reference files in ASDF, and their description as text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from astropy.modeling import Model, models

from bayesdist.products.common.asdf.distortion import (
    AGREEMENT,
    DistortionFile,
    closure_of,
    departure,
    exchanged,
    leaves,
    order_of,
    recorded,
    tables_of,
)
from bayesdist.products.common.document import Finding, finding_lines
from bayesdist.products.common.record import error_lines
from bayesdist.products.common.rules import (
    Inverse,
    LinearPart,
    Missing,
    copies,
    not_finite,
    record,
    stated_closure,
)
from bayesdist.utils.arrays import Float

PIXEL, SKY = ("pix", "pixel"), ("arcsec",)
_INVERSE = Inverse(
    "inverse",
    good=0.01,
    bad=0.5,
    misses="misses the inverse of the model",
    poor="leaves up to {closure:.3g} px; raise its order",
)
# Largest ratio of a pixel scale to its nominal value: filters and position change it by less.
_SCALE_RATIO = 1.2
_PER_DEGREE = 3600.0


def lint_distortion(file: DistortionFile) -> list[Finding]:
    """Findings about the transform of a file, its units and its record."""
    findings = [*_units(file)]
    if file.size is None:
        message = "the detector is not known here: inverse, parity and scale are not checked"
        findings.append(Finding("note", "meta.instrument", message))
        return findings
    x, y = file.grid()
    bad = not_finite(file.v2v3(x, y), "model", "gives values that are not finite")
    if bad:
        return [*findings, *bad]
    return [
        *findings,
        *_linear(file, file.size),
        *_inverse(file),
        *_repeated(file.model),
        *_record(file),
    ]


def _units(file: DistortionFile) -> Iterator[Finding]:
    for name, unit, wanted in zip(
        ("input_units", "output_units"), file.units, (PIXEL, SKY), strict=True
    ):
        if unit and unit not in wanted:
            yield Finding(
                "error", f"meta.{name}",
                f"units are {unit!r}; pipelines convert pixels to arcsec regardless of this entry",
            )  # fmt: skip
        elif not unit:
            yield Missing(f"meta.{name}", f"; it should be {wanted[0]!r}", "warning").finding


def _middle(file: DistortionFile, size: tuple[float, float]) -> tuple[Float, Float]:
    """V2, V3 (2,) at the middle of the detector, and derivatives (2, 2) with respect to pixels."""
    x, y = ((n + 1) / 2 for n in size)
    at = file.v2v3([x, x + 0.5, x - 0.5, x, x], [y, y, y, y + 0.5, y - 0.5])
    return at[:, 0], np.stack([at[:, 1] - at[:, 2], at[:, 3] - at[:, 4]], axis=1)


def _linear(file: DistortionFile, size: tuple[float, float]) -> Iterator[Finding]:
    """Findings on parity and scale at the middle of the detector."""
    _, slope = _middle(file, size)
    area = float(np.linalg.det(slope))
    if area != 0:
        yield from LinearPart(
            "parity",
            "V2, V3 run as x, y do: the image is a mirror image of the sky, which no imager of "
            f"{file.observatory} gives (VIdlParity is -1)",
            level="error",
        ).findings(area)
    scale = np.sqrt(abs(area))
    if file.detector is None:
        return
    ratio = float(scale / file.detector.scale)
    if not 1 / _SCALE_RATIO < ratio < _SCALE_RATIO:
        message = f"a pixel is {scale:.4g} arcsec, and nominally {file.detector.scale:g}"
        if 1 / _SCALE_RATIO < ratio * _PER_DEGREE < _SCALE_RATIO:
            message += ": the transform gives degrees"
        yield Finding("error", "scale", message)


def _inverse(file: DistortionFile) -> Iterator[Finding]:
    back = file.inverse
    if back is None:
        yield Missing(
            "inverse",
            ": gwcs cannot transform the sky to pixels, so pipelines fail where they need it",
        ).finding
        return
    x, y = file.grid()
    closure = closure_of(file.model, back, x, y)
    exchanges = (
        (part, closure_of(forward, inverse, x, y))
        for part, forward, inverse in _exchanged(file.model, back)
    )
    yield from _INVERSE.findings(closure, exchanges)
    yield from stated_closure(
        file.stated_closure, closure, "bayesdist.inverse", "the inverse leaves"
    )


def _exchanged(model: Model, back: Model) -> Iterator[tuple[str, Model, Model]]:
    """Part in which powers of x and y are exchanged, with forward and inverse model."""
    for lowest in (1, 2):
        yield "inverse", model, exchanged(back, lowest)
        yield "model", exchanged(model, lowest), back


def _repeated(model: Model) -> Iterator[Finding]:
    for polynomial in leaves(model):
        if not isinstance(polynomial, models.Polynomial2D) or polynomial.degree < 2:
            continue
        values = {
            name: float(c)
            for name, c in zip(polynomial.param_names, polynomial.parameters, strict=True)
            if sum(map(int, name[1:].split("_"))) > 1
        }
        yield from copies(values)


def _record(file: DistortionFile) -> Iterator[Finding]:
    """Findings about the record written by bayesdist."""
    if file.record is None:
        yield Finding("note", "bayesdist", "is missing: the file states no uncertainty")
        return
    stored = file.record
    yield from record(
        "bayesdist",
        lambda: departure(file, recorded(file, stored)),
        AGREEMENT,
        "are another map than the model, by up to {far:.3g} px: one of them has been changed",
        differs_at="bayesdist.parameters",
    )


def describe_distortion(file: DistortionFile, findings: Sequence[Finding]) -> list[str]:
    """Lines of text on a file, its findings at the end."""
    meta, instrument = file.meta, file.meta.get("instrument", {})
    named = [str(instrument[k]) for k in ("name", "detector") if instrument.get(k)]
    lines = [f"{file.name}: {file.observatory} distortion of {'/'.join(named) or '(unnamed)'}"]
    elements = [
        str(instrument[k]) for k in ("filter", "pupil", "optical_element") if instrument.get(k)
    ]
    if elements:
        lines.append(f"  filter    {' '.join(elements)}")
    lines += [
        f"  {label:<9} {meta[key]}"
        for label, key in (("about", "description"), ("useafter",) * 2, ("pedigree",) * 2)
        if key in meta
    ]
    kinds = [type(leaf).__name__ for leaf in leaves(file.model)]
    order, tables = order_of(file.model), tables_of(file.model)
    lines.append(
        f"  model     {len(kinds)} parts"
        + (f", polynomial of order {order}" if order else "")
        + (f", {len(tables)} look-up tables" if tables else "")
    )
    if file.size is not None:
        lines += _measured(file, file.size)
    lines += _uncertainty(file)
    return [*lines, "", *finding_lines(findings)]


def _measured(file: DistortionFile, size: tuple[float, float]) -> list[str]:
    """Lines on quantities measured from the transform."""
    at, slope = _middle(file, size)
    area = float(np.linalg.det(slope))
    lines = [
        f"  detector  {size[0]:g} x {size[1]:g} px",
        f"  V2, V3    {at[0]:.6f}, {at[1]:.6f} arcsec at its middle",
        f"  pixel     {np.sqrt(abs(area)):.8f} arcsec, parity {'-1' if area < 0 else '+1'}",
    ]
    back = file.inverse
    if back is not None:
        lines.append(f"  inverse   {closure_of(file.model, back, *file.grid()):.2g} px at worst")
    return lines


def _uncertainty(file: DistortionFile) -> list[str]:
    """Lines on the record."""
    record = file.record
    if record is None:
        return error_lines(None, "")

    def origin() -> list[str]:
        provenance = record["provenance"]
        return [
            f"  gauge     {record['gauge']}",
            f"  from      {provenance['source']} by {provenance['software']}",
        ]

    return error_lines(lambda: recorded(file, record), "a record", origin)
