"""File formats, parsed files and findings.

A `Format` is a record of functions: parse, describe, lint, read, build. Parsing, checks and
descriptions work on a `Document`, because a file with errors has no valid calibration and because
lossless reading concerns the bytes. A `Calibration` is made from a document, and refused if no
detector can have it. `ReadBack` has positions computed from written files, for comparison with the
solution they were made from.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.io import fits
from pydantic import BaseModel, ConfigDict

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap
from bayesdist.errors import FormatError, InputError
from bayesdist.model import LookupTable, TimeDependence
from bayesdist.model.basis import MAX_ORDER
from bayesdist.products.common.content import Content, readable
from bayesdist.utils.arrays import Float

if TYPE_CHECKING:
    from astropy.wcs import WCS

LEVELS = ("error", "warning", "note")
PARAMETERS = "parameters"  # kind of a companion file that holds the parameters and their covariance


@dataclass(frozen=True)
class Finding:
    """One finding of a format check.

    Parameters
    ----------
    level : {'error', 'warning', 'note'}
        'error': programs will fail or misplace stars; 'warning': they may; 'note': good to know.
    where : str
        Keyword, column or row.
    message : str
        One clause.
    """

    level: str
    where: str
    message: str

    def __str__(self) -> str:
        return f"{self.level}: {self.where}: {self.message}"


@dataclass(frozen=True)
class DistortionText:
    """Description of the distortion in a header."""

    lines: Sequence[str]  # at the beginning, with the size of the image
    terms: Sequence[str]  # coefficients, at the end
    findings: Sequence[Finding]


# ``(header, name)`` returns the description of a distortion; None if the header has none
DistortionReader = Callable[[fits.Header, str], DistortionText | None]


def identity_lines(header: fits.Header) -> list[str]:
    """Lines of text with the keywords that identify a reference file."""
    return [f"  {k:<9} {header[k]}" for k in ("DESCRIP", "USEAFTER", "PEDIGREE") if k in header]


def finding_lines(findings: Sequence[Finding]) -> list[str]:
    """Findings as lines of text, the most severe finding first."""
    if not findings:
        return ["Findings: none"]
    ordered = sorted(findings, key=lambda f: LEVELS.index(f.level))
    return ["Findings:", *(f"  {finding}" for finding in ordered)]


class MissingSizeError(InputError):
    """Error for a file that does not state the size of its image."""


def required_size(
    stated: tuple[float, float] | None,
    given: tuple[float, float] | None,
    name: str,
    what: str = "image",
) -> tuple[float, float]:
    """Columns and rows stated by a file, by default those given by the user.

    Raises MissingSizeError if both are None.  `name` is the file and `what` the object that has the
    size, for the message.
    """
    size = given if stated is None else stated
    if size is None:
        raise MissingSizeError(
            f"does not state the size of the {what}",
            where=name,
            do="give it (size=(NX, NY) in Python, --size NX NY on the command line)",
        )
    return float(size[0]), float(size[1])


@dataclass(frozen=True)
class Choice:
    """Selection of one calibration in a file, and values that the file may lack.

    Parameters
    ----------
    filter : str, optional
        Filter or band, for files that hold several.
    size : tuple of float, optional
        Columns and rows, for a header that does not state them.
    as_used : bool
        True to read the file as other programs do, without its stored parameters.
    """

    filter: str | None = None
    size: tuple[float, float] | None = None
    as_used: bool = False


class FormatSettings(BaseModel):
    """Configuration of a product in one format; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def check(
        self,
        detector: str,
        size: tuple[float, float] | None,
        reference_pixel: tuple[float, float] | None,
    ) -> None:
        """Raise ValueError if the format does not support the detector.

        `detector` is its name, `size` has its columns and rows, and `reference_pixel` is in FITS
        1-based pixels; None if unknown.
        """


@dataclass(frozen=True)
class BuildOptions:
    """Options for building files, common to all formats."""

    epoch: float | None = None  # decimal years, for files that are valid at one date
    scale_arcsec: float | None = None  # arcseconds per pixel; None if not configured
    # look-up tables of detector and filter, which correct pixels before the polynomials
    tables: tuple[LookupTable, ...] = ()
    file_name: str = ""  # name of the file; empty for the usual name of the format

    def named(self, usual: str, *, several: bool = False) -> str:
        """Name of a file: the requested one, or the usual one if several files are made."""
        return usual if several else self.file_name or usual


