"""Reports on the matching of exposures, and warnings on their comparison."""

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

# largest fraction of exposures that may fail; with more, the campaign is misconfigured
_MAX_FRACTION_LEFT_OUT = 0.2
_MAX_FAILURES_AT_FIRST = 2  # largest number of exposures that may fail before any has matched
_MIN_EXPOSURES = 5  # smallest number of exposures among which outliers are identified
_ODD_SIGMAS = 5.0  # robust standard deviations of all exposures
_MIN_COMPLETENESS_STEP = 0.15  # smallest deviation of the completeness that is reported
_MIN_FALSE_STEP = 0.05  # smallest deviation of the false fraction that is reported
# smallest deviation of the scale that is reported; the breathing of telescopes is below
_MIN_SCALE_STEP = 2e-5
_MAX_NAMED = 5  # largest number of exposures named in a sentence


@dataclass(frozen=True)
class ExposureReport:
    """Report on the matching of an exposure.

    Parameters
    ----------
    exposure, filter : str
        Name of the exposure and its filter.
    epoch : float
        Decimal year.
    detected : int
        Number of detections in the list.
    rejected : dict of str to int
        Number of detections that failed the cuts, by reason.
    matched : int
        Number of matches.
    per_chip : dict of int to int
        Number of matches on each chip of the campaign.
    missing_chips : tuple of int
        Chips of the campaign without a detection that passed the cuts.
    astray : tuple of int
        Chips with few matched detections although another chip has many.
    expected : int
        Number of catalogue stars in the footprint of the detections and within their magnitude
        range.
    completeness : float
        Fraction of `expected` that is matched.
    false_rate : float
        Probability that a detection without counterpart in the catalogue is matched by chance.
    false_fraction : float
        Expected fraction of such chance matches among all matches.
    rotation : float
        Rotation from the positions after the known distortion to the catalogue, degrees
        anticlockwise, in [0, 360).
    scale : float
        Scale of that transformation.
    offset : tuple of float
        Catalogue position of the middle of the detections, in the catalogue's unit.
    radius : tuple of float
        Smallest and largest search radius over the detector.
    rms : float
        Rms distance of the pairs after the linear transformation and a cubic per chip.
    zero_point : float or None
        Median difference between the magnitudes of the catalogue and of the list.
    coincidences : int
        Number of stars that agreed on rotation and shift.
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
    """Raise InputError if the lists, the log and the catalogue are inconsistent.

    This is the case if there are no lists, if an exposure is not in the log or occurs in two lists,
    if errors are 0, or if there are proper motions without an epoch.
    """
    if not lists:
        raise InputError("there are no star lists to match", do="give at least one")
    names = [stars.name for stars in lists]
    for k, stars in enumerate(lists):
        if stars.name not in log:
            raise InputError(
                f"exposure {stars.name} is not in {log.source}",
                where=stars.source,
                do="add it to the log, or leave the list out",
            )
        if stars.name in names[:k]:
            raise InputError(
                f"exposure {stars.name} also has a list in {lists[names.index(stars.name)].source}",
                where=stars.source,
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
    """Error for a list in which the cuts leave no detection.

    `rejected` has the number of detections that each cut removed, by reason.
    """
    counts = ", ".join(f"{count} {reason}" for reason, count in rejected.items())
    return InputError(
        f"the cuts leave none of {len(stars)} detections ({counts})",
        where=stars.where,
        do="widen the cuts, or correct the columns that they use",
    )


def too_many(failed: int, matched: int, n: int) -> bool:
    """True if too many exposures failed, which shows that the campaign is misconfigured.

    `failed` and `matched` count the exposures so far, and n is the number of all exposures.
    """
    return failed > _MAX_FRACTION_LEFT_OUT * n or (not matched and failed >= _MAX_FAILURES_AT_FIRST)


def failure(
    failed: Mapping[str, InputError], reason: str, n: int, tried: Sequence[bool] = (False,)
) -> InputError:
    """First failure as an error, with a summary of the other failures among n exposures.

    `failed` has the errors by exposure, and `reason` is the clause from `mismatch_reason`, or
    empty. `tried` has an entry for each parity that was tried: True for a mirrored catalogue.
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
    """Raise InputError if a chip does not match in most exposures although another one does.

    The known distortion or the chip numbers are then wrong.
    """
    astray = [report for report in reports if report.astray]
    if 2 * len(astray) <= len(reports):
        return
    first = astray[0]
    raise InputError(
        f"in {len(astray)} of {len(reports)} exposures the detections of chip {first.astray[0]} do "
        f"not match where those of another chip do (exposure {first.exposure}: "
        + ", ".join(f"{n} matched on chip {chip}" for chip, n in first.per_chip.items())
        + ")",
        where=catalog.source,
        do="check the chip numbers, and the position of that chip in the known distortion",
    )


