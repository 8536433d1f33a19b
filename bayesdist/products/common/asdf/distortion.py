"""Distortion reference files in ASDF: read, built, checked and described, with their calibration.

This module imports astropy.modeling, which takes longer than reading files of other formats.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from astropy.modeling import CompoundModel, Model, models
from numpy.typing import ArrayLike

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import fitted_map
from bayesdist.calibration.inverse import detector_grid, fitted_inverse
from bayesdist.calibration.modeling import forward_transform, inverse_transform
from bayesdist.calibration.plane import Plane
from bayesdist.errors import FormatError, InputError, required
from bayesdist.model.basis import MAX_ORDER
from bayesdist.products.common.asdf.tree import KnownDetector, PlacedSettings
from bayesdist.products.common.coefficients import require_regular
from bayesdist.products.common.document import (
    BuildOptions,
    Choice,
    Finding,
    MissingSizeError,
    ReadBack,
    finding_lines,
    of_chips,
)
from bayesdist.products.common.record import (
    CalibrationRecord,
    at_date,
    calibration_from,
    error_lines,
    record_of,
)
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

ARCSEC = {"arcsec": 1.0, "deg": 3600.0, "mas": 1e-3, "rad": 180 / np.pi * 3600, "arcmin": 60.0}
AGREEMENT = 1e-6  # pixels; tolerance between the record and the transform of one file
GRID = 65  # grid points per axis, over the pixel centres from corner to corner


@dataclass(frozen=True, eq=False)
class DistortionFile:
    """Parsed distortion reference file."""

    name: str
    observatory: str
    model: Model  # from 0-based pixels to V2, V3
    meta: Mapping[str, Any]
    units: tuple[str, str]  # of input and output, as stated; empty if not stated
    record: Mapping[str, Any] | None = None  # record written by bayesdist, see `common.record`
    detector: KnownDetector | None = None  # None if unknown

    @property
    def inverse(self) -> Model | None:
        """Inverse transform; None if the file has none."""
        try:
            return self.model.inverse
        except NotImplementedError:
            return None

    @property
    def size(self) -> tuple[float, float] | None:
        """Columns and rows, from the record or of the known detector; None if unknown."""
        nominal = None if self.detector is None else self.detector.size
        if self.record is None:
            return nominal
        try:
            columns, rows = self.record["chip"]["size"]
            return float(columns), float(rows)
        # an invalid record is reported when it is read in full
        except (KeyError, TypeError, ValueError):
            return nominal

    @property
    def stated_closure(self) -> float | None:
        """Largest error of the inverse in pixels, as stated in the file; None if not stated."""
        inverse = {} if self.record is None else self.record.get("inverse", {})
        return inverse.get("closure_pix")

    def v2v3(self, x: ArrayLike, y: ArrayLike) -> Float:
        """V2 and V3 (2, N) in arcsec at FITS 1-based pixels (N,)."""
        at = evaluated(self.model, np.asarray(x, float) - 1.0, np.asarray(y, float) - 1.0)
        return ARCSEC.get(self.units[1], 1.0) * at

    def grid(self) -> tuple[Float, Float]:
        """FITS 1-based pixels x, y (N,) on a grid over the detector.

        Raises MissingSizeError if the size of the detector is unknown.
        """
        if self.size is None:
            raise _no_size(self.name)
        return detector_grid(self.size, GRID)


def transform_in(tree: Mapping[str, Any], key: str, where: str) -> Model:
    """Transform of two coordinates to two stored under `key`.

    Raises FormatError for anything else.
    """
    model = tree.get(key)
    if not isinstance(model, Model):
        content = (
            "a list of models" if isinstance(model, (list, tuple)) else f"no model ({model!r})"
        )
        raise FormatError(
            f"{key} holds {content}, which is not a map of a detector's pixels"[:200],
            where=where,
            do="give a distortion reference file of an imager",
        )
    if (model.n_inputs, model.n_outputs) != (2, 2):
        raise FormatError(
            f"{key} takes {model.n_inputs} coordinates to {model.n_outputs} instead of 2 to 2",
            where=where,
            do="give a distortion reference file of an imager",
        )
    return model


def closure_of(forward: Model, back: Model, x: Float, y: Float) -> float:
    """Largest closure error: distance in pixels after the forward and inverse transformations.

    x and y (N,) are FITS 1-based pixels.  The result is NaN if a transform gives no position.
    """
    with np.errstate(all="ignore"):
        returned = evaluated(back, *evaluated(forward, x - 1.0, y - 1.0))
    return float(np.hypot(returned[0] - (x - 1.0), returned[1] - (y - 1.0)).max())


def recorded(file: DistortionFile, record: Mapping[str, Any]) -> Calibration:
    """Calibration stored in the record, with the look-up tables of the transform."""
    values = [table.lookup_table for table in tables_of(file.model)]
    inner = [np.asarray(v, float)[1:-1, 1:-1].T for v in values]  # without the padding
    pairs = [np.stack(inner[k : k + 2]) for k in range(0, len(inner), 2)]
    return calibration_from(record, file.name, pairs)


def departure(file: DistortionFile, calibration: Calibration) -> float:
    """Largest distance in pixels between a calibration and the transform of its file."""
    x, y = file.grid()
    turn, v2v3 = calibration.plane.to_v2v3, calibration.plane.v2v3
    if turn is None or v2v3 is None:
        return float("inf")
    [number] = calibration.numbers
    ours = turn @ calibration.forward(x, y, chip=number).T + np.array(v2v3)[:, None]
    return float(np.hypot(*(ours - file.v2v3(x, y))).max() / calibration.pixel()[0])


def transforms_read_back(files: Mapping[int, DistortionFile]) -> ReadBack:
    """Positions in V2, V3 computed from the files of the chips, and the errors of their inverses.

    `files` has the file of each chip, by chip number.
    """

    def read_back(file: DistortionFile) -> ReadBack:
        back = file.inverse

        def forward(x: Float, y: Float, _: int, __: float | None) -> Float:
            return file.v2v3(x, y).T

        if back is None:
            return ReadBack(file.name, forward, None, own_axes=True)

        def missed(x: Float, y: Float, _: int, __: float | None) -> Float:
            pixels = np.stack([x, y]) - 1.0
            return (evaluated(back, *evaluated(file.model, *pixels)) - pixels).T

        return ReadBack(file.name, forward, missed, own_axes=True)

    return of_chips({number: read_back(file) for number, file in files.items()})


def distortion_calibration(file: DistortionFile, choice: Choice) -> Calibration:
    """Calibration in arcsec, with the covariance of the record if the transform agrees with it.

    For a file without record, (u, v) are V2, V3 relative to the middle of the detector.
    Raises MissingSizeError if neither the file nor `choice` gives the size, and InputError if the
    transform is not a polynomial.
    """
    notes: tuple[str, ...] = ()
    if file.record is not None:
        calibration = recorded(file, file.record)
        far = departure(file, calibration)
        if far <= AGREEMENT:
            return calibration
        notes = (f"the transform is {far:.2g} px from the parameters beside it: without errors",)
    size = file.size if choice.size is None else choice.size
    if size is None:
        raise _no_size(file.name)
    order = order_of(file.model)
    if order is None:
        tables = bool(tables_of(file.model))
        raise InputError(
            "its look-up tables are not arranged as bayesdist does"
            if tables
            else "its transform is not a polynomial",
            where=file.name,
            do="give a polynomial, or a file with a bayesdist record",
        )
    middle = ((size[0] + 1) / 2, (size[1] + 1) / 2)
    zero = file.v2v3(*(np.array([m]) for m in middle))

    def positions(x: Float, y: Float) -> tuple[Float, Float]:
        u, v = file.v2v3(x, y) - zero
        return u, v

    number = _chip_number(file)
    chip_map = fitted_map(
        positions,
        file.name,
        order=min(order, MAX_ORDER),
        size=size,
        reference_pixel=middle,
        unit="arcsec",
        chip=number,
    )
    x, y = detector_grid(size, GRID)
    far = float(np.abs(chip_map.at(x, y) - np.stack(positions(x, y))).max())
    if far > AGREEMENT * np.sqrt(abs(np.linalg.det(chip_map.linear))):
        raise InputError(
            f"its transform is a polynomial of an order above {MAX_ORDER}",
            where=file.name,
            do=f"give one of order {MAX_ORDER} or less",
        )
    instrument = file.meta.get("instrument", {})
    return calibration_of_maps(
        {number: chip_map},
        file.name,
        plane=Plane(
            "aperture", v2v3=(float(zero[0, 0]), float(zero[1, 0])), v3_angle=0.0, parity=1
        ),
        instrument=str(instrument.get("name", "")),
        detector=str(instrument.get("detector", "")),
        filter=str(instrument.get("filter") or instrument.get("optical_element") or ""),
        numbered=False,
        notes=notes,
    )


def _chip_number(file: DistortionFile) -> int:
    return 1 if file.record is None else int(file.record["chip"]["number"] or 1)


def _no_size(name: str) -> MissingSizeError:
    return MissingSizeError(
        "does not state the size of the image, and its detector is not known",
        where=name,
        do="compare it with a file that states it",
    )


# Models that do not change the order of a polynomial.
_AFFINE = (
    models.Shift,
    models.Scale,
    models.Multiply,
    models.AffineTransformation2D,
    models.Rotation2D,
    models.Identity,
    models.Mapping,
)


def evaluated(model: Model, x: ArrayLike, y: ArrayLike) -> Float:
    """Values (2, N) of a transform at inputs (N,), without units."""
    out = model(np.asarray(x, float), np.asarray(y, float))
    return np.stack(
        [np.asarray(getattr(coordinate, "value", coordinate), float) for coordinate in out]
    )


def leaves(model: Model) -> Iterator[Model]:
    """Elementary models of a compound transform, from left to right."""
    if isinstance(model, CompoundModel):
        for part in (model.left, model.right):
            if isinstance(part, Model):
                yield from leaves(part)
    else:
        yield model


def tables_of(model: Model) -> list[Model]:
    """Two-dimensional look-up tables in a transform."""
    return [leaf for leaf in leaves(model) if leaf.n_inputs == 2 and hasattr(leaf, "lookup_table")]


def order_of(model: Model) -> int | None:
    """Order of a transform that is a polynomial; None for any other transform."""
    if isinstance(model, CompoundModel):
        left_order, right_order = order_of(model.left), order_of(model.right)
        if left_order is None or right_order is None or model.op not in ("|", "&", "+", "-"):
            return None
        return left_order * right_order if model.op == "|" else max(left_order, right_order)
    if isinstance(model, (models.Polynomial2D, models.Polynomial1D)):
        return max(int(model.degree), 1)
    if isinstance(model, (models.Chebyshev2D, models.Legendre2D)):
        return max(int(model.x_degree) + int(model.y_degree), 1)
    return 1 if isinstance(model, (*_AFFINE, models.Const1D)) else None


def exchanged(model: Model, lowest: int = 1) -> Model:
    """Copy of a transform with the powers of x and y exchanged in its polynomials.

    Only terms of total order `lowest` or higher are exchanged. Polynomials of order 1, which
    describe rotations, are unchanged.
    """
    out = model.copy()
    for leaf in leaves(out):
        if isinstance(leaf, models.Polynomial2D) and leaf.degree > 1:
            values = dict(zip(leaf.param_names, leaf.parameters.copy(), strict=True))
            for name in leaf.param_names:
                i, j = map(int, name[1:].split("_"))
                if i + j >= lowest:
                    setattr(leaf, name, values[f"c{j}_{i}"])
    return out


@dataclass(frozen=True, eq=False)
class ChipTransform:
    """Transform of one chip with everything else that its file states."""

    calibration: Calibration  # calibration of the chip, in the frame of its aperture
    chip: int
    chip_name: str
    model: Model  # pixels to V2, V3, with its inverse
    record: CalibrationRecord
    closure: float  # pixels; largest error of the inverse

    @property
    def table_arrays(self) -> list[Float]:
        """Arrays of the look-up tables of the transform and of its inverse."""
        tables = [*tables_of(self.model), *tables_of(self.model.inverse)]
        return [array for table in tables for array in (table.lookup_table, *table.points)]


def chip_transforms(
    calibration: Calibration, settings: PlacedSettings, options: BuildOptions, where: str
) -> Iterator[ChipTransform]:
    """Yield the transform of each chip; `where` is the configuration section named in messages.

    Raises InputError if neither the settings nor the calibration give the position or orientation
    in V2, V3, and for the reasons given in `at_date` and `fitted_inverse`.
    """
    plane = _placed(calibration.plane, settings, where)
    matrix = required(plane.to_v2v3, "the plane of an aperture has no axes along V2 and V3")
    v2v3 = required(plane.v2v3, "the plane of an aperture has no position in V2 and V3")
    for nominal in calibration.model.chips:
        number = nominal.number
        dated = at_date(calibration, number, options.epoch, options.scale_arcsec, where=where)
        dated = replace(dated, plane=plane)
        chip = dated.chip(number, origin="stated")
        poly = chip.monomials()
        require_regular(poly.linear, number)
        model = forward_transform(poly, matrix, v2v3, dated.before)
        back = inverse_transform(
            fitted_inverse(chip, settings.inverse_order), matrix, v2v3, dated.before
        )
        closure = closure_of(model, back, *detector_grid(nominal.size))
        if not np.isfinite(closure):
            raise InputError(
                "the inverse of its look-up tables does not converge",
                where=where,
                do="check the tables: they change the order of neighbouring pixels",
            )
        model.inverse = back
        date = options.epoch if calibration.model.time is not None else None
        record = record_of(dated, calibration, epoch=date, closure=closure)
        yield ChipTransform(dated, number, nominal.name, model, record, closure)


def refuse_larger(one: ChipTransform, name: str, known: KnownDetector | None, where: str) -> None:
    """Raise InputError if a chip has more pixels than the detector of this name, if it is known."""
    [chip] = one.calibration.model.chips
    if known is not None and any(a > b for a, b in zip(chip.size, known.size, strict=True)):
        (nx, ny), (most_x, most_y) = chip.size, known.size
        raise InputError(
            f"the chip has {nx:g} x {ny:g} pixels, but {name} {most_x:g} x {most_y:g}",
            where=where,
            do="name the detector that it is",
        )


def _placed(plane: Plane, settings: PlacedSettings, where: str) -> Plane:
    """Plane in an aperture: from the settings, or else from the calibration; default parity -1."""
    v2v3 = plane.v2v3 or (None, None)
    values = {
        "v2ref": settings.v2ref if settings.v2ref is not None else v2v3[0],
        "v3ref": settings.v3ref if settings.v3ref is not None else v2v3[1],
        "v3idlyangle": settings.v3idlyangle if settings.v3idlyangle is not None else plane.v3_angle,
    }
    missing = [name for name, value in values.items() if value is None]
    if missing:
        raise InputError(
            f"{' and '.join(missing)} of (u, v) = 0 {'is' if len(missing) == 1 else 'are'} not "
            "known",
            where=where,
            do="take them from the SIAF of the aperture",
        )
    v2, v3, angle = (float(value) for value in values.values() if value is not None)
    return Plane(
        "aperture",
        v2v3=(v2, v3),
        v3_angle=angle,
        parity=settings.parity or plane.parity or -1,
        orientation=plane.orientation,
    )


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
