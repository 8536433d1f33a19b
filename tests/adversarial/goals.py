"""What is asked of the claims, over kinds of truth and seeds, and the table of it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .truth import KINDS

MOST_FALSE_MET = 0.05  # of verdicts on limits that the actual error exceeds, over all kinds
WITHIN_68 = (0.60, 0.85)
LEAST_WITHIN_95 = 0.90
LEAST_EXCUSED = 0.9  # of the runs of a kind: undecided with a right reason
# Inside the family, of limits 1.6 times the actual p95 that exact errors would let be called met:
# 45 to 90 % of all, as the actual p95 is often well below its 95 % quantile.
LEAST_MET = 0.8
WIDTH = 1.3  # inside the family: stated over actual rms, or the inverse

HEAD = (
    "| kind | runs | rms error/stated | cover 68/95 % | false met (0.9) "
    "| met at 1.6, of attainable | undecided | warned | reason right |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


@dataclass(frozen=True)
class Row:
    """What the runs of one kind show together.

    Parameters
    ----------
    kind : str
    runs : int
    ratio : float
        Root mean square of the actual error, over that of the stated sigmas.
    within_68, within_95 : float
        Fractions of positions and axes whose error is within the stated intervals.
    false_met : float
        Fraction of verdicts 'met' on limits that are 0.9 times the actual p95 or max.
    met, attainable : float
        Fraction of verdicts 'met' on limits that are 1.6 times the actual p95, and what it is on
        the mean where stated errors are exact.
    undecided : float
        Fraction of all verdicts.
    warned : float
        Fraction of runs with a warning.
    right : float
        Fraction of runs in which a reason or a warning names the right cause.
    excused : float
        Fraction of runs whose verdict above the actual p95 is 'undecided', with such a reason.
    """

    kind: str
    runs: int
    ratio: float
    within_68: float
    within_95: float
    false_met: float
    met: float
    attainable: float
    undecided: float
    warned: float
    right: float
    excused: float

    @property
    def inside(self) -> bool:
        """Whether the truth is in the family that is fitted."""
        return self.kind in KINDS and KINDS[self.kind].inside

    @property
    def covers(self) -> bool:
        """Whether intervals cover what they claim."""
        low, high = WITHIN_68
        return low <= self.within_68 <= high and self.within_95 >= LEAST_WITHIN_95

    @property
    def honest(self) -> bool:
        """Whether intervals cover, or verdicts are withheld for the right reason."""
        return self.covers or self.excused >= LEAST_EXCUSED

    @property
    def decides(self) -> bool:
        """Inside the family: whether what is clearly met is called met."""
        return not self.inside or self.met >= LEAST_MET * self.attainable

    @property
    def of_right_width(self) -> bool:
        """Inside the family: whether stated errors have the size of the actual ones."""
        return not self.inside or 1 / WIDTH <= self.ratio <= WIDTH


def row_of(kind: str, runs: Sequence[dict[str, Any]]) -> Row:
    """The runs of a kind, or of all, summed up."""

    def mean(values: Iterable[Any]) -> float:
        return float(np.mean(list(values)))

    def verdicts(run: dict[str, Any], names: str) -> list[str]:
        return [m["verdict"] for m in run["margins"] if m["name"].startswith(names)]

    return Row(
        kind,
        len(runs),
        float(
            np.sqrt(mean(r["rms_error"] ** 2 for r in runs))
            / np.sqrt(mean(r["rms_stated"] ** 2 for r in runs))
        ),
        mean(r["within_68"] for r in runs),
        mean(r["within_95"] for r in runs),
        mean(v == "met" for r in runs for v in verdicts(r, "below")),
        mean(v == "met" for r in runs for v in verdicts(r, "above")),
        mean(m["attainable"] for r in runs for m in r["margins"] if m["name"] == "above p95"),
        mean(v == "undecided" for r in runs for v in verdicts(r, "")),
        mean(bool(r["warnings"]) for r in runs),
        mean(r["right_reason"] for r in runs),
        mean("undecided" in verdicts(r, "above") and r["right_reason"] for r in runs),
    )


def rows_of(results: Iterable[dict[str, Any]]) -> list[Row]:
    """One row for each kind, in the order of the suite."""
    by_kind: dict[str, list[dict[str, Any]]] = {}
    for one in results:
        by_kind.setdefault(one["kind"], []).append(one)
    order = {name: k for k, name in enumerate(KINDS)}
    return [row_of(k, by_kind[k]) for k in sorted(by_kind, key=lambda k: order.get(k, len(order)))]


def table_of(results: Sequence[dict[str, Any]]) -> str:
    """A Markdown table of all kinds; what misses a goal is in italics."""
    lines = [_line(row) for row in rows_of(results)]
    return "\n".join([HEAD, *lines, _line(row_of("all", results), over_all=True)]) + "\n"


def _line(row: Row, *, over_all: bool = False) -> str:
    def cell(text: str, good: bool = True) -> str:
        return text if good else f"*{text}*"

    inside = row.inside and not over_all
    wordless = over_all or (row.kind in KINDS and not KINDS[row.kind].words)
    return (
        "| "
        + " | ".join(
            (
                row.kind + (" (inside)" if inside else ""),
                str(row.runs),
                "" if over_all else cell(f"{row.ratio:.2f}", row.of_right_width),
                cell(f"{row.within_68:.2f} / {row.within_95:.2f}", over_all or row.honest),
                cell(f"{row.false_met:.2f}", row.false_met <= MOST_FALSE_MET),
                cell(f"{row.met:.2f} of {row.attainable:.2f}", row.decides),
                f"{row.undecided:.2f}",
                f"{row.warned:.2f}",
                "" if wordless else f"{row.right:.2f}",
            )
        )
        + " |"
    )
