"""Inputs of a campaign, validated; tangent plane, parity and errors of its catalogue.

Unsuitable inputs are refused; unknown quantities cause warnings.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from astropy.coordinates import angular_separation

from bayesdist.app.config.results import ReleaseBlock
from bayesdist.app.kind import Outline
from bayesdist.calibration.plane import ARCSEC
from bayesdist.data import (
    ExposureLog,
    ReferenceCatalog,
    catalog_from_table,
    read_exposures,
    select_motions,
)
from bayesdist.data.covariances import without_sizes
from bayesdist.data.matching.reports import check_campaign
from bayesdist.data.preparing import refuse_strangers
from bayesdist.data.sky import parallax_factors
from bayesdist.data.tangent import mean_direction, tangent_plane
from bayesdist.errors import ConfigError, DegenerateError, InputError
from bayesdist.files.tables import read_table
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.kinds.campaign.config import CampaignBlock, CampaignConfig
from bayesdist.kinds.campaign.reference import held_tables, rehearse_references
from bayesdist.kinds.star_lists import StarLists, lists_of, refuse_other_chips
from bayesdist.model import DistortionModel, LookupTable, TimeDependence
from bayesdist.products.common.document import Document
from bayesdist.products.registry import open_document
from bayesdist.utils.arrays import Float, Int

MIN_EXPOSURES = 3  # exposures: two do not determine a scatter
ONE_DAY = 1.0 / 365.25  # in years: shorter spans do not determine a rate
LINEAR_KINDS = 3  # number of drifting terms from which scale and both shears drift
ONE_ROLL = 2.0  # degrees: roll angles that scatter by less count as one
MAX_NAMED = 5  # exposures named in a sentence
YEARS_AT_REST = 1.0  # years over which proper motions may be neglected


@dataclass(frozen=True, eq=False)
class CampaignInputs:
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


def outline_of_campaign(inputs: CampaignInputs) -> Outline:
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


def read_campaign(config: CampaignConfig, base: Path) -> CampaignInputs:
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
    return CampaignInputs(
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
    exposures has one error, because the factors differ by less than 1e-4.  Errors of parallaxes
    grow with their factors at the middle of the field, as in `ReferenceCatalog.as_seen`.
    """
    position = catalog.by_code("sigma_u", "sigma_v")
    if position is None or not position.any():
        return None
    motion = catalog.by_code("sigma_pm_u", "sigma_pm_v")
    epoch = catalog.by_code("epoch")
    dates = None if epoch is None else epoch[:, 0]
    point = catalog.tangent_point
    sigma_parallax = None if catalog.parallax is None or dates is None else catalog.sigma_parallax
    seen = point is not None and sigma_parallax is not None and bool(sigma_parallax.any())
    if catalog.correlations is None and not seen:
        motion = None if motion is None else motion / largest_vafactor
        return StarErrors(position / largest_vafactor, motion, dates)
    n = 5 if seen else 2 if motion is None else 4
    sigma, correlations = without_sizes(catalog.covariances)
    parameters = np.array([0, 1, 3, 4, 2])[:n]
    sigmas, matrices = np.zeros((len(position), n)), np.tile(np.eye(n), (len(position), 1, 1))
    sigmas[catalog.star] = sigma[:, parameters] / largest_vafactor
    sign = np.array([-1.0 if mirrored else 1.0, 1.0] * 2 + [1.0])[:n]
    matrices[catalog.star] = correlations[:, parameters[:, None], parameters] * np.outer(sign, sign)
    errors = StarErrors(sigmas[:, :2], sigmas[:, 2:4] if n > 2 else None, dates, matrices)
    if not seen or point is None:
        return errors

    def factors(epoch: Float) -> Float:
        return parallax_factors(epoch, *point) * sign[:2]

    return replace(errors, parallax=sigmas[:, 4], factors=factors)


def refuse_campaign(inputs: CampaignInputs) -> None:
    """Refuse inconsistent inputs, and files of other runs or products that cannot be used."""
    config, base = inputs.config, inputs.base
    refuse_unsound(inputs)
    open_document(base / config.campaign.initial_distortion)
    rehearse_references(config, inputs.catalog.unit, base)
    if config.products.release is not None:
        open_document(base / config.products.release.reference)


