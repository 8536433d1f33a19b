"""Sampling of a fit with stars at given positions, as of matched stars and campaigns."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from bayesdist.app.run import Run
from bayesdist.data import Matches
from bayesdist.infer import Posterior, sample
from bayesdist.model import DistortionModel
from bayesdist.model.basis import n_terms

log = logging.getLogger("bayesdist")

STARS_PER_TERM = 3  # fewest stars per term and axis for which residuals show the errors


def sample_stars(
    run: Run,
    *,
    folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """Sample the posterior of a fit; checkpoints are written to `folder`."""
    config = run.config
    for text in doubts_on_numbers(run.sample, run.model):
        log.warning("sample: %s", text)
    return sample(
        run.fit,
        run.shards,
        outliers=config.mixture(run.stars.match_radius),
        priors=run.priors,
        folder=folder,
        progress=progress,
        **config.sampler.model_dump(),
    )


def doubts_on_numbers(stars: Matches, model: DistortionModel) -> Iterator[str]:
    """Sentences about chips with fewer than three stars per polynomial term and axis."""
    terms = n_terms(model.order)
    needed = STARS_PER_TERM * terms
    counts = dict(zip(stars.chip_numbers, np.bincount(stars.chip), strict=False))
    for chip in model.chips:
        n_stars = int(counts.get(chip.number, 0))
        if n_stars < needed:
            yield (
                f"chip {chip.name} has {n_stars} stars for {terms} terms on each axis (order "
                f"{model.order}), and {needed} or more are advisable: the posterior may be far "
                "from normal and sampling slow; lower model.order, or add stars"
            )
