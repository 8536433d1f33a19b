"""Reports on the matching of exposures, and warnings on all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.detections import Detections
from bayesdist.data.exposures import ExposureLog
from bayesdist.data.magnitude_errors import MAD_TO_SIGMA
from bayesdist.data.matching.similarity import MIRRORED
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float

_MAX_FRACTION_LEFT_OUT = 0.2  # of the exposures: beyond, the campaign itself is wrong
_MAX_FAILURES_AT_FIRST = 2  # exposures that fail before any has matched
_MIN_EXPOSURES = 5  # exposures among which one can be called odd
_ODD_SIGMAS = 5.0  # of the other exposures
_MIN_COMPLETENESS_STEP = 0.15  # of completeness, at least
_MIN_FALSE_STEP = 0.05  # of the matches, at least
_MIN_SCALE_STEP = 2e-5  # at least: telescopes breathe less
_MAX_NAMED = 5  # exposures in a sentence


@dataclass(frozen=True)
class ExposureReport:
    """Report of the matching of an exposure.

    Parameters
    ----------
    exposure, filter : str
    epoch : float
    detected : int
        Detections in the list.
    rejected : dict of str to int
        Those that the cuts left out, by reason.
    matched : int
    per_chip : dict of int to int
        Matched on each chip of the campaign.
    missing_chips : tuple of int
        Chips of the campaign without a detection that passed the cuts.
    astray : tuple of int
        Chips whose detections hardly match, where those of another chip do.
    expected : int
        Catalogue stars in the footprint of the detections and within their range of magnitudes.
    completeness : float
        Part of `expected` that is matched.
    false_rate : float
        Probability that a detection without counterpart in the catalogue is matched by chance.
    false_fraction : float
        Part of the matches that are expected to be false for that reason.
    rotation : float
        From the start's positions to the catalogue, degrees anticlockwise, in [0, 360).
    scale : float
    offset : tuple of float
        Position of the middle of the detections, in the catalogue's unit.
    radius : tuple of float
        Smallest and largest search radius over the detector.
    rms : float
        Of the distances of the pairs, after the linear transformation and a cubic for each chip.
    zero_point : float or None
        Median of the catalogue's magnitudes less those of the list.
    coincidences : int
        Stars that agreed on rotation and shift.
    """

    exposure: str
    filter: str
    epoch: float
    detected: int
    rejected: Mapping[str, int]
    matched: int
    per_chip: Mapping[int, int]
    missing_chips: tuple[int, ...]
    astray: tuple[int, ...]
    expected: int
    completeness: float
    false_rate: float
    false_fraction: float
    rotation: float
    scale: float
    offset: tuple[float, float]
    radius: tuple[float, float]
    rms: float
    zero_point: float | None
    coincidences: int


def check_campaign(
    lists: Sequence[Detections], log: ExposureLog, catalog: ReferenceCatalog
) -> None:
    """Refuse lists, log and catalogue that do not fit together; nothing is matched.

    InputError for no lists, an exposure that is not in the log or stands in two lists, errors of 0,
    and proper motions without an epoch.
    """
    if not lists:
        raise InputError("there are no star lists to match", do="give at least one")
    names = [one.name for one in lists]
    for k, one in enumerate(lists):
        if one.name not in log:
            raise InputError(
                f"exposure {one.name} is not in {log.source}",
                where=one.source,
                do="add it to the log, or leave the list out",
            )
        if one.name in names[:k]:
            raise InputError(
                f"exposure {one.name} has a list in {lists[names.index(one.name)].source}, too",
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


def all_cut(stars: Detections, rejected: Mapping[str, int]) -> InputError:
    """Error of a list of which the cuts leave nothing, with the counts of each cut."""
    counts = ", ".join(f"{count} {reason}" for reason, count in rejected.items())
    return InputError(
        f"the cuts leave none of {len(stars)} detections ({counts})",
        where=stars.where,
        do="widen the cuts, or correct the columns that they go by",
    )


def too_many(failed: int, matched: int, n: int) -> bool:
    """True where so many exposures failed that the campaign itself is wrong."""
    return failed > _MAX_FRACTION_LEFT_OUT * n or (not matched and failed >= _MAX_FAILURES_AT_FIRST)


def failure(
    failed: Mapping[str, InputError], reason: str, n: int, tried: Sequence[bool] = (False,)
) -> InputError:
    """First failure as an error, with what is known of the others.

    `failed` is by exposure, `reason` that of `mismatch_reason`; `tried` has True for each parity in
    which the catalogue was taken mirrored.
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


def match_warnings(
    reports: Sequence[ExposureReport], left_out: Mapping[str, str], log: ExposureLog
) -> list[str]:
    """Clauses on exposures that were left out, that lack a chip, or that are outliers.

    An exposure is an outlier when its completeness is far below that of the others, when far more
    of its matches are expected to be false, or when its scale, free of aberration (where the log
    has VAFACTOR), differs: by five robust standard deviations of all exposures, and no less than
    0.15, 0.05 and 2e-5.
    """
    out = []
    if left_out:
        n = len(reports) + len(left_out)
        texts = [f"{name} ({cause})" for name, cause in left_out.items()]
        verb = "were" if len(texts) > 1 else "was"
        out.append(f"{len(texts)} of {n} exposures {verb} left out: {_listed(texts)}")
    for chip in sorted({chip for one in reports for chip in one.missing_chips}):
        names = [one.exposure for one in reports if chip in one.missing_chips]
        out.append(f"no detection on chip {chip} passes the cuts in exposure {_listed(names)}")
    for chip in sorted({chip for one in reports for chip in one.astray}):
        names = [one.exposure for one in reports if chip in one.astray]
        out.append(f"the detections of chip {chip} hardly match in exposure {_listed(names)}")
    if len(reports) < _MIN_EXPOSURES:
        return out
    completeness = np.array([one.completeness for one in reports])
    false = np.array([one.false_fraction for one in reports])
    factor = log.select(names=[one.exposure for one in reports])
    whole = np.array([not one.missing_chips and not one.astray for one in reports])
    scale = np.array(
        [one.scale / (factor[one.exposure].vafactor or np.nan) if full else np.nan
         for one, full in zip(reports, whole, strict=True)]
    )  # fmt: skip
    for what, values, odd, form in (
        ("completeness", completeness, _away(-completeness, _MIN_COMPLETENESS_STEP) > 0, ".2f"),
        ("fraction of false matches", false, _away(false, _MIN_FALSE_STEP) > 0, ".2f"),
        ("scale", scale - _median(scale), np.abs(_away(scale, _MIN_SCALE_STEP)) > 0, "+.1e"),
    ):
        named = [
            f"{one.exposure} ({value:{form}})"
            for one, value, is_odd in zip(reports, values, odd, strict=True)
            if is_odd
        ]
        if named:
            usual = "of the others" if what == "scale" else f"of {_median(values):.2f}"
            out.append(f"the {what} is unlike that {usual} in exposure {_listed(named)}")
    return out


def _median(values: Float) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0


def _away(values: Float, least: float) -> Float:
    """Distances from the median where they are large in both ways; else 0."""
    d = np.nan_to_num(values - _median(values))
    limit = max(_ODD_SIGMAS * MAD_TO_SIGMA * _median(np.abs(values - _median(values))), least)
    return np.where(np.abs(d) > limit, d, 0.0)


def _listed(texts: Sequence[str]) -> str:
    more = f" and {len(texts) - _MAX_NAMED} more" if len(texts) > _MAX_NAMED else ""
    return ", ".join(texts[:_MAX_NAMED]) + more
