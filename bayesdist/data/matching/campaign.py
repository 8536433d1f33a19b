"""Match the star lists of a campaign's exposures with one catalogue, without relying on a WCS.

The known distortion projects raw positions to a plane. Triangles of bright stars give rotation and
shift. A linear map is iterated while the search radius shrinks, and a cubic per chip fits the
remaining distortion. Matches are mutual nearest neighbours within a radius that is derived from
their distances. The transformations are used only for the matching: the results are raw pixels with
catalogue positions (Kozhurina-Platais et al. (2015), Section 4.1).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, TypeAlias

import numpy as np
from astropy.table import Table
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.columns import merged_counts
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
_STEP = 0.5  # pixels, over which the known distortion is differentiated


@dataclass(frozen=True, eq=False)
class CampaignMatches:
    """Matches of a campaign.

    Parameters
    ----------
    table : Matches
        Raw pixels with catalogue positions at the epoch of each exposure. `sigma_u`, `sigma_v` and
        `rho_uv` are the errors of these positions, together with those of the centroids if all
        lists have them.
    reports : tuple of ExposureReport
        Reports in the order of the lists.
    left_out : dict of str to str
        Exposures that did not match, and the reason for each.
    mirrored : bool
        True if u has the opposite sign to that in the catalogue.
    """

    table: Matches
    reports: tuple[ExposureReport, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)
    mirrored: bool = False

    def warnings(self, log: ExposureLog) -> list[str]:
        """Warnings about the matching, see `match_warnings`."""
        return match_warnings(self.reports, self.left_out, log)

    def summary(self) -> Table:
        """Reports as a table with one row per exposure.

        It has a column for each chip, and one for each reason for which detections were rejected.
        """
        chips = sorted({chip for report in self.reports for chip in report.per_chip})
        reasons = list(
            dict.fromkeys(reason for report in self.reports for reason in report.rejected)
        )
        rows: dict[str, list[Any]] = {}
        simple = ("exposure", "filter", "epoch", "detected")
        for name in simple:
            rows[name] = [getattr(report, name) for report in self.reports]
        for reason in reasons:
            rows[reason] = [report.rejected.get(reason, 0) for report in self.reports]
        for name in ("matched", "expected", "completeness", "false_rate", "false_fraction"):
            rows[name] = [getattr(report, name) for report in self.reports]
        for chip in chips:
            rows[f"chip {chip}"] = [report.per_chip.get(chip, 0) for report in self.reports]
        for name in ("rotation", "scale", "rms", "coincidences"):
            rows[name] = [getattr(report, name) for report in self.reports]
        for k, name in enumerate(("offset_u", "offset_v")):
            rows[name] = [report.offset[k] for report in self.reports]
        for k, name in enumerate(("radius_min", "radius_max")):
            rows[name] = [report.radius[k] for report in self.reports]
        rows["zero_point"] = [
            np.nan if report.zero_point is None else report.zero_point for report in self.reports
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

    Exposures that do not match, or that have no detections after the cuts, are left out and
    counted.

    Parameters
    ----------
    lists : sequence of Detections
        Star lists, one per exposure.
    log : ExposureLog
        Log with the epochs and filters of the exposures.
    catalog : ReferenceCatalog
        Reference stars. They are moved to the epoch of each exposure and displaced by their
        parallaxes. Positions remain relative to the origin of the catalogue.
    start : callable
        Known distortion: ``start(x, y, chip, epoch)`` returns positions (N, 2) for raw pixels and
        chip numbers, on one plane for all chips, in the catalogue's unit, with any rotation and
        origin. It is called by several threads at the same time.
    cuts : StarCuts, optional
        Cuts on the detections to be matched; none by default. Detections that fail the cuts are
        still used to recognise the field.
    radius : float, optional
        Search radius. By default it is derived from the scatter of the pairs in rings around the
        middle of the detector (`search_radius`), and is limited to radii with few chance matches.
    mirrored : sequence of bool, optional
        True uses the catalogue with the sign of u reversed. If several values are given, they are
        tried in turn until an exposure matches. On the sky with north up, east is to the left: a
        detector that shows the sky in this orientation has the opposite parity to (u, v) on a
        tangent plane.

    Returns
    -------
    CampaignMatches
        Matches of all exposures that match, with reports.

    Raises
    ------
    InputError
        If an exposure is not in the log or occurs in two lists. If more than a fifth of the
        exposures fail, if the first two fail, or if the first one would match with another scale or
        as a mirror image: the message gives the best number of coincidences. If in most exposures
        one chip does not match although another one does.
    """
    check_campaign(lists, log, catalog)
    cuts = StarCuts() if cuts is None else cuts
    passed = [cuts.passed(stars) for stars in lists]
    chips = sorted({chip for stars in lists for chip in stars.chips})
    mean_epoch = float(np.mean([log[stars.name].epoch for stars in lists]))
    views = [_View(catalog, is_mirrored, mean_epoch) for is_mirrored in mirrored]

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

    exposure_matches: list[ExposureMatch] = []
    failed: dict[str, InputError] = {}
    outcomes = _in_turn(attempt, zip(lists, passed, strict=True), views)
    for one, (good, _), outcome in zip(lists, passed, outcomes, strict=True):
        if not isinstance(outcome, InputError):
            pairs, views = outcome[0], [outcome[1]]
            exposure_matches.append(pairs)
            continue
        reason = ""
        if good.any() and not exposure_matches and not failed:
            plane = _started(start, one, log[one.name].epoch)
            reason = mismatch_reason(plane, one.mag, views[0].index)
        failed[one.name] = outcome
        if reason or too_many(len(failed), len(exposure_matches), len(lists)):
            raise failure(failed, reason, len(lists), mirrored) from outcome
    refuse_astray([match.report for match in exposure_matches], catalog)
    matched = [stars for stars in lists if stars.name not in failed]
    shown = catalog.mirrored() if views[0].mirrored else catalog
    table = _table(matched, log, shown, exposure_matches, start)
    if failed:
        n = sum(len(stars) for stars in lists) - table.n_rows
        table = table.with_counts(table.n_rows + n, {**table.rejected, _LEFT_OUT: n})
    left_out = {k: e.cause for k, e in failed.items()}
    reports = tuple(match.report for match in exposure_matches)
    return CampaignMatches(table, reports, left_out, views[0].mirrored)


