"""Lines of `bayesdist check` on a self-calibration: its stars, and directions that stay free."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayesdist.app.screen import number
from bayesdist.app.selfcal.gauge import CONVENTION, fixed_by
from bayesdist.app.selfcal.inputs import Inputs
from bayesdist.app.selfcal.matching import (
    calibrated,
    exposure_table,
    matching_facts,
    refuse_unconnected,
)
from bayesdist.infer.selfcal.gauge import NamedDirection

__all__ = ["selfcal_lines"]


def selfcal_lines(inputs: Inputs) -> Iterator[str]:
    """Stars and free directions of a self-calibration, as lines of text: nothing is sampled."""
    found = calibrated(inputs, lambda text: None)
    s, gauge, model = found.mode, found.gauge, found.mode.problem.model
    refuse_unconnected(exposure_table(found, inputs))
    summary = matching_facts(found, inputs)
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
    n, held = gauge.null.shape[1], gauge.open.shape[1]
    yield f"null space   {n} directions are free, {held} of them held by convention"
    for one in gauge.directions:
        if one.free or one.weak:
            yield f"             {_state_words(one, fixed[one.name])}"
    for sigma, k in gauge.weakest:
        yield f"nearly free  {number(sigma)} pix at the edge, led by {model.names[int(k)]}"
    for text in (*gauge.sentences, *summary["warnings"]):
        yield f"WARNING      {text[0].upper() + text[1:]}"


def _state_words(one: NamedDirection, by: str) -> str:
    """Error of a direction by the detections, its constraint, and its error then."""
    known = "" if one.free else f", {number(one.sigma)} {one.unit} from detections".rstrip()
    how = "held by convention" if by == CONVENTION else f"fixed by {by}"
    size = "" if by == CONVENTION else f", sigma {number(one.sigma_fixed)} {one.unit}".rstrip()
    return f"{one.name}{known}: {how}{size}"
