"""Parts of the sigmas of residual tables that partitions of the array make."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayesdist.missions.wise.assess.residual_structure import ResidualPartition

__all__ = ["partition_parts"]


def partition_parts(
    partitions: Mapping[str, ResidualPartition], arcsec: Mapping[str, float]
) -> dict[tuple[str, str], float]:
    """Rms that significant partitions add to the sigma of each row.

    `partitions`: by band, of residuals in pixels; bands without one that is significant count as
    having none. The result is by table and label: rms over the array without the noise of the
    fitted blocks, in the unit of the table.
    """
    found = {name: p for name, p in partitions.items() if p.significant}
    out: dict[tuple[str, str], float] = {}
    names = list(partitions)
    for k, axis in enumerate("XY"):
        for name, p in found.items():
            out["5-1", f"{name}/{axis}"] = p.rms[k]
            out["5-3", f"{name}/{axis}"] = float(np.sqrt(2)) * arcsec[name] * p.rms[k]
        for i, earlier in enumerate(names):
            for later in names[i + 1 :]:
                here = {name: found[name] for name in (earlier, later) if name in found}
                if here:
                    out["5-2", f"{later}-{earlier}/{axis}"] = _difference(here, arcsec, earlier, k)
    return out


def _difference(
    found: Mapping[str, ResidualPartition], arcsec: Mapping[str, float], minus: str, axis: int
) -> float:
    """Rms of the difference of two patterns, which may be alike, without their noise."""
    scaled = [
        (-1 if name == minus else 1) * arcsec[name] * p.pattern[axis] for name, p in found.items()
    ]
    total = float(np.nanvar(np.sum(scaled, axis=0)))
    noise = sum(
        arcsec[name] ** 2 * (float(np.nanmean(p.pattern[axis] ** 2)) - p.rms[axis] ** 2)
        for name, p in found.items()
    )
    return float(np.sqrt(max(total - noise, 0.0)))
