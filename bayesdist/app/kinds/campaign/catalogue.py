"""The reference catalogue of a campaign: its plane, its parity, and its errors by star."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bayesdist.app.config.campaign import CampaignBlock
from bayesdist.app.kinds.matched import columns_by_code
from bayesdist.data import ExposureLog, ReferenceCatalog, catalog_from_table
from bayesdist.data.sky.tangent import mean_direction, tangent_plane
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.products import IdcTab
from bayesdist.products.formats.idctab.hst import parity_of


def read_campaign_catalog(
    block: CampaignBlock, base: Path, log: ExposureLog
) -> tuple[ReferenceCatalog, str]:
    """The catalogue, and what its plane is where it has right ascension and declination.

    The plane touches the sky in the middle of the exposures of all filters, where the log says
    where they point and that lies among the stars; else in the middle of these.
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
    """
    if block.parity != "auto":
        return (block.parity == "mirrored",)
    if catalog.tangent_point is None:
        return (False,)
    expected = bool(np.prod(parity_of(tab.instrument, tab.detector)) < 0)
    return (expected, not expected)


def errors_by_star(catalog: ReferenceCatalog, largest_vafactor: float = 1.0) -> StarErrors | None:
    """Errors of the catalogue by code of the star; None where it has none.

    `largest_vafactor`: by which catalogue positions were divided; a star in many exposures has one
    error, and the factors differ by less than a ten-thousandth.
    """
    position = columns_by_code(catalog, "sigma_u", "sigma_v")
    if position is None or not position.any():
        return None
    motion = columns_by_code(catalog, "sigma_pm_u", "sigma_pm_v")
    epoch = columns_by_code(catalog, "epoch")
    return StarErrors(
        position / largest_vafactor,
        None if motion is None else motion / largest_vafactor,
        None if epoch is None else epoch[:, 0],
    )