def match_warnings(
    reports: Sequence[ExposureReport], left_out: Mapping[str, str], log: ExposureLog
) -> list[str]:
    """Clauses on exposures that were left out, that lack a chip, or that are outliers.

    `left_out` has the reason for each exposure that was left out, by name.

    An exposure is an outlier if its completeness is far below that of the others, if far more of
    its matches are expected to be false, or if its scale differs. The scale is corrected for
    velocity aberration if the log has it. The thresholds are five robust standard deviations
    of all exposures, and at least 0.15, 0.05 and 2e-5.
    """
    out = []
    if left_out:
        n = len(reports) + len(left_out)
        texts = [f"{name} ({cause})" for name, cause in left_out.items()]
        verb = "were" if len(texts) > 1 else "was"
        out.append(f"{len(texts)} of {n} exposures {verb} left out: {_listed(texts)}")
    for chip in sorted({chip for report in reports for chip in report.missing_chips}):
        names = [report.exposure for report in reports if chip in report.missing_chips]
        out.append(f"no detection on chip {chip} passes the cuts in exposure {_listed(names)}")
    for chip in sorted({chip for report in reports for chip in report.astray}):
        names = [report.exposure for report in reports if chip in report.astray]
        out.append(f"the detections of chip {chip} hardly match in exposure {_listed(names)}")
    if len(reports) < _MIN_EXPOSURES:
        return out
    completeness = np.array([report.completeness for report in reports])
    false = np.array([report.false_fraction for report in reports])
    factor = log.select(names=[report.exposure for report in reports])
    has_all_chips = np.array([not report.missing_chips and not report.astray for report in reports])
    scale = np.array(
        [report.scale / (factor[report.exposure].vafactor or np.nan) if full else np.nan
         for report, full in zip(reports, has_all_chips, strict=True)]
    )  # fmt: skip
    for quantity, values, odd, form in (
        ("completeness", completeness, _away(-completeness, _MIN_COMPLETENESS_STEP) > 0, ".2f"),
        ("fraction of false matches", false, _away(false, _MIN_FALSE_STEP) > 0, ".2f"),
        ("scale", scale - _median(scale), np.abs(_away(scale, _MIN_SCALE_STEP)) > 0, "+.1e"),
    ):
        named = [
            f"{report.exposure} ({value:{form}})"
            for report, value, is_odd in zip(reports, values, odd, strict=True)
            if is_odd
        ]
        if named:
            usual = "of the others" if quantity == "scale" else f"of {_median(values):.2f}"
            out.append(f"the {quantity} is unlike that {usual} in exposure {_listed(named)}")
    return out


def _median(values: Float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else 0.0


def _away(values: Float, least: float) -> Float:
    """Deviations from the median where they exceed both thresholds; zero elsewhere."""
    d = np.nan_to_num(values - _median(values))
    limit = max(_ODD_SIGMAS * MAD_TO_SIGMA * _median(np.abs(values - _median(values))), least)
    return np.where(np.abs(d) > limit, d, 0.0)


def _listed(texts: Sequence[str]) -> str:
    remainder = f" and {len(texts) - _MAX_NAMED} more" if len(texts) > _MAX_NAMED else ""
    return ", ".join(texts[:_MAX_NAMED]) + remainder
