"""Formats, documents and findings.

A format is its functions, each in a module of its own where it is long.  A file with errors has no
calibration, and lossless reading is a property of bytes: so parsing, checks and descriptions are of
a document, and a calibration is made from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from astropy.io import fits
from pydantic import BaseModel, ConfigDict

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plausible import refuse_senseless
from bayesdist.errors import InputError
from bayesdist.model import LookupTable
from bayesdist.model.basis import MAX_ORDER
from bayesdist.products.formats.common.content import Content, readable
from bayesdist.products.formats.common.read_back import ReadBack

LEVELS = ("error", "warning", "note")
PARAMETERS = "parameters"  # kind of a file that stands beside another, with its covariance


@dataclass(frozen=True)
class Finding:
    """One finding."""

    # 'error': programs will fail or misplace stars; 'warning': they may; 'note': good to know
    level: str
    where: str  # keyword, column or row
    message: str  # one clause

    def __str__(self) -> str:
        return f"{self.level}: {self.where}: {self.message}"


def of_part(part: str, findings: Iterable[Finding]) -> list[Finding]:
    """Findings in a part of a file, whose name stands before; empty for a file of one part."""
    return [replace(one, where=f"{part}, {one.where}" if part else one.where) for one in findings]


def repeated_values(coefficients: Mapping[str, float]) -> list[tuple[str, ...]]:
    """Groups of names whose values are equal in size and not zero.

    Two fitted numbers never agree to the last digit: one of them has been copied over the other, as
    in tables that went through text extraction.
    """
    groups: dict[float, list[str]] = {}
    for name, value in coefficients.items():
        if value != 0:
            groups.setdefault(abs(value), []).append(name)
    return [tuple(names) for names in groups.values() if len(names) > 1]


def identity_lines(header: fits.Header) -> list[str]:
    """Lines of text on the keywords by which a reference file is known."""
    return [f"  {k:<9} {header[k]}" for k in ("DESCRIP", "USEAFTER", "PEDIGREE") if k in header]


def missing_identity(header: fits.Header) -> list[Finding]:
    """Findings on the keywords that a reference file should have."""
    message = "is missing; reference files of the observatory have it"
    keywords = ("USEAFTER", "PEDIGREE", "FILETYPE", "DESCRIP")
    return [Finding("note", keyword, message) for keyword in keywords if keyword not in header]


def finding_lines(findings: Sequence[Finding]) -> list[str]:
    """Lines of text, the most severe finding first."""
    if not findings:
        return ["Findings: none"]
    ordered = sorted(findings, key=lambda f: LEVELS.index(f.level))
    return ["Findings:", *(f"  {finding}" for finding in ordered)]


class MissingSizeError(InputError):
    """Error of a file that does not state the size of its image."""


def required_size(
    stated: tuple[float, float] | None,
    given: tuple[float, float] | None,
    name: str,
    what: str = "image",
) -> tuple[float, float]:
    """Columns and rows that a file states, else those given; MissingSizeError without either."""
    found = given if stated is None else stated
    if found is None:
        raise MissingSizeError(
            f"does not say how large the {what} is",
            where=name,
            do="give it (size=(NX, NY) in Python, --size NX NY on the command line)",
        )
    return float(found[0]), float(found[1])


@dataclass(frozen=True)
class Choice:
    """Choice among the calibrations of a file, and values that the file may lack."""

    # of an IDCTAB, where names of both wheels may be joined by a comma; the band of WISE meta-data,
    # as in "W2"
    filter: str | None = None
    size: tuple[float, float] | None = None  # columns and rows, for a header that lacks them
    as_used: bool = False  # as other programs have it: without the parameters that stand beside it


class FormatSettings(BaseModel):
    """Configuration of a file to be built; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def check(
        self,
        detector: str,
        size: tuple[float, float] | None,
        reference_pixel: tuple[float, float] | None,
    ) -> None:
        """Refuse (ValueError) a detector that the format is not for."""


