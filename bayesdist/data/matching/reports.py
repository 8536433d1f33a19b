"""What is wrong with a campaign as a whole: lists, log and catalogue, or the way they match."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.exposure_log import ExposureLog
from bayesdist.data.matching.mismatch import MIRRORED
from bayesdist.data.starlists import StarList
from bayesdist.errors import InputError

if TYPE_CHECKING:
    from bayesdist.data.matching.campaign import ExposureReport

__all__ = ["all_cut", "check_campaign", "failure", "refuse_astray", "too_many"]

_MOST_LEFT_OUT = 0.2  # of the exposures: beyond, the campaign itself is wrong
_AT_FIRST = 2  # exposures that fail before any has matched


def check_campaign(lists: Sequence[StarList], log: ExposureLog, catalog: ReferenceCatalog) -> None:
    """Refuse lists, log and catalogue that do not go together; nothing is matched.

    Parameters
    ----------
    lists : sequence of StarList
    log : ExposureLog
    catalog : ReferenceCatalog

    Raises
    ------
    InputError
        For no lists, an exposure that is not in the log or stands in two lists, errors of 0, and
        proper motions without an epoch.
    """
    if not lists:
        raise InputError("there are no star lists to match", do="give at least one")
    names = [one.exposure for one in lists]
    for k, one in enumerate(lists):
        if one.exposure not in log:
            raise InputError(
                f"exposure {one.exposure} is not in {log.source}",
                where=one.source,
                do="add it to the log, or leave the list out",
            )
        if one.exposure in names[:k]:
            raise InputError(
                f"exposure {one.exposure} has a list in {lists[names.index(one.exposure)].source}, "
                "too",
                where=one.source,
                do="give one list for each exposure",
            )
    for name in ("sigma_u", "sigma_v"):
        sigma = getattr(catalog, name)
        if sigma is not None and not (sigma > 0).all():
            raise InputError(
                "an error of 0 cannot be the error of a match",
                # not the row: stars may have been left out since the file was read
                where=f"{catalog.source}, star {catalog.star[np.argmin(sigma)]}, column {name!r}",
                do="give positive errors, or leave the columns out",
            )
    if catalog.pm_u is not None:
        catalog.at(log[names[0]].epoch)


def all_cut(stars: StarList, rejected: Mapping[str, int], where: str) -> InputError:
    """The error of a list of which the cuts leave nothing, with the counts of each cut."""
    counts = ", ".join(f"{count} {reason}" for reason, count in rejected.items())
    return InputError(
        f"the cuts leave none of {len(stars)} detections ({counts})",
        where=where,
        do="widen the cuts, or correct the columns that they go by",
    )


def too_many(failed: int, matched: int, n: int) -> bool:
    """Whether so many exposures failed that the campaign itself is wrong."""
    return failed > _MOST_LEFT_OUT * n or (not matched and failed >= _AT_FIRST)


def failure(
    failed: Mapping[str, InputError], reason: str, n: int, tried: Sequence[bool] = (False,)
) -> InputError:
    """The first failure, with what is known of the others.

    Parameters
    ----------
    failed : mapping of str to InputError
        By exposure.
    reason : str
        As `mismatch_reason`.
    n : int
        Exposures.
    tried : sequence of bool
        Whether the catalogue was taken mirrored.
    """
    first = next(iter(failed.values()))
    cause, do = first.cause, first.do
    if reason:
        cause = f"{cause} ({reason})"
        do = "correct the catalogue's unit or axes, the columns x and y, or the known distortion"
        if MIRRORED in reason and len(tried) == 1:
            do += f", or set campaign.parity = '{'direct' if tried[0] else 'mirrored'}'"
    elif len(failed) > 1:
        cause += f", and {len(failed) - 1} more of {n} exposures fail likewise"
    return InputError(cause, where=first.where, do=do)


def refuse_astray(reports: Sequence[ExposureReport], catalog: ReferenceCatalog) -> None:
    """Refuse a known distortion, or chip numbers, that put a chip elsewhere."""
    astray = [one for one in reports if one.astray]
    if 2 * len(astray) <= len(reports):
        return
    first = astray[0]
    raise InputError(
        f"in {len(astray)} of {len(reports)} exposures the detections of chip {first.astray[0]} do "
        f"not match where those of another chip do (exposure {first.exposure}: "
        + ", ".join(f"{n} matched on chip {chip}" for chip, n in first.per_chip.items())
        + ")",
        where=catalog.source,
        do="check the chip numbers, and where the known distortion puts that chip",
    )