@dataclass(frozen=True, eq=False)
class Built:
    """File that has been built but not yet written."""

    file_name: str
    kind: str  # file kind as listed in summary.json
    content: bytes
    made: Any  # object that was written, in the class of its format
    chip: int | None = None  # chip number of a file that holds one chip
    summary: Mapping[str, Any] = field(default_factory=dict)  # further entries of summary.json
    warnings: tuple[str, ...] = ()  # effects on programs that read the file, for the terminal
    notes: tuple[str, ...] = ()  # useful information, such as consequences of the settings


@dataclass(frozen=True)
class Format:
    """File format, defined by its functions.

    Parameters
    ----------
    key : str
        Name in the configuration and on the command line.
    title : str
        Name with its article, as in "a SIP header".
    rank : int
        Position in the order in which formats are tried; the most specific formats come first.
    parse : callable
        ``parse(content)`` returns the parsed file, or None if the `Content` is of another format.
    describe : callable
        ``describe(parsed)`` returns lines of text: the first begins with the name of the file,
        which `parse` therefore keeps, and the last ones are the `finding_lines`.
    lint : callable, optional
        ``lint(parsed)`` returns the findings. Formats without checks omit it.
    calibration : callable, optional
        ``calibration(parsed, name, choice)`` returns a `Calibration`; `choice` is a `Choice`.
    settings : type of FormatSettings, optional
        Settings class of a format that can be built.
    build : callable, optional
        ``build(calibration, settings, options)`` returns the files, a tuple of `Built`.
    read_back : callable, optional
        ``read_back(files, calibration, options)`` evaluates files that were built from that
        calibration with those options. It returns one `ReadBack` for each row of the error budget.
        By default, files are read by `calibration` and aligned with the solution.
    highest_order : int
        Highest polynomial order that can be built.
    holds_tables : bool
        True if files of this format can hold the look-up tables of the calibration.
    holds_time : bool
        True if files of this format can hold the time dependence of the calibration.
    needs_scale : callable
        ``needs_scale(settings)`` is True if the file states angles, so that u and v in pixels need
        a pixel scale.
    asks : tuple of str
        Fields of `Choice` that `calibration` uses: "filter", "size".
    filters : callable, optional
        ``filters(parsed)`` returns the names of the filters in a file with several calibrations.
    mirrored : callable, optional
        ``mirrored(parsed)`` is True if the axes of u and v are mirrored on the sky.
    tables : callable, optional
        ``tables(parsed)`` returns the look-up tables of a detector, each a `LookupTable`.
    fits_wcs : callable, optional
        ``fits_wcs(calibration, point)`` returns an `astropy.wcs.WCS` of a one-chip calibration;
        `point` is the sky position of u, v = 0 in degrees.
    refuse : callable, optional
        For a format without calibrations: ``refuse(parsed, name)`` raises an InputError that
        explains why this file has none, or returns if there is nothing specific to say.
    """

    key: str
    title: str
    rank: int
    parse: Callable[[Content], Any]
    describe: Callable[[Any], list[str]]
    lint: Callable[[Any], Sequence[Finding]] | None = None
    calibration: Callable[[Any, str, Choice], Calibration] | None = None
    settings: type[FormatSettings] | None = None
    build: Callable[[Calibration, Any, BuildOptions], tuple[Built, ...]] | None = None
    read_back: Callable[[Sequence[Built], Calibration, BuildOptions], Sequence[ReadBack]] | None = (
        None
    )
    highest_order: int = MAX_ORDER
    holds_tables: bool = False
    holds_time: bool = False
    needs_scale: Callable[[Any], bool] = lambda settings: False
    asks: tuple[str, ...] = ()
    refuse: Callable[[Any, str], None] | None = None
    filters: Callable[[Any], Collection[str]] | None = None
    mirrored: Callable[[Any], bool] | None = None
    tables: Callable[[Any], tuple[LookupTable, ...]] | None = None
    fits_wcs: Callable[[Calibration, tuple[float, float]], WCS] | None = None


