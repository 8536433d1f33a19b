"""Input files of a campaign; tangent plane, parity and errors of its catalogue."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bayesdist.app.kinds.kind import Outline
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data import (
    ExposureLog,
    ReferenceCatalog,
    catalog_from_table,
    read_exposures,
    select_motions,
)
from bayesdist.data.covariances import without_sizes
from bayesdist.data.sky import mean_direction, tangent_plane
from bayesdist.errors import InputError
from bayesdist.files.tables import read_table
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.kinds.campaign.config import CampaignBlock, CampaignConfig
from bayesdist.kinds.campaign.reference import held_tables
from bayesdist.kinds.star_lists import StarLists, lists_of
from bayesdist.model import DistortionModel, LookupTable
from bayesdist.products.common.document import Document
from bayesdist.utils.arrays import Float


@dataclass(frozen=True, eq=False)
class Inputs:
    """Catalogue, exposures and star lists of a campaign."""

    config: CampaignConfig
    base: Path  # folder that file names are relative to
    whole_catalog: ReferenceCatalog  # all stars in the file
    # without stars that have unreliable proper motions, if these are to be excluded
    catalog: ReferenceCatalog
    log: ExposureLog  # exposures of the calibrated filter, with factors of aberration
    star_lists: StarLists  # star lists of the exposures in `log`
    # exposures with a list but without an entry in the log, in any filter; not used
    unlogged: tuple[str, ...] = ()
    plane: str = ""  # description of the tangent plane; empty if the catalogue has u and v

    @property
    def largest_vafactor(self) -> float:
        """Largest factor of aberration, by which catalogue errors are divided; all nearly equal."""
        return float(self.log.values("vafactor").max())

    @property
    def has_quoted_errors(self) -> bool:
        """True if the star lists have the errors of the centroids."""
        return self.config.campaign.sigma == "columns"

    @property
    def pixel_arcsec(self) -> float:
        """Pixel size in arcsec; 0.05 if the configuration gives none."""
        return (self.config.detector.scale_mas or 50.0) / 1000

    @property
    def unit_arcsec(self) -> float:
        """Size of the unit of u and v in arcsec."""
        return ARCSEC.get(self.catalog.unit, self.pixel_arcsec)

    @property
    def filter(self) -> str:
        """Filter of the exposures."""
        return self.log.filters[0]


def outline_of_campaign(inputs: Inputs) -> Outline:
    """Shape of the solution, including fitted look-up tables and those held fixed."""
    config = inputs.config
    chips, block = config.chips(), config.tables
    tables = held_tables(block, chips, inputs.base)
    if block.method != "none":
        name = inputs.filter if tables else ""
        for chip in chips:
            nx, ny = np.maximum(np.floor_divide(chip.size, block.step), 2).astype(int)
            values = np.zeros((2, ny, nx))
            first = ((block.step[0] + 1) / 2, (block.step[1] + 1) / 2)
            tables += (LookupTable(chip.number, values, name, first, block.step, values),)
    model = DistortionModel(config.model.order, chips, inputs.catalog.unit, config.time())
    return Outline(model, inputs.pixel_arcsec / inputs.unit_arcsec, inputs.filter, tables)


def read_campaign(config: CampaignConfig, base: Path) -> Inputs:
    """Read the catalogue, the exposure log and the star lists."""
    block = config.campaign
    whole_log = read_exposures(base / block.exposures)
    full_catalog, plane = read_campaign_catalog(block, base, whole_log)
    log = _exposures_of(block, whole_log)
    all_lists = lists_of(block, base, errors=block.sigma == "columns")
    lists = all_lists.of(log.names)
    missing = sorted(set(log.names) - set(lists.names))
    if missing:
        raise InputError(
            f"there is no star list of exposure {missing[0]!r}"
            + (f" and {len(missing) - 1} more" if len(missing) > 1 else ""),
            where=log.source,
            do="add the list, or take the exposure out of the log",
        )
    unlogged = dict.fromkeys(name for name in all_lists.names if name not in whole_log)
    reliable = block.pm_selection == "reliable" and full_catalog.sigma_pm_u is not None
    return Inputs(
        config,
        base,
        full_catalog,
        select_motions(full_catalog) if reliable else full_catalog,
        log,
        lists,
        tuple(unlogged),
        plane,
    )


def _exposures_of(block: CampaignBlock, log: ExposureLog) -> ExposureLog:
    """Exposures of the filter to be calibrated, with their factors of velocity aberration."""
    if block.filter is not None and block.filter not in log.filters:
        raise InputError(
            f"there is no exposure in filter {block.filter!r}",
            where=log.source,
            do=f"choose among {', '.join(log.filters)}",
        )
    if block.filter is None and len(log.filters) > 1:
        raise InputError(
            f"there are exposures in {len(log.filters)} filters, but a run calibrates only one",
            where=log.source,
            do=f"set campaign.filter to one of {', '.join(log.filters)}",
        )
    if block.filter is not None:
        log = log.select(filter=block.filter)
    if block.vafactor_source == "earth":
        bare = tuple(replace(exposure, vafactor=None) for exposure in log)
        log = ExposureLog(bare, log.source).with_aberration()
    log.require("vafactor")
    return log


def read_campaign_catalog(
    block: CampaignBlock, base: Path, log: ExposureLog
) -> tuple[ReferenceCatalog, str]:
    """Read the catalogue, and describe its tangent plane if it has right ascension and declination.

    The plane touches the sky at the mean pointing of the exposures of all filters if the log has
    all pointings and their mean is within the field of the stars; otherwise at the centre of the
    stars.

    Returns
    -------
    catalog : ReferenceCatalog
    plane : str
        Description of the tangent plane; empty if the catalogue has u and v.
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
            motion_prior=block.motion_prior,
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
    """Mean pointing of the exposures; None if unknown or outside the field of the stars."""
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


