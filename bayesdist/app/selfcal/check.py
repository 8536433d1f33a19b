"""What a self-calibration would begin with, and what it could not tell."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.app.screen import number
from bayesdist.app.selfcal.gauge import CONVENTION, fixed_by
from bayesdist.app.selfcal.given import Given
from bayesdist.app.selfcal.matching import calibrated, matching_of

__all__ = ["selfcal_lines"]


def selfcal_lines(given: Given) -> Iterator[str]:
    """Stars and free directions of a self-calibration, as lines of text: nothing is sampled."""
    found = calibrated(given, lambda text: None)
    s, gauge, model = found.mode, found.gauge, found.mode.problem.model
    matching = matching_of(found, given.inputs, given.block.min_detections)
    matching.refuse_strangers()
    summary = matching.summary
    fixed = fixed_by(gauge, s, given.known_for(model))
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
    if given.tangent_plane is None:
        yield "sky          taken as flat: detector.scale_mas, the size of a pixel, is not given"
    else:
        moved = summary["tangent_planes_pix"]
        yield f"sky          tangent planes taken to one: detections move by up to {moved:.2g} pix"
    error = float(np.sqrt(np.median(s.problem.var) + s.mixture.jitter**2))
    yield f"errors       {number(error)} pix at the median, {number(s.mixture.fraction)} false"
    yield f"model        order {model.order}, frames '{model.frames}', {model.n_params} parameters"
    n, held = gauge.null.shape[1], gauge.open.shape[1]
    yield f"null space   {n} directions are free, {held} of them held by convention"
    for one in gauge.directions:
        if one.free or one.weak:
            yield f"             {_told(one, fixed[one.name])}"
    for sigma, k in gauge.weakest:
        yield f"nearly free  {number(sigma)} pix at the edge, led by {model.names[int(k)]}"
    for text in (*gauge.sentences, *summary["warnings"]):
        yield f"WARNING      {text[0].upper() + text[1:]}"


def _told(one, by: str) -> str:  # type: ignore[no-untyped-def]
    known = "" if one.free else f", {number(one.sigma)} {one.unit} from detections".rstrip()
    how = "held by convention" if by == CONVENTION else f"fixed by {by}"
    size = "" if by == CONVENTION else f", sigma {number(one.sigma_fixed)} {one.unit}".rstrip()
    return f"{one.name}{known}: {how}{size}"