@dataclass(frozen=True, eq=False)
class Document:
    """File of a recognized format.

    Parameters
    ----------
    name : str
        Name of the file, for messages.
    format : Format
        Format of the file.
    holds : object
        Parsed file, as returned by the format's `parse`.
    """

    name: str
    format: Format
    holds: Any

    def lint(self) -> tuple[Finding, ...]:
        """Findings of the format's checks; empty if the format has none.

        Raises
        ------
        FormatError
            If a value in the file cannot be interpreted.
        """
        with readable(self.name):
            return () if self.format.lint is None else tuple(self.format.lint(self.holds))

    def describe(self) -> str:
        """Text that describes the content of the file and ends with the findings.

        Raises
        ------
        FormatError
            If a value in the file cannot be interpreted.
        """
        with readable(self.name):
            return "\n".join(self.format.describe(self.holds))

    def filters(self) -> Collection[str]:
        """Names of the filters in the file; empty if its format has none."""
        with readable(self.name):
            return () if self.format.filters is None else self.format.filters(self.holds)

    def mirrored(self) -> bool | None:
        """True if the axes of u and v are mirrored on the sky; None if that is unknown."""
        with readable(self.name):
            return None if self.format.mirrored is None else self.format.mirrored(self.holds)

    def tables(self) -> tuple[LookupTable, ...]:
        """Look-up tables of the detector.

        Raises
        ------
        InputError
            If the format has no look-up tables.
        """
        if self.format.tables is None:
            raise InputError(
                f"is {self.format.title}, which holds no look-up tables of a detector",
                where=self.name,
                do="give a file with look-up tables, or a run",
            )
        with readable(self.name):
            return self.format.tables(self.holds)

    def calibration(self, choice: Choice = Choice()) -> Calibration:
        """Calibration that the file holds.

        Parameters
        ----------
        choice : Choice
            Selected filter and image size, for files that need them.

        Returns
        -------
        Calibration
            Calibration with plausible values.

        Raises
        ------
        InputError
            If the format holds no calibration, or if it needs a filter or size that `choice` lacks.
        """
        if self.format.calibration is None:
            if self.format.refuse is not None:
                self.format.refuse(self.holds, self.name)
            raise InputError(
                f"is {self.format.title}, which holds no calibration by itself",
                where=self.name,
                do="give a file that holds one, such as a header or a run directory",
            )
        with readable(self.name):
            calibration = self.format.calibration(self.holds, self.name, choice)
            refuse_senseless(calibration)
            return calibration


Positions = Callable[[Float, Float, int, float | None], Float]


@dataclass(frozen=True, eq=False)
class ReadBack:
    """Positions that a file yields when its bytes are read back."""

    file: str  # name of the file, or of several files that form one product
    forward: Positions  # (x (N,), y (N,), chip number, date) -> positions (N, 2)
    # same arguments -> error (N, 2) of the pixel after forward and inverse; None without an inverse
    missed: Positions | None = None
    # True if the file has separate axes and unit, so that shift, rotation and scale do not
    # count as errors; otherwise positions are along u, v in their unit
    own_axes: bool = False


