"""Rules that the checks of several formats share, each with its condition and limits.

A format fills in where a rule applies and how programs that read the file react to a violation.
Checks that only one format needs are in the module of that format.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesdist.errors import BayesdistError
from bayesdist.products.common.document import Finding
from bayesdist.utils.arrays import Float

WIDEST_IMAGE = 180.0  # degrees; an image this wide means that its matrix is in another unit
SKEW = 0.5  # smallest plausible sine of the angle between the axes, and ratio of their scales
EXPLAINED = 0.1  # an exchange of powers is blamed if it reduces the closure to this fraction
CLOSURE_RELATIVE, CLOSURE_ABSOLUTE = 1e-2, 1e-9  # tolerance of a stated closure; second in pixels


# -- keywords and values --------------------------------------------------------------------------


@dataclass(frozen=True)
class Missing:
    """Keyword that a file should have.

    Parameters
    ----------
    keyword : str
        Keyword, or path of an entry.
    consequence : str
        Continuation of the message "is missing", with its punctuation.
    level : {'error', 'warning', 'note'}
        Level of the finding.
    """

    keyword: str
    consequence: str
    level: str = "error"

    @property
    def finding(self) -> Finding:
        """Finding for a file without the keyword."""
        return Finding(self.level, self.keyword, f"is missing{self.consequence}")


# keywords by which observatories identify reference files
IDENTITY = tuple(
    Missing(keyword, "; reference files of the observatory have it", "note")
    for keyword in ("USEAFTER", "PEDIGREE", "FILETYPE", "DESCRIP")
)

NO_SIZE = Finding("note", "NAXIS1", "the size of the image is not stated")


def missing(present: Container[str], rules: Iterable[Missing]) -> list[Finding]:
    """Findings on keywords that are not among those that are present."""
    return [rule.finding for rule in rules if rule.keyword not in present]


def missing_entries(
    meta: Mapping[str, Any], names: Iterable[str], instrument_names: Iterable[str], message: str
) -> list[Finding]:
    """Warning about empty or missing entries of the node `meta` and of its node `instrument`."""
    instrument = meta["instrument"]
    paths = [f"meta.{name}" for name in names if not meta.get(name)]
    paths += [f"meta.instrument.{name}" for name in instrument_names if not instrument.get(name)]
    return [Finding("warning", ", ".join(paths), message)] if paths else []


def other_type(stated: str, wanted: str, where: str) -> list[Finding]:
    """Error if a file states another type of reference file than `wanted`."""
    if not stated or stated == wanted:
        return []
    return [Finding("error", where, f"is {stated!r}, not {wanted!r}")]


def not_finite(values: Float, where: str, message: str) -> list[Finding]:
    """Error if any value is infinite or not a number; `message` may contain {count}."""
    bad = int((~np.isfinite(values)).sum())
    return [Finding("error", where, message.format(count=bad))] if bad else []


def repeated_values(coefficients: Mapping[str, float]) -> list[tuple[str, ...]]:
    """Groups of names with non-zero values of equal magnitude, from coefficients by name.

    Two fitted numbers never agree to the last digit: one of them has been copied over the other, as
    in tables that went through text extraction.
    """
    groups: dict[float, list[str]] = {}
    for name, value in coefficients.items():
        if value != 0:
            groups.setdefault(abs(value), []).append(name)
    return [tuple(names) for names in groups.values() if len(names) > 1]


def copies(
    coefficients: Mapping[str, float],
    message: str = "the same value, {value:.7g}: one may have been copied over the other",
    groups: Iterable[tuple[str, ...]] | None = None,
) -> list[Finding]:
    """Warnings about coefficients of equal magnitude; see `repeated_values`.

    `message` may contain {value}. `groups` replaces the groups of all equal values.
    """
    if groups is None:
        groups = repeated_values(coefficients)
    return [
        Finding("warning", ", ".join(names), message.format(value=abs(coefficients[names[0]])))
        for names in groups
    ]


def above_order(names: Sequence[str], shown: str, order: str, level: str) -> list[Finding]:
    """Finding on coefficients above the stated order, which programs ignore.

    `shown` is the text that stands for the names, and `order` the keyword with its value.
    """
    return [Finding(level, shown, f"above {order}, so ignored")] if names else []


# -- look-up tables -------------------------------------------------------------------------------


def no_grid(values: Float, where: str) -> list[Finding]:
    """Error if an array has fewer than two nodes along an axis, or not two axes."""
    if values.ndim == 2 and min(values.shape) >= 2:
        return []
    return [Finding("error", where, f"shape {values.shape} is not a grid of nodes")]


def no_sigmas(
    sigma: Float,
    shape: tuple[int, ...] | None,
    where: str,
    value_message: str,
    shape_message: str,
) -> list[Finding]:
    """Warnings about standard errors that are negative or not finite, or of another shape."""
    out = []
    if not (np.isfinite(sigma).all() and (sigma >= 0).all()):
        out.append(Finding("warning", where, value_message))
    if sigma.shape != shape:
        out.append(Finding("warning", where, shape_message))
    return out


# -- linear terms ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class LinearPart:
    """Linear terms, which must not be singular, and have the parity of the sky.

    Parameters
    ----------
    where : str
        Keywords of the linear terms.
    mirrored : str
        Message for an image that is a mirror image of the sky.
    level : {'error', 'note'}
        Level of that finding.
    singular : str
        Message for a singular matrix.
    """

    where: str
    mirrored: str
    level: str = "note"
    singular: str = "is singular"

    def findings(
        self, determinant: float, mirror: float = 1.0, *, smallest: float = 0.0
    ) -> list[Finding]:
        """Findings on a determinant.

        Parameters
        ----------
        determinant : float
            Determinant of the linear terms.
        mirror : float
            Sign of the determinant of a mirror image; 0 if the parity is not known.
        smallest : float
            Absolute value up to which the matrix is singular.

        Returns
        -------
        list of Finding
            At most one finding.
        """
        if abs(determinant) <= smallest:
            return [Finding("error", self.where, self.singular)]
        if determinant * mirror > 0:
            return [Finding(self.level, self.where, self.mirrored)]
        return []


def too_wide(width: float, where: str, message: str) -> list[Finding]:
    """Error if the width of an image exceeds the sky; `message` may contain {width}, degrees."""
    return [Finding("error", where, message.format(width=width))] if width > WIDEST_IMAGE else []


def is_skewed(slope: Float) -> bool:
    """True if the axes of a matrix (2, 2) of derivatives are far from perpendicular or equal."""
    across, up = np.hypot(*slope)
    low, high = min(across, up), max(across, up)
    return bool(low == 0 or abs(np.linalg.det(slope)) < SKEW * across * up or low < SKEW * high)


def mixed_parities(determinants: Iterable[float], where: str, message: str) -> list[Finding]:
    """Warning if the determinants of several detectors have different signs."""
    signs = {float(np.sign(determinant)) for determinant in determinants}
    return [Finding("warning", where, message)] if len(signs) > 1 else []


# -- inverse --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Inverse:
    """Explicit inverse, which must return from positions to pixels.

    Parameters
    ----------
    where : str
        Keywords of the inverse.
    good, bad : float
        Closure in pixels that is accepted, and closure that only a wrong coefficient explains.
    misses : str
        Clause for a bad inverse, such as "they miss the inverse of A, B".
    poor : str
        Message for an inverse between the limits, with {closure}.
    exchanged : str
        Message for powers of x and y that are exchanged.
    """

    where: str
    good: float
    bad: float
    misses: str
    poor: str
    exchanged: str = "the order of coefficients: powers of x and y are exchanged"

    def findings(
        self,
        closure: float,
        exchanges: Iterable[tuple[str, float]],
        explain: Callable[[], Iterable[Finding]] = tuple,
        *,
        conclusive: bool = False,
    ) -> Iterator[Finding]:
        """Findings on an inverse.

        Parameters
        ----------
        closure : float
            Largest distance between a pixel and the inverse of its forward position, pixels.
        exchanges : iterable of (str, float)
            Parts of the file, and the closure after an exchange of the powers of x and y in that
            part. It is only read if the closure is not good.
        explain : callable
            Findings on another cause of the closure; only called if no exchange is the cause.
        conclusive : bool
            True if a cause that was found replaces the finding on a bad closure.

        Yields
        ------
        Finding
            Findings, none if the closure is good.
        """
        if closure <= self.good:
            return
        # if powers are exchanged in both directions they nearly agree again: take the better one
        part, smallest = min(exchanges, key=lambda exchange: exchange[1])
        if smallest < EXPLAINED * closure:
            yield Finding("error", part, f"{self.exchanged} (closure {closure:.3g} px)")
            return
        causes = list(explain())
        yield from causes
        if causes and conclusive:
            return
        if not closure <= self.bad:
            yield Finding(
                "error",
                self.where,
                f"{self.misses} by up to {closure:.3g} px: a coefficient of one or the other is "
                "wrong",
            )
        elif not causes:
            yield Finding("warning", self.where, self.poor.format(closure=closure))


def stated_closure(stated: float | None, closure: float, where: str, subject: str) -> list[Finding]:
    """Error if a file states a smaller closure of its inverse than the computed one; pixels.

    `subject` is the inverse with its verb, such as "the inverse leaves".
    """
    if stated is None or not closure > stated * (1 + CLOSURE_RELATIVE) + CLOSURE_ABSOLUTE:
        return []
    message = f"states {stated:.3g} px, and {subject} {closure:.3g} px"
    return [Finding("error", where, message)]


# -- records of the calibration -------------------------------------------------------------------


def record(
    where: str,
    read: Callable[[], float],
    limit: float,
    message: str,
    *,
    differs_at: str = "",
) -> list[Finding]:
    """Error if the stored calibration cannot be read, or differs from the file itself.

    Parameters
    ----------
    where : str
        Name of the record.
    read : callable
        Reads the record and returns the largest distance of its positions from those of the file.
    limit : float
        Largest distance that is accepted, pixels.
    message : str
        Message for a larger distance, with {far}.
    differs_at : str
        Location of that finding, if it is not `where`.

    Returns
    -------
    list of Finding
        At most one finding.
    """
    try:
        far = read()
    except BayesdistError as error:
        return [Finding("error", where, error.cause)]
    if far <= limit:
        return []
    return [Finding("error", differs_at or where, message.format(far=far))]


def no_side_file(where: str, name: str, description: str = "the covariance") -> Finding:
    """Warning that the covariance file is missing from the folder of the file that names it."""
    return Finding("warning", where, f"{name}, {description}, is missing")


def of_part(part: str, findings: Iterable[Finding]) -> list[Finding]:
    """Add the name of the part of a file in front of each finding; unchanged if `part` is empty."""
    return [
        replace(finding, where=f"{part}, {finding.where}" if part else finding.where)
        for finding in findings
    ]
