"""A campaign: the star lists of many exposures matched with one catalogue, without trusting a WCS.

Known distortion brings the raw positions to a plane; triangles of bright stars find rotation and
shift; a linear map is iterated while the search radius shrinks; a cubic for each chip takes up what
the known distortion has left.  The pairs are mutual nearest neighbours within a radius that they
themselves suggest.  Transformations serve the pairing alone: what comes out are raw pixels beside
catalogue positions (ACS ISR 2015-06, Section 4.1).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.exposures import ExposureLog
from bayesdist.data.matches import MatchTable
from bayesdist.data.matching.exposure import ExposureMatch, match_exposure
from bayesdist.data.matching.mismatch import mismatch_reason
from bayesdist.data.matching.reports import (
    all_cut,
    check_campaign,
    failure,
    refuse_astray,
    too_many,
)
from bayesdist.data.matching.similarity import PatternIndex, pattern_index
from bayesdist.data.merging import encoded, merged_counts
from bayesdist.data.starlists import StarCuts, StarList
from bayesdist.errors import InputError

__all__ = [
    "CampaignMatches",
    "ExposureReport",
    "match_campaign",
]

Float = NDArray[np.float64]
Start = Callable[[Float, Float, NDArray[np.int64], float], ArrayLike]

_UNMATCHED = "no counterpart in the catalogue"
_LEFT_OUT = "exposure left out"
_ASTRAY = 0.2  # of the matched share of the best chip: a chip below lies elsewhere
_ENOUGH = 20  # detections of a chip, of which that can be said


@dataclass(frozen=True)
class ExposureReport:
    """How an exposure was matched.

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
    false_share : float
        Part of the matches that are expected to be false for that reason.
    rotation : float
        From the start's positions to the catalogue, degrees anticlockwise, in [0, 360).
    scale : float
    offset : tuple of float
        Where the middle of the detections comes to lie, in the catalogue's unit.
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
    false_share: float
    rotation: float
    scale: float
    offset: tuple[float, float]
    radius: tuple[float, float]
    rms: float
    zero_point: float | None
    coincidences: int


@dataclass(frozen=True, eq=False)
class CampaignMatches:
    """The matches of a campaign.

    Parameters
    ----------
    table : MatchTable
        Raw pixels beside catalogue positions at the epoch of each exposure; `sigma_u`, `sigma_v`
        are those of the catalogue there, without the centroid's error.
    reports : tuple of ExposureReport
        In the order of the lists.
    left_out : dict of str to str
        Exposures that did not match, and why.
    mirrored : bool
        Whether u has the sign that is opposite to the catalogue's.
    """

    table: MatchTable
    reports: tuple[ExposureReport, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)
    mirrored: bool = False

    def summary(self) -> Table:
        """The reports as a table, a row for each exposure; chips and reasons are columns."""
        chips = sorted({chip for one in self.reports for chip in one.per_chip})
        reasons = list(dict.fromkeys(reason for one in self.reports for reason in one.rejected))
        rows: dict[str, list[Any]] = {}
        simple = ("exposure", "filter", "epoch", "detected")
        for name in simple:
            rows[name] = [getattr(one, name) for one in self.reports]
        for reason in reasons:
            rows[reason] = [one.rejected.get(reason, 0) for one in self.reports]
        for name in ("matched", "expected", "completeness", "false_rate", "false_share"):
            rows[name] = [getattr(one, name) for one in self.reports]
        for chip in chips:
            rows[f"chip {chip}"] = [one.per_chip.get(chip, 0) for one in self.reports]
        for name in ("rotation", "scale", "rms", "coincidences"):
            rows[name] = [getattr(one, name) for one in self.reports]
        for k, name in enumerate(("offset_u", "offset_v")):
            rows[name] = [one.offset[k] for one in self.reports]
        for k, name in enumerate(("radius_min", "radius_max")):
            rows[name] = [one.radius[k] for one in self.reports]
        rows["zero_point"] = [
            np.nan if one.zero_point is None else one.zero_point for one in self.reports
        ]
        return Table(rows)


