"""The three kinds of runs, which differ in every step before the posterior."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import StarReader
from bayesdist.app.kinds.fitted import Fitted, load_fitted
from bayesdist.app.kinds.matched import Matched, Outline
from bayesdist.app.kinds.matches.stars import (
    fit_stars,
    match_stars,
    read_stars,
    sample_stars,
)
from bayesdist.infer import Posterior


@dataclass(frozen=True)
class Kind:
    """Functions that implement one kind of run: matched stars, a campaign, or a self-calibration.

    Configurations, inputs and matches have different types for each kind.

    Parameters
    ----------
    read : callable
        ``read(config, base)`` reads the inputs of a run; paths are relative to the folder `base`.
    match : callable
        ``match(inputs, config)`` returns the fitted and the held-out stars.
    fit : callable
        ``fit(matched, config, base, reader)`` returns the least-squares solution.
    sample : callable
        ``sample(data, config, folder=, progress=)`` returns the posterior of a fit; checkpoints are
        written to `folder`.
    load_matched : callable, optional
        ``load_matched(folder, inputs, summary)`` loads the matches of an earlier stage from the
        folder of a run and its summary.json.  None if the stars are matched again instead.
    load_fitted : callable
        ``load_fitted(folder, matched)`` loads the fit of an earlier stage; `matched` is a function
        that returns the matches, called only if they are needed.
    refuse : callable
        ``refuse(inputs)`` raises InputError if the inputs are inconsistent.  Problems of matched
        stars are found by their fit.
    lines : callable
        ``lines(inputs)`` returns the lines that the command `check` prints about the inputs, or
        None if those about the fit are more informative.
    outline : callable, optional
        ``outline(inputs)`` returns the shape of the solution, from which products are written on
        trial before stars are matched.  None if the fit is used for that.
    begins_with : str
        First stage: 'match', or 'fit' if the stars are matched already.
    rows : str
        Word for the rows of the data.
    chooser : str
        Words for the step that rejects outlying rows.
    """

    read: Callable[[Any, Path], Any]
    match: Callable[[Any, Any], Matched]
    fit: Callable[[Any, Any, Path, StarReader], Fitted]
    sample: Callable[..., Posterior] = sample_stars
    load_matched: Callable[[Path, Any, Mapping[str, Any]], Matched] | None = None
    load_fitted: Callable[[Path, Callable[[], Any]], Fitted] = lambda folder, _: load_fitted(folder)
    refuse: Callable[[Any], None] = lambda inputs: None
    lines: Callable[[Any], Iterator[str] | None] = lambda inputs: None
    outline: Callable[[Any], Outline] | None = None
    begins_with: str = "match"
    rows: str = "stars"
    chooser: str = "least-squares fit"


MATCHES = Kind(read=read_stars, match=match_stars, fit=fit_stars, begins_with="fit")


@cache
def _campaign() -> Kind:
    """Functions of a campaign; imported only when needed, as those of self-calibrations."""
    from bayesdist.app.kinds.campaign.fit import fit_campaign
    from bayesdist.app.kinds.campaign.input_validation import refuse_campaign
    from bayesdist.app.kinds.campaign.inputs import outline_of_campaign, read_campaign
    from bayesdist.app.kinds.campaign.matched import load_matched_campaign
    from bayesdist.app.kinds.campaign.matching import campaign_lines, match_lists

    return Kind(
        read=read_campaign,
        match=lambda inputs, _: match_lists(inputs),
        fit=lambda matched, *_: fit_campaign(matched),
        load_matched=load_matched_campaign,
        refuse=refuse_campaign,
        lines=campaign_lines,
        outline=outline_of_campaign,
    )


@cache
def _selfcal() -> Kind:
    """Functions of a self-calibration."""
    from bayesdist.app.kinds.selfcal.fit import fit_selfcal, load_selfcal, sample_detections
    from bayesdist.app.kinds.selfcal.inputs import outline_of_selfcal, read_selfcal, refuse_selfcal
    from bayesdist.app.kinds.selfcal.matched import load_matched_selfcal
    from bayesdist.app.kinds.selfcal.matching import match_dithers, selfcal_lines

    return Kind(
        read=read_selfcal,
        match=lambda inputs, _: match_dithers(inputs),
        fit=lambda matched, *_: fit_selfcal(matched),
        sample=sample_detections,
        load_matched=load_matched_selfcal,
        load_fitted=load_selfcal,
        refuse=refuse_selfcal,
        lines=selfcal_lines,
        outline=outline_of_selfcal,
        rows="detections",
        chooser="limits of residuals",
    )


def kind_of(config: Config) -> Kind:
    """Kind of run that a configuration describes."""
    if config.campaign is not None:
        return _campaign()
    return _selfcal() if config.selfcal is not None else MATCHES
