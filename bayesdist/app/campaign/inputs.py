"""The files that a campaign begins with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.campaign.config import CampaignBlock, StarListsBlock
from bayesdist.calibration.calibration import Calibration
from bayesdist.data import (
    ExposureLog,
    ReferenceCatalog,
    StarCuts,
    StarList,
    read_catalog,
    read_exposures,
    read_star_lists,
    select_motions,
)
from bayesdist.errors import InputError
from bayesdist.products import IdcTab, read_idctab
from bayesdist.products.formats.idctab.calibration import idctab_calibration

__all__ = ["Inputs", "cuts_of", "lists_of", "read_inputs", "start_of"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Inputs:
    """What a campaign begins with.

    Parameters
    ----------
    catalog : ReferenceCatalog
        Without stars whose proper motions are badly measured, where these were asked to go.
    n_catalog : int
        Stars that the file holds.
    log : ExposureLog
        Of the exposures of the filter, with VAFACTOR.
    lists : tuple of StarList
        Of these exposures.
    strangers : tuple of str
        Exposures that have a list and no entry in the log file, of whatever filter: not used.
    """

    catalog: ReferenceCatalog
    n_catalog: int
    log: ExposureLog
    lists: tuple[StarList, ...]
    strangers: tuple[str, ...] = ()

    @property
    def filter(self) -> str:
        """The one filter of the exposures."""
        return self.log.filters[0]


def read_inputs(block: CampaignBlock, base: Path) -> Inputs:
    """Read catalogue, exposures and star lists.

    Raises
    ------
    InputError
        For files that cannot be read, lists without an entry in the log, a filter without
        exposures, and exposures without VAFACTOR.
    """
    catalog = read_catalog(base / block.catalog)
    log = read_exposures(base / block.exposures)
    logged = set(log.names)
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
    if block.aberration == "earth":
        bare = tuple(replace(one, vafactor=None) for one in log)
        log = ExposureLog(bare, log.source).with_aberration()
    log.require("vafactor")
    lists = lists_of(block, base)
    wanted = tuple(one for one in lists if one.exposure in log)
    missing = sorted(set(log.names) - {one.exposure for one in wanted})
    if missing:
        raise InputError(
            f"there is no star list of exposure {missing[0]!r}"
            + (f" and {len(missing) - 1} more" if len(missing) > 1 else ""),
            where=log.source,
            do="add the list, or take the exposure out of the log",
        )
    strangers = dict.fromkeys(one.exposure for one in lists if one.exposure not in logged)
    n = len(catalog)
    if block.motions == "reliable" and catalog.sigma_pm_u is not None:
        catalog = select_motions(catalog)
    return Inputs(catalog, n, log, wanted, tuple(strangers))


def lists_of(
    block: StarListsBlock, base: Path, columns: Mapping[str, str] | None = None
) -> tuple[StarList, ...]:
    """All star lists that the configuration names.

    Each place is read alone: a list whose name stands in two is an exposure given twice, not two.
    """
    names = block.lists if isinstance(block.lists, list) else [block.lists]
    return tuple(one for name in names for one in read_star_lists(base / name, columns))


def cuts_of(block: StarListsBlock) -> StarCuts:
    """Which detections are used."""
    return StarCuts(mag=block.mag, saturation=block.saturation, q_max=block.q_max)


def start_of(
    tab: IdcTab | Path, unit_arcsec: float, filter: str | None
) -> Callable[[Float, Float, NDArray[np.int64], float], Float]:
    """The known distortion, from pixels to the catalogue's unit up to rotation and shift.

    Parameters
    ----------
    tab : IdcTab or Path
    unit_arcsec : float
        Size of the catalogue's unit.
    filter : str or None
        The table's only one, or any of it, by default.
    """
    known = known_calibration(tab, filter)

    def start(x: Float, y: Float, chip: NDArray[np.int64], epoch: float) -> Float:
        out = np.empty((len(x), 2))
        for number in np.unique(chip):
            rows = chip == number
            out[rows] = known.forward(x[rows], y[rows], chip=int(number))
        return out / unit_arcsec

    return start


def known_calibration(tab: IdcTab | Path, filter: str | None) -> Calibration:
    """The calibration of an IDCTAB in a filter, or in any where it does not name that one."""
    known = read_idctab(tab) if isinstance(tab, Path) else tab
    names = {name for row in known.filters() for name in row}
    return idctab_calibration(known, filter if filter in names else None)