def by_calibrations(
    file: str, sets: Sequence[Calibration], time: TimeDependence | None
) -> ReadBack:
    """Positions computed from the calibrations of a file that defines its own axes.

    `sets` holds one calibration, or one per segment of the drift. `time` is the time dependence of
    the solution that the file was made from.
    """

    def of(epoch: float | None) -> Calibration:
        if time is None or epoch is None or len(sets) == 1:
            return sets[0]
        return sets[int(np.searchsorted(time.breaks, epoch, side="right"))]

    def within(one: Calibration, chip: int) -> int:
        # a file of one chip may count from 1
        return chip if chip in one.numbers or len(one.numbers) > 1 else one.numbers[0]

    def forward(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        calibration = of(epoch)
        # a calibration without drift does not accept a date
        return calibration.forward(
            x, y, chip=within(calibration, chip), epoch=epoch if calibration.model.time else None
        )

    def missed(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        calibration = of(epoch)
        number = within(calibration, chip)
        about_zero = calibration.at(origin="chip")[number]  # at the date of the inverse rows
        back = calibration.inverses[number].pixels(*about_zero.at(x, y))
        return np.stack([back[0] - x, back[1] - y], axis=-1)

    inverses = all(one.inverses for one in sets)
    return ReadBack(file, forward, missed if inverses else None, own_axes=True)


def of_chips(parts: Mapping[int, ReadBack]) -> ReadBack:
    """Combine files of one format that hold different chips; `parts` maps chip numbers to files."""

    def forward(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        return parts[chip].forward(x, y, chip, epoch)

    def missed(x: Float, y: Float, chip: int, epoch: float | None) -> Float:
        return back[chip](x, y, chip, epoch)

    each = parts.values()
    back = {n: part.missed for n, part in parts.items() if part.missed is not None}
    names = dict.fromkeys(part.file for part in each)
    return ReadBack(
        ", ".join(names),
        forward,
        missed if len(back) == len(parts) else None,
        own_axes=any(part.own_axes for part in each),
    )


MOST_PIXELS = 1e6  # columns or rows of a chip
FAR = 1e7  # largest coordinate of a reference pixel, pixels
BEND = 10.0  # largest nonlinear displacement, in units of the chip's size
ROUNDING = 1e-3  # relative tolerance for rounded covariances in text files
OFF = 1e3  # largest ratio between a stated scale and the pixel scale of the linear terms


def refuse_senseless(found: Calibration) -> None:
    """Raise FormatError if sizes, scales, errors or coefficients are implausible for a detector."""
    do = "correct the file, or fetch it again"
    for cause in _faults(found):
        raise FormatError(cause, where=found.name, do=do)


def _faults(found: Calibration) -> list[str]:
    for chip in found.model.chips:
        if not all(1 < n <= MOST_PIXELS for n in chip.size):
            return [f"chip {chip.number} has {chip.size[0]:g} x {chip.size[1]:g} pixels"]
        if not np.abs(chip.reference_pixel).max() <= FAR:
            x, y = chip.reference_pixel
            return [f"chip {chip.number} has its reference pixel at ({x:g}, {y:g})"]
    if not np.isfinite(found.solution.mean).all():
        return ["some coefficients are not finite"]
    if not np.isfinite(found.solution.cov).all():
        return ["some errors of coefficients are not finite"]
    if not _is_covariance(found.solution.cov):
        return ["the covariance of its coefficients is invalid: a correlation exceeds 1"]
    if any(not np.isfinite(table.values).all() for table in (*found.before, *found.after)):
        return ["some values of its look-up tables are not finite"]
    point = found.plane.point
    if point is not None and not (abs(point[0]) <= 360 and abs(point[1]) <= 90):
        return [f"the plane touches the sky at ({point[0]:g}, {point[1]:g}) degrees: on no sphere"]
    try:
        maps = found.at(origin="stated")
    except InputError:  # it cannot be evaluated without a date
        return []
    faults = [
        fault for number, chip_map in maps.items() for fault in _faults_of_map(number, chip_map)
    ]
    if faults or found.scale is None:
        return faults
    pixel = float(np.sqrt(abs(np.linalg.det(next(iter(maps.values())).linear))))
    if not 1 / OFF < found.scale / pixel < OFF:
        return [f"the stated scale is {found.scale:g}, but the linear terms give {pixel:.3g}"]
    return []


def _is_covariance(cov: Float) -> bool:
    """True if no variance is negative and all correlations are between -1 and 1."""
    variance = np.diag(cov)
    if variance.min(initial=0.0) < 0:
        return False
    sigma = np.sqrt(variance)
    return bool((np.abs(cov) <= (1 + ROUNDING) * np.outer(sigma, sigma)).all())


def _faults_of_map(number: int, one: ChipMap) -> list[str]:
    """Faults of the polynomial of a chip, as clauses."""
    area = abs(float(np.linalg.det(one.linear)))
    (nx, ny), (x0, y0) = one.basis.size, one.basis.reference_pixel
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(1, nx, 5), np.linspace(1, ny, 5)))
    if not area > 0 or not np.isfinite(area):
        return [f"the linear terms of chip {number} give a pixel without area"]
    zero = one.basis.evaluate(np.array([x0]), np.array([y0])) @ one.coefficients.T
    offsets = one.basis.evaluate(x, y) @ one.coefficients.T - zero
    bend = np.hypot(*(offsets - np.stack([x - x0, y - y0], axis=1) @ one.linear.T).T)
    reach = max(nx, ny, float(np.hypot(x - x0, y - y0).max())) * np.sqrt(area)
    if not bend.max() < BEND * reach:
        return [
            f"the polynomial of chip {number} deviates by {bend.max() / np.sqrt(area):.3g} px from "
            f"its linear terms, on a chip of {nx:g} x {ny:g} pixels"
        ]
    return []
