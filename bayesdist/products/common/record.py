"""Calibration of one chip at one date as a record of names, numbers and arrays, and back.

The record is stored in a file in addition to what a pipeline reads. It holds what the pipeline's
format cannot: the fitted parameters, their covariance, the choice of gauge, and the provenance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, NotRequired, TypedDict

import numpy as np
from pydantic import BaseModel, Field, TypeAdapter

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import further_from
from bayesdist.calibration.inverse import detector_grid
from bayesdist.calibration.orientation import in_arcsec
from bayesdist.calibration.plane import Plane, arcsec_per
from bayesdist.errors import BayesdistError, FormatError, InputError
from bayesdist.files.documents import model_of
from bayesdist.infer.solution.solution import GaussianSolution
from bayesdist.model import Chip, DistortionModel, LookupTable
from bayesdist.utils.arrays import Float
from bayesdist.version import __version__

VERSION = 1
Pair = tuple[float, float]


class _Parameters(BaseModel):
    order: int
    unit: str
    values: Any  # numbers, as an array or a list


class _ChipRecord(BaseModel):
    number: int | None
    name: str
    size: Pair
    reference_pixel: Pair


class _Plane(BaseModel):
    kind: str
    v2v3: Pair | None = None
    v3_angle: float | None = None
    parity: int | None = None


class _Table(BaseModel):
    filter: str
    first: Pair
    step: Pair
    sigma: Any = None


class _Provenance(BaseModel):
    instrument: str = ""
    detector: str = ""
    filter: str = ""
    converged: bool | None = None
    notes: list[str] = []


class _Record(BaseModel):
    """Fields of a record that are read; its other fields are for human readers."""

    parameters: _Parameters
    gauge: str
    provenance: _Provenance
    chip: _ChipRecord
    plane: _Plane
    errors: str = "none"
    covariance: Any = None
    tables: list[_Table] = []
    further_errors: list[Any] = Field(default_factory=list)


_RECORD = TypeAdapter(_Record)


def at_date(
    calibration: Calibration,
    chip: int,
    epoch: float | None,
    scale_arcsec: float | None,
    *,
    where: str,
) -> Calibration:
    """Calibration of one chip at one date, in arcsec, with the look-up tables of that chip.

    `epoch` is in decimal years, and `scale_arcsec` is the size of a pixel for u and v in pixels.

    Raises InputError, which names the configuration section `where`, if u and v are in pixels and
    no scale is given, if a date is missing, or if there are look-up tables after the polynomial.
    """
    if calibration.model.time is not None and epoch is None and calibration.reference_date is None:
        raise InputError(
            "the file holds for one epoch, but the model depends on time",
            where=where,
            do="give an epoch in decimal years",
        )
    if any(table.chip == chip for table in calibration.after):
        raise InputError(
            "the look-up tables are applied after the polynomial, which the file cannot hold",
            where=where,
            do="fit tables of pixels",
        )
    unit = calibration.unit
    if unit == "pix" and scale_arcsec is None:
        raise InputError(
            "u and v are in pixels, but the file is in arcseconds",
            where="detector.scale_mas",
            do="give the pixel scale (scale_mas in Python, --scale of convert)",
        )
    date = epoch if calibration.model.time is not None else None
    factor = arcsec_per(unit, scale_arcsec)
    converted = in_arcsec(calibration.only(chip, date), factor)
    named_chip = calibration.model.chips[calibration.model.chip_code(chip)]
    model = replace(converted.model, chips=(named_chip,))  # keep the name of the chip
    return replace(
        converted,
        solution=GaussianSolution(model, converted.solution.mean, converted.solution.cov),
        before=tuple(t for t in converted.before if t.filter in ("", calibration.filter)),
    )


class ParametersRecord(TypedDict):
    """Parameters of the polynomials."""

    meaning: str
    unit: str
    order: int
    names: list[str]
    values: Float  # (D,)


class ChipRecord(TypedDict):
    """Chip of the parameters; sizes and positions in pixels."""

    number: int | None
    name: str
    size: list[float]
    reference_pixel: list[float]


class PlaneRecord(TypedDict):
    """Plane of (u, v); see `bayesdist.calibration.plane.Plane`."""

    kind: str
    v2v3: list[float] | None
    v3_angle: float | None
    parity: int | None


class TableRecord(TypedDict):
    """Look-up table, apart from its values, which are in the transform."""

    filter: str
    first: list[float]
    step: list[float]
    sigma: NotRequired[Float]  # (2, ny, nx)


class ProvenanceRecord(TypedDict):
    """Origin of the parameters."""

    software: str
    source: str
    instrument: str
    detector: str
    filter: str
    epoch: float | None  # decimal years
    kind: str
    converged: bool | None
    notes: list[str]


class InverseRecord(TypedDict):
    """Accuracy of the inverse."""

    closure_pix: float


class CalibrationRecord(TypedDict):
    """Record of a calibration of one chip at one date, as stored in a file."""

    version: int
    parameters: ParametersRecord
    errors: str
    gauge: str
    chip: ChipRecord
    plane: PlaneRecord
    tables: list[TableRecord]
    provenance: ProvenanceRecord
    inverse: NotRequired[InverseRecord]
    further_errors: NotRequired[list[dict[str, Any]]]
    covariance: NotRequired[Float]  # (D, D)


def record_of(
    calibration: Calibration,
    source: Calibration,
    *,
    epoch: float | None = None,
    closure: float | None = None,
) -> CalibrationRecord:
    """Record of a calibration of one chip at one date.

    `source` is the calibration that it was made from, and `closure` the largest error of the
    inverse in pixels.
    """
    model, plane = calibration.model, calibration.plane
    [chip] = model.chips
    convergence = source.solution.convergence
    record: CalibrationRecord = {
        "version": VERSION,
        "parameters": {
            "meaning": "Legendre products over the chip, pixels to (u, v)",
            "unit": model.unit,
            "order": model.order,
            "names": list(model.names),
            "values": np.array(calibration.solution.mean, float),
        },
        "errors": calibration.errors,
        "gauge": _gauge(source),
        "chip": {
            "number": chip.number if calibration.numbered else None,
            "name": chip.name,
            "size": list(map(float, chip.size)),
            "reference_pixel": list(map(float, chip.reference_pixel)),
        },
        "plane": {
            "kind": plane.kind,
            "v2v3": None if plane.v2v3 is None else list(map(float, plane.v2v3)),
            "v3_angle": plane.v3_angle,
            "parity": plane.parity,
        },
        "tables": [_table_entry(table) for table in calibration.before],
        "provenance": {
            "software": f"bayesdist {__version__}",
            "source": source.name,
            "instrument": calibration.instrument,
            "detector": calibration.detector,
            "filter": calibration.filter,
            "epoch": None if epoch is None else float(epoch),
            "kind": source.solution.kind,
            "converged": None if convergence is None else bool(convergence.converged),
            "notes": list(source.notes),
        },
    }
    if closure is not None:
        record["inverse"] = {"closure_pix": float(closure)}
    if calibration.further:
        record["further_errors"] = [asdict(row) for row in calibration.further]
    if calibration.errors != "none":
        record["covariance"] = np.array(calibration.solution.cov, float)
    return record


def _gauge(source: Calibration) -> str:
    """Sentence that states whether the covariance includes errors of position and orientation."""
    orientation = source.plane.orientation
    if orientation is not None:
        return f"Oriented by {orientation.source}; the error of that is in the covariance."
    if source.plane.kind == "free":
        return "Position, scale and angle in V2, V3 are taken as exact."
    return "Position and angle of the aperture in V2, V3 are taken as exact."


def _table_entry(table: LookupTable) -> TableRecord:
    entry: TableRecord = {
        "filter": table.filter,
        "first": list(table.first),
        "step": list(table.step),
    }
    if table.sigma is not None:
        entry["sigma"] = np.array(table.sigma)
    return entry


# -- and back -------------------------------------------------------------------------------------


def calibration_from(
    record: Mapping[str, Any], name: str, table_values: Sequence[Float] = ()
) -> Calibration:
    """Calibration of a record; `table_values` (2, ny, nx) are its look-up tables in order.

    Raises FormatError for a record of another version or with missing parts.
    """
    location = f"{name}, bayesdist"
    if record.get("version") != VERSION:
        raise FormatError(
            f"the record is of version {record.get('version')}, but this version of bayesdist "
            f"reads {VERSION}",
            where=location,
            do="use the version of bayesdist that wrote it",
        )
    stored = model_of(_RECORD, record, location, do="fetch the file again")
    parameters, chip = stored.parameters, stored.chip
    number = 1 if chip.number is None else chip.number
    model = DistortionModel(
        parameters.order,
        (Chip(number, chip.name, chip.size, chip.reference_pixel),),
        parameters.unit,
    )
    mean = np.array(parameters.values, float)
    cov = np.zeros((model.n_params, model.n_params))
    if stored.errors != "none":
        cov = np.array(stored.covariance, float)
    if mean.shape != (model.n_params,) or cov.shape != (model.n_params,) * 2:
        raise FormatError(
            f"{mean.size} parameters and a covariance of {' x '.join(map(str, cov.shape))} do not "
            f"match order {model.order}",
            where=location,
            do="fetch the file again",
        )
    tables = tuple(
        LookupTable(number, values, table.filter, table.first, table.step, table.sigma)
        for table, values in zip(stored.tables, table_values, strict=True)
    )
    source = stored.provenance
    return Calibration(
        name,
        GaussianSolution(model, mean, cov),
        Plane(**stored.plane.model_dump()),
        instrument=source.instrument,
        detector=source.detector,
        filter=source.filter,
        errors=stored.errors,
        numbered=chip.number is not None,
        before=tables,
        notes=(*source.notes, *(["has not converged"] if source.converged is False else [])),
        further=further_from(stored.further_errors, location),
    )


def error_lines(
    read: Callable[[], Calibration] | None, source: str, more: Callable[[], list[str]] = list
) -> list[str]:
    """Lines of text on the errors that a record states.

    `read` returns the calibration of the record; it is None if there is no record. `more` returns
    further lines, which are added if the record can be read.
    """
    if read is None:
        return ["  errors    none stated"]
    try:
        calibration = read()
        [chip] = calibration.by_chip().values()
        cov = chip.covariance_at(*detector_grid(chip.basis.size, 65))
    except BayesdistError:
        return [f"  errors    of {source} that cannot be read"]
    if cov is None:
        return ["  errors    none stated", *more()]
    sigma = 1e3 * np.sqrt((cov[:, 0, 0] + cov[:, 1, 1]) / 2)
    return [
        f"  errors    {calibration.errors}: {np.median(sigma):.3g} mas per axis at the median, "
        f"{sigma.max():.3g} at worst",
        *more(),
    ]
