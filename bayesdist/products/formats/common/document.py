"""What is wrong, or looks wrong, in a product: the findings, and checks that formats share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

__all__ = ["LEVELS", "Finding", "finding_lines", "repeated_values"]

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