def refuse_unsound(inputs: CampaignInputs) -> None:
    """Refuse exposures, lists or a catalogue that cannot be used; stars are not matched."""
    config, lists = inputs.config, inputs.star_lists
    refuse_other_chips(lists.lists, config.chips(), "campaign.lists")
    check_campaign(lists.lists, inputs.log, inputs.catalog)
    if inputs.catalog.sigma_u is None:
        raise InputError(
            "has no errors of the positions",
            where=inputs.catalog.source,
            do="give the columns sigma_u and sigma_v",
        )
    # a single exposure without usable detections is left out in matching
    if not any(good.any() for good in lists.passed):
        raise InputError(
            f"the cuts leave none of {len(lists)} detections in {len(lists.lists)} exposures "
            f"({lists.cut_words})",
            where="campaign",
            do="widen mag, saturation or q_max, or correct the columns that they use",
        )
    refuse_few(inputs.log.values("epoch"), config.time() if config.has_free_rates else None)
    _refuse_periods(config.products.release, config.time())
    held = config.holdout
    if held is not None and not isinstance(held.exposures, int):
        refuse_strangers(held.exposures, inputs.log.names, inputs.log.source)


def input_warnings(inputs: CampaignInputs) -> list[str]:
    """Clauses that warn about quantities that a campaign cannot determine or has to assume."""
    config, log, catalog = inputs.config, inputs.log, inputs.catalog
    out = []
    if inputs.unlogged:
        out.append(_unlogged(inputs.unlogged, log.source))
    for key in ("exptime", "ra", "dec"):  # PA_V3 is checked together with the matches
        unknown = int(np.isnan(log.values(key)).sum())
        if 0 < unknown < len(log):
            out.append(f"{key} is missing of {unknown} of {len(log)} exposures in {log.source}")
    epochs = log.values("epoch")
    span = float(np.ptp(epochs))
    if catalog.pm_u is None and span > YEARS_AT_REST:
        out.append(
            f"the catalogue has no proper motions, and the exposures span {span:.1f} years: "
            "whatever the stars move is taken for an error"
        )
    elif catalog.sigma_pm_u is None and catalog.pm_u is not None and span > YEARS_AT_REST:
        out.append(
            "the catalogue has no errors of the proper motions: its positions count as equally "
            "good at all epochs"
        )
    asked = {"assess.epoch": config.assess.epoch} | {
        f"requirement {requirement.name!r}": requirement.epoch
        for requirement in config.requirements()
    }
    for name, epoch in asked.items():
        if epoch is not None and not epochs.min() - span <= epoch <= epochs.max() + span:
            out.append(
                f"{name} asks for {epoch:g}, and the exposures are from {epochs.min():.2f} to "
                f"{epochs.max():.2f}: the drift is extrapolated by more than they span"
            )
    if config.catalogue is not None:
        apart = distance_of_pointings(log.values("ra"), log.values("dec"))
        doubt = config.catalogue.catalogue().doubt_on_pointings(apart)
        out += [doubt] if doubt else []
    if config.campaign.vafactor_source == "earth":
        out.append(
            "the factors of velocity aberration were computed from the motion of the Earth: that "
            "of the telescope about it, up to 2.5e-5, is in the scales of the exposures"
        )
    return out


def distance_of_pointings(ra: Float, dec: Float) -> float:
    """Largest distance of a pointing from the mean of all, in degrees; 0 if they are unknown."""
    known = np.isfinite(ra) & np.isfinite(dec)
    if not known.any():
        return 0.0
    mean = np.radians(mean_direction(ra[known], dec[known]))
    apart = angular_separation(*mean, np.radians(ra[known]), np.radians(dec[known]))
    return float(np.degrees(apart.max()))


def _unlogged(names: tuple[str, ...], log: str) -> str:
    remainder = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    several = len(names) > 1
    return (
        f"{len(names)} star list{'s are of exposures' if several else ' is of an exposure'} that "
        f"{log} does not have, and {'are' if several else 'is'} not used: "
        f"{', '.join(names[:MAX_NAMED])}{remainder}"
    )


def one_roll_angle(angles: Float) -> bool:
    """True if all roll angles (E,), in radians, respond alike to a shear of the catalogue.

    An exposure at roll angle a sees a shear of the catalogue as a shear of its detector rotated by
    2a. At a single angle, or at angles 180 degrees apart, the two shears are degenerate.
    """
    spread = 1.0 - abs(np.exp(2j * angles).mean())  # 2 s^2 for angles that scatter by a small s
    return bool(spread < 2.0 * np.radians(ONE_ROLL) ** 2)


