"""Compiled loops over the detections of stars with unknown positions."""

from pathlib import Path

from bayesdist.infer.kernel.cache import kept_by_content

with kept_by_content(Path(__file__).parent):
    from bayesdist.kinds.selfcal.kernel.star_draws import (
        DOUBTFUL,
        FALSE,
        MEMBER,
        MOST_DOUBTFUL,
        log_marginals,
    )
    from bayesdist.kinds.selfcal.kernel.stars_unknown import (
        EliminationSums,
        eliminate_stars,
        weighted_stars,
    )

__all__ = [
    "DOUBTFUL",
    "FALSE",
    "MEMBER",
    "MOST_DOUBTFUL",
    "EliminationSums",
    "eliminate_stars",
    "log_marginals",
    "weighted_stars",
]
