"""HDUs of an IDCTAB that is built, and the cards of its headers.

Keywords of its primary header:

==================  ==========================================================================
BDVAFAC, BDUNIT     velocity aberration that was divided out; unit of u and v in the fit
BDU0_c, BDV0_c      constant of chip c that went into V2REF and V3REF
BDANGLE, BDSCALE    similarity from (u, v) to (Xc, Yc); sigmas BDANGSIG, BDSCASIG
BDV2SIG, BDV3SIG    sigmas of V2 and V3 of (u, v) = (0, 0)
BDAGRRMS, BDAGRMAX  distance to the reference table when the similarity is taken out
BDCLOS_c            worst closure of the INVERSE rows of chip c
==================  ==========================================================================
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from astropy.io import fits

from bayesdist.arrays import Float
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import Orientation
from bayesdist.products.formats.common.cards import (
    append_cards,
    number_card,
    text_card,
    wrapped_cards,
)
from bayesdist.products.formats.idctab.numbers import ChipInverse, ChipNumbers


@dataclass(frozen=True, eq=False)
class Piece:
    """Rows that one solution fills."""

    combinations: tuple[tuple[str, ...], ...]  # names of all wheels; () for all filters
    fitted: tuple[ChipNumbers, ...]  # one for each chip
    inverse: tuple[ChipInverse, ...] = ()  # one for each chip; empty without INVERSE rows

    @property
    def n_numbers(self) -> int:
        """Fitted numbers of all chips."""
        return sum(len(f.names) for f in self.fitted)


@dataclass(frozen=True, eq=False)
class _Row:
    filters: tuple[str, ...]
    numbers: ChipNumbers
    inverse: ChipInverse | None
    place: slice  # indices of the chip's numbers in the covariance

    @property
    def direction(self) -> str:
        return "FORWARD" if self.inverse is None else "INVERSE"

    def value(self, name: str) -> float:
        if self.inverse is None or name not in self.inverse.values:
            return self.numbers.column(name)
        return self.inverse.values[name]

    def sigmas(self, cov: Float) -> dict[str, float]:
        names, block = self.numbers.names, cov[self.place, self.place]
        out = dict(zip(names, _deviations(block).tolist(), strict=True))
        return out if self.inverse is None else out | self.inverse.sigmas


def _deviations(cov: Float) -> Float:
    return np.sqrt(np.maximum(np.diag(cov), 0.0))  # -1e-40 is a rounded zero


def _rows(pieces: Sequence[Piece]) -> Iterator[_Row]:
    """Rows filter after filter, chip after chip; FORWARD before INVERSE."""
    start = 0
    for piece in pieces:
        ends = start + np.cumsum([len(f.names) for f in piece.fitted])
        places = [
            slice(int(end) - len(f.names), int(end))
            for end, f in zip(ends, piece.fitted, strict=True)
        ]
        for filters in piece.combinations:
            for f, place in zip(piece.fitted, places, strict=True):
                yield _Row(filters, f, None, place)
            for f, place, inverse in zip(piece.fitted, places, piece.inverse, strict=False):
                yield _Row(filters, f, inverse, place)
        start += piece.n_numbers


def coefficient_hdu(pieces: Sequence[Piece], scale: float) -> fits.BinTableHDU:
    """HDU 1: the table that pipelines read, in doubles."""
    rows = list(_rows(pieces))

    def column(name: str, values: Sequence[float], unit: str = "", form: str = "1D") -> fits.Column:
        return fits.Column(name, form, unit=unit or None, array=np.array(values))

    columns = _key_columns(rows)
    for k, axis in enumerate("XY"):
        sizes = [int(r.numbers.chip.size[k]) for r in rows]
        columns.append(column(f"{axis}SIZE", sizes, "pixel", "1J"))
    for k, axis in enumerate("XY"):
        places = [r.numbers.chip.reference_pixel[k] for r in rows]
        columns.append(column(f"{axis}REF", places, "pixel"))
    for name in _column_names(pieces):
        if name == "CX10":
            columns.append(column("SCALE", [scale] * len(rows), "arcsec"))
        values = [r.value(name) for r in rows]
        if name == "CX11" and scale != 1.0:
            # stwcs takes exactly 1 as a sign that coefficients are in units of SCALE
            values = [np.nextafter(1.0, 0.0) if v == 1.0 else v for v in values]
        columns.append(column(name, values, _unit(name)))
    return fits.BinTableHDU.from_columns(columns)


def sigma_hdu(pieces: Sequence[Piece], cov: Float) -> fits.BinTableHDU:
    """HDU SIGMA: standard deviations, row by row; those of the drift are keywords."""
    rows = list(_rows(pieces))
    sigmas = [r.sigmas(cov) for r in rows]
    columns = _key_columns(rows) + [
        fits.Column(name, "1D", unit=_unit(name), array=np.array([s[name] for s in sigmas]))
        for name in _column_names(pieces)
    ]
    hdu = fits.BinTableHDU.from_columns(columns, name="SIGMA")
    drift = {k: v for s in sigmas for k, v in s.items() if k.startswith("TDD")}
    append_cards(hdu, (number_card(k, v, "[arcsec/pix/yr] 1-sigma") for k, v in drift.items()))
    return hdu


def covariance_hdu(pieces: Sequence[Piece], cov: Float) -> fits.BinTableHDU:
    """HDU COVAR: every fitted number with its covariances; filters named where they differ."""
    entries = [(p, f, name) for p in pieces for f in p.fitted for name in f.names]
    columns = [fits.Column("DETCHIP", "1I", array=np.array([f.chip.number for _, f, _ in entries]))]
    if len(pieces) > 1:
        columns += _filter_columns([p.combinations[0] for p, _, _ in entries])
    values = [np.concatenate([f.values for f in p.fitted]) for p in pieces]
    columns += [
        fits.Column("PARAM", "8A", array=np.array([name for _, _, name in entries])),
        fits.Column("VALUE", "1D", array=np.concatenate(values)),
        fits.Column("COV", f"{len(cov)}D", array=cov),
    ]
    return fits.BinTableHDU.from_columns(columns, name="COVAR")


def _key_columns(rows: Sequence[_Row]) -> list[fits.Column]:
    return [
        fits.Column(
            "DETCHIP", "1I", unit="chip", array=np.array([r.numbers.chip.number for r in rows])
        ),
        fits.Column("DIRECTION", "8A", array=np.array([r.direction for r in rows])),
        *_filter_columns([r.filters for r in rows]),
    ]


def _filter_columns(names: Sequence[tuple[str, ...]]) -> list[fits.Column]:
    labels = ("FILTER1", "FILTER2") if len(names[0]) == 2 else ("FILTER",)
    out = []
    for k, label in enumerate(labels[: len(names[0])]):
        width = max(8, *(len(n[k]) for n in names))
        out.append(fits.Column(label, f"{width}A", array=np.array([n[k] for n in names])))
    return out


def _column_names(pieces: Sequence[Piece]) -> list[str]:
    return [name for name in pieces[0].fitted[0].names if not name.startswith("TDD")]


def _unit(name: str) -> str:
    if name.startswith("V"):
        return "arcsec"
    order = int(name[2])
    return "arcsec/pixel" if order == 1 else f"arcsec/pixel**{order}"


def tdd_cards(fitted: Sequence[ChipNumbers], epoch: float | None, acs_wfc: bool) -> list[str]:
    """Time-dependent terms of ACS/WFC in the scheme of 2015, zeros where none was fitted."""
    if not acs_wfc:
        return []
    comment = "" if epoch is not None else "no time-dependent terms"
    cards = [number_card("TDD_DATE", 2004.5 if epoch is None else epoch, "[yr] reference date")]
    rates = {name: f.column(name) for f in fitted for name in f.names if name.startswith("TDD")}
    for chip in (1, 2):  # stwcs looks for TDD_CTB1 to know the scheme, whatever the chip
        rates.setdefault(f"TDD_CTB{chip}", 0.0)
    for name in sorted(rates):
        cards.append(number_card(name, rates[name], comment or "[arcsec/pix/yr]"))
    return cards


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
    """Cards on the closure of INVERSE with FORWARD rows, the worst of all filters for each chip."""
    worst: dict[int, float] = {}
    for piece in pieces:
        for f, back in zip(piece.fitted, piece.inverse, strict=False):
            worst[f.chip.number] = max(worst.get(f.chip.number, 0.0), back.closure)
    return [
        number_card(f"BDCLOS_{chip}", value, "[pix] worst closure of INVERSE at TDD_DATE")
        for chip, value in worst.items()
    ]
