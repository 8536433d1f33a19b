"""What the three kinds of runs do in their own way: all that comes before the posterior."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

from bayesdist.app.campaign.kind import CampaignKind
from bayesdist.app.config import Config
from bayesdist.app.kinds.fit_data import FitData
from bayesdist.app.kinds.fitted import Fitted
from bayesdist.app.kinds.matched import Matched
from bayesdist.app.kinds.matches import MatchesKind
from bayesdist.app.kinds.reader import StarReader
from bayesdist.app.selfcal.kind import SelfcalKind
from bayesdist.infer import Posterior

__all__ = ["Kind", "kind_of"]


class Kind(Protocol):
    """Matched stars, a campaign, or a self-calibration.

    Attributes
    ----------
    rows : str
        What a row of the data is, in words.
    chooser : str
        What leaves out rows that are far off, in words.
    begins_with : str
        Its first stage: 'match', or 'fit' where stars are matched already.
    """

    @property
    def rows(self) -> str: ...

    @property
    def chooser(self) -> str: ...

    @property
    def begins_with(self) -> str: ...

    def read(self, config: Config, base: Path) -> Any:
        """All that a run begins with; paths are relative to `base`."""

    def refuse(self, inputs: Any, config: Config, base: Path) -> None:
        """Refuse inputs that do not go together, and files of others that cannot be used."""

    def match(self, inputs: Any, config: Config, base: Path) -> Matched:
        """Stars that are fitted, and those that are held out."""

    def fit(
        self, matched: Matched, config: Config, base: Path, *, reader: StarReader | None = None
    ) -> Fitted:
        """The least-squares solution; the reader has the stars in the end, where it is given."""

    def sample(
        self,
        data: FitData,
        config: Config,
        *,
        folder: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Posterior:
        """The posterior; checkpoints are in the folder."""

    def load_matched(
        self, folder: Path, config: Config, base: Path, inputs: Any, summary: Mapping[str, Any]
    ) -> Matched:
        """The matches of an earlier stage, from a run's folder and its summary.json."""

    def load_fitted(
        self,
        folder: Path,
        config: Config,
        matched: Callable[[], Matched],
        summary: Mapping[str, Any],
    ) -> Fitted:
        """The fit of an earlier stage; `matched` loads what it was made from."""

    def lines(self, inputs: Any, config: Config) -> Iterator[str] | None:
        """What `check` says of the inputs; None where it says more of the fit."""


def kind_of(config: Config) -> Kind:
    """The kind of run that a configuration is of."""
    if config.campaign is not None:
        return CampaignKind()
    return SelfcalKind() if config.selfcal is not None else MatchesKind()
