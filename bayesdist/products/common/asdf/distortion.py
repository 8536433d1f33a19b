"""Distortion reference files in ASDF, read and built: transforms, inverse, record, calibration.

This module imports astropy.modeling, which takes longer than reading files of other formats.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
    MissingSizeError,
    ReadBack,
    of_chips,
)
from bayesdist.products.common.record import CalibrationRecord, at_date, calibration_from, record_of
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
