"""Position errors outside of the covariance of the parameters, in a form for files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from bayesdist.errors import FormatError

SHARED = "systematic"  # kind of an error that is common to all stars of an image


@dataclass(frozen=True)
class FurtherError:
    """Row of an error budget that the covariance of the parameters does not include."""

    name: str
    # 'systematic' (common to all stars of an image), 'random' (independent for each star) or
    # 'local' (common to stars that are close together)
    kind: str
    u: float  # rms over the detector of the error along u, in the unit of u and v
    v: float  # the same along v
    source: str = ""
    # for local errors: (fraction of the variance, correlation length in pixels) of each correlated
    # component; the remaining variance is independent for each star
    correlation: tuple[tuple[float, float], ...] = ()

    @property
    def shared(self) -> bool:
        """True if the error is common to all stars of an image."""
        return self.kind == SHARED


def scaled(rows: Sequence[FurtherError], factor: float) -> tuple[FurtherError, ...]:
    """Convert rows to another unit."""
    return tuple(replace(row, u=factor * row.u, v=factor * row.v) for row in rows)


def further_from(records: Sequence[Mapping[str, Any]], where: str) -> tuple[FurtherError, ...]:
    """Rows from the records of a file; raises FormatError if a record is incomplete."""
    try:
        return tuple(
            FurtherError(
                str(record["name"]),
                str(record["kind"]),
                float(record["u"]),
                float(record["v"]),
                str(record.get("source", "")),
                tuple(
                    (float(part), float(length)) for part, length in record.get("correlation", ())
                ),
            )
            for record in records
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"has an incomplete entry for a further error ({error})",
            where=where,
            do="write the file again",
        ) from None
