"""A fit and the stars that it was made from, which are read once for all that follows the fit."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from bayesdist.app.kinds.errors import QUOTED, ErrorLaw
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.matched import Matched
from bayesdist.data.matches import Matches
from bayesdist.diagnose.residuals.quoted import error_scale_sentence
from bayesdist.diagnose.residuals.sample import SAMPLE, dates_of
from bayesdist.infer import LinearFit, Shards, load
from bayesdist.infer.stars.shards import Compute
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float


class StarReader:
    """Reads stars, and remembers those that it was asked for last."""

    def __init__(self, compute: Compute | None = None) -> None:
        self.compute = compute or Compute()
        # those that were asked for, with which errors, and what came of it
        self._read: tuple[Matches, ErrorLaw, Matches] | None = None
        self._shards: Shards | None = None
        self._sample: Matches | None = None

    def matches(self, stars: Matches, errors: ErrorLaw = QUOTED) -> Matches:
        """The stars with their errors."""
        if self._read is None or self._read[0] is not stars or self._read[1] is not errors:
            self.close()
            self._read = stars, errors, errors.applied(stars)
        return self._read[2]

    def shards(self, model: DistortionModel, stars: Matches, errors: ErrorLaw = QUOTED) -> Shards:
        """The stars as passes of a model go over them; closed by whoever closes the reader."""
        matches = self.matches(stars, errors)
        if self._shards is None or self._shards.model != model:
            self._close_shards()
            self._shards = load(model, matches, self.compute)
        return self._shards

    def sample(self, stars: Matches, errors: ErrorLaw = QUOTED) -> Matches:
        """Some of the stars, or all where they are not many."""
        matches = self.matches(stars, errors)
        if self._sample is None:
            self._sample = matches.sample(SAMPLE)
        return self._sample

    def moved(self, stars: Matches) -> None:
        """Take note that the stars that were asked for last lie in other files now."""
        if self._read is None or self.compute.engine == "dask":  # workers may read them again
            self.close()
        else:
            errors = self._read[1]
            self._read = stars, errors, errors.applied(stars)

    def close(self) -> None:
        """Let go of the stars, and of whoever holds them."""
        self._close_shards()
        self._read = self._sample = None

    def _close_shards(self) -> None:
        if self._shards is not None:
            self._shards.close()
            self._shards = None


@dataclass(frozen=True, eq=False)
class FitData:
    """A fit and its stars: where its tables move them, with its errors."""

    matched: Matched
    fitted: Fitted
    # reads the stars once for all passes over them
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
        """Stars at the pixels that the tables move them to, with their quoted errors."""
        return self.fitted.placed(self.matched.stars)

    @property
    def _law(self) -> ErrorLaw:
        """Errors on top of those of the placed stars: detections of solved stars have theirs."""
        return QUOTED if self.fitted.solved is not None else self.fitted.errors

    @cached_property
    def stars(self) -> Matches:
        """Stars that were fitted, with their errors."""
        return self.reader.matches(self.placed, self._law)

    @cached_property
    def held(self) -> Matches | None:
        """Stars that are held out, in the same way; None where there are none."""
        held = self.matched.held
        return None if held is None else self.fitted.errors.applied(self.fitted.placed(held))

    @property
    def shards(self) -> Shards:
        """All stars that were fitted, as passes go over them."""
        return self.reader.shards(self.model, self.placed, self._law)

    @property
    def sample(self) -> Matches:
        """Evenly spread ones of them, or all."""
        return self.reader.sample(self.placed, self._law)

    @cached_property
    def dates(self) -> Float:
        """Distinct dates of the stars, decimal years; none where they have none."""
        return dates_of(self.placed if self.placed.in_memory else self.sample)

    @cached_property
    def last_epoch(self) -> float:
        """Latest date of the stars, decimal years; they have dates where the model drifts."""
        if self.placed.in_memory:
            return float(np.max(self.placed.column("epoch")))
        return float(np.max(self.shards.groups.epoch))

    @property
    def error_scale_sentence(self) -> str:
        """Sentence on quoted errors that are far too small; empty where they will do."""
        if self.fitted.errors.factor == 1.0:
            return ""
        return error_scale_sentence(
            self.fitted.errors.factor,
            self.shards.survey.reference_sigma,
            self.model.unit,
            by_magnitude=self.placed.has_mag,
        )