_Outcome: TypeAlias = "tuple[ExposureMatch, _View] | InputError"


def _in_turn(
    attempt: Callable[..., _Outcome],
    lists: Iterable[tuple[Detections, Any]],
    views: list[_View],
) -> Iterator[_Outcome]:
    """Outcomes for the lists: one at a time until one matches, the remaining ones on all cores."""
    remaining = iter(lists)
    for stars in remaining:
        outcome = attempt(*stars, views)
        yield outcome
        if not isinstance(outcome, InputError):
            views = [outcome[1]]
            break
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield from pool.map(lambda one: attempt(*one, views), remaining)


class _View:
    """Catalogue in one parity, at any epoch."""

    def __init__(self, catalog: ReferenceCatalog, mirrored: bool, mean_epoch: float) -> None:
        self.mirrored = mirrored
        self._catalog, self._mean_epoch = catalog, mean_epoch

    def at(self, epoch: float) -> ReferenceCatalog:
        """Catalogue as seen at an epoch."""
        then = self._catalog if self._catalog.pm_u is None else self._catalog.as_seen(epoch)
        return then.mirrored() if self.mirrored else then

    @cached_property
    def index(self) -> PatternIndex:
        """Patterns at the mean epoch; motions of some years do not change shapes of triangles."""
        mean = self.at(self._mean_epoch)
        return pattern_index(np.column_stack([mean.u, mean.v]), mean.mag)


def _matched(
    match: Callable[[ReferenceCatalog, PatternIndex], ExposureMatch],
    views: Sequence[_View],
    epoch: float,
) -> tuple[ExposureMatch, _View]:
    """Match with the first view that succeeds; otherwise raise the error of the first view."""
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
    start: Start,
) -> Matches:
    """Table of all matches, with the optional columns that every list has."""
    reports = [exposure_match.report for exposure_match in found]
    sizes = [len(match.index) for match in found]

    def joined(values: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([column[m.index] for column, m in zip(values, found, strict=True)])

    each = np.repeat(np.arange(len(lists)), sizes)
    filters, filter_names = encoded(np.array([log[entry.name].filter for entry in lists]))
    files, sources = encoded(np.array([entry.source for entry in lists]))
    chip, chip_numbers = encoded(joined([entry.chip for entry in lists]), ordered=True)
    mags = [entry.mag for entry in lists if entry.mag is not None]
    unmatched = sum(
        entry.detected - sum(entry.rejected.values()) - entry.matched for entry in reports
    )
    rejected = merged_counts([entry.rejected for entry in reports])
    if unmatched:
        rejected[_UNMATCHED] = unmatched
    star = np.concatenate([match.catalog_index for match in found])
    errors: dict[str, Any] = {
        name: np.concatenate([match.errors[name] for match in found]) for name in found[0].errors
    }
    table = Matches(
        x=joined([entry.x for entry in lists]),
        y=joined([entry.y for entry in lists]),
        u=np.concatenate([match.u for match in found]),
        v=np.concatenate([match.v for match in found]),
        **errors,
        unit=catalog.unit,
        epoch=np.array([log[entry.name].epoch for entry in lists])[each],
        mag=joined(mags) if len(mags) == len(lists) else None,
        exposure=each,
        exposure_names=tuple(entry.name for entry in lists),
        chip=chip,
        chip_numbers=chip_numbers,
        filter=filters[each],
        filter_names=filter_names,
        star=catalog.star[star],
        row=joined([entry.row for entry in lists]),
        source=files[each],
        sources=sources,
        n_rows=sum(len(entry) for entry in lists),
        rejected=rejected,
        tangent_point=catalog.tangent_point,
    )
    centroids = [
        _in_uv(entry, log[entry.name].epoch, match, start)
        for entry, match in zip(lists, found, strict=True)
        if entry.covariances is not None
    ]
    if len(centroids) < len(lists):
        return table
    total = np.concatenate(centroids)
    return table.with_covariances(total if table.sigma_u is None else total + table.covariances())


def _in_uv(stars: Detections, epoch: float, match: ExposureMatch, start: Start) -> Float:
    """Covariances (n, 2, 2) of the centroids of matched stars, converted from pixels to u and v.

    The conversion is that of the known distortion, with the rotation and scale of the match.
    """
    matched = stars.select(match.index)
    J = np.empty((len(matched), 2, 2))
    for axis, name in enumerate(("x", "y")):
        low, high = (
            _started(start, replace(matched, **{name: getattr(matched, name) + by}), epoch)
            for by in (-_STEP, _STEP)
        )
        J[:, :, axis] = (high - low) / (2 * _STEP)
    angle = np.radians(match.report.rotation)
    c, s = match.report.scale * np.cos(angle), match.report.scale * np.sin(angle)
    J = np.array([[c, -s], [s, c]]) @ J
    return np.asarray(J @ required(matched.covariances, "no errors") @ np.swapaxes(J, 1, 2))