@dataclass(frozen=True)
class BuildOptions:
    """Options of building files of any format."""

    epoch: float | None = None  # decimal years, for files that are valid at one date
    scale_arcsec: float | None = None  # arcseconds per pixel, where configured
    # by which pixels are corrected before the polynomials, of the detector and of the filter
    tables: tuple[LookupTable, ...] = ()
    file_name: str = ""  # of the file; empty for the usual name of the format

    def named(self, usual: str, *, several: bool = False) -> str:
        """Name of a file: the requested one, or the usual one if several files are made."""
        return usual if several else self.file_name or usual


@dataclass(frozen=True, eq=False)
class Built:
    """File that was built and not yet written."""

    file_name: str
    kind: str  # as in summary.json
    content: bytes
    made: Any  # source of the content, in the terms of its format
    chip: int | None = None  # of a file of one chip
    summary: Mapping[str, Any] = field(default_factory=dict)  # further entries of summary.json
    warnings: tuple[str, ...] = ()  # on what programs will make of it, for the terminal
    notes: tuple[str, ...] = ()  # good to know, such as what the settings cause


@dataclass(frozen=True)
class Format:
    """Format of files, as its functions.

    Parameters
    ----------
    key : str
        As in the configuration and on the command line.
    title : str
        With its article, as in "an IDCTAB".
    rank : int
        Formats are tried in this order: the most special first.
    parse : callable
        From a `Content` to the parsed file; None for a file of another kind.
    describe : callable
        From the parsed file to lines of text, its `finding_lines` at the end.
    lint : callable, optional
        From the parsed file to findings; of a format without checks there are none.
    calibration : callable, optional
        From the parsed file, its name and a `Choice` to a `Calibration`.
    settings : type of FormatSettings, optional
        Of a format that can be built.
    build : callable, optional
        From a `Calibration`, its settings and `BuildOptions` to files.
    read_back : callable, optional
        From files that were built, and the calibration and options that they were built from, to
        what they say of positions, one `ReadBack` for each row of the budget.  By default they are
        read by `calibration`, and laid on the solution.
    highest_order : int
        Of the polynomials that can be built.
    holds_tables : bool
        True if files that are built have the look-up tables of the calibration.
    holds_time : bool
        True if files that are built have the dependence of the calibration on time.
    needs_scale : callable
        From the settings to True if a file states angles, for which u and v in pixels need a scale.
    asks : tuple of str
        Fields of `Choice` that `calibration` uses: "filter", "size".
    refuse : callable, optional
        For a format without calibrations: raises the InputError that says why this file has none;
        returns if nothing more is known than that the format has none.
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


@dataclass(frozen=True, eq=False)
class Document:
    """File whose format was recognized.

    Parameters
    ----------
    name : str
    format : Format
    holds : object
        Parsed file, by the format's `parse`.
    """

    name: str
    format: Format
    holds: Any

    def lint(self) -> tuple[Finding, ...]:
        """Findings in the file."""
        with readable(self.name):
            return () if self.format.lint is None else tuple(self.format.lint(self.holds))

    def describe(self) -> str:
        """Text on the content of the file, its findings at the end."""
        with readable(self.name):
            return "\n".join(self.format.describe(self.holds))

    def calibration(self, choice: Choice = Choice()) -> Calibration:
        """Calibration of the file.

        Raises
        ------
        InputError
            For a format that holds none, or whatever the format misses in the choice.
        """
        if self.format.calibration is None:
            if self.format.refuse is not None:
                self.format.refuse(self.holds, self.name)
            raise InputError(
                f"is {self.format.title}, which holds no calibration by itself",
                where=self.name,
                do="give a file that holds one, such as an IDCTAB, a header or a run directory",
            )
        with readable(self.name):
            found = self.format.calibration(self.holds, self.name, choice)
            refuse_senseless(found)
            return found
