"""Published linear terms of ACS/WFC, for comparison with those of a run.

ACS ISR 2015-06 (Kozhurina-Platais et al. 2015), Tables 1 to 3, and Section 4.4.1; filter F606W.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayesdist.kinds.campaign.report.linear_terms import Published, PublishedLine, publishes

SOURCE = "ACS ISR 2015-06"

# location of each term in the report
WHERE = {"A_2": "Table 1", "B_3": "Table 2", "B_2": "Table 3", "B_1": "Section 4.4.1"}


LINES: dict[str, tuple[PublishedLine, ...]] = {
    "A_2": (
        PublishedLine("WFC1", 2004.5, 0.98205648, 9.14e-7, -9.22e-6, 6.85e-7),
        PublishedLine("WFC2", 2004.5, 0.99468101, 8.65e-7, -9.16e-6, 6.47e-7),
        PublishedLine("WFC1", 2012.5, 0.98196909, 1.45e-6, -2.18e-5, 8.40e-7),
        PublishedLine("WFC2", 2012.5, 0.99459657, 1.36e-6, -2.26e-5, 7.86e-7),
    ),
    "B_3": (
        PublishedLine("WFC1", 2004.5, 0.97263238, 1.25e-6, 2.42e-6, 9.37e-7),
        PublishedLine("WFC2", 2004.5, 1.00622300, 1.29e-6, 3.30e-6, 9.65e-7),
        PublishedLine("WFC1", 2012.5, 0.97263233, 1.41e-6, -1.12e-6, 8.17e-7),
        PublishedLine("WFC2", 2012.5, 1.00621870, 1.13e-6, -8.04e-7, 6.52e-7),
    ),
    "B_2": (
        PublishedLine("WFC1", 2004.5, 0.080947069, 9.206e-7, 3.617e-5, 6.893e-7),
        PublishedLine("WFC2", 2004.5, 0.068598586, 9.211e-7, 3.532e-5, 6.897e-7),
        PublishedLine("WFC1", 2012.5, 0.081139194, 2.450e-6, 3.235e-5, 1.418e-6),
        PublishedLine("WFC2", 2012.5, 0.068779336, 2.255e-6, 3.070e-5, 1.305e-6),
    ),
    "B_1": (  # means before and after SM4
        PublishedLine("WFC1", 2004.5, 2079.58, 0.02),
        PublishedLine("WFC1", 2012.5, 2079.53, 0.02),
    ),
}


@publishes
def published_lines(
    config: Mapping[str, Any], filter: str, chips: tuple[str, ...]
) -> dict[str, Published]:
    """Published lines by term if the run is of ACS/WFC in F606W, otherwise an empty dict."""
    release = config.get("products", {}).get("release") or {}
    detector = (release.get("instrument", "ACS"), release.get("detector", "WFC"))
    if detector != ("ACS", "WFC") or set(chips) != {"WFC1", "WFC2"} or filter != "F606W":
        return {}
    return {term: Published(SOURCE, WHERE[term], lines) for term, lines in LINES.items()}
