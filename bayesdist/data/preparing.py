"""Preparation of matches for the fit: selection, centroid errors, aberration, and held-out stars.

Stars are selected by the errors of their proper motions. Centroid errors are derived from the
scatter of the residuals, and catalogue positions are converted to a scale without aberration.

Matches that are held out of the fit are predicted afterwards. Their selection depends on a seed and
on the star code, or on the detector position if there are no codes. It does not depend on the order
of the rows or on the batches in which they are read.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.data.catalog import ReferenceCatalog
from bayesdist.data.exposures import ExposureLog
from bayesdist.data.magnitude_errors import MAD_TO_SIGMA, MagnitudeErrors
from bayesdist.data.matches import Matches
from bayesdist.data.tables.checks import columns_of
from bayesdist.errors import InputError, required
from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.random import mixed

_STARS_IN_BIN = 200  # stars per magnitude bin
_MAX_BINS = 40
# scatters above the median of ln(sigma): 0.6 % of a log-normal distribution is farther
_MAX_SCATTERS_ABOVE = 2.5
# smallest scatter of ln(sigma): keeps slightly larger errors if all are nearly equal
_MIN_SCATTER = 0.05
_MIN_STARS_OF_EXPOSURE = 10  # three determine a linear part and leave no residuals
Bits = NDArray[np.uint64]
HELD_OUT = "held out"  # reason under which held-out rows are counted


@dataclass(frozen=True, eq=False)
class MotionErrorLine:
    """Largest proper-motion error that counts as well measured, as a function of magnitude.

    Arrays (B,) have the magnitudes, and the errors in the catalogue's unit per year.
    """

    # mag, sigma (B,): knots in ascending magnitude; log-linear between them, constant beyond
    mag: Float
    sigma: Float

    def __call__(self, mag: ArrayLike) -> Float:
        """Largest error at the given magnitudes, in the catalogue's unit per year."""
        return np.exp(np.interp(np.asarray(mag, float), self.mag, np.log(self.sigma)))


