"""Stars are read once for all passes over them, whichever function asks for them."""

from __future__ import annotations

from bayesdist.app.kinds.errors import QUOTED, ErrorLaw
from bayesdist.data.matches import Matches
from bayesdist.diagnose.residuals.sample import SAMPLE
from bayesdist.infer import Shards, load
from bayesdist.infer.stars.shards import Compute
from bayesdist.model import DistortionModel

__all__ = ["StarReader"]


class StarReader:
    """Reads stars, and remembers those that it was asked for last.

    Parameters
    ----------
    compute : Compute, optional
        Where the work is done.
    """

    def __init__(self, compute: Compute | None = None) -> None:
        self.compute = compute or Compute()
        self._asked: tuple[Matches, ErrorLaw] | None = None
        self._matches: Matches | None = None
        self._shards: Shards | None = None
        self._sample: Matches | None = None

    def matches(self, stars: Matches, errors: ErrorLaw = QUOTED) -> Matches:
        """The stars with their errors."""
        known = self._asked
        if (
            self._matches is None
            or known is None
            or known[0] is not stars
            or known[1] is not errors
        ):
            self.close()
            self._asked, self._matches = (stars, errors), errors.applied(stars)
        return self._matches

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
        if self._asked is None or self.compute.engine == "dask":  # workers may read them again
            self.close()
        else:
            self._asked = stars, self._asked[1]
            self._matches = self._asked[1].applied(stars)

    def close(self) -> None:
        """Let go of the stars, and of whoever holds them."""
        self._close_shards()
        self._asked = self._matches = self._sample = None

    def _close_shards(self) -> None:
        if self._shards is not None:
            self._shards.close()
            self._shards = None
