"""Errors of positions that are in no covariance of parameters, as a file can carry them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from bayesdist.errors import FormatError

SHARED = "systematic"  # kind of an error that all stars of an image have in common


@dataclass(frozen=True)
class FurtherError:
    """Row of an error budget beside the covariance: root mean squares over the detector."""

    name: str
    # 'systematic' (shared by the stars of an image), 'random' (of each star) or 'local' (shared by
    # the stars near a position)
    kind: str
    u: float  # standard deviation, in the unit of u, v
    v: float
    source: str = ""
    # of a local error: fractions of its variance with the correlation lengths, in pixels, of fields
    # that the stars of a chip share; the rest is independent from star to star
    correlation: tuple[tuple[float, float], ...] = ()

    @property
    def shared(self) -> bool:
        """True for an error that all stars of an image have in common."""
        return self.kind == SHARED


def scaled(rows: Sequence[FurtherError], factor: float) -> tuple[FurtherError, ...]:
    """Rows in another unit."""
    return tuple(replace(row, u=factor * row.u, v=factor * row.v) for row in rows)


def further_from(records: Sequence[Mapping[str, Any]], where: str) -> tuple[FurtherError, ...]:
    """Rows of records; FormatError for one that lacks a part."""
    try:
        return tuple(
            FurtherError(
                str(one["name"]),
                str(one["kind"]),
                float(one["u"]),
                float(one["v"]),
                str(one.get("source", "")),
                tuple((float(part), float(length)) for part, length in one.get("correlation", ())),
            )
            for one in records
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"holds a further error that is not whole ({error})", where=where, do="write it again"
        ) from None
