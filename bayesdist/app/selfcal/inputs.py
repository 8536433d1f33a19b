"""What a self-calibration begins with: detections of all exposures, dates, VAFACTOR, offsets."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesdist.app.campaign.inputs import cuts_of, lists_of
from bayesdist.app.chips import check_chips
from bayesdist.app.config import Config
from bayesdist.app.config.selfcal import SelfcalBlock
from bayesdist.data import ReferenceCatalog, read_catalog, read_exposures
from bayesdist.data.detections import Detections, detections_of
from bayesdist.data.matching.frames import refuse_duplicates
from bayesdist.data.tables.column import SourceColumn
from bayesdist.data.tables.files import read_table
from bayesdist.data.tables.names import find_columns
from bayesdist.data.tables.units import conversion
from bayesdist.errors import ConfigError, InputError

__all__ = [
    "Commanded",
    "Inputs",
    "read_commanded",
    "read_inputs",
    "read_references",
    "selfcal_block",
]

log = logging.getLogger("bayesdist")

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_COLUMNS = {
    "exposure": ("exposure", "name", "rootname"),
    "du": ("du", "postarg1", "dx"),
    "dv": ("dv", "postarg2", "dy"),
    "sigma": ("sigma",),
    "roll": ("roll",),
    "group": ("group", "guide_stars"),
}


@dataclass(frozen=True, eq=False)
class Inputs:
    """Detections of all exposures.

    Parameters
    ----------
    detections : Detections
        That pass the cuts; without star codes.
    n_read : int
        Detections of the lists.
    rejected : dict of str to int
        Those that were cut, by reason.
    sources : tuple of str
    dilation : ndarray, shape (E,), or None
        VAFACTOR, where the log has it.
    """

    detections: Detections
    n_read: int
    rejected: dict[str, int]
    sources: tuple[str, ...]
    dilation: Float | None


@dataclass(frozen=True, eq=False)
class Commanded:
    """Where exposures were to point.

    Parameters
    ----------
    offsets : ndarray, shape (E, 2)
        Along u and v, NaN where there is none; None in a file of rolls alone.
    sigma : ndarray, shape (E,)
        Of each, on one axis.
    roll : ndarray, shape (E,), or None
        Radians, from u to v.
    group : ndarray of int, shape (E,)
        Exposures with the same guide stars.
    """

    offsets: Float | None
    sigma: Float
    roll: Float | None
    group: Int


def selfcal_block(config: Config) -> SelfcalBlock:
    """The self-calibration's part of a configuration.

    Raises
    ------
    ConfigError
        Where it has none.
    """
    if config.selfcal is None:
        raise ConfigError("names no star lists", where="selfcal", do="give the section [selfcal]")
    return config.selfcal


def read_inputs(config: Config, base: Path) -> Inputs:
    """Read the lists of a self-calibration.

    Raises
    ------
    InputError
        For files that cannot be read, a single exposure, one that stands there twice, chips without
        stars, and exposures that the log does not have.
    """
    block = selfcal_block(config)
    cuts, rejected, used = cuts_of(block), dict[str, int](), list[Detections]()
    lists = lists_of(block, base)
    for one in lists:
        good, reasons = cuts.passed(one)
        for reason, count in reasons.items():
            rejected[reason] = rejected.get(reason, 0) + count
        if not good.any():
            raise InputError(
                f"no detection of exposure {one.name} passes the cuts",
                where=one.source,
                do="widen them, or leave the exposure out",
            )
        used.append(one.select(good))
    if len(used) < 2:
        raise InputError(
            f"there is one exposure, {used[0].name}, and distortion shows between exposures",
            where=used[0].source,
            do="give dithered exposures of one field",
        )
    check_chips(config.chips(), sorted({int(n) for one in used for n in one.chips}))
    refuse_duplicates(
        [np.column_stack([one.x, one.y, one.chip]) for one in used],
        [one.name for one in used],
        source="selfcal.lists",
    )
    epoch, dilation = _of_log(config, base, [one.name for one in used])
    own = [one.epoch for one in used if one.epoch is not None]
    if epoch is None and len(own) == len(used):
        epoch = np.concatenate(own)
    sigma = None if block.sigma == "measured" else float(block.sigma)
    detections = detections_of(used, epoch=epoch, sigma=sigma)
    sources = tuple(dict.fromkeys(one.source for one in used))
    return Inputs(detections, sum(len(one) for one in lists), rejected, sources, dilation)


def _of_log(config: Config, base: Path, names: Sequence[str]) -> tuple[Float | None, Float | None]:
    """Dates and VAFACTOR of the exposures, where there is a log."""
    exposures = selfcal_block(config).exposures
    if exposures is None:
        return None, None
    log = read_exposures(base / exposures)
    found = [log[name] for name in names]
    factors = np.array([np.nan if one.vafactor is None else one.vafactor for one in found])
    known = np.isfinite(factors)
    if known.any() and not known.all():
        raise InputError(
            f"exposure {names[int(np.argmin(known))]} has no vafactor, and others have",
            where=log.source,
            do="give it for all exposures, or for none",
        )
    return np.array([one.epoch for one in found]), factors if known.all() else None


def read_commanded(
    path: Path, names: Sequence[str], unit: str, scale_mas: float | None, sigma: float | None
) -> Commanded:
    """Commanded offsets and rolls of exposures from a table.

    Parameters
    ----------
    path : Path
        Columns exposure, du and dv along u and v, sigma, roll in degrees from u to v, group.
    names : sequence of str
        Exposures, in their order.
    unit : str
        Of u and v, for columns without one.
    scale_mas : float, optional
        Size of a pixel, where units have to be converted.
    sigma : float, optional
        Of the offsets, where the table has no such column.

    Raises
    ------
    InputError
        For files that cannot be read, missing columns or values, and units that do not go together.
    """
    table = read_table(path)
    found = find_columns(table.colnames, None, _COLUMNS, source=str(path))
    if "exposure" not in found or ("du" in found) != ("dv" in found):
        raise InputError(
            f"no columns exposure, du and dv among {', '.join(table.colnames) or 'none'}",
            where=str(path),
            do="name the exposures and their offsets along u and v",
        )

    def column(key: str) -> SourceColumn:
        return SourceColumn(table[found[key]], str(path), found[key])

    def length(key: str) -> Float:
        own = column(key).unit
        return column(key).numbers() * (1.0 if own is None else _factor(own, unit, scale_mas, path))

    codes, labels = column("exposure").labels()
    row_of = {labels[code]: k for k, code in enumerate(codes)}
    if len(row_of) < len(codes):
        twice = labels[int(np.argmax(np.bincount(codes)))]
        raise InputError(
            f"exposure {twice} stands there twice", where=str(path), do="keep one row of each"
        )
    rows = np.array([row_of.get(name, -1) for name in names])
    if (rows < 0).all():
        raise InputError(
            f"has none of the exposures {', '.join(names[:3])}, ...",
            where=str(path),
            do="name them as the lists do",
        )

    def of_each(values: Float, missing: float = np.nan) -> Float:
        return np.where(rows >= 0, values[rows], missing)

    offsets, error = None, np.full(len(names), np.nan if sigma is None else sigma)
    if "du" in found:
        offsets = np.stack([of_each(length("du")), of_each(length("dv"))], axis=1)
        if "sigma" in found and sigma is None:
            error = of_each(length("sigma"), 1.0)
        if not (error > 0).all():
            raise InputError(
                "the offsets have no errors",
                where=str(path),
                do="give a column sigma above zero, or gauge.offset_sigma",
            )
    group = np.zeros(len(names), np.int64)
    if "group" in found:
        group = np.where(rows >= 0, column("group").labels()[0][rows], -1)
    roll = np.radians(of_each(column("roll").numbers())) if "roll" in found else None
    return Commanded(offsets, error, roll, group)


def _factor(own: str, unit: str, scale_mas: float | None, path: Path) -> float:
    """What one `own` is in `unit`, pixels among them."""
    if own == unit:
        return 1.0
    if "pix" not in (own, unit):
        return conversion(own, unit, where=str(path))
    if scale_mas is None:
        raise InputError(
            f"offsets are in {own}, and u and v in {unit}",
            where=str(path),
            do="give detector.scale_mas, by which one is the other",
        )
    if own == "pix":
        return conversion("mas", unit, where=str(path)) * scale_mas
    return conversion(own, "mas", where=str(path)) / scale_mas


def read_references(
    config: Config, base: Path, unit_arcsec: float | None
) -> ReferenceCatalog | None:
    """The reference stars, in the unit of u and v; None where there are none.

    Raises
    ------
    InputError
        As `read_catalog`, and for stars without errors.
    """
    block = config.gauge.reference
    if block is None or unit_arcsec is None:  # the configuration asks for a scale with references
        return None
    catalog = read_catalog(
        base / block.catalog,
        block.columns,
        unit=block.unit,
        epoch=block.epoch,
        tangent_point=block.tangent_point,
    )
    if catalog.sigma_u is None or catalog.sigma_v is None:
        raise InputError(
            "the reference stars have no errors",
            where=catalog.source,
            do="give the columns sigma_u and sigma_v, or ra_error and dec_error",
        )
    if not ((catalog.sigma_u > 0) & (catalog.sigma_v > 0)).all():
        raise InputError(
            "a reference star has the error zero", where=catalog.source, do="drop it, or correct it"
        )
    catalog = _with_motions(catalog)
    own = {"arcsec": 1.0, "mas": 1e-3, "deg": 3600.0}.get(catalog.unit, unit_arcsec)
    return catalog.rescaled(own / unit_arcsec, selfcal_block(config).unit)


def _with_motions(catalog: ReferenceCatalog) -> ReferenceCatalog:
    """Without stars whose motion has the error zero: where they are at other dates is not known.

    So catalogues write motions that were not measured, beside those that were.
    """
    if catalog.sigma_pm_u is None or catalog.sigma_pm_v is None:
        return catalog
    measured = (catalog.sigma_pm_u > 0) & (catalog.sigma_pm_v > 0)
    if not measured.all():
        log.info(
            "match: %d of %d reference stars have no measured motion and are left out",
            len(catalog) - measured.sum(),
            len(catalog),
        )
    return catalog.select(measured)