def motion_error_line(catalog: ReferenceCatalog) -> MotionErrorLine:
    """Limit on the proper-motion error by magnitude; stars above it are badly measured.

    In magnitude bins of about 200 stars (at most 40 bins), the line is the median of the error
    times exp(2.5 s), where s is the robust scatter (1.4826 median absolute deviation) of its
    logarithm. The median follows the increase of errors towards faint stars; a star above the line
    has an unusual error for its magnitude. The error is the larger one of the two axes.

    Parameters
    ----------
    catalog : ReferenceCatalog
        Catalogue with magnitudes and proper-motion errors.

    Returns
    -------
    MotionErrorLine
        Largest error by magnitude.

    Raises
    ------
    InputError
        If there are no magnitudes or no errors of the motions.
    """
    catalog = catalog.select(catalog.measured_motion)
    sigma = _motion_errors(catalog)
    if catalog.mag is None:
        raise InputError(
            "has no magnitudes, which are needed to recognise poorly measured motions",
            where=catalog.source,
            do="give them, or keep all stars (campaign.pm_selection = 'all')",
        )
    count = int(np.clip(len(catalog) // _STARS_IN_BIN, 1, _MAX_BINS))
    parts = np.array_split(np.argsort(catalog.mag, kind="stable"), count)
    knots = []
    for part in parts:
        log = np.log(np.maximum(sigma[part], np.finfo(float).tiny))
        middle = float(np.median(log))
        scatter = max(MAD_TO_SIGMA * float(np.median(np.abs(log - middle))), _MIN_SCATTER)
        knots.append(
            (float(np.median(catalog.mag[part])), np.exp(middle + _MAX_SCATTERS_ABOVE * scatter))
        )
    mag, line = np.array(knots).T
    return MotionErrorLine(mag, line)


def select_motions(catalog: ReferenceCatalog) -> ReferenceCatalog:
    """Select stars with well measured proper motions (Kozhurina-Platais et al. (2015), Figure 3).

    Parameters
    ----------
    catalog : ReferenceCatalog
        Catalogue with magnitudes and proper-motion errors.

    Returns
    -------
    ReferenceCatalog
        Stars at or below the line of `motion_error_line` on both axes, and those whose motion is
        not measured but assumed with its error; with their codes.

    Raises
    ------
    InputError
        As for `motion_error_line`.
    """
    line = motion_error_line(catalog)
    mag = required(catalog.mag, "proper motions are selected by magnitude")
    return catalog.select((_motion_errors(catalog) <= line(mag)) | ~catalog.measured_motion)


def _motion_errors(catalog: ReferenceCatalog) -> Float:
    if catalog.sigma_pm_u is None or catalog.sigma_pm_v is None:
        raise InputError(
            "has no errors of the proper motions",
            where=catalog.source,
            do="give sigma_pm_u and sigma_pm_v",
        )
    return np.maximum(catalog.sigma_pm_u, catalog.sigma_pm_v)


def with_measured_motions(table: Matches, catalog: ReferenceCatalog) -> Matches:
    """Select matches of stars whose motion is measured.

    Exposures with fewer than 10 such stars are left out: too few for a linear part of their own.

    Parameters
    ----------
    table : Matches
        Matches with star codes of the catalogue.
    catalog : ReferenceCatalog
        Catalogue, which marks stars with an assumed motion.

    Returns
    -------
    Matches
        The same object if no motion of the catalogue is assumed.

    Raises
    ------
    InputError
        If no exposure has 10 stars with a measured motion.
    """
    if catalog.measured_motion.all():
        return table
    star = required(table.star, "stars with a measured motion are selected by their codes")
    measured = ~np.isin(star, catalog.star[~catalog.measured_motion])
    n = np.bincount(table.exposure[measured], minlength=len(table.exposure_names))
    measured &= n[table.exposure] >= _MIN_STARS_OF_EXPOSURE
    if not measured.any():
        raise InputError(
            f"no exposure has {_MIN_STARS_OF_EXPOSURE} stars with a measured motion, from which "
            "the errors of the centroids are derived",
            where=catalog.source,
            do="give it more motions, or star lists with errors (campaign.sigma = 'columns')",
        )
    selected = table.select(measured, reason="no measured motion")
    return selected.with_exposure_names(selected.exposures)


def centroid_errors(table: Matches, total: MagnitudeErrors) -> MagnitudeErrors:
    """Centroid errors: scatter of the residuals minus the errors of the catalogue, in quadrature.

    Parameters
    ----------
    table : Matches
        Matches with magnitudes and the errors of the catalogue.
    total : MagnitudeErrors
        Scatter of their residuals.

    Returns
    -------
    MagnitudeErrors
        Scatter minus the median catalogue error in each bin, in quadrature.

    Raises
    ------
    InputError
        If there are no magnitudes or no errors.
    """
    if table.mag is None or table.sigma_u is None or table.sigma_v is None:
        raise InputError(
            "has no magnitudes, or no errors of the catalogue",
            where=", ".join(table.sources),
            do="give lists with magnitudes and a catalogue with errors",
        )
    bin_number = np.searchsorted((total.mag[1:] + total.mag[:-1]) / 2, table.mag)
    of_bins = [np.flatnonzero(bin_number == k) for k in range(len(total.mag))]
    known_u, known_v = (
        np.array([np.median(sigma[rows]) if rows.size else 0.0 for rows in of_bins])
        for sigma in (table.sigma_u, table.sigma_v)
    )
    return total.less(known_u, known_v)


def neutralise_aberration(table: Matches, log: ExposureLog) -> Matches:
    """Matches with catalogue positions converted to a scale free of velocity aberration.

    In an exposure with the factor a of velocity aberration, a true offset on the sky is a times the
    offset in the aberration-free scale of the detector. Positions, relative to u = v = 0, and their
    errors are therefore divided by a. Another origin would shift all stars of an exposure equally.

    Parameters
    ----------
    table : Matches
        Matches with positions of the catalogue.
    log : ExposureLog
        Log with the factor of velocity aberration of each exposure of the table.

    Returns
    -------
    Matches
        Matches with rescaled positions and errors.

    Raises
    ------
    InputError
        If an exposure is not in the log or has no factor; the message names the first such
        exposure.
    """
    for name in table.exposures:
        if name not in log:
            raise InputError(f"has no exposure {name!r}", where=log.source, do="add it to the log")
    used = log.select(names=table.exposures)
    used.require("vafactor")
    factor = np.array(
        [used[name].vafactor if name in used else 1.0 for name in table.exposure_names], float
    )[table.exposure]
    lengths = ("u", "v", "sigma_u", "sigma_v", "u_nominal", "v_nominal")
    columns = columns_of(table, lengths)
    return table.with_columns(**{name: values / factor for name, values in columns.items()})


@dataclass(frozen=True)
class HoldoutSpec:
    """Selection of the matches to hold out: a fraction of the stars, and entire exposures."""

    fraction: float  # fraction of the stars, in [0, 1)
    exposures: tuple[str, ...] = ()
    seed: int = 1

    def which(self, table: Matches) -> Bool:
        """Boolean mask (N,) of the matches to hold out; all matches of a star are treated alike."""
        if table.star is not None:
            keys = [table.star.view(np.uint64)]
        else:
            # adding 0.0 makes -0.0 and 0.0 the same position
            keys = [(a + 0.0).view(np.uint64) for a in (table.x, table.y)]
        bits = np.full(len(table), mixed(np.array([self.seed], np.uint64))[0])
        for key in keys:
            bits = mixed(bits ^ key)
        chosen = (bits >> np.uint64(11)) * 2.0**-53 < self.fraction
        is_held_exposure = [name in set(self.exposures) for name in table.exposure_names]
        return np.asarray(chosen | np.array(is_held_exposure, bool)[table.exposure])


@dataclass(frozen=True, eq=False)
class HoldoutSplit:
    """Matches split into those to fit and those that are held out."""

    kept: Matches  # matches to fit; exposures without such matches are not listed
    held: Matches  # held-out matches, with the names of all exposures


def exposures_drawn(names: Sequence[str], n: int, seed: int) -> tuple[str, ...]:
    """Names of `n` exposures drawn with a seed, in the order of `names`.

    Raises InputError unless fewer exposures are drawn than there are.
    """
    if n >= len(names):
        raise InputError(
            f"{n} exposures are to be held out, but there are only {len(names)}",
            where="holdout.exposures",
            do="hold out fewer",
        )
    drawn = sorted(names, key=lambda name: hashlib.sha256(f"{seed}\n{name}".encode()).digest())
    chosen = set(drawn[:n])
    return tuple(name for name in names if name in chosen)


def split_matches(matches: Matches, aside: HoldoutSpec) -> HoldoutSplit:
    """Split matches into those to fit and those to hold out; matches on disk are read once.

    Raises InputError for an unknown exposure, or if either part would be empty.
    """
    location = ", ".join(matches.sources)
    refuse_strangers(aside.exposures, matches.exposure_names, location)
    masks = []
    has_fitted = np.zeros(len(matches.exposure_names), bool)
    for batch in matches.batches():
        rows = aside.which(batch)
        has_fitted[batch.exposure[~rows]] = True
        masks.append(rows)
    held = np.concatenate(masks)
    _refuse_nothing(int(held.sum()), len(held), location)
    names = tuple(
        n for n, is_fitted in zip(matches.exposure_names, has_fitted, strict=True) if is_fitted
    )
    fitted = matches.select(~held, reason=HELD_OUT).with_exposure_names(names)
    return HoldoutSplit(fitted, matches.select(held))


def refuse_strangers(asked: Sequence[str], names: Sequence[str], where: str) -> None:
    """Raise InputError if a name of a held-out exposure, in `asked`, is not among `names`."""
    for name in asked:
        if name not in names:
            raise InputError(
                f"there is no exposure {name!r} to be held out",
                where=where,
                do=f"name some of {', '.join(names[:5])}, ... in holdout.exposures",
            )


def _refuse_nothing(held: int, n: int, where: str) -> None:
    if 0 < held < n:
        return
    raise InputError(
        "no star is held out"
        if held == 0
        else "every star is held out, so that none is left to fit",
        where=where,
        do="correct holdout.fraction and holdout.exposures",
    )
