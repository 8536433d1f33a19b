"""A fit and the stars that it used, which are read once for all later steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from bayesdist.app.config import Config
from bayesdist.app.kinds.errors import QUOTED, ErrorLaw
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.matched import Matched
from bayesdist.data.matches import Matches
from bayesdist.diagnose.residuals.misfit import error_scale_sentence
from bayesdist.diagnose.residuals.stars import SAMPLE, dates_of
from bayesdist.infer import LinearFit, Shards, load
from bayesdist.infer.stars.shards import Compute
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float


class StarReader:
    """Reader of stars that caches the most recent request."""

    def __init__(self, compute: Compute | None = None) -> None:
        self.compute = compute or Compute()
        # requested stars, their error law, and the stars with these errors
        self._read: tuple[Matches, ErrorLaw, Matches] | None = None
        self._shards: Shards | None = None
        self._sample: Matches | None = None

    def matches(self, stars: Matches, errors: ErrorLaw = QUOTED) -> Matches:
        """Stars with their errors."""
        if self._read is None or self._read[0] is not stars or self._read[1] is not errors:
            self.close()
            self._read = stars, errors, errors.applied(stars)
        return self._read[2]

    def shards(self, model: DistortionModel, stars: Matches, errors: ErrorLaw = QUOTED) -> Shards:
        """Stars split into shards for passes of a model; closed together with the reader."""
        matches = self.matches(stars, errors)
        if self._shards is None or self._shards.model != model:
            self._close_shards()
            self._shards = load(model, matches, self.compute)
        return self._shards

    def sample(self, stars: Matches, errors: ErrorLaw = QUOTED) -> Matches:
        """Evenly spread subset of the stars, or all of them if they are few."""
        matches = self.matches(stars, errors)
        if self._sample is None:
            self._sample = matches.sample(SAMPLE)
        return self._sample

    def moved(self, stars: Matches) -> None:
        """Update the cache after the files of the stars in use were moved.

        `stars` are the same stars, which refer to the new files.
        """
        if self._read is None or self.compute.engine == "dask":  # workers may read the files again
            self.close()
        else:
            errors = self._read[1]
            self._read = stars, errors, errors.applied(stars)

    def close(self) -> None:
        """Release the stars, and the workers that hold them."""
        self._close_shards()
        self._read = self._sample = None

    def _close_shards(self) -> None:
        if self._shards is not None:
            self._shards.close()
            self._shards = None


@dataclass(frozen=True, eq=False)
class FitData:
    """A fit and its stars.

    The pixels of the stars are corrected by the look-up tables of the fit, and the errors are those
    that the fit assumed.
    """

    matched: Matched
    fitted: Fitted
    # cache: the stars are read once for all passes
    reader: StarReader = field(default_factory=StarReader)

    @property
    def fit(self) -> LinearFit:
        """The least-squares fit."""
        return self.fitted.linear

    @property
    def model(self) -> DistortionModel:
        """The model that was fitted."""
        return self.fit.model

    @cached_property
    def placed(self) -> Matches:
        """Stars with pixels corrected by the look-up tables, and with their quoted errors."""
        return self.fitted.placed(self.matched.stars)

    @cached_property
    def stars(self) -> Matches:
        """Fitted stars with their errors."""
        return self.reader.matches(self.placed, self.fitted.remaining_errors)

    @cached_property
    def held(self) -> Matches | None:
        """Held-out stars with pixels and errors as for fitted stars; None if there are none."""
        held = self.matched.held
        return None if held is None else self.fitted.errors.applied(self.fitted.placed(held))

    @property
    def shards(self) -> Shards:
        """All fitted stars, split into shards for passes over the data."""
        return self.reader.shards(self.model, self.placed, self.fitted.remaining_errors)

    @property
    def sample(self) -> Matches:
        """Evenly spread subset of the fitted stars, or all of them if they are few."""
        return self.reader.sample(self.placed, self.fitted.remaining_errors)

    @cached_property
    def dates(self) -> Float:
        """Distinct dates of the stars in decimal years; empty if they have no dates."""
        return dates_of(self.placed if self.placed.in_memory else self.sample)

    @cached_property
    def last_epoch(self) -> float:
        """Latest date of the stars in decimal years; they must have dates if the model drifts."""
        if self.placed.in_memory:
            return float(np.max(self.placed.column("epoch")))
        return float(np.max(self.shards.groups.epoch))

    @property
    def error_scale_sentence(self) -> str:
        """Sentence about quoted errors that are far too small; empty if they are adequate."""
        if self.fitted.errors.factor == 1.0:
            return ""
        return error_scale_sentence(
            self.fitted.errors.factor,
            self.shards.survey.reference_sigma,
            self.model.unit,
            by_magnitude=self.placed.has_mag,
        )


def assessment_epoch(data: FitData, config: Config) -> float | None:
    """Epoch of the assessment in decimal years.

    By default it is the date from which a product is to be used, or the latest date of the stars if
    that is later, because errors of a drift grow with time.  None if the model does not depend on
    time.
    """
    if config.assess.epoch is not None or data.model.time is None:
        return config.assess.epoch
    return max((data.last_epoch, *config.products.useafter_years()))
