"""Sampling of a fit with stars at given positions, as of matched stars and campaigns."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from bayesdist.app.run import Run
from bayesdist.data import Matches
from bayesdist.diagnose import score_tests
from bayesdist.errors import DegenerateError
from bayesdist.infer import Posterior, sample
from bayesdist.model import DistortionModel
from bayesdist.model.basis import n_terms

log = logging.getLogger("bayesdist")

DISPLACED = ("displaced stars", "two cores")  # tests that find displaced stars, best words first
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
    with naming_displaced_stars(run):
        return sample(
            run.fit,
            run.shards,
            outliers=config.mixture(run.stars.match_radius),
            priors=run.priors,
            folder=folder,
            progress=progress,
            **config.sampler.model_dump(),
        )


@contextmanager
def naming_displaced_stars(run: Run) -> Iterator[None]:
    """Add displaced stars, if the residuals of the fit show any, to a DegenerateError as its cause.

    A part of the stars that is displaced as a whole can be described by a scatter of true matches
    as well as by one of false matches, so that the posterior has several modes.
    """
    try:
        yield
    except DegenerateError as error:
        tests = {
            test.name: test
            for test in score_tests(run.sample, run.fit, priors=run.priors)
            if test.significant
        }
        for name in DISPLACED:
            if name in tests:
                raise DegenerateError(
                    f"{error.cause}; a likely cause is that {tests[name].finding}",
                    where=error.where,
                    do=tests[name].remedy,
                ) from error
        raise


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
