"""Differences of the files of a run from its solution, read back from the files as written.

A SIP header holds one chip at one date: drift is left out at any other, look-up tables always.  An
IDCTAB lies along axes of its own and counts in its own pixels: the best shift, rotation and, once
for all dates, scale are taken out; of a released set the look-up tables are applied as well.  An
inverse is compared with the forward terms of its own file, between which a user goes to and fro.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.config import Config
from bayesdist.app.exposures.release_files import write_files
from bayesdist.app.products.file_positions import sip_positions
from bayesdist.app.products.made_files import ProductInput, made_files
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import MEASURED, PRODUCT, Known, Row
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import ARCSEC
from bayesdist.errors import BayesdistError
from bayesdist.model import corrected
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.products import SipHeader, read_d2im, read_lookup_file
from bayesdist.products.formats.common.content import Content
from bayesdist.products.formats.common.document import PARAMETERS, Built, Choice
from bayesdist.products.formats.sip.read import sip_of
from bayesdist.products.formats.wise.meta import bands_of
from bayesdist.products.registry import read_calibration, recognized

__all__ = ["file_errors", "product_terms"]

log = logging.getLogger("bayesdist")

Float = NDArray[np.float64]
Positions = Callable[[Float, Float, int, float | None], Float]

FORWARD, INVERSE = "forward", "inverse"
_OF_THEIR_OWN = ("sip", "idctab", "wise_meta")  # formats that are compared in a way of their own
GRID = (33, 33)  # points over which files are laid on the solution
ROUNDING = 1e-9  # of a pixel
SKY_ROUNDING = 2e-9  # arcsec: what double precision leaves of an RA of 360 degrees, and back


def product_terms(product: ProductInput, config: Config, base: Path) -> tuple[Known, ...]:
    """Terms of the files that the configuration asks for.

    They are read back from their bytes, so that digits and orders are those of the files; nothing
    of the run is touched.
    """
    release, made = config.products.release, made_files(product, config)
    out: list[Known] = []
    if "sip" in made:
        headers = {one.chip: sip_of(_content(one)) for one in made["sip"] if one.chip is not None}
        out += _sip_terms(product, ", ".join(one.file_name for one in made["sip"]), headers)
    for one in made.get("idctab", ()):
        of_file = recognized(_content(one)).calibration()
        out += _idctab_terms(product, one.file_name, [of_file])
    for key, files in made.items():
        if key not in _OF_THEIR_OWN:
            out.append(_laid_term(product, [one for one in files if one.kind != PARAMETERS]))
    for one in made.get("wise_meta", ()):
        [band] = bands_of(_content(one))
        chip = product.solution.model.chips[0].number
        out += _sip_terms(product, one.file_name, {chip: band.sip}, like=one.made)
    if release is not None:
        with TemporaryDirectory() as folder:
            sets = _released(product, config, base, Path(folder))
            out += _idctab_terms(product, release.name, sets)
    return tuple(out)


def file_errors(product: ProductInput, config: Config, base: Path) -> tuple[Known, ...]:
    """As `product_terms`; none where the files cannot be made, of which the export complains."""
    try:
        return product_terms(product, config, base)
    except BayesdistError as error:
        log.warning("evaluate: WARNING: the files were not compared with the solution: %s", error)
        return ()


def _content(built: Built) -> Content:
    return Content(built.file_name, built.content)


def _sip_terms(
    product: ProductInput,
    file: str,
    headers: Mapping[int, SipHeader],
    like: SipHeader | None = None,
) -> list[Known]:
    """Forward and inverse of one header for each chip."""
    unit, scale = product.solution.model.unit, product.scale_arcsec
    point = product.tangent_point if like is None else None  # WISE's entries have no CRVAL

    def place(x: Float, y: Float, chip: int, _: float | None) -> Float:
        return sip_positions(
            headers[chip], x, y, unit=unit, scale_arcsec=scale, like=like, tangent_point=point
        )

    def missed(x: Float, y: Float, chip: int, _: float | None) -> Float:
        sip = headers[chip]
        back_x, back_y = sip.inverse(*sip.forward(x, y))
        return np.stack([back_x - x, back_y - y], axis=-1)

    rotates = product.aligned
    turned = _Laid(product, place, scaled=False) if rotates else None
    forward = turned or (lambda x, y, c, t: place(x, y, c, t) - _solution(product, x, y, c, t))
    return [
        _term(product, file, FORWARD, forward),
        _term(product, file, INVERSE, _in_unit(product, missed)),
    ]


def _idctab_terms(product: ProductInput, file: str, sets: Sequence[Calibration]) -> list[Known]:
    """Forward, and inverse where there are such rows; one set for each segment of the drift."""
    time = product.solution.model.time

    def of(epoch: float | None) -> Calibration:
        if time is None or epoch is None or len(sets) == 1:
            return sets[0]
        return sets[int(np.searchsorted(time.breaks, epoch, side="right"))]

    def place(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        # a table without drift would refuse a date
        return of(epoch).forward(x, y, chip=chip, epoch=None if time is None else epoch)

    def missed(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        one = of(epoch)
        about_zero = one.at(origin="chip")[chip]  # at the reference date, for which the rows are
        back = one.inverses[chip].pixels(*about_zero.at(x, y))
        return np.stack([back[0] - x, back[1] - y], axis=-1)

    out = [_term(product, file, FORWARD, _Laid(product, place, scaled=True))]
    if all(one.inverses for one in sets):
        out.append(_term(product, file, INVERSE, _in_unit(product, missed)))
    return out


def _laid_term(product: ProductInput, files: Sequence[Built]) -> Known:
    """Forward term of one file, or of one for each chip, as other programs read them."""
    by_chip: dict[int, Calibration] = {}
    for one in files:
        found = recognized(_content(one)).calibration(Choice(as_used=True))
        by_chip |= dict.fromkeys(found.numbers if one.chip is None else (one.chip,), found)

    def place(x: Float, y: Float, chip: int, _: float | None) -> Float:
        return by_chip[chip].forward(x, y, chip=chip)

    name = ", ".join(one.file_name for one in files)
    return _term(product, name, FORWARD, _Laid(product, place, scaled=True))


def _released(product: ProductInput, config: Config, base: Path, folder: Path) -> list[Calibration]:
    """The files of a release, one set for each segment: of several periods of one, the first."""
    block, filter = config.products.release, product.filter
    assert block is not None
    solutions = {filter: product.solution}
    entries = write_files(config, base, folder, solutions, product.tables)
    paths = {e["kind"]: folder / e["path"] for e in entries}
    before = read_d2im(paths["D2IMFILE"]) if "D2IMFILE" in paths else ()
    npol = read_lookup_file(paths["NPOLFILE"]) if "NPOLFILE" in paths else None
    sets = {}
    for entry in entries:
        if entry["kind"] == "IDCTAB":
            one = read_calibration(folder / entry["path"], filter=filter)
            after = (
                ()
                if npol is None
                else [npol.table(c, one.pixel()[0] * npol.values(c), None) for c in npol.chips]
            )
            sets[entry["period"]] = replace(one, before=tuple(before), after=tuple(after))
    segments: dict[int, Calibration] = {}
    for period in block.period:
        segments.setdefault(period.segment, sets[period.name])
    time = product.solution.model.time
    n = 1 if time is None else time.n_segments
    last = segments[min(segments)]
    return [segments.get(k, last) for k in range(n)]


def _term(product: ProductInput, file: str, direction: str, shift: Positions) -> Known:
    solution = product.solution
    least = ROUNDING * solution.model.pixel_size(solution.mean)
    if product.tangent_point is not None:
        least = max(least, SKY_ROUNDING / ARCSEC[solution.model.unit])
    against = "the solution" if direction == FORWARD else "its forward terms"
    source = f"{MEASURED}: as written, against {against}"

    def rounded(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        # displacements below this are digits of the arithmetic
        found = np.asarray(shift(x, y, chip, epoch), float)
        return np.where(np.abs(found) < least, 0.0, found)

    return Known(Row(f"{file}, {direction}", PRODUCT, source, in_total=False), rounded)


def _solution(product: ProductInput, x: Float, y: Float, chip: int, epoch: float | None) -> Float:
    """Positions (N, 2) by the solution: tables where it has some, then the polynomials."""
    solution = product.solution
    if product.tables:
        x, y = corrected(product.tables, x, y, chip=chip, filter=product.filter)
    place = place_of(solution.model, epoch=epoch, chip=chip)
    return np.asarray(place.basis.evaluate(x, y) @ place.polynomial(solution.mean).T)


def _in_unit(product: ProductInput, missed: Positions) -> Positions:
    """Displacements of pixels as those of positions."""
    solution = product.solution

    def shift(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        place = place_of(solution.model, epoch=epoch, chip=chip)
        P = place.polynomial(solution.mean)
        J = np.stack([d @ P.T for d in place.gradient(x, y)], axis=-1)
        return np.asarray(np.einsum("nab,nb->na", J, missed(x, y, chip, epoch)))

    return shift


class _Laid:
    """Positions by a file, laid on those of the solution over all chips at once, less these.

    Parameters
    ----------
    product : ProductInput
    place : callable
        Positions by the file, in a unit of its own where `scaled`.
    scaled : bool
        Whether the file's scale is a convention of its own, found at the date of the assessment.
    """

    def __init__(self, product: ProductInput, place: Positions, *, scaled: bool) -> None:
        self.product, self.place, self.scaled = product, place, scaled
        self._kept: dict[float | None, tuple[complex, complex, bool]] = {}

    def __call__(self, x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        zero, factor, mirrored = self._map(epoch)
        w = self.place(x, y, chip, epoch) @ [1, -1j if mirrored else 1j]
        at = zero + factor * w
        return np.stack([at.real, at.imag], axis=-1) - _solution(self.product, x, y, chip, epoch)

    def _map(self, epoch: float | None) -> tuple[complex, complex, bool]:
        if epoch not in self._kept:
            size = 1.0
            date = self.product.epoch
            if self.scaled:
                size = abs(self._fitted(epoch)[1] if epoch == date else self._map(date)[1])
            self._kept[epoch] = self._fitted(epoch, size)
        return self._kept[epoch]

    def _fitted(
        self, epoch: float | None, size: float | None = None
    ) -> tuple[complex, complex, bool]:
        """Shift and factor, of a given size, by least squares; mirrored where that is nearer."""
        z, w = [], []
        for chip in self.product.solution.model.chips:
            x, y = mesh(*grid_pixels(chip.size, GRID))
            z.append(_solution(self.product, x, y, chip.number, epoch) @ [1, 1j])
            w.append(self.place(x, y, chip.number, epoch) @ [1, 1j])
        here, there = np.concatenate(z), np.concatenate(w)
        found = []
        for mirrored in (False, True):
            v = there.conj() if mirrored else there
            factor = np.vdot(v - v.mean(), here) / np.vdot(v - v.mean(), v)
            if size is not None:
                factor *= size / abs(factor)
            zero = (here - factor * v).mean()
            found.append((float(np.std(here - zero - factor * v)), zero, factor, mirrored))
        _, zero, factor, mirrored = min(found, key=lambda one: one[0])
        return complex(zero), complex(factor), mirrored
