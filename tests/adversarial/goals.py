"""What is asked of the claims, over kinds of truth and seeds, and the table of it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .truth import KINDS

# of the truths of a kind, on limits that the actual error exceeds: p95, max, or both
MOST_FALSE_MET = 0.05
WITHIN_68 = (0.60, 0.85)
LEAST_WITHIN_95 = 0.90
LEAST_EXCUSED = 0.9  # of the runs of a kind: no verdict, with a right reason
MOST_MISLED = 0.1  # of the runs of a kind: with advice that makes nothing better
# Inside the family, of limits 1.6 times the actual p95 that exact errors would let be called met:
# 45 to 90 % of all, as the actual p95 is often well below its 95 % quantile.
LEAST_MET = 0.8
BELOW = 2  # limits that are missed, for each exposure that is judged
WIDTH = 1.3  # inside the family: stated over actual rms, or the inverse

HEAD = (
    "| kind | runs | rms error/stated | cover 68/95 % | false met (0.9) "
    "| met at 1.6, of attainable | undecided | warned | reason right | misled |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
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
        Fraction of truths with a verdict 'met' on a limit of 0.9 times the actual p95 or max.
    met, attainable : float
        Fraction of verdicts 'met' on limits that are 1.6 times the actual p95, and what it is on
        the mean where stated errors are exact.
    undecided : float
        Fraction of all verdicts that are neither 'met' nor 'missed'.
    warned : float
        Fraction of runs with a warning.
    right : float
        Fraction of runs in which a reason or a warning names the right cause.
    excused : float
        Fraction of runs whose verdict above the actual p95 is 'undecided' where a reason or a
        warning names the right cause, or 'not shown' for a reason that names it.
    misled : float
        Fraction of runs in which a warning has advice that makes nothing better.
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
    misled: float

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
    def believable(self) -> bool:
        """Whether next to nothing is called met that the truth misses."""
        return self.false_met <= MOST_FALSE_MET

    @property
    def decides(self) -> bool:
        """Inside the family: whether what is clearly met is called met."""
        return not self.inside or self.met >= LEAST_MET * self.attainable

    @property
    def of_right_width(self) -> bool:
        """Inside the family: whether stated errors have the size of the actual ones."""
        return not self.inside or 1 / WIDTH <= self.ratio <= WIDTH


def names_cause(words: Iterable[str], texts: Iterable[str]) -> bool:
    """Whether one of the words stands in one of the texts, in any case of letters."""
    said = " ".join(texts).lower()
    return any(word in said for word in words)


def names_right_cause(run: dict[str, Any]) -> bool:
    """Whether a reason or a warning of a run names the cause that its kind has."""
    texts = [*(m.get("reason", "") for m in run["margins"]), *run["warnings"]]
    return names_cause(KINDS[run["kind"]].words, texts)


def excused(run: dict[str, Any]) -> bool:
    """Whether a verdict that could be 'met' is withheld, and for the right reason."""
    above = [m for m in run["margins"] if m["name"].startswith("above")]
    if any(m["verdict"] == "undecided" for m in above) and names_right_cause(run):
        return True
    words = KINDS[run["kind"]].words
    return any(m["verdict"] == "not shown" and names_cause(words, [m["reason"]]) for m in above)


def falsely_met(run: dict[str, Any]) -> list[bool]:
    """Whether a limit that is missed is called met, for each exposure that is judged."""
    below = [m["verdict"] == "met" for m in run["margins"] if m["name"].startswith("below")]
    return [any(below[k : k + BELOW]) for k in range(0, len(below), BELOW)]


def row_of(kind: str, runs: Sequence[dict[str, Any]]) -> Row:
    """The runs of a kind, or of all, summed up."""

    def mean(values: Iterable[Any]) -> float:
        return float(np.mean(list(values)))

    def verdicts(run: dict[str, Any], names: str) -> list[str]:
        return [m["verdict"] for m in run["margins"] if m["name"].startswith(names)]

    def misled(run: dict[str, Any]) -> bool:
        return names_cause(KINDS[run["kind"]].misleading, run["warnings"])

    return Row(
        kind,
        len(runs),
        float(
            np.sqrt(mean(r["rms_error"] ** 2 for r in runs))
            / np.sqrt(mean(r["rms_stated"] ** 2 for r in runs))
        ),
        mean(r["within_68"] for r in runs),
        mean(r["within_95"] for r in runs),
        mean(wrong for r in runs for wrong in falsely_met(r)),
        mean(v == "met" for r in runs for v in verdicts(r, "above")),
        mean(m["attainable"] for r in runs for m in r["margins"] if m["name"] == "above p95"),
        mean(v not in ("met", "missed") for r in runs for v in verdicts(r, "")),
        mean(bool(r["warnings"]) for r in runs),
        mean(names_right_cause(r) for r in runs),
        mean(excused(r) for r in runs),
        mean(misled(r) for r in runs),
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
    warns = not over_all and row.kind in KINDS and bool(KINDS[row.kind].misleading)
    wordless = over_all or (row.kind in KINDS and not KINDS[row.kind].words)
    return (
        "| "
        + " | ".join(
            (
                row.kind + (" (inside)" if inside else ""),
                str(row.runs),
                "" if over_all else cell(f"{row.ratio:.2f}", row.of_right_width),
                cell(f"{row.within_68:.2f} / {row.within_95:.2f}", over_all or row.honest),
                cell(f"{row.false_met:.2f}", row.believable),
                cell(f"{row.met:.2f} of {row.attainable:.2f}", row.decides),
                f"{row.undecided:.2f}",
                f"{row.warned:.2f}",
                "" if wordless else f"{row.right:.2f}",
                cell(f"{row.misled:.2f}", row.misled <= MOST_MISLED) if warns else "",
            )
        )
        + " |"
    )
