"""The files that a campaign begins with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from bayesdist.app.config import CampaignConfig
from bayesdist.app.config.campaign import CampaignBlock
from bayesdist.app.kinds.campaign.catalogue import read_campaign_catalog
from bayesdist.app.kinds.star_lists import StarLists, lists_of
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data import ExposureLog, ReferenceCatalog, read_exposures, select_motions
from bayesdist.errors import InputError


@dataclass(frozen=True, eq=False)
class Inputs:
    """Catalogue, exposures and star lists of a campaign."""

    config: CampaignConfig
    base: Path  # folder that its files are relative to
    whole_catalog: ReferenceCatalog  # all stars that the file holds
    # without stars whose proper motions are badly measured, where these were asked to go
    catalog: ReferenceCatalog
    log: ExposureLog  # of the exposures of the filter, with VAFACTOR
    star_lists: StarLists  # of these exposures
    # exposures that have a list and no entry in the log file, of whatever filter: not used
    unlogged: tuple[str, ...] = ()
    plane: str = ""  # what the catalogue's u and v are, where they come from the sky

    @property
    def largest_vafactor(self) -> float:
        """By which the catalogue's errors are divided: all factors are nearly the same."""
        return float(self.log.values("vafactor").max())

    @property
    def pixel_arcsec(self) -> float:
        """Size of a pixel; that of ACS/WFC where the configuration gives none."""
        return (self.config.detector.scale_mas or 50.0) / 1000

    @property
    def unit_arcsec(self) -> float:
        """Size of a unit of u and v."""
        return ARCSEC.get(self.catalog.unit, self.pixel_arcsec)

    @property
    def filter(self) -> str:
        """The one filter of the exposures."""
        return self.log.filters[0]


def read_campaign(config: CampaignConfig, base: Path) -> Inputs:
    """Read catalogue, exposures and star lists."""
    block = config.campaign
    whole_log = read_exposures(base / block.exposures)
    whole, plane = read_campaign_catalog(block, base, whole_log)
    log = _exposures_of(block, whole_log)
    found = lists_of(block, base)
    lists = found.of(log.names)
    missing = sorted(set(log.names) - set(lists.names))
    if missing:
        raise InputError(
            f"there is no star list of exposure {missing[0]!r}"
            + (f" and {len(missing) - 1} more" if len(missing) > 1 else ""),
            where=log.source,
            do="add the list, or take the exposure out of the log",
        )
    unlogged = dict.fromkeys(name for name in found.names if name not in whole_log)
    reliable = block.pm_selection == "reliable" and whole.sigma_pm_u is not None
    return Inputs(
        config,
        base,
        whole,
        select_motions(whole) if reliable else whole,
        log,
        lists,
        tuple(unlogged),
        plane,
    )


def _exposures_of(block: CampaignBlock, log: ExposureLog) -> ExposureLog:
    """Exposures of the filter that is calibrated, with VAFACTOR."""
    if block.filter is not None and block.filter not in log.filters:
        raise InputError(
            f"there is no exposure in filter {block.filter!r}",
            where=log.source,
            do=f"choose among {', '.join(log.filters)}",
        )
    if block.filter is None and len(log.filters) > 1:
        raise InputError(
            f"there are exposures in {len(log.filters)} filters, and a run calibrates one",
            where=log.source,
            do=f"set campaign.filter to one of {', '.join(log.filters)}",
        )
    if block.filter is not None:
        log = log.select(filter=block.filter)
    if block.vafactor_source == "earth":
        bare = tuple(replace(one, vafactor=None) for one in log)
        log = ExposureLog(bare, log.source).with_aberration()
    log.require("vafactor")
    return log
