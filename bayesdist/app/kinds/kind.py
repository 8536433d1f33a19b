"""The three kinds of runs, which differ in all that comes before the posterior."""

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
    """Matched stars, a campaign, or a self-calibration.

    Each takes configurations, inputs and matches of its own types.
    """

    # of (config, base): all that a run begins with, its inputs; paths are relative to `base`
    read: Callable[[Any, Path], Any]
    # of (inputs, config): stars that are fitted, and those that are held out
    match: Callable[[Any, Any], Matched]
    # of (matched, config, base, reader): the least-squares solution
    fit: Callable[[Any, Any, Path, StarReader], Fitted]
    # of (data, config, folder=, progress=): the posterior of the fit; checkpoints are in the folder
    sample: Callable[..., Posterior] = sample_stars
    # of (folder, inputs, summary): the matches of an earlier stage, from a run's folder and its
    # summary.json; without it they are matched again
    load_matched: Callable[[Path, Any, Mapping[str, Any]], Matched] | None = None
    # of (folder, matched): the fit of an earlier stage; `matched` is called where that needs the
    # matches
    load_fitted: Callable[[Path, Callable[[], Any]], Fitted] = lambda folder, _: load_fitted(folder)
    # of inputs: refuses what does not go together; what is wrong with matched stars shows in their
    # fit
    refuse: Callable[[Any], None] = lambda inputs: None
    # of inputs: what `check` says of them; None where the fit says more
    lines: Callable[[Any], Iterator[str] | None] = lambda inputs: None
    # of inputs: shape of the solution, from which files are made on trial before stars are matched;
    # None where the fit serves for that
    outline: Callable[[Any], Outline] | None = None
    begins_with: str = "match"  # its first stage: 'match', or 'fit' where stars are matched already
    rows: str = "stars"  # what a row of the data is, in words
    chooser: str = "least-squares fit"  # what leaves out rows that are far off, in words


MATCHES = Kind(read=read_stars, match=match_stars, fit=fit_stars, begins_with="fit")


@cache
def _campaign() -> Kind:
    """A campaign; like self-calibrations it is imported where there is one."""
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
    """The kind of run that a configuration is of."""
    if config.campaign is not None:
        return _campaign()
    return _selfcal() if config.selfcal is not None else MATCHES
