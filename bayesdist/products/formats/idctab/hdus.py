"""Tables of an IDCTAB: coefficients, their standard deviations, their covariance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bayesdist.products.formats.common.cards import number_card
from bayesdist.products.formats.idctab.numbers import ChipInverse, ChipNumbers

__all__ = ["Piece", "coefficient_hdu", "covariance_hdu", "sigma_hdu"]

Float = NDArray[np.float64]


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
    for name, value in drift.items():
        card = number_card(name, value, "[arcsec/pix/yr] 1-sigma")
        hdu.header.append(fits.Card.fromstring(card), end=True)
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
