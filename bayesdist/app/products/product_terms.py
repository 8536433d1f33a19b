"""Differences between products as written and the solution of their run.

Each format reads its files back (`read_back`).  A SIP header holds one chip at one date: drift to
other dates and look-up tables are always left out.  Some formats have axes and a pixel of their
own: the best-fitting shift, rotation and (common to all dates) scale are removed; the look-up
tables of a released set are applied as well.  An inverse is compared with the forward terms of its
own file, because users transform back and forth with the same file.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.config.products import ReleaseBlock
from bayesdist.app.products.made_files import ProductInput, made_files
from bayesdist.app.products.release_set import first_segments, release_set
from bayesdist.assess.solution import place_of
from bayesdist.assess.terms.forms import MEASURED, PRODUCT, Known, Row
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import ARCSEC
from bayesdist.errors import BayesdistError
from bayesdist.model import corrected
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.products.common.document import Positions, ReadBack, by_calibrations
from bayesdist.products.registry import read_back
from bayesdist.utils.arrays import Float

log = logging.getLogger("bayesdist")


FORWARD, INVERSE = "forward", "inverse"
GRID = (33, 33)  # grid on which files are aligned with the solution
ROUNDING = 1e-9  # pixels
SKY_ROUNDING = 2e-9  # arcsec: rounding error of converting to an RA near 360 degrees and back


def product_terms(product: ProductInput, config: Config, base: Path) -> tuple[Known, ...]:
    """Error terms of the configured products.

    The products are read back from their bytes, so that digits and orders are those of the files;
    the folder of the run is not changed.
    """
    files_read: list[ReadBack] = []
    for key, files in made_files(product, config).items():
        files_read += read_back(key, files, product.calibration, product.options)
    release = config.products.release
    if release is None:
        return tuple(_terms(product, files_read))
    with TemporaryDirectory() as folder:
        number = config.chips()[0].number
        sets = _released(product, release, number, base, Path(folder))
        files_read.append(by_calibrations(release.name, sets, product.solution.model.time))
        return tuple(_terms(product, files_read))


def file_errors(product: ProductInput, config: Config, base: Path) -> tuple[Known, ...]:
    """As `product_terms`; empty if the files cannot be made, which the export reports."""
    try:
        return product_terms(product, config, base)
    except BayesdistError as error:
        log.warning("evaluate: WARNING: the files were not compared with the solution: %s", error)
        return ()


def _terms(product: ProductInput, files: Sequence[ReadBack]) -> Iterator[Known]:
    """Forward terms against the solution, and the inverse if a file has one."""
    for file in files:
        yield _term(product, file.file, FORWARD, _forward(product, file))
        if file.missed is not None:
            yield _term(product, file.file, INVERSE, _in_unit(product, file.missed))


def _forward(product: ProductInput, file: ReadBack) -> Positions:
    """Difference between the positions of a file and of the solution, as its user sees it."""
    if file.own_axes or product.aligned:
        return _Laid(product, file.forward, scaled=file.own_axes)
    return lambda x, y, c, t: file.forward(x, y, c, t) - _solution(product, x, y, c, t)


def _released(
    product: ProductInput, block: ReleaseBlock, number: int, base: Path, folder: Path
) -> list[Calibration]:
    """Calibrations of a release, one per segment; of several periods of a segment the first."""
    filter = product.calibration.filter
    release = release_set()
    solutions = {filter: product.solution}
    entries = release.write(block, number, base, folder, solutions, product.options.tables, ())
    time = product.solution.model.time
    sets = release.calibrations(entries, folder, filter)
    return first_segments(block, sets, 1 if time is None else time.n_segments)


def _term(product: ProductInput, file: str, direction: str, shift: Positions) -> Known:
    solution = product.solution
    threshold = ROUNDING * solution.model.pixel_size(solution.mean)
    if product.calibration.plane.point is not None:
        threshold = max(threshold, SKY_ROUNDING / ARCSEC[solution.model.unit])
    against = "the solution" if direction == FORWARD else "its forward terms"
    source = f"{MEASURED}: as written, against {against}"

    def rounded(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        # smaller displacements are rounding errors
        displacement = np.asarray(shift(x, y, chip, epoch), float)
        return np.where(np.abs(displacement) < threshold, 0.0, displacement)

    return Known(Row(f"{file}, {direction}", PRODUCT, source, in_total=False), rounded)


def _solution(product: ProductInput, x: Float, y: Float, chip: int, epoch: float | None) -> Float:
    """Positions (N, 2) of the solution: look-up tables, if any, followed by the polynomials."""
    solution = product.solution
    if product.options.tables:
        x, y = corrected(product.options.tables, x, y, chip=chip, filter=product.calibration.filter)
    place = place_of(solution.model, epoch=epoch, chip=chip)
    return np.asarray(place.basis.evaluate(x, y) @ place.polynomial(solution.mean).T)


def _in_unit(product: ProductInput, missed: Positions) -> Positions:
    """Displacements in pixels converted to displacements of positions."""
    solution = product.solution

    def shift(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        place = place_of(solution.model, epoch=epoch, chip=chip)
        P = place.polynomial(solution.mean)
        J = np.stack([d @ P.T for d in place.basis.gradient(x, y)], axis=-1)
        return np.asarray(np.einsum("nab,nb->na", J, missed(x, y, chip, epoch)))

    return shift


class _Laid:
    """Difference between the solution and positions of a file, aligned with it over all chips.

    Parameters
    ----------
    product : ProductInput
    place : callable
        Positions of the file, in an arbitrary unit if `scaled`.
    scaled : bool
        True if the scale of the file is a convention; it is fitted at the date of the assessment.
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
        """Least-squares shift and factor, of a given size if any, and the better parity.

        The result is complex shift, complex factor, and True if mirrored.
        """
        z, w = [], []
        for chip in self.product.solution.model.chips:
            x, y = mesh(*grid_pixels(chip.size, GRID))
            z.append(_solution(self.product, x, y, chip.number, epoch) @ [1, 1j])
            w.append(self.place(x, y, chip.number, epoch) @ [1, 1j])
        target, positions = np.concatenate(z), np.concatenate(w)
        fits = []
        for mirrored in (False, True):
            v = positions.conj() if mirrored else positions
            factor = np.vdot(v - v.mean(), target) / np.vdot(v - v.mean(), v)
            if size is not None:
                factor *= size / abs(factor)
            zero = (target - factor * v).mean()
            fits.append((float(np.std(target - zero - factor * v)), zero, factor, mirrored))
        _, zero, factor, mirrored = min(fits, key=lambda candidate: candidate[0])
        return complex(zero), complex(factor), mirrored
