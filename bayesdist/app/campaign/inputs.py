"""The files that a campaign begins with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.config import CampaignConfig
from bayesdist.app.config.campaign import CampaignBlock
from bayesdist.app.kinds.star_lists import StarLists, lists_of
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data import (
    ExposureLog,
    ReferenceCatalog,
    catalog_from_table,
    read_exposures,
    select_motions,
)
from bayesdist.data.sky.tangent import mean_direction, tangent_plane
from bayesdist.data.tables.files import read_table
from bayesdist.errors import InputError
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.products import IdcTab
from bayesdist.products.formats.idctab.hst import parity_of

__all__ = [
    "Inputs",
    "errors_by_star",
    "parities_of",
    "read_campaign",
    "read_campaign_catalog",
]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Inputs:
    """Catalogue, exposures and star lists of a campaign.

    Parameters
    ----------
    config : CampaignConfig
    base : Path
        Folder that its files are relative to.
    catalog : ReferenceCatalog
        Without stars whose proper motions are badly measured, where these were asked to go.
    n_catalog : int
        Stars that the file holds.
    log : ExposureLog
        Of the exposures of the filter, with VAFACTOR.
    star_lists : StarLists
        Of these exposures.
    unlogged : tuple of str
        Exposures that have a list and no entry in the log file, of whatever filter: not used.
    plane : str
        What the catalogue's u and v are, where they come from the sky.
    """

    config: CampaignConfig
    base: Path
    catalog: ReferenceCatalog
    n_catalog: int
    log: ExposureLog
    star_lists: StarLists
    unlogged: tuple[str, ...] = ()
    plane: str = ""

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
    """Read catalogue, exposures and star lists.

    Raises
    ------
    InputError
        For files that cannot be read, lists without an entry in the log, a filter without
        exposures, and exposures without VAFACTOR.
    """
    block = config.campaign
    log = read_exposures(base / block.exposures)
    catalog, plane = read_campaign_catalog(block, base, log)
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
    if block.vafactor_source == "earth":
        bare = tuple(replace(one, vafactor=None) for one in log)
        log = ExposureLog(bare, log.source).with_aberration()
    log.require("vafactor")
    found = lists_of(block, base)
    wanted = tuple(one for one in found.lists if one.name in log)
    missing = sorted(set(log.names) - {one.name for one in wanted})
    if missing:
        raise InputError(
            f"there is no star list of exposure {missing[0]!r}"
            + (f" and {len(missing) - 1} more" if len(missing) > 1 else ""),
            where=log.source,
            do="add the list, or take the exposure out of the log",
        )
    unlogged = dict.fromkeys(one.name for one in found.lists if one.name not in logged)
    n = len(catalog)
    if block.pm_selection == "reliable" and catalog.sigma_pm_u is not None:
        catalog = select_motions(catalog)
    wanted_lists = replace(found, lists=wanted)
    return Inputs(config, base, catalog, n, log, wanted_lists, tuple(unlogged), plane)


def read_campaign_catalog(
    block: CampaignBlock, base: Path, log: ExposureLog
) -> tuple[ReferenceCatalog, str]:
    """The catalogue, and what its plane is where it has right ascension and declination.

    The plane touches the sky in the middle of the exposures of all filters, where the log says
    where they point and that lies among the stars; else in the middle of these.

    Raises
    ------
    InputError
        As `catalog_from_table`, and for proper motions without an epoch, in the configuration's
        words.
    """
    path = base / block.catalog
    table = read_table(path)

    def read(point: tuple[float, float] | None) -> ReferenceCatalog:
        return catalog_from_table(
            table,
            block.catalog_columns,
            source=str(path),
            unit=block.unit,
            epoch=block.catalogue_epoch,
            tangent_point=point,
        )

    try:
        catalog = read(None)
    except InputError as error:
        do = error.do.replace("the option 'columns'", "campaign.catalog_columns")
        do = do.replace("the unit option", "campaign.unit")
        raise type(error)(error.cause, where=error.where, do=do) from error
    if catalog.pm_u is not None and catalog.epoch is None:
        raise InputError(
            "has proper motions but no epoch",
            where=catalog.source,
            do="set campaign.catalogue_epoch, or give the column epoch or ref_epoch",
        )
    if catalog.tangent_point is None:
        return catalog, ""
    (ra, dec), middle = catalog.tangent_point, "stars"
    point = _middle_of(log, catalog)
    if point is not None:
        catalog, (ra, dec), middle = read(point), point, "exposures"
    return catalog, (
        f"tangent plane at RA {ra:.5f}, Dec {dec:+.5f} (the middle of the {middle}), arcsec"
    )


def _middle_of(log: ExposureLog, catalog: ReferenceCatalog) -> tuple[float, float] | None:
    """Mean direction of the exposures; None where the log lacks it, or it is not in the field."""
    ra, dec = log.values("ra"), log.values("dec")
    if not np.isfinite([ra, dec]).all() or catalog.tangent_point is None:
        return None
    point = mean_direction(ra, dec)
    try:
        u, v = tangent_plane([point[0]], [point[1]], catalog.tangent_point)
    except InputError:  # on the other side of the sky
        return None
    inside = catalog.u.min() <= u[0] <= catalog.u.max()
    inside &= catalog.v.min() <= v[0] <= catalog.v.max()
    return point if inside else None


def parities_of(block: CampaignBlock, catalog: ReferenceCatalog, tab: IdcTab) -> tuple[bool, ...]:
    """Parities of the catalogue to try, the more probable first: True is mirrored.

    V2 and V3 lie on the sky as east and north do but for a rotation, and the table says how its
    axes lie along V2 and V3.

    Parameters
    ----------
    block : CampaignBlock
    catalog : ReferenceCatalog
    tab : IdcTab
        The known distortion.
    """
    if block.parity != "auto":
        return (block.parity == "mirrored",)
    if catalog.tangent_point is None:
        return (False,)
    expected = bool(np.prod(parity_of(tab.instrument, tab.detector)) < 0)
    return (expected, not expected)


def errors_by_star(catalog: ReferenceCatalog, largest_vafactor: float = 1.0) -> StarErrors | None:
    """Errors of the catalogue by code of the star; None where it has none.

    Parameters
    ----------
    catalog : ReferenceCatalog
    largest_vafactor : float
        By which catalogue positions were divided; a star in many exposures has one error, and the
        factors differ by less than a ten-thousandth.
    """
    if catalog.sigma_u is None or not (np.any(catalog.sigma_u) or np.any(catalog.sigma_v)):
        return None

    size = int(catalog.star.max()) + 1

    def by_code(*names: str) -> Float | None:
        """Columns of the catalogue side by side (codes, n); None where it lacks one."""
        out = np.zeros((size, len(names)))
        for k, name in enumerate(names):
            values = getattr(catalog, name)
            if values is None:
                return None
            out[catalog.star, k] = values
        return out

    position, motion = by_code("sigma_u", "sigma_v"), by_code("sigma_pm_u", "sigma_pm_v")
    epoch = by_code("epoch")
    assert position is not None
    return StarErrors(
        position / largest_vafactor,
        None if motion is None else motion / largest_vafactor,
        None if epoch is None else epoch[:, 0],
    )