def match_campaign(
    lists: Sequence[StarList],
    log: ExposureLog,
    catalog: ReferenceCatalog,
    start: Start,
    *,
    cuts: StarCuts | None = None,
    radius: float | None = None,
    mirrored: Sequence[bool] = (False,),
    skip: bool = False,
) -> CampaignMatches:
    """Match the star lists of many exposures with a catalogue.

    Parameters
    ----------
    lists : sequence of StarList
        One for each exposure.
    log : ExposureLog
        With their epochs and filters.
    catalog : ReferenceCatalog
        Brought to the epoch of each exposure, where its parallaxes displace it, too.  Its positions
        stay relative to its own origin.
    start : callable
        Known distortion: ``start(x, y, chip, epoch) -> (N, 2)`` from raw pixels and chip numbers to
        a plane in the catalogue's unit, any rotation and origin; all chips on one plane.
    cuts : StarCuts, optional
        Which detections may be matched; by default all.  Those that the cuts leave out still help
        to recognise the field.
    radius : float, optional
        Search radius; by default it is taken from the scatter of the pairs, ring by ring around the
        middle of the detector (`search_radius`), below that where chance takes over.
    mirrored : sequence of bool, optional
        Whether the catalogue is taken with the sign of u changed; of several, those that follow are
        tried where the first matches no exposure.  East of a sky with north up is to the left: a
        detector that is read out as the sky is seen has the parity that is opposite to (u, v) of a
        tangent plane.
    skip : bool, optional
        Whether exposures that do not match, or lose all their detections to the cuts, are left out
        and counted.  More than a fifth of them, or the first two, are an error all the same.

    Returns
    -------
    CampaignMatches

    Raises
    ------
    InputError
        When an exposure is not in the log, stands in two lists, loses all its detections to the
        cuts, or shows another field: then with the best number of coincidences, and with the scale
        or the mirror image that would match.  When in most exposures one chip does not match where
        another does.
    """
    check_campaign(lists, log, catalog)
    cuts = StarCuts() if cuts is None else cuts
    passed = [cuts.passed(one) for one in lists]
    chips = sorted({chip for one in lists for chip in one.chips})
    mean_epoch = float(np.mean([log[one.exposure].epoch for one in lists]))
    views = [_View(catalog, one, mean_epoch) for one in mirrored]
    found: list[ExposureMatch] = []
    reports: list[ExposureReport] = []
    failed: dict[str, InputError] = {}
    for one, (good, rejected) in zip(lists, passed, strict=True):
        where = f"{one.source}, exposure {one.exposure}"
        missing = tuple(chip for chip in chips if not (one.chip[good] == chip).any())
        epoch = log[one.exposure].epoch
        plane = _started(start, one, epoch)
        try:
            if not good.any():
                raise all_cut(one, rejected, where)
            match, view = _matched(one, good, plane, views, epoch, radius=radius, where=where)
            views = [view]
        except InputError as error:
            reason = ""
            if good.any() and not found and not failed:
                reason = mismatch_reason(plane, one.mag, views[0].index)
            failed[one.exposure] = error
            if reason or not skip or too_many(len(failed), len(found), len(lists)):
                raise failure(failed, reason, len(lists), mirrored) from error
            continue
        found.append(match)
        reports.append(_report(one, good, log, match, rejected, tuple(chips), missing))
    refuse_astray(reports, catalog)
    kept = [one for one in lists if one.exposure not in failed]
    shown = catalog.mirrored() if views[0].mirrored else catalog
    table = _table(kept, log, shown, found, reports)
    if failed:
        n = sum(len(one) for one in lists) - table.n_rows
        table = replace(table, n_rows=table.n_rows + n, rejected={**table.rejected, _LEFT_OUT: n})
    left_out = {k: e.cause for k, e in failed.items()}
    return CampaignMatches(table, tuple(reports), left_out, views[0].mirrored)


class _View:
    """A catalogue in one of its parities, at any epoch."""

    def __init__(self, catalog: ReferenceCatalog, mirrored: bool, mean_epoch: float) -> None:
        self.mirrored = mirrored
        self._catalog, self._mean_epoch = catalog, mean_epoch
        self._last: tuple[float, ReferenceCatalog] | None = None

    def at(self, epoch: float) -> ReferenceCatalog:
        """As it is seen at an epoch."""
        if self._last is None or self._last[0] != epoch:
            then = self._catalog if self._catalog.pm_u is None else self._catalog.as_seen(epoch)
            self._last = epoch, then.mirrored() if self.mirrored else then
        return self._last[1]

    @cached_property
    def index(self) -> PatternIndex:
        """Patterns at the mean epoch: motions of some years do not change shapes of triangles."""
        mean = self.at(self._mean_epoch)
        return pattern_index(np.column_stack([mean.u, mean.v]), mean.mag)


