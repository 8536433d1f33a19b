"""Star lists of the exposures of a campaign matched with one catalogue, without trusting a WCS.

Known distortion brings the raw positions to a plane; triangles of bright stars find rotation and
shift; a linear map is iterated while the search radius shrinks; a cubic for each chip fits what the
known distortion has left.  Matches are mutual nearest neighbours within a radius that follows from
their own distances.  Transformations serve the matching alone: the results are raw pixels with
catalogue positions (ACS ISR 2015-06, Section 4.1).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, TypeAlias

import numpy as np
from astropy.table import Table
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.columns.labels import merged_counts
from bayesdist.data.detections import Detections
from bayesdist.data.exposures import ExposureLog
from bayesdist.data.matches import Matches
from bayesdist.data.matching.exposure import ExposureMatch, match_exposure
from bayesdist.data.matching.reports import (
    ExposureReport,
    all_cut,
    check_campaign,
    failure,
    match_warnings,
    refuse_astray,
    too_many,
)
from bayesdist.data.matching.similarity import PatternIndex, mismatch_reason, pattern_index
from bayesdist.data.starlists import StarCuts
from bayesdist.data.tables.column import encoded
from bayesdist.errors import InputError, required
from bayesdist.utils.arrays import Bool, Float, Int

Start = Callable[[Float, Float, Int, float], ArrayLike]

_UNMATCHED = "no counterpart in the catalogue"
_LEFT_OUT = "exposure left out"


@dataclass(frozen=True, eq=False)
class CampaignMatches:
    """Matches of a campaign.

    Parameters
    ----------
    table : Matches
        Raw pixels with catalogue positions at the epoch of each exposure; `sigma_u`, `sigma_v`
        are those of the catalogue there, without the centroid's error.
    reports : tuple of ExposureReport
        In the order of the lists.
    left_out : dict of str to str
        Exposures that did not match, and why.
    mirrored : bool
        True where u has the sign that is opposite to the catalogue's.
    """

    table: Matches
    reports: tuple[ExposureReport, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)
    mirrored: bool = False

    def warnings(self, log: ExposureLog) -> list[str]:
        """Warnings of `match_warnings` on the matching."""
        return match_warnings(self.reports, self.left_out, log)

    def summary(self) -> Table:
        """Reports as a table, a row for each exposure; chips and reasons are columns."""
        chips = sorted({chip for one in self.reports for chip in one.per_chip})
        reasons = list(dict.fromkeys(reason for one in self.reports for reason in one.rejected))
        rows: dict[str, list[Any]] = {}
        simple = ("exposure", "filter", "epoch", "detected")
        for name in simple:
            rows[name] = [getattr(one, name) for one in self.reports]
        for reason in reasons:
            rows[reason] = [one.rejected.get(reason, 0) for one in self.reports]
        for name in ("matched", "expected", "completeness", "false_rate", "false_fraction"):
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
    lists: Sequence[Detections],
    log: ExposureLog,
    catalog: ReferenceCatalog,
    start: Start,
    *,
    cuts: StarCuts | None = None,
    radius: float | None = None,
    mirrored: Sequence[bool] = (False,),
) -> CampaignMatches:
    """Match the star lists of many exposures with a catalogue.

    Exposures that do not match or lose all their detections to the cuts are left out, and counted.

    Parameters
    ----------
    lists : sequence of Detections
        One for each exposure.
    log : ExposureLog
        With their epochs and filters.
    catalog : ReferenceCatalog
        Brought to the epoch of each exposure, where its parallaxes displace it, too.  Its positions
        stay relative to its own origin.
    start : callable
        Known distortion: ``start(x, y, chip, epoch) -> (N, 2)`` from raw pixels and chip numbers to
        a plane in the catalogue's unit, any rotation and origin; all chips on one plane.  It is
        called by several threads at a time.
    cuts : StarCuts, optional
        Cuts on detections to be matched; by default none.  Those that the cuts leave out still help
        to recognise the field.
    radius : float, optional
        Search radius; by default it is taken from the scatter of the pairs, ring by ring around the
        middle of the detector (`search_radius`), below that where chance takes over.
    mirrored : sequence of bool, optional
        True to take the catalogue with the sign of u changed; of several, those that follow are
        tried where the first matches no exposure.  East of a sky with north up is to the left: a
        detector that is read out as the sky is seen has the parity that is opposite to (u, v) of a
        tangent plane.

    Returns
    -------
    CampaignMatches

    Raises
    ------
    InputError
        When an exposure is not in the log or stands in two lists.  When more than a fifth of them
        are left out, the first two, or one that would match by another scale or as a mirror image:
        with the best number of coincidences.  When in most exposures one chip does not match where
        another does.
    """
    check_campaign(lists, log, catalog)
    cuts = StarCuts() if cuts is None else cuts
    passed = [cuts.passed(one) for one in lists]
    chips = sorted({chip for one in lists for chip in one.chips})
    mean_epoch = float(np.mean([log[one.name].epoch for one in lists]))
    views = [_View(catalog, one, mean_epoch) for one in mirrored]

    def attempt(one: Detections, cut: tuple[Bool, dict[str, int]], views: list[_View]) -> _Outcome:
        good, rejected = cut
        exposure = log[one.name]
        plane = _started(start, one, exposure.epoch)
        match = partial(
            match_exposure,
            one,
            good,
            plane,
            exposure=exposure,
            chips=chips,
            rejected=rejected,
            radius=radius,
            source=one.where,
        )
        try:
            if not good.any():
                raise all_cut(one, rejected)
            return _matched(match, views, exposure.epoch)
        except InputError as error:
            return error

    found: list[ExposureMatch] = []
    failed: dict[str, InputError] = {}
    outcomes = _in_turn(attempt, zip(lists, passed, strict=True), views)
    for one, (good, _), outcome in zip(lists, passed, outcomes, strict=True):
        if not isinstance(outcome, InputError):
            pairs, views = outcome[0], [outcome[1]]
            found.append(pairs)
            continue
        reason = ""
        if good.any() and not found and not failed:
            plane = _started(start, one, log[one.name].epoch)
            reason = mismatch_reason(plane, one.mag, views[0].index)
        failed[one.name] = outcome
        if reason or too_many(len(failed), len(found), len(lists)):
            raise failure(failed, reason, len(lists), mirrored) from outcome
    refuse_astray([one.report for one in found], catalog)
    matched = [one for one in lists if one.name not in failed]
    shown = catalog.mirrored() if views[0].mirrored else catalog
    table = _table(matched, log, shown, found)
    if failed:
        n = sum(len(one) for one in lists) - table.n_rows
        table = table.with_counts(table.n_rows + n, {**table.rejected, _LEFT_OUT: n})
    left_out = {k: e.cause for k, e in failed.items()}
    reports = tuple(one.report for one in found)
    return CampaignMatches(table, reports, left_out, views[0].mirrored)


_Outcome: TypeAlias = "tuple[ExposureMatch, _View] | InputError"


def _in_turn(
    attempt: Callable[..., _Outcome],
    lists: Iterable[tuple[Detections, Any]],
    views: list[_View],
) -> Iterator[_Outcome]:
    """Outcomes for the lists: one by one until one matches in a parity, the others on all cores."""
    rest = iter(lists)
    for one in rest:
        outcome = attempt(*one, views)
        yield outcome
        if not isinstance(outcome, InputError):
            views = [outcome[1]]
            break
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield from pool.map(lambda one: attempt(*one, views), rest)


class _View:
    """Catalogue in one of its parities, at any epoch."""

    def __init__(self, catalog: ReferenceCatalog, mirrored: bool, mean_epoch: float) -> None:
        self.mirrored = mirrored
        self._catalog, self._mean_epoch = catalog, mean_epoch

    def at(self, epoch: float) -> ReferenceCatalog:
        """Catalogue as seen at an epoch."""
        then = self._catalog if self._catalog.pm_u is None else self._catalog.as_seen(epoch)
        return then.mirrored() if self.mirrored else then

    @cached_property
    def index(self) -> PatternIndex:
        """Patterns at the mean epoch: motions of some years do not change shapes of triangles."""
        mean = self.at(self._mean_epoch)
        return pattern_index(np.column_stack([mean.u, mean.v]), mean.mag)


def _matched(
    match: Callable[[ReferenceCatalog, PatternIndex], ExposureMatch],
    views: Sequence[_View],
    epoch: float,
) -> tuple[ExposureMatch, _View]:
    """Match with the first of these views that gives one; else the error of the first view."""
    errors = []
    for view in views:
        try:
            return match(view.at(epoch), view.index), view
        except InputError as error:
            errors.append(error)
    first = errors[0]
    if len(errors) == 1:
        raise first
    cause = f"{first.cause}, and the mirror image does not match either"
    raise InputError(cause, where=first.where, do=first.do.replace(", the parity and", " and"))


def _started(start: Start, stars: Detections, epoch: float) -> Float:
    plane = np.ascontiguousarray(start(stars.x, stars.y, stars.chip, epoch), np.float64)
    if plane.shape != (len(stars), 2) or not np.isfinite(plane).all():
        raise InputError(
            f"the known distortion gives shape {plane.shape} or values that are not finite, "
            f"where ({len(stars)}, 2) finite ones are expected",
            where=stars.where,
            do="correct the function 'start'",
        )
    return plane


def _table(
    lists: Sequence[Detections],
    log: ExposureLog,
    catalog: ReferenceCatalog,
    found: Sequence[ExposureMatch],
) -> Matches:
    """Table of all matches, with the columns that every list has."""
    reports = [one.report for one in found]
    sizes = [len(match.index) for match in found]

    def joined(values: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([one[m.index] for one, m in zip(values, found, strict=True)])

    each = np.repeat(np.arange(len(lists)), sizes)
    filters, filter_names = encoded(np.array([log[one.name].filter for one in lists]))
    files, sources = encoded(np.array([one.source for one in lists]))
    chip, chip_numbers = encoded(joined([one.chip for one in lists]), ordered=True)
    mags = [one.mag for one in lists if one.mag is not None]
    unmatched = sum(one.detected - sum(one.rejected.values()) - one.matched for one in reports)
    rejected = merged_counts([one.rejected for one in reports])
    if unmatched:
        rejected[_UNMATCHED] = unmatched
    star = np.concatenate([match.catalog_index for match in found])
    sigmas: dict[str, Any] = {}
    if catalog.sigma_u is not None:
        pairs = [required(m.sigma, "a match has no errors") for m in found]
        sigmas["sigma_u"] = np.concatenate([pair[0] for pair in pairs])
        sigmas["sigma_v"] = np.concatenate([pair[1] for pair in pairs])
    return Matches(
        x=joined([one.x for one in lists]),
        y=joined([one.y for one in lists]),
        u=np.concatenate([match.u for match in found]),
        v=np.concatenate([match.v for match in found]),
        **sigmas,
        unit=catalog.unit,
        epoch=np.array([log[one.name].epoch for one in lists])[each],
        mag=joined(mags) if len(mags) == len(lists) else None,
        exposure=each,
        exposure_names=tuple(one.name for one in lists),
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