def parities_of(
    block: CampaignBlock, catalog: ReferenceCatalog, initial: Document
) -> tuple[bool, ...]:
    """Parities of the catalogue to try, the more probable one first; True is mirrored.

    `initial` is the file of the initial distortion, whose format may state the parity of its axes.
    """
    if block.parity != "auto":
        return (block.parity == "mirrored",)
    if catalog.tangent_point is None:
        return (False,)
    expected = bool(initial.mirrored())
    return (expected, not expected)


def errors_by_star(
    catalog: ReferenceCatalog, largest_vafactor: float = 1.0, *, mirrored: bool = False
) -> StarErrors | None:
    """Errors of the catalogue by star code; None if there are none.

    `largest_vafactor` is the factor that catalogue positions were divided by, and `mirrored` is
    True if u of the matches has the opposite sign to that of the catalogue.  A star in several
    exposures has one error, because the factors differ by less than 1e-4.  Errors of parallaxes,
    and what other errors have in common with them, are taken as errors of single exposures.
    """
    position = catalog.by_code("sigma_u", "sigma_v")
    if position is None or not position.any():
        return None
    motion = catalog.by_code("sigma_pm_u", "sigma_pm_v")
    epoch = catalog.by_code("epoch")
    dates = None if epoch is None else epoch[:, 0]
    if catalog.correlations is None:
        motion = None if motion is None else motion / largest_vafactor
        return StarErrors(position / largest_vafactor, motion, dates)
    sigma, correlations = without_sizes(_without_parallax(catalog.covariances))
    n = 2 if motion is None else 4
    sigmas, matrices = np.zeros((len(position), n)), np.tile(np.eye(n), (len(position), 1, 1))
    sigmas[catalog.star] = sigma[:, :n] / largest_vafactor
    sign = np.array([-1.0 if mirrored else 1.0, 1.0] * (n // 2))
    matrices[catalog.star] = correlations[:, :n, :n] * np.outer(sign, sign)
    return StarErrors(sigmas[:, :2], sigmas[:, 2:] if n == 4 else None, dates, matrices)


def _without_parallax(covariances: Float) -> Float:
    """Covariances (N, 4, 4) of positions and motions, without what parallaxes explain of them."""
    rest = np.array([0, 1, 3, 4])
    with_parallax, variance = covariances[:, rest, 2], covariances[:, 2, 2]
    explained = with_parallax / np.sqrt(np.where(variance > 0, variance, np.inf))[:, None]
    out = covariances[:, rest[:, None], rest] - explained[:, :, None] * explained[:, None]
    return np.asarray(out)
