"""What a format is, a document of one, and what is found wrong in it.

A format is its functions, each in a module of its own where it is long.  A file that its checks
call broken has no calibration, and bit-by-bit losslessness is a property of bytes: so reading,
checks and words are of a document, whose meaning is a calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel, ConfigDict

from bayesdist.calibration.calibration import Calibration
from bayesdist.errors import InputError
from bayesdist.products.formats.common.content import Content, readable

__all__ = [
    "LEVELS",
    "BuildOptions",
    "Built",
    "Choice",
    "Document",
    "Finding",
    "Format",
    "FormatSettings",
    "finding_lines",
    "repeated_values",
]

LEVELS = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One finding.

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


def repeated_values(coefficients: Mapping[str, float]) -> list[tuple[str, ...]]:
    """Groups of names whose values are equal in size and not zero.

    Two fitted numbers never agree to the last digit: one of them has been copied over the other, as
    in tables that went through text extraction.

    Parameters
    ----------
    coefficients : mapping of str to float

    Returns
    -------
    list of tuple of str
    """
    groups: dict[float, list[str]] = {}
    for name, value in coefficients.items():
        if value != 0:
            groups.setdefault(abs(value), []).append(name)
    return [tuple(names) for names in groups.values() if len(names) > 1]


def finding_lines(findings: Sequence[Finding]) -> list[str]:
    """Lines of text, the weightiest finding first.

    Parameters
    ----------
    findings : sequence of Finding

    Returns
    -------
    list of str
    """
    if not findings:
        return ["Findings: none"]
    ordered = sorted(findings, key=lambda f: LEVELS.index(f.level))
    return ["Findings:", *(f"  {finding}" for finding in ordered)]


@dataclass(frozen=True)
class Choice:
    """Which of the calibrations of a file is wanted, and what a file may not say itself.

    Parameters
    ----------
    filter : str, optional
        Of an IDCTAB, where names of both wheels may be joined by a comma; the band of WISE
        meta-data, as in "W2".
    size : tuple of float, optional
        Columns and rows, for a header that does not say.
    """

    filter: str | None = None
    size: tuple[float, float] | None = None


class FormatSettings(BaseModel):
    """What the configuration says of a file to be built; keys that are not known are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def check(
        self,
        detector: str,
        size: tuple[float, float] | None,
        reference_pixel: tuple[float, float] | None,
    ) -> None:
        """Refuse a detector that the file is not for.

        Raises
        ------
        ValueError
        """


@dataclass(frozen=True)
class BuildOptions:
    """What files are built with, whatever their format.

    Parameters
    ----------
    epoch : float, optional
        Decimal years, for files that hold for one date.
    scale_arcsec : float, optional
        Arcseconds in a pixel, where the configuration says it.
    """

    epoch: float | None = None
    scale_arcsec: float | None = None


@dataclass(frozen=True, eq=False)
class Built:
    """A file that was built and not yet written.

    Parameters
    ----------
    file_name : str
    kind : str
        As in summary.json.
    content : bytes
    made : object
        What the content was made from, in the terms of its format.
    chip : int, optional
        Of a file of one chip.
    summary : mapping
        What summary.json says of it besides.
    """

    file_name: str
    kind: str
    content: bytes
    made: Any
    chip: int | None = None
    summary: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Format:
    """A format of files, as its functions.

    Parameters
    ----------
    key : str
        As in the configuration and on the command line.
    title : str
        With its article, as in "an IDCTAB".
    rank : int
        Formats are tried in this order: the most special first.
    parse : callable
        From a `Content` to what the file holds; None for a file of another kind.
    describe : callable
        From what `parse` gave to lines of text, its `finding_lines` at the end.
    lint : callable, optional
        From what `parse` gave to findings; of a format without checks there are none.
    calibration : callable, optional
        From what `parse` gave, the file's name and a `Choice` to a `Calibration`.
    settings : type of FormatSettings, optional
        Of a format that can be built.
    build : callable, optional
        From a `Calibration`, its settings and `BuildOptions` to files.
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


@dataclass(frozen=True, eq=False)
class Document:
    """A file that was recognized.

    Parameters
    ----------
    name : str
    format : Format
    holds : object
        What the format's `parse` gave.
    """

    name: str
    format: Format
    holds: Any

    def lint(self) -> tuple[Finding, ...]:
        """What is wrong, or looks wrong, in the file."""
        with readable(self.name):
            return () if self.format.lint is None else tuple(self.format.lint(self.holds))

    def describe(self) -> str:
        """Text of what the file holds, its findings at the end."""
        with readable(self.name):
            return "\n".join(self.format.describe(self.holds))

    def calibration(self, choice: Choice = Choice()) -> Calibration:
        """The calibration that the file holds.

        Raises
        ------
        InputError
            For a format that holds none, or whatever the format misses in the choice.
        """
        if self.format.calibration is None:
            raise InputError(
                f"is {self.format.title}, which holds no calibration by itself",
                where=self.name,
                do="give an IDCTAB, a SIP header, WISE meta-data, or a run directory",
            )
        with readable(self.name):
            return self.format.calibration(self.holds, self.name, choice)
