"""Progress of the sampling in the log, at most one line every ten seconds."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from bayesdist.infer.density.target import Density
from bayesdist.utils.arrays import Float

log = logging.getLogger("bayesdist")

EVERY_S = 10.0  # seconds between two lines


@dataclass(eq=False)
class Heartbeat:
    """Wrapper of a density that counts its evaluations and logs them every ten seconds.

    Since all moves evaluate the density, progress is reported for each of them.
    """

    density: Density
    n_stars: int
    clock: Callable[[], float] = time.monotonic  # seconds
    method: str = "pilot"  # moves of the current plan
    passes: int = 0  # number of points evaluated
    _started: float = field(init=False)
    _last: float = field(init=False)

    def __post_init__(self) -> None:
        self._started = self._last = self.clock()

    @property
    def n_theta(self) -> int:
        """Number of parameters in theta, that is, without the hyperparameters."""
        return self.density.n_theta

    @property
    def names(self) -> tuple[str, ...]:
        """Names of psi."""
        return self.density.names

    def log_density(self, psi: Float) -> Float:
        """Log density (n,) of points (n, D); minus infinity outside the support."""
        values = self.density.log_density(psi)
        self.passes += len(psi)
        now = self.clock()
        if now - self._last >= EVERY_S:
            self._last = now
            log.info(
                "sample: %s, %d passes over %d stars in %.0f s",
                self.method,
                self.passes,
                self.n_stars,
                now - self._started,
            )
        return values
