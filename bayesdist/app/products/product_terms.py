"""Differences of the files of a run from its solution, read back from the files as written.

What a file says of positions its format knows (`read_back`).  A SIP header holds one chip at one
date: drift is left out at any other, look-up tables always.  An IDCTAB lies along axes of its own
and counts in its own pixels: the best shift, rotation and, once for all dates, scale are taken out;
of a released set the look-up tables are applied as well.  An inverse is compared with the forward
terms of its own file, between which a user goes to and fro.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.config.products import ReleaseBlock
from bayesdist.app.products.made_files import ProductInput, made_files, write_files
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import MEASURED, PRODUCT, Known, Row
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import ARCSEC
from bayesdist.errors import BayesdistError
from bayesdist.model import corrected
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.products import read_d2im, read_lookup_file
from bayesdist.products.formats.common.read_back import Positions, ReadBack, by_calibrations
from bayesdist.products.registry import read_back, read_calibration
from bayesdist.utils.arrays import Float

log = logging.getLogger("bayesdist")


FORWARD, INVERSE = "forward", "inverse"
GRID = (33, 33)  # points over which files are laid on the solution
ROUNDING = 1e-9  # of a pixel
SKY_ROUNDING = 2e-9  # arcsec: what double precision leaves of an RA of 360 degrees, and back


def product_terms(product: ProductInput, config: Config, base: Path) -> tuple[Known, ...]:
    """Terms of the files that the configuration asks for.

    They are read back from their bytes, so that digits and orders are those of the files; nothing
    of the run is touched.
    """
    found: list[ReadBack] = []
    for key, files in made_files(product, config).items():
        found += read_back(key, files, product.calibration, product.options)
    release = config.products.release
    if release is None:
        return tuple(_terms(product, found))
    with TemporaryDirectory() as folder:
        number = config.chips()[0].number
        sets = _released(product, release, number, base, Path(folder))
        found.append(by_calibrations(release.name, sets, product.solution.model.time))
        return tuple(_terms(product, found))


def file_errors(product: ProductInput, config: Config, base: Path) -> tuple[Known, ...]:
    """As `product_terms`; none where the files cannot be made, of which the export complains."""
    try:
        return product_terms(product, config, base)
    except BayesdistError as error:
        log.warning("evaluate: WARNING: the files were not compared with the solution: %s", error)
        return ()


def _terms(product: ProductInput, files: Sequence[ReadBack]) -> Iterator[Known]:
    """Forward terms against the solution, and the inverse where a file has one."""
    for one in files:
        yield _term(product, one.file, FORWARD, _forward(product, one))
        if one.missed is not None:
            yield _term(product, one.file, INVERSE, _in_unit(product, one.missed))


def _forward(product: ProductInput, file: ReadBack) -> Positions:
    """Positions by a file less those of the solution, as its user sees them."""
    if file.own_axes or product.aligned:
        return _Laid(product, file.forward, scaled=file.own_axes)
    return lambda x, y, c, t: file.forward(x, y, c, t) - _solution(product, x, y, c, t)


def _released(
    product: ProductInput, block: ReleaseBlock, number: int, base: Path, folder: Path
) -> list[Calibration]:
    """The files of a release, one set for each segment: of several periods of one, the first."""
    filter = product.calibration.filter
    solutions = {filter: product.solution}
    entries = write_files(block, number, base, folder, solutions, product.options.tables)
    paths = {e["kind"]: folder / e["path"] for e in entries}
    before = read_d2im(paths["D2IMFILE"]) if "D2IMFILE" in paths else ()
    npol = read_lookup_file(paths["NPOLFILE"]) if "NPOLFILE" in paths else None
    sets = {}
    for entry in entries:
        if entry["kind"] == "IDCTAB":
            one = read_calibration(folder / entry["path"], filter=filter)
            tables = [] if npol is None else [npol.table(chip) for chip in npol.chips]
            pixel = one.pixel()[0]
            after = [replace(table, values=pixel * table.values, sigma=None) for table in tables]
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
    if product.calibration.plane.point is not None:
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
    if product.options.tables:
        x, y = corrected(product.options.tables, x, y, chip=chip, filter=product.calibration.filter)
    place = place_of(solution.model, epoch=epoch, chip=chip)
    return np.asarray(place.basis.evaluate(x, y) @ place.polynomial(solution.mean).T)


def _in_unit(product: ProductInput, missed: Positions) -> Positions:
    """Displacements of pixels as those of positions."""
    solution = product.solution

    def shift(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        place = place_of(solution.model, epoch=epoch, chip=chip)
        P = place.polynomial(solution.mean)
        J = np.stack([d @ P.T for d in place.basis.gradient(x, y)], axis=-1)
        return np.asarray(np.einsum("nab,nb->na", J, missed(x, y, chip, epoch)))

    return shift


class _Laid:
    """Positions by a file, laid on those of the solution over all chips at once, less these.

    `place`: positions by the file, in a unit of its own where `scaled`. `scaled`: whether the
    file's scale is a convention of its own, found at the date of the assessment.
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
            date = self.product.options.epoch
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
