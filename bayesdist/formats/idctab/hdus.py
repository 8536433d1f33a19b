"""HDUs of a newly built IDCTAB, and the cards of its headers.

bayesdist adds these keywords to the primary header:

==================  ==========================================================================
BDVAFAC, BDUNIT     velocity aberration that was divided out; unit of u and v in the fit
BDU0_c, BDV0_c      constant term of chip c that was moved to V2REF and V3REF
BDANGLE, BDSCALE    similarity from (u, v) to (Xc, Yc); sigmas BDANGSIG, BDSCASIG
BDV2SIG, BDV3SIG    sigmas of V2 and V3 of (u, v) = (0, 0)
BDAGRRMS, BDAGRMAX  distance from the reference table after a fitted similarity
BDCLOS_c            worst closure of the INVERSE rows of chip c
==================  ==========================================================================
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.io import fits

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import Orientation
from bayesdist.formats.idctab.numbers import ChipInverse, ChipNumbers
from bayesdist.products.common.cards import (
    append_cards,
    number_card,
    text_card,
    wrapped_cards,
)
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class Piece:
    """Rows that are filled from one solution."""

    combinations: tuple[tuple[str, ...], ...]  # filter names of all wheels; () for all filters
    fitted: tuple[ChipNumbers, ...]  # one per chip
    inverse: tuple[ChipInverse, ...] = ()  # one per chip; empty without INVERSE rows


@dataclass(frozen=True, eq=False)
class _Row:
    filters: tuple[str, ...]
    numbers: ChipNumbers
    inverse: ChipInverse | None
    place: slice  # indices of the chip's numbers in the covariance

    @property
    def key(self) -> dict[str, Any]:
        """Columns that identify the row."""
        direction = "FORWARD" if self.inverse is None else "INVERSE"
        named = {"DETCHIP": self.numbers.chip.number, "DIRECTION": direction}
        return named | _by_wheel(self.filters)

    def value(self, name: str) -> float:
        if self.inverse is None or name not in self.inverse.values:
            return self.numbers.column(name)
        return self.inverse.values[name]

    def sigmas(self, cov: Float) -> dict[str, float]:
        variances = np.diag(cov)[self.place]
        sigmas = np.sqrt(np.maximum(variances, 0.0)).tolist()  # rounding may give -1e-40
        out = dict(zip(self.numbers.names, sigmas, strict=True))
        return out if self.inverse is None else out | self.inverse.sigmas


def _rows(pieces: Sequence[Piece]) -> Iterator[_Row]:
    """Rows ordered by filter, then by chip, with FORWARD before INVERSE."""
    end = 0
    for piece in pieces:
        places = []
        for f in piece.fitted:
            places.append(slice(end, end + len(f.names)))
            end += len(f.names)
        for filters in piece.combinations:
            for f, place in zip(piece.fitted, places, strict=True):
                yield _Row(filters, f, None, place)
            for f, place, inverse in zip(piece.fitted, places, piece.inverse, strict=False):
                yield _Row(filters, f, inverse, place)


def coefficient_hdu(pieces: Sequence[Piece], scale: float) -> fits.BinTableHDU:
    """HDU 1: the coefficient table that pipelines read, in double precision."""
    table = []
    for row in _rows(pieces):
        chip = row.numbers.chip
        out = row.key
        out |= {f"{axis}SIZE": int(n) for axis, n in zip("XY", chip.size, strict=True)}
        out |= {f"{axis}REF": n for axis, n in zip("XY", chip.reference_pixel, strict=True)}
        for name in _column_names(pieces):
            if name == "CX10":
                out["SCALE"] = scale
            out[name] = row.value(name)
        if out.get("CX11") == 1.0 and scale != 1.0:
            # in stwcs, exactly 1 means that the coefficients are in units of SCALE
            out["CX11"] = np.nextafter(1.0, 0.0)
        table.append(out)
    return _table(table)


def sigma_hdu(pieces: Sequence[Piece], cov: Float) -> fits.BinTableHDU:
    """HDU SIGMA: standard deviations of each row; those of the drift are header keywords."""
    table, drift = [], dict[str, float]()
    for row in _rows(pieces):
        sigmas = row.sigmas(cov)
        table.append(row.key | {name: sigmas[name] for name in _column_names(pieces)})
        drift |= {k: v for k, v in sigmas.items() if k.startswith("TDD")}
    hdu = _table(table, "SIGMA")
    append_cards(hdu, (number_card(k, v, "[arcsec/pix/yr] 1-sigma") for k, v in drift.items()))
    return hdu


def covariance_hdu(pieces: Sequence[Piece], cov: Float) -> fits.BinTableHDU:
    """HDU COVAR: every fitted number with its covariances, and its filters if solutions differ."""
    named = [
        {"DETCHIP": f.chip.number}
        | (_by_wheel(p.combinations[0]) if len(pieces) > 1 else {})
        | {"PARAM": name, "VALUE": value}
        for p in pieces
        for f in p.fitted
        for name, value in zip(f.names, f.values, strict=True)
    ]
    return _table([row | {"COV": by} for row, by in zip(named, cov, strict=True)], "COVAR")


def _by_wheel(filters: tuple[str, ...]) -> dict[str, str]:
    """Filter names by the columns that hold them."""
    labels = ("FILTER1", "FILTER2") if len(filters) == 2 else ("FILTER",)
    return dict(zip(labels, filters, strict=False))


def _table(rows: Sequence[Mapping[str, Any]], name: str | None = None) -> fits.BinTableHDU:
    """Table from rows of values by column; in double precision, except for integer columns."""
    columns = []
    for column in rows[0]:
        values = np.array([row[column] for row in rows])
        form = f"{values.shape[1]}D" if values.ndim == 2 else "1D"
        form = {"DETCHIP": "1I", "XSIZE": "1J", "YSIZE": "1J"}.get(column, form)
        if values.dtype.kind == "U":
            form = f"{max(8, values.dtype.itemsize // 4)}A"
        unit = None if name == "COVAR" else _unit(column)
        columns.append(fits.Column(column, form, unit=unit, array=values))
    return fits.BinTableHDU.from_columns(columns, name=name)


def _column_names(pieces: Sequence[Piece]) -> list[str]:
    return [name for name in pieces[0].fitted[0].names if not name.startswith("TDD")]


def _unit(column: str) -> str | None:
    if column[:2] in ("CX", "CY"):
        order = int(column[2])
        return "arcsec/pixel" if order == 1 else f"arcsec/pixel**{order}"
    pixels = dict.fromkeys(("XSIZE", "YSIZE", "XREF", "YREF"), "pixel")
    arcsec = dict.fromkeys(("V2REF", "V3REF", "SCALE"), "arcsec")
    return (pixels | arcsec | {"DETCHIP": "chip"}).get(column)


def tdd_cards(fitted: Sequence[ChipNumbers], epoch: float | None, acs_wfc: bool) -> list[str]:
    """Cards of the ACS/WFC drift in the scheme of 2015; zeros if no drift was fitted."""
    if not acs_wfc:
        return []
    comment = "" if epoch is not None else "no time-dependent terms"
    cards = [number_card("TDD_DATE", 2004.5 if epoch is None else epoch, "[yr] reference date")]
    rates = {name: f.column(name) for f in fitted for name in f.names if name.startswith("TDD")}
    for chip in (1, 2):  # stwcs recognizes the scheme by TDD_CTB1, whatever the chip
        rates.setdefault(f"TDD_CTB{chip}", 0.0)
    comment = comment or "[arcsec/pix/yr]"
    return cards + [number_card(name, rates[name], comment) for name in sorted(rates)]


def provenance_cards(
    fitted: Sequence[ChipNumbers], vafactor: float, calibration: Calibration
) -> list[str]:
    """Cards on the origin of the numbers: unit and constants of the fit, and the orientation."""
    orientation = calibration.plane.orientation
    unit = calibration.unit if orientation is None else orientation.base.model.unit
    cards = [
        text_card("CREATOR", "bayesdist"),
        number_card("BDVAFAC", float(vafactor), "VAFACTOR that was divided out"),
        text_card("BDUNIT", unit, "unit of u and v in the fit"),
    ]
    for f in fitted:
        for axis, value in zip("UV", f.constant, strict=True):
            keyword = f"BD{axis}0_{f.chip.number}"
            cards.append(number_card(keyword, float(value), "[arcsec] constant, now in V2/V3REF"))
    return cards if orientation is None else cards + _orientation_cards(orientation, vafactor)


def _orientation_cards(orientation: Orientation, vafactor: float) -> list[str]:
    """Cards on the orientation, its error and its agreement with the reference."""
    sigma = orientation.sigma
    scale = orientation.scale / vafactor
    degrees = np.rad2deg([orientation.angle, sigma["angle"]]).tolist()
    cards = [
        number_card("BDANGLE", degrees[0], "[deg] from (u, v) to (Xc, Yc)"),
        number_card("BDANGSIG", degrees[1], "[deg] 1-sigma of BDANGLE"),
        number_card("BDSCALE", scale, "[arcsec] one unit of u and v"),
        number_card("BDSCASIG", scale * sigma["log_scale"], "[arcsec] 1-sigma of BDSCALE"),
        number_card("BDV2SIG", sigma["shift_x"], "[arcsec] 1-sigma of V2 of (u, v) = 0"),
        number_card("BDV3SIG", sigma["shift_y"], "[arcsec] 1-sigma of V3 of (u, v) = 0"),
        number_card("BDAGRRMS", orientation.agreement.rms, "[mas] rms distance to reference"),
        number_card("BDAGRMAX", orientation.agreement.worst, "[mas] largest distance"),
    ]
    return cards + wrapped_cards("HISTORY", [f"V2/V3: {orientation.source}"], 72)


def closure_cards(pieces: Sequence[Piece]) -> list[str]:
    """Cards with the worst closure of the INVERSE rows of each chip, over all filters."""
    worst: dict[int, float] = {}
    for piece in pieces:
        for f, back in zip(piece.fitted, piece.inverse, strict=False):
            worst[f.chip.number] = max(worst.get(f.chip.number, 0.0), back.closure)
    return [
        number_card(f"BDCLOS_{chip}", value, "[pix] worst closure of INVERSE at TDD_DATE")
        for chip, value in worst.items()
    ]
