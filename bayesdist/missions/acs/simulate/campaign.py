"""Simulated campaign: the input of a calibration, and its truth."""

from __future__ import annotations

from dataclasses import dataclass

from bayesdist.data import ReferenceCatalog
from bayesdist.data.exposures import ExposureLog
from bayesdist.data.starlists import StarList
from bayesdist.missions.acs.simulate.truth import AcsTruth

__all__ = ["AcsCampaign"]


@dataclass(frozen=True, eq=False)
class AcsCampaign:
    """A simulated campaign.

    Parameters
    ----------
    catalog : ReferenceCatalog
        Standard catalogue: epoch 2004.5, with proper motions.
    early, late : ReferenceCatalog
        Mean positions before and after SM4, of the same stars in the same order.
    log : ExposureLog
    lists : tuple of StarList
        Raw detections of each exposure, in the order of the log.
    truth : AcsTruth
    """

    catalog: ReferenceCatalog
    early: ReferenceCatalog
    late: ReferenceCatalog
    log: ExposureLog
    lists: tuple[StarList, ...]
    truth: AcsTruth
