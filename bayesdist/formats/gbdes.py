"""Model parameters of gbdes with their covariance, as written by Rubin's gbdesAstrometricFit.

The table has the columns mapName, coordinate (x or y), coefficientNumber and parameter. For each
row it also has a column ``{map}_{x|y}_{n}_cov`` with that row of the covariance matrix, where n
counts through both coordinates of a map. The map of a detector, ``{band}/{detector}/poly``,
converts pixels scaled to -1 to 1, x' = 2 x / NX - 1 with x counted from 0, to degrees; the map of a
visit is applied after it. Coefficients are in the order 1, x, y, x^2, xy, y^2, ...
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.calibration.calibration import Calibration, calibration_of_maps
from bayesdist.calibration.chip_map import ChipMap, fitted_map
from bayesdist.errors import FormatError, InputError
from bayesdist.model import polynomial_terms
from bayesdist.model.basis import MAX_ORDER, PolynomialBasis, n_terms
from bayesdist.products.common.content import Content
from bayesdist.products.common.document import (
    Choice,
    Finding,
    Format,
    MissingSizeError,
    finding_lines,
)
from bayesdist.products.common.rules import WIDEST_IMAGE, is_skewed, mixed_parities, not_finite
from bayesdist.utils.arrays import Float, Int

if TYPE_CHECKING:
    from astropy.table import Table  # slow to import, and needed for few files

_COLUMNS = ("mapName", "coordinate", "coefficientNumber", "parameter")
_DEVICE = re.compile(r"(.+)/(\d+)/poly$")
_NOT_EVEN = 1e-9  # relative tolerance for the symmetry of a covariance matrix


@dataclass(frozen=True, eq=False)
class GbdesParameters:
    """Table of gbdes model parameters."""

    name: str
    table: Table

    @property
    def maps(self) -> dict[str, Int]:
        """Row indices of each map, x before y, by the name of the map."""
        names = _filled(self.table["mapName"], "").astype(str)
        return {str(n): np.flatnonzero(names == n) for n in dict.fromkeys(names)}

    def order(self, rows: Int) -> int:
        """Polynomial order of a map; FormatError if the number of coefficients fits no order."""
        half = len(rows) // 2
        for order in range(MAX_ORDER + 1):
            if n_terms(order) == half and len(rows) == 2 * half:
                return order
        raise FormatError(f"a map has {len(rows)} coefficients", where=self.name, do="check it")

    @property
    def covariance(self) -> Float | None:
        """Covariance of all parameters in the order of the rows; None if a column is missing."""
        columns = []
        for name, rows in self.maps.items():
            for p in range(len(rows)):
                coordinate = "x" if p < len(rows) // 2 else "y"
                column = f"{name}_{coordinate}_{p}_cov"
                if column not in self.table.colnames:
                    return None
                columns.append(_filled(self.table[column], np.nan).astype(float))
        return np.stack(columns)

    def devices(self, band: str | None) -> dict[int, Int]:
        """Row indices of the detector maps of one band, by detector number."""
        matches = {n: m for n in self.maps if (m := _DEVICE.match(n)) is not None}
        bands = list(dict.fromkeys(match[1] for match in matches.values()))
        if band is None and len(bands) > 1:
            raise InputError(
                f"holds the bands {', '.join(bands)}",
                where=self.name,
                do="name one (filter in Python, --filter on the command line)",
            )
        chosen = bands[0] if band is None and bands else band
        if chosen not in bands:
            raise InputError(
                "holds no map of a detector" if not bands else f"there is no band {chosen}",
                where=self.name,
                do="give the parameters of a fit with maps BAND/DETECTOR/poly",
            )
        return {
            int(match[2]): self.maps[name] for name, match in matches.items() if match[1] == chosen
        }


def _filled(column: Any, missing: float | str) -> NDArray[Any]:
    """Values of a column; `missing` in place of those that are masked."""
    return np.asarray(np.ma.filled(np.ma.asarray(column), missing))


def _parse(content: Content) -> GbdesParameters | None:
    # with thousands of columns, the column names are far from the end of a Parquet file
    if content.path is None or not all(name.encode() in content.raw for name in _COLUMNS):
        return None
    from bayesdist.files.tables import read_table  # slow to import

    table = read_table(content.path)
    if not set(_COLUMNS) <= set(table.colnames):
        return None
    return GbdesParameters(content.name, table)


def _lint(found: GbdesParameters) -> tuple[Finding, ...]:
    return tuple(_findings(found))


def _findings(found: GbdesParameters) -> Iterator[Finding]:
    table = found.table
    determinants = []
    for name, rows in found.maps.items():
        axes = [str(v) for v in _filled(table["coordinate"], "")[rows]]
        half = len(rows) // 2
        numbers = _filled(table["coefficientNumber"], -1).astype(int)[rows].tolist()
        if axes != ["x"] * half + ["y"] * half or numbers != [*range(half)] * 2:
            yield Finding(
                "error", name, "coefficients are not in the order x, y, each from 0 upwards"
            )
        slope = _filled(table["parameter"], np.nan).astype(float)[rows]
        yield from not_finite(slope, name, "holds parameters that are not finite")
        if half >= 3 and _DEVICE.match(name):
            linear = np.array([slope[1:3], slope[half + 1 : half + 3]])
            determinants.append(float(np.linalg.det(linear)))
            if is_skewed(linear):
                yield Finding(
                    "error", name, "its axes are not perpendicular: x and y may be exchanged"
                )
            if np.hypot(*linear).max() > WIDEST_IMAGE / 2:
                yield Finding("error", name, "is wider than the sky: its unit is the degree")
    yield from mixed_parities(
        determinants, "parameter", "detectors are of different parity: check their maps"
    )
    cov = found.covariance
    if cov is None:
        yield Finding("warning", "MAP_x_n_cov", "columns of the covariance are missing")
    elif cov.shape[0] != cov.shape[1]:
        yield Finding("error", "MAP_x_n_cov", f"the covariance is {cov.shape[0]} x {cov.shape[1]}")
    elif not np.isfinite(cov).all():
        yield Finding("error", "MAP_x_n_cov", "some elements are missing or not finite")
    elif not np.allclose(cov, cov.T, rtol=0, atol=_NOT_EVEN * np.abs(cov).max()):
        yield Finding("error", "MAP_x_n_cov", "the covariance is not symmetric")
    elif (np.diag(cov) < 0).any():
        yield Finding("error", "MAP_x_n_cov", "some variances are negative")


def _describe(found: GbdesParameters) -> list[str]:
    """Lines of text on the maps, followed by the findings."""
    lines = [f"{found.name}: model parameters of gbdes, {len(found.maps)} maps"]
    cov = found.covariance
    sigma = None if cov is None else np.sqrt(np.maximum(np.diag(cov), 0.0))
    for name, rows in list(found.maps.items())[:20]:
        text = f"  {name:<24} order {found.order(rows)}"
        if sigma is not None:
            text += f", sigma of the constants {3600e3 * sigma[rows[0]]:.3g} mas"
        lines.append(text)
    if len(found.maps) > 20:
        lines.append(f"  ... {len(found.maps) - 20} more")
    return [*lines, "", *finding_lines(_lint(found))]


def _calibration(found: GbdesParameters, name: str, choice: Choice) -> Calibration:
    """Calibration in degrees from the maps of the detectors, with their joint covariance."""
    if choice.size is None:
        raise MissingSizeError(
            "does not state the size of the detectors",
            where=name,
            do="give it (size=(NX, NY) in Python, --size NX NY on the command line)",
        )
    wrong = [f for f in _lint(found) if f.level == "error"]
    if wrong:
        raise FormatError(
            wrong[0].message, where=f"{name}, {wrong[0].where}", do="correct the table"
        )
    devices = found.devices(choice.filter)
    order = max(1, *(found.order(rows) for rows in devices.values()))
    values = _filled(found.table["parameter"], np.nan).astype(float)
    maps, changes, used = {}, [], []
    for number, rows in devices.items():
        maps[number] = _map(values[rows], found.order(rows), order, choice.size, name, number)
        changes.append(_change(found.order(rows), maps[number].basis))
        used.append(rows)
    cov, full_cov = None, found.covariance
    if full_cov is not None:
        rows = np.concatenate(used)
        sizes = [c.shape[0] for c in changes]
        J = np.zeros((sum(sizes), len(rows)))
        at = np.cumsum([0, *sizes]), np.cumsum([0, *(c.shape[1] for c in changes)])
        for k, change in enumerate(changes):
            J[at[0][k] : at[0][k + 1], at[1][k] : at[1][k + 1]] = change
        cov = J @ full_cov[np.ix_(rows, rows)] @ J.T
        cov = (cov + cov.T) / 2
    return calibration_of_maps(
        maps, name, cov=cov, errors="covariance", filter=choice.filter or "",
        notes=("pixels to degrees before the map of a visit, which turns and shifts them",),
    )  # fmt: skip


def _map(
    values: Float, own: int, order: int, size: tuple[float, float], name: str, number: int
) -> ChipMap:
    def positions(x: Float, y: Float) -> tuple[Float, Float]:
        X, Y = 2 * (x - 1) / size[0] - 1, 2 * (y - 1) / size[1] - 1
        powers = np.stack([X**i * Y**j for i, j in polynomial_terms(own)])
        u, v = values.reshape(2, -1) @ powers
        return u, v

    return fitted_map(
        positions, name, order=order, size=size, unit="deg", chip=number,
        reference_pixel=((size[0] + 1) / 2, (size[1] + 1) / 2),
    )  # fmt: skip


def _change(own: int, basis: PolynomialBasis) -> Float:
    """Matrix from the coefficients of a map, x before y, to Legendre coefficients."""
    columns = []
    for k in range(n_terms(own)):
        values = np.zeros((2, n_terms(own)))
        values[0, k] = 1.0
        chip_map = _map(values.ravel(), own, basis.order, basis.size, "", 1)
        columns.append(chip_map.coefficients[0])
    return np.kron(np.eye(2), np.stack(columns, axis=1))


FORMAT = Format(
    "gbdes", "model parameters of gbdes", 35, _parse, _describe, _lint, _calibration,
    asks=("filter", "size"),
)  # fmt: skip
