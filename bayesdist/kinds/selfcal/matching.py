"""Matching of the detections of a self-calibration to stars, exposure by exposure.

Matched detections can be used for the same statistics of residuals, maps and diagrams as the
matches of other runs.  The stars are fitted to their detections, so that residuals are smaller than
the errors by the corresponding degrees of freedom.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from astropy.table import Table

from bayesdist.app.parts import Part
from bayesdist.app.run import Run
from bayesdist.app.screen import number
from bayesdist.data import MagnitudeErrors
from bayesdist.data.detections import NO_STAR, Detections
from bayesdist.data.matches import Matches
from bayesdist.data.matching.pairs import hull_of, inside_hull
from bayesdist.errors import DegenerateError, InputError, NotSettledError
from bayesdist.files.documents import json_of
from bayesdist.files.faults import restoring
from bayesdist.files.hdf5 import read_arrays, write_arrays
from bayesdist.infer.solution.geometry import geometries
from bayesdist.kinds.selfcal.gauge import CONVENTION, fixed_by
from bayesdist.kinds.selfcal.infer import SelfCalibration, SelfCalibrationMode
from bayesdist.kinds.selfcal.infer.calibrate import scatter_by_magnitude, self_calibrate
from bayesdist.kinds.selfcal.infer.elimination import Mixture, memberships, one_cluster
from bayesdist.kinds.selfcal.infer.gauge import NamedDirection
from bayesdist.kinds.selfcal.infer.problem import Problem, places_of
from bayesdist.kinds.selfcal.inputs import SelfcalInputs
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Bool, Float, Int

log = logging.getLogger("bayesdist")

FEW_COMMON = 0.5  # of the median fraction of common detections: fewer are refused
HALF_TURN = np.radians(10.0)  # radians: tolerance on a rotation by 180 degrees
TURN_BACK = "turn its pixels back by 180 degrees if they were turned, or leave it out"
AMBIGUOUS = 0.05  # fraction of ambiguous groups above which there is a warning


def match_dithers(run: Run) -> Run:
    """Match detections of dithered exposures to stars, with a first solution."""
    inputs: SelfcalInputs = run.inputs
    calibration = calibrated(inputs, lambda text: log.info("match: %s", text))
    table, facts = exposure_table(calibration, inputs), matching_facts(calibration, inputs)
    refuse_unconnected(table)
    for text in facts["warnings"]:
        log.warning("match: WARNING: %s", text)
    log.info(
        "match: %d stars of %d of %d detections in %d exposures, %d ambiguous groups",
        facts["n_stars"],
        facts["detections"]["used"],
        facts["detections"]["read"],
        facts["n_exposures"],
        facts["n_ambiguous"],
    )
    s = calibration.mode
    if inputs.tangent_plane is not None:
        moved = facts["tangent_planes_pix"]
        log.info("match: detections moved by up to %.2g pix onto one tangent plane", moved)
    return with_detections(
        run,
        calibration.detections,
        s.problem.model,
        (s.theta, s.stars, s.mixture),
        facts=facts,
        table=table,
    )


def calibrated(inputs: SelfcalInputs, report: Callable[[str], None]) -> SelfCalibration:
    """Stars and solution of a self-calibration.

    `report` is called with text about the progress.  If the solution does not settle and one
    exposure is rotated by 180 degrees with respect to all others, the error names that exposure.
    """
    (model, theta), block = inputs.start, inputs.config.selfcal
    try:
        with one_cluster(inputs.config.resources()) as compute:
            return self_calibrate(
                model,
                inputs.detections,
                theta,
                prior_at=inputs.known_for(model),
                match_radius=block.match_radius,
                start_radius=block.start_radius,
                min_detections=block.min_detections,
                motion=block.motion,
                parallax_factors=inputs.parallax_factors,
                dilation=inputs.dilation,
                jitter=inputs.jitter,
                references=inputs.references,
                plane=inputs.tangent_plane,
                max_iterations=block.max_iterations,
                log=report,
                compute=compute,
            )
    except (NotSettledError, DegenerateError) as error:
        frames = [model.frame(theta, e)[0] for e in range(len(model.exposures))]
        turned = rolled_180(np.array([np.arctan2(M[1, 0], M[0, 0]) for M in frames]))
        if not turned:
            raise
        name = model.exposures[turned[0]]
        raise InputError(
            f"{error.cause}, and exposure {name} lies half a turn from all the others",
            where="selfcal.lists",
            do=TURN_BACK,
        ) from error


def rolled_180(rolls: Float) -> list[int]:
    """Exposures rotated by 180 degrees with respect to all others; empty for fewer than three."""
    if len(rolls) < 3:
        return []
    off = np.abs(np.angle(np.exp(1j * (rolls[:, None] - rolls)))) - np.pi
    np.fill_diagonal(off, 0.0)
    return np.flatnonzero((np.abs(off) < HALF_TURN).all(axis=1)).tolist()


def exposure_table(found: SelfCalibration, inputs: SelfcalInputs) -> Table:
    """One row per exposure: its detections, those in common with others, rms in pixels, frame.

    'overlapping' counts detections within the field of other exposures.  'common' counts those of
    them with a star that other exposures detected, too.  'fraction_common' is their ratio.
    """
    s, d = found.mode, found.detections
    p, model, E = s.problem, s.problem.model, len(d.exposure_names)
    used = np.zeros(len(d), bool)
    used[p.rows] = True
    places = places_of(model, d, s.theta, inputs.dilation)
    overlaps = _seen_by_others(model, s.theta, places, d.exposure)
    total, overlap, common = (
        np.bincount(d.exposure[mask], minlength=E)
        for mask in (np.ones(len(d), bool), overlaps, used & overlaps)
    )
    w = memberships(p, s.theta, s.mixture, s.stars)
    square = p.squares(s.theta, s.stars)
    exposure = d.exposure[p.rows]
    weight = np.bincount(exposure, w, minlength=E)
    rms = np.sqrt(np.bincount(exposure, w * square, minlength=E) / np.maximum(2 * weight, 1e-9))
    frames = [model.frame(s.theta, e) for e in range(E)]
    units = {"rms": "pix", "shift_u": model.unit, "shift_v": model.unit, "rotation": "deg"}
    columns = {
        "exposure": list(d.exposure_names),
        "detections": total,
        "overlapping": overlap,
        "common": common,
        "fraction_common": common / np.maximum(overlap, 1),
        "rms": rms,
        "shift_u": [shift[0] for _, shift in frames],
        "shift_v": [shift[1] for _, shift in frames],
        "rotation": [np.degrees(np.arctan2(M[1, 0], M[0, 0])) for M, _ in frames],
    }
    return Table(columns, units=units)


def refuse_unconnected(table: Table) -> None:
    """Refuse an exposure that hardly shares stars with the others where they overlap."""
    share = np.asarray(table["fraction_common"], float)
    if len(share) < 3:  # with two exposures it is unknown which one is wrong
        return
    usual = np.array([np.nanmedian(np.delete(share, k)) for k in range(len(share))])
    unconnected = share < FEW_COMMON * usual
    if not unconnected.any():
        return
    k = int(np.nanargmin(np.where(unconnected, share / usual, np.nan)))
    name = str(table["exposure"][k])
    half = k in rolled_180(np.radians(np.asarray(table["rotation"], float)))
    turned = ", and it lies half a turn from all the others" if half else ""
    raise InputError(
        f"exposure {name} has {100 * share[k]:.0f} % of its detections where others look in common "
        f"with them, but the usual fraction is {100 * usual[k]:.0f} %{turned}",
        where="selfcal.lists",
        do=TURN_BACK
        if half
        else "check its pixels and its commanded offset and roll, or leave it out",
    )


class TangentPlaneFacts(TypedDict):
    """Tangent points of exposures and stars."""

    chip: int  # number of the chip with the tangent points of the exposures
    pixel: list[float]  # tangent point of each exposure: (x, y), FITS 1-based
    contact: list[float]  # tangent point of the stars (u, v)
    unit: str  # of the contact


class DetectionCounts(TypedDict):
    """Numbers of detections; `cut` and `unused` are by reason."""

    read: int
    cut: dict[str, int]
    used: int
    unused: dict[str, int]


class PerStar(TypedDict):
    """Number of detections of a star."""

    median: float
    most: int


class MatchingFacts(TypedDict):
    """Section 'selfcal' of summary.json, as the stage 'match' writes it."""

    n_exposures: int
    n_stars: int
    n_ambiguous: int
    n_doubled: int
    n_chains: int
    iterations: int
    match_radius: float  # pixels
    tangent_plane: TangentPlaneFacts | None  # None if the sky is flat
    tangent_planes_pix: float  # largest displacement onto the common tangent plane
    detections: DetectionCounts
    per_star: PerStar
    warnings: list[str]


def matching_facts(found: SelfCalibration, inputs: SelfcalInputs) -> MatchingFacts:
    """Section 'selfcal' of summary.json: numbers of detections and stars."""
    d, friends, p = found.detections, found.friends, found.mode.problem
    raw = inputs.detections  # before they were moved onto a common tangent plane
    counts = np.bincount(d.star[d.star != NO_STAR], minlength=friends.n_stars)
    too_few = (counts > 1) & (counts < inputs.config.selfcal.min_detections)
    unused = {
        "of a star that one exposure alone has": int((counts == 1).sum()),
        "of a star with too few detections": int(counts[too_few].sum()),
        "second detection of a star in an exposure": friends.n_dropped,
        "in a chain of several stars": int((d.star == NO_STAR).sum()) - friends.n_dropped,
    }
    warnings = []
    if friends.n_ambiguous > AMBIGUOUS * max(p.n_stars, 1):
        warnings.append(
            f"{friends.n_ambiguous} groups of detections are ambiguous beside {p.n_stars} stars: "
            "the field is crowded for this match radius"
        )
    if inputs.catalog is not None and inputs.catalog.pm_u is not None and p.dates is None:
        warnings.append(
            "the reference stars have proper motions, and the exposures have no dates: the stars "
            "are taken where they were at the epoch of their catalogue; give selfcal.exposures "
            "with dates"
        )
    return {
        "n_exposures": len(d.exposure_names),
        "n_stars": p.n_stars,
        "n_ambiguous": friends.n_ambiguous,
        "n_doubled": friends.n_doubled,
        "n_chains": friends.n_chains,
        "iterations": found.iterations,
        "match_radius": p.match_radius,
        "tangent_plane": tangent_plane_facts(found, inputs),
        "tangent_planes_pix": float(np.hypot(d.x - raw.x, d.y - raw.y).max()),
        "detections": {
            "read": inputs.n_read,
            "cut": dict(inputs.rejected),
            "used": len(p),
            "unused": {reason: count for reason, count in unused.items() if count},
        },
        "per_star": {"median": float(np.median(p.counts)), "most": int(p.counts.max())},
        "warnings": warnings,
    }


def tangent_plane_facts(found: SelfCalibration, inputs: SelfcalInputs) -> TangentPlaneFacts | None:
    """Tangent points of exposures and stars, for summary.json; None if the sky is flat."""
    model = found.mode.problem.model
    contact = inputs.contact(model, found.mode.theta)
    if contact is None:
        return None
    chip = model.chips[0]
    return {
        "chip": chip.number,
        "pixel": [float(z) for z in chip.reference_pixel],
        "contact": list(contact),
        "unit": model.unit,
    }


def _seen_by_others(model: DistortionModel, theta: Float, places: Float, exposure: Int) -> Bool:
    """Boolean mask (N,) of detections that fall on a chip of another exposure."""
    E = len(model.exposures)
    outlines = [
        [hull_of(_corners(model, theta, e, chip.number, chip.size))[0] for chip in model.chips]
        for e in range(E)
    ]
    out = np.zeros(len(places), bool)
    for e in range(E):
        rows = np.flatnonzero(exposure == e)
        inside = np.zeros(len(rows), bool)
        for k in range(E):
            if k != e:
                for outline in outlines[k]:
                    inside |= inside_hull(places[rows], outline)
        out[rows] = inside
    return out


def _corners(
    model: DistortionModel, theta: Float, exposure: int, chip: int, size: tuple[float, float]
) -> Float:
    x, y = (0.5 + n * np.array(c) for n, c in zip(size, ([0, 1, 1, 0], [0, 0, 1, 1]), strict=True))
    when = None if model.time is None else np.full(4, model.time.epoch0[0])
    return model.predict(theta, x, y, exposure=np.full(4, exposure), chip=chip, epoch=when)


def selfcal_lines(inputs: SelfcalInputs) -> Iterator[str]:
    """Lines of text about stars and free directions of a self-calibration, without sampling."""
    calibration = calibrated(inputs, lambda text: None)
    s, gauge, model = calibration.mode, calibration.gauge, calibration.mode.problem.model
    refuse_unconnected(exposure_table(calibration, inputs))
    summary = matching_facts(calibration, inputs)
    fixed = fixed_by(gauge, s, inputs.known_for(model))
    d = summary["detections"]
    cut = "".join(f", {count} {reason}" for reason, count in d["cut"].items())
    yield f"exposures    {summary['n_exposures']}"
    yield f"detections   {d['read']} read{cut}"
    for reason, count in d["unused"].items():
        yield f"             {count} {reason}"
    yield (
        f"stars        {summary['n_stars']} of {d['used']} detections, "
        f"{number(summary['per_star']['median'])} at the median; "
        f"{summary['n_ambiguous']} ambiguous groups"
    )
    if inputs.tangent_plane is None:
        yield "sky          taken as flat: detector.scale_mas, the size of a pixel, is not given"
    else:
        moved = summary["tangent_planes_pix"]
        yield f"sky          tangent planes taken to one: detections move by up to {moved:.2g} pix"
    error = float(np.sqrt(np.median(s.problem.var) + s.mixture.jitter**2))
    yield f"errors       {number(error)} pix at the median, {number(s.mixture.fraction)} false"
    yield f"model        order {model.order}, frames '{model.frames}', {model.n_params} parameters"
    chips = geometries(s.solution)
    for chip in chips:
        yield f"geometry     chip {chip.chip}: {chip.sentence}"
    n, held = gauge.null.shape[1], gauge.open.shape[1]
    yield f"null space   {n} directions are free, {held} of them held by convention"
    for direction in gauge.directions:
        if direction.free or direction.weak:
            yield f"             {_state_words(direction, fixed[direction.name])}"
    for motion in gauge.motions:
        yield f"             {motion.name} of the whole sky: {_held_words(fixed[motion.name])}"
    for sigma, k in gauge.weakest:
        yield f"nearly free  {number(sigma)} pix at the edge, led by {model.names[int(k)]}"
    doubtful = [text for chip in chips for text in chip.warnings]
    for text in gauge.settled:
        yield f"note         {text}"
    for text in (*gauge.unsettled, *summary["warnings"], *doubtful):
        yield f"WARNING      {text[0].upper() + text[1:]}"


def _state_words(one: NamedDirection, by: str) -> str:
    """Text with the error of a direction from the detections, its constraint and final error."""
    uncertainty = "" if one.free else f", {number(one.sigma)} {one.unit} from detections".rstrip()
    size = "" if by == CONVENTION else f", sigma {number(one.sigma_fixed)} {one.unit}".rstrip()
    return f"{one.name}{uncertainty}: {_held_words(by)}{size}"


def _held_words(by: str) -> str:
    """Clause on the source `by` that determines a direction."""
    return "held by convention" if by == CONVENTION else f"fixed by {by}"


def matches_of(
    problem: Problem,
    stars: Float,
    detections: Detections,
    inputs: SelfcalInputs,
    unused: Mapping[str, int],
) -> Matches:
    """Detections matched with their stars, in the frame of each exposure's own VAFACTOR.

    Parameters
    ----------
    problem : Problem
        Linearised at a solution.
    stars : ndarray, shape (S, q)
        Stars of the solution.
    detections : Detections
    inputs : SelfcalInputs
    unused : mapping of str to int
        Number of detections without a star, by reason.
    """
    p, d = problem, detections
    rows, model = p.rows, p.model
    places = p.star_places(stars)
    if p.dilation is not None:
        o = np.asarray(model.origin)
        places = o + (places - o) / p.dilation[d.exposure[rows], None]
    sigma = np.sqrt(p.var)[:, None] * _axes(p.W)
    numbers = np.array([chip.number for chip in model.chips])
    chip = np.zeros(len(rows), np.int64)
    for code, chip_number in enumerate(numbers[1:], start=1):
        chip[d.chip[rows] == chip_number] = code
    matches = Matches.of_distinct_rows(
        x=d.x[rows],
        y=d.y[rows],
        u=places[:, 0],
        v=places[:, 1],
        sigma_u=sigma[:, 0],
        sigma_v=sigma[:, 1],
        unit=model.unit,
        epoch=None if d.epoch is None else d.epoch[d.exposure[rows]],
        mag=None if d.mag is None else d.mag[rows],
        exposure=d.exposure[rows],
        exposure_names=d.exposure_names,
        chip=chip,
        chip_numbers=tuple(int(n) for n in numbers),
        row=rows,
        sources=(d.source,),
        n_rows=inputs.n_read,
        rejected={**inputs.rejected, **unused},
    )
    if p.shape is None:
        return matches
    W = p.W[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return matches.with_covariances(p.var[:, None, None] * np.linalg.inv(W))


def _axes(W: Float) -> Float:
    """Error along u and v (N, 2) that corresponds to one pixel: sqrt of the diagonal of W^-1."""
    det = W[:, 0] * W[:, 2] - W[:, 1] ** 2
    return np.sqrt(np.stack([W[:, 2], W[:, 0]], axis=1) / det[:, None])


def magnitude_errors_of(solution: SelfCalibrationMode, matches: Matches) -> MagnitudeErrors | None:
    """Centroid errors by magnitude in the unit of u, v; None if there are no magnitudes."""
    if matches.mag is None:
        return None
    p = solution.problem
    state = p, solution.theta, solution.mixture, solution.stars
    middles, sigma = scatter_by_magnitude(*state, matches.mag)
    sigma = sigma * p.model.pixel_size(solution.theta)
    edges = np.concatenate([[-np.inf], (middles[1:] + middles[:-1]) / 2, [np.inf]])
    n = np.histogram(matches.mag, edges, weights=memberships(*state))[0]
    return MagnitudeErrors(middles, sigma, sigma, n.astype(np.int64), sigma, sigma)


DETECTIONS = "detections.h5"
ARRAYS = ("x", "y", "star", "sigma", "theta", "stars", "mixture", "model")


@dataclass(frozen=True, eq=False)
class FirstSolution(Part):
    """Detections with their stars, and the first solution that matched them."""

    title = "matched detections"
    stage = "match"

    # with star codes and errors, on a common tangent plane
    detections: Detections
    problem: Problem  # linearised at this solution
    theta: Float  # (D,), parameters
    places: Float  # (S, q), stars
    mixture: Mixture  # errors

    def save(self, folder: Path) -> None:
        """Write the detections and the solution to the folder of a run."""
        names, m = ("x", "y", "star", "sigma"), self.mixture
        arrays = {name: getattr(self.detections, name) for name in names}
        arrays |= {"theta": self.theta, "stars": self.places}
        arrays["mixture"] = np.array([m.jitter, m.fraction])
        text = json.dumps(self.problem.model.to_dict())
        arrays["model"] = np.frombuffer(text.encode(), np.uint8)
        write_arrays(folder / DETECTIONS, "", arrays)


def unused_detections(facts: Mapping[str, Any]) -> dict[str, int]:
    """Number of detections without a star, by reason.

    `facts` is the section 'selfcal' of summary.json.
    """
    return dict(facts.get("detections", {}).get("unused", {}))


def load_matched_selfcal(run: Run) -> Run:
    """Run with the detections of an earlier stage, from its folder."""
    inputs: SelfcalInputs = run.inputs
    path, content = run.directory / DETECTIONS, "a file of detections"
    do = "run the stage 'match' again"
    arrays = read_arrays(path, "", content, ARRAYS, do=do)
    with restoring(path, content, do=do):
        text = arrays["model"].astype(np.uint8).tobytes().decode()
        model = DistortionModel.from_dict(json_of(text, str(path)))
        detections = replace(
            inputs.detections,
            x=arrays["x"],
            y=arrays["y"],
            star=arrays["star"].astype(np.int64),
            sigma=arrays["sigma"],
        )
        mixture = Mixture(*(float(value) for value in arrays["mixture"]))
    first = arrays["theta"], arrays["stars"], mixture
    facts = run.directory.summary.get("selfcal", {})
    return with_detections(run, detections, model, first, facts=facts)


def with_detections(
    run: Run,
    detections: Detections,
    model: DistortionModel,
    first: tuple[Float, Float, Mixture],
    *,
    facts: Mapping[str, Any],
    table: Table | None = None,
) -> Run:
    """Run with detections that are matched with their stars by a first solution.

    Parameters
    ----------
    run : Run
    detections : Detections
        With star codes and errors.
    model : DistortionModel
    first : tuple
        First solution: parameters (D,), stars (S, q) and outlier mixture.
    facts : mapping of str to object
        Section 'selfcal' of summary.json.
    table : Table, optional
        One row per exposure.
    """
    inputs: SelfcalInputs = run.inputs
    theta, places, mixture = first
    problem = inputs.problem(model, detections, theta, theta)
    return run.having(
        stars=matches_of(problem, places, detections, inputs, unused_detections(facts)),
        match_facts=facts,
        match_table=table,
        match_parts={"first": FirstSolution(detections, problem, theta, places, mixture)},
    )
