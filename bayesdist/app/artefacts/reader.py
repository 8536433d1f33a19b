"""Stars of a run as they are read: once for all passes, and from files that may be moved."""

from __future__ import annotations

from typing import Protocol

from bayesdist.app.artefacts.errors import QUOTED, ErrorLaw
from bayesdist.data.matches import Matches
from bayesdist.diagnose.residuals.stars import SAMPLE
from bayesdist.infer import Shards, load
from bayesdist.infer.stars.shards import Compute
from bayesdist.model import DistortionModel


class RunInput(Protocol):
    """Matches of a run that may have to be written to disk before they can be used."""

    def load(self) -> Matches:
        """All matches that the configuration selects."""

    def move_into_run(self) -> bool:
        """Move the matches into the folder of the run, which has begun; True if any were moved."""

    def close(self) -> None:
        """Remove files that were not moved."""


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