def shear_warnings(rolls: Float, of: str) -> list[str]:
    """Warnings if the roll angles leave a shear of the catalogue undetermined.

    `rolls` are in degrees, NaN if unknown. `of` says where they are from.
    """
    angles = np.asarray(rolls, float)
    angles = angles[np.isfinite(angles)]
    if not len(angles) or not one_roll_angle(np.radians(angles)):
        return []
    return [
        f"all exposures have one roll angle, or angles half a turn apart ({of}): a shear of the "
        "catalogue is degenerate with one of the detector (A_2 - B_3, A_3 + B_2)"
    ]


@contextmanager
def frames_not_set() -> Iterator[None]:
    """Drop the advice to set model.frames from errors; campaigns set the frames themselves."""
    try:
        yield
    except DegenerateError as error:
        do = re.sub(r",? or set model\.frames = '\w+'", "", error.do)
        raise DegenerateError(error.cause, where=error.where, do=do) from error


def segment_counts(epochs: Float, time: TimeDependence) -> list[int]:
    """Number of exposures in each segment of the drift."""
    counts = np.bincount(_segment(epochs, time), minlength=time.n_segments)
    return [int(n) for n in counts]


def _segment(epochs: Float, time: TimeDependence) -> Int:
    """Number of the drift segment, from 0, of each epoch (E,)."""
    return np.searchsorted(time.breaks, epochs, side="right")


def segment_text(time: TimeDependence, number: int) -> str:
    """A segment of the drift, given by its number from 0, with its dates, as text."""
    edges = [None, *time.breaks, None]
    first, last = edges[number], edges[number + 1]
    dates = [
        "" if first is None else f"from {first:g}",
        "" if last is None else f"to {last:g}",
    ]
    return f"segment {number + 1} of the drift ({' '.join(d for d in dates if d) or 'all dates'})"


def refuse_few(epochs: Float, time: TimeDependence | None) -> None:
    """Refuse exposures at epochs (E,) that cannot determine the scatter or the drift."""
    n = len(epochs)
    if n < MIN_EXPOSURES:
        subject = "one exposure tells" if n == 1 else f"{n} exposures tell"
        raise DegenerateError(
            f"{subject} neither how exposures scatter nor how they drift",
            where="campaign.exposures",
            do=f"give at least {MIN_EXPOSURES}, or calibrate matched stars ([data] in place of "
            "[campaign], model.frames = 'shift_rotation')",
        )
    if time is None:
        return
    segment = _segment(epochs, time)
    for k in range(time.n_segments):
        inside = epochs[segment == k]
        fault = ""
        if not len(inside):
            fault = f"holds no exposure: they are from {epochs.min():.2f} to {epochs.max():.2f}"
        elif np.ptp(inside) < ONE_DAY:
            noun = "exposure" if len(inside) == 1 else "epoch"
            fault = f"holds one {noun} only, at {inside[0]:.2f}: its rate is not determined"
        if fault:
            raise DegenerateError(
                f"{segment_text(time, k)} {fault}",
                where="model.tdd",
                do="drop [model.tdd]"
                if time.n_segments == 1
                else "correct or drop model.tdd.breaks, or give exposures in that segment",
            )
    if len(time.terms) >= LINEAR_KINDS and n <= 2 * time.n_segments:
        lines = "a line" if time.n_segments == 1 else f"{time.n_segments} lines"
        raise DegenerateError(
            f"{n} exposures have no scatter about {lines}, as [model.tdd] asks for",
            where="model.tdd",
            do="give more exposures, drop a break, or drop [model.tdd]",
        )


def _refuse_periods(release: ReleaseBlock | None, time: TimeDependence | None) -> None:
    edges = [-np.inf, *(() if time is None else time.breaks), np.inf]
    for k, period in enumerate(() if release is None else release.period):
        key = f"products.release.period[{k + 1}]"
        if period.segment > len(edges) - 2:
            raise ConfigError(
                f"segment {period.segment} is asked for, but the drift has segments 0 to "
                f"{len(edges) - 2}",
                where=key,
                do="correct it, or give model.tdd.breaks",
            )
        first, last = edges[period.segment], edges[period.segment + 1]
        if time is not None and not (period.years[0] < last and period.years[1] > first):
            raise ConfigError(
                f"{period.years[0]:g} to {period.years[1]:g} lies outside "
                f"{segment_text(time, period.segment)}",
                where=key,
                do=f"correct the years, or segment = {period.segment} (counted from 0)",
            )
