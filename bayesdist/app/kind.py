"""The three kinds of runs, which differ in all that comes before the posterior."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from bayesdist.app.campaign.fit import fit_campaign
from bayesdist.app.campaign.input_validation import refuse_campaign
from bayesdist.app.campaign.inputs import read_campaign
from bayesdist.app.campaign.matched import load_matched_campaign
from bayesdist.app.campaign.matching import match_lists
from bayesdist.app.campaign.preview import campaign_lines
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.fitted import Fitted, load_fitted
from bayesdist.app.kinds.matched import Matched
from bayesdist.app.kinds.reader import StarReader
from bayesdist.app.kinds.stars import (
    fit_stars,
    match_stars,
    priors_of,
    read_stars,
    sample_stars,
)
from bayesdist.app.selfcal.fit import fit_selfcal, sample_detections
from bayesdist.app.selfcal.inputs import read_selfcal, refuse_selfcal
from bayesdist.app.selfcal.matched import load_matched_selfcal
from bayesdist.app.selfcal.matching import match_dithers
from bayesdist.app.selfcal.preview import selfcal_lines
from bayesdist.app.selfcal.solved import read_solution, solved_of
from bayesdist.infer import Posterior

__all__ = ["Kind", "kind_of"]


class Sampler(Protocol):
    """The posterior of a fit; checkpoints are in the folder."""

    def __call__(
        self,
        data: FitData,
        config: Config,
        *,
        folder: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Posterior: ...


@dataclass(frozen=True)
class Kind:
    """Matched stars, a campaign, or a self-calibration.

    Each takes configurations, inputs and matches of its own types.

    Parameters
    ----------
    rows : str
        What a row of the data is, in words.
    chooser : str
        What leaves out rows that are far off, in words.
    begins_with : str
        Its first stage: 'match', or 'fit' where stars are matched already.
    read : callable
        Of (config, base): all that a run begins with, its inputs; paths are relative to `base`.
    refuse : callable
        Of (inputs, config, base): refuses what does not go together.
    match : callable
        Of (inputs, config, base): stars that are fitted, and those that are held out.
    fit : callable
        Of (matched, config, base, reader): the least-squares solution.
    sample : callable
        The posterior of the fit.
    load_matched : callable
        Of (folder, inputs, config, base, summary): the matches of an earlier stage, from a run's
        folder and its summary.json.
    load_fitted : callable
        Of (folder, matched, config, summary): the fit of an earlier stage; `matched` is called
        where that needs the matches.
    lines : callable
        Of (inputs, config): what `check` says of the inputs; None where the fit says more.
    """

    rows: str
    chooser: str
    begins_with: str
    read: Callable[[Any, Path], Any]
    refuse: Callable[[Any, Any, Path], None]
    match: Callable[[Any, Any, Path], Matched]
    fit: Callable[[Any, Any, Path, StarReader], Fitted]
    sample: Sampler
    load_matched: Callable[[Path, Any, Any, Path, Mapping[str, Any]], Matched]
    load_fitted: Callable[[Path, Callable[[], Any], Any, Mapping[str, Any]], Fitted]
    lines: Callable[[Any, Any], Iterator[str] | None]


MATCHES = Kind(
    rows="stars",
    chooser="least-squares fit",
    begins_with="fit",
    read=read_stars,
    refuse=lambda inputs, config, base: None,  # what is wrong shows in their fit
    match=lambda inputs, config, base: match_stars(inputs, config),
    fit=lambda matched, config, base, reader: fit_stars(matched, config, base, reader=reader),
    sample=sample_stars,
    load_matched=lambda folder, inputs, config, base, summary: match_stars(inputs, config),
    load_fitted=lambda folder, matched, config, summary: load_fitted(
        folder, summary, priors=lambda model: priors_of(model, config)
    ),
    lines=lambda inputs, config: None,
)

CAMPAIGN = Kind(
    rows="stars",
    chooser="least-squares fit",
    begins_with="match",
    read=read_campaign,
    refuse=lambda inputs, config, base: refuse_campaign(inputs),
    match=lambda inputs, config, base: match_lists(inputs),
    fit=lambda matched, config, base, reader: fit_campaign(matched),
    sample=sample_stars,
    load_matched=lambda folder, inputs, config, base, summary: load_matched_campaign(
        folder, inputs, summary
    ),
    load_fitted=lambda folder, matched, config, summary: load_fitted(folder, summary, joint=True),
    lines=lambda inputs, config: campaign_lines(inputs),
)

SELFCAL = Kind(
    rows="detections",
    chooser="limits of residuals",
    begins_with="match",
    read=read_selfcal,
    refuse=lambda inputs, config, base: refuse_selfcal(inputs),
    match=lambda inputs, config, base: match_dithers(inputs),
    fit=lambda matched, config, base, reader: fit_selfcal(matched),
    sample=sample_detections,
    load_matched=lambda folder, inputs, config, base, summary: load_matched_selfcal(
        folder, inputs, summary
    ),
    load_fitted=lambda folder, matched, config, summary: load_fitted(
        folder,
        summary,
        solved=lambda model: solved_of(matched(), model, read_solution(folder)),
    ),
    lines=lambda inputs, config: selfcal_lines(inputs),
)


def kind_of(config: Config) -> Kind:
    """The kind of run that a configuration is of."""
    if config.campaign is not None:
        return CAMPAIGN
    return SELFCAL if config.selfcal is not None else MATCHES