def _matched(
    stars: StarList,
    good: NDArray[np.bool_],
    plane: Float,
    views: Sequence[_View],
    epoch: float,
    *,
    radius: float | None,
    where: str,
) -> tuple[ExposureMatch, _View]:
    """The match with the first of these views that gives one.

    Raises
    ------
    InputError
        That of the first view.
    """
    errors = []
    for view in views:
        try:
            found = match_exposure(
                stars,
                good,
                plane,
                view.at(epoch),
                view.index,
                radius=radius,
                source=where,
            )
            return found, view
        except InputError as error:
            errors.append(error)
    first = errors[0]
    if len(errors) == 1:
        raise first
    cause = f"{first.cause}, and the mirror image does not match either"
    raise InputError(cause, where=first.where, do=first.do.replace(", the parity and", " and"))


def _started(start: Start, stars: StarList, epoch: float) -> Float:
    plane = np.ascontiguousarray(start(stars.x, stars.y, stars.chip, epoch), np.float64)
    if plane.shape != (len(stars), 2) or not np.isfinite(plane).all():
        raise InputError(
            f"the known distortion gives shape {plane.shape} or values that are not finite, "
            f"where ({len(stars)}, 2) finite ones are expected",
            where=f"{stars.source}, exposure {stars.exposure}",
            do="correct the function 'start'",
        )
    return plane


def _report(
    stars: StarList,
    good: NDArray[np.bool_],
    log: ExposureLog,
    match: ExposureMatch,
    rejected: Mapping[str, int],
    chips: tuple[int, ...],
    missing: tuple[int, ...],
) -> ExposureReport:
    exposure = log[stars.exposure]
    asked = {chip: int((stars.chip[good] == chip).sum()) for chip in chips}
    matched = {chip: int((stars.chip[match.index] == chip).sum()) for chip in chips}
    share = {chip: matched[chip] / n for chip, n in asked.items() if n >= _ENOUGH}
    best = max(share.values(), default=0.0)
    return ExposureReport(
        exposure=exposure.name,
        filter=exposure.filter,
        epoch=exposure.epoch,
        detected=len(stars),
        rejected=dict(rejected),
        matched=len(match.index),
        per_chip=matched,
        missing_chips=missing,
        astray=tuple(chip for chip, part in share.items() if part < _ASTRAY * best),
        expected=match.expected,
        completeness=match.completeness,
        false_rate=match.false_rate,
        false_share=match.false_share,
        rotation=match.rotation,
        scale=match.scale,
        offset=match.offset,
        radius=match.radius,
        rms=float(np.sqrt(np.mean(match.distance**2))),
        zero_point=match.zero_point,
        coincidences=match.coincidences,
    )


def _table(
    lists: Sequence[StarList],
    log: ExposureLog,
    catalog: ReferenceCatalog,
    found: Sequence[ExposureMatch],
    reports: Sequence[ExposureReport],
) -> MatchTable:
    """All matches, with the columns that every list has."""
    sizes = [len(match.index) for match in found]

    def joined(values: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([one[m.index] for one, m in zip(values, found, strict=True)])

    each = np.repeat(np.arange(len(lists)), sizes)
    filters, filter_names = encoded(np.array([log[one.exposure].filter for one in lists]))
    files, sources = encoded(np.array([one.source for one in lists]))
    chip, chip_numbers = encoded(joined([one.chip for one in lists]), ordered=True)
    with_mag = all(one.mag is not None for one in lists)
    unmatched = sum(one.detected - sum(one.rejected.values()) - one.matched for one in reports)
    rejected = merged_counts([one.rejected for one in reports])
    if unmatched:
        rejected[_UNMATCHED] = unmatched
    star = np.concatenate([match.catalog_index for match in found])
    sigmas: dict[str, Float] = {}
    if catalog.sigma_u is not None:
        sigmas["sigma_u"] = np.concatenate([m.sigma[0] for m in found])  # type: ignore[index]
        sigmas["sigma_v"] = np.concatenate([m.sigma[1] for m in found])  # type: ignore[index]
    return MatchTable(
        x=joined([one.x for one in lists]),
        y=joined([one.y for one in lists]),
        u=np.concatenate([match.u for match in found]),
        v=np.concatenate([match.v for match in found]),
        **sigmas,
        unit=catalog.unit,
        epoch=np.array([log[one.exposure].epoch for one in lists])[each],
        mag=joined([one.mag for one in lists]) if with_mag else None,  # type: ignore[misc]
        exposure=each,
        exposure_names=tuple(one.exposure for one in lists),
        chip=chip,
        chip_numbers=chip_numbers,
        filter=filters[each],
        filter_names=filter_names,
        star=catalog.star[star],
        row=joined([one.row for one in lists]),
        source=files[each],
        sources=sources,
        n_rows=sum(len(one) for one in lists),
        rejected=rejected,
        tangent_point=catalog.tangent_point,
    )
