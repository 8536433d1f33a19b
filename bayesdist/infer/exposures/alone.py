"""Independent fits of every exposure, in the reference gauge, and their linear terms.

The way of ACS ISR 2015-06 (sections 4.2 and 4.4): all chips of one exposure are fitted in the one
system of the catalogue, rotated and shifted to the reference chip; the linear terms of all
exposures, each with its covariance, are then a series in time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.matches import Matches
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.equations.scaled import one_thread
from bayesdist.infer.linear import DEFAULT_REJECTION, LinearFit, Rejection, fit_linear
from bayesdist.infer.solution import ReferenceGauge, Solution, TransformedSolution
from bayesdist.infer.transforms import (
    LinearTerms,
    bare_model,
    linear_terms,
    reference_gauge,
    without_frames,
)
from bayesdist.model import DistortionModel

__all__ = ["ExposureSolutions", "fit_exposures"]

Float = NDArray[np.float64]

HELD_WITHIN = 1e-6  # pixels: the sigma with which terms are fixed at a given value


@dataclass(frozen=True, eq=False)
class ExposureSolutions:
    """Solutions of single exposures: a series in time.

    Parameters
    ----------
    names : tuple of str, length E
        Exposures.
    epoch : ndarray, shape (E,)
        Decimal years.
    labels : tuple of str, length k
        Linear terms, as in `LinearTerms`.
    values : ndarray, shape (E, k)
        In the reference gauge; A_1, B_1 and A_3 of the reference chip are zero and have no error.
    cov : ndarray, shape (E, k, k)
        Formal covariance.
    views : tuple of TransformedSolution
        The whole solution of each exposure, in the reference gauge.
    fits : tuple of LinearFit
        As fitted, in the system of the catalogue.
    skipped : dict of str to str
        Exposures left out, with the reason.
    """

    names: tuple[str, ...]
    epoch: Float
    labels: tuple[str, ...]
    values: Float
    cov: Float
    views: tuple[TransformedSolution, ...]
    fits: tuple[LinearFit, ...]
    skipped: Mapping[str, str]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def sigma(self) -> Float:
        """Formal standard deviations, shape (E, k)."""
        return np.sqrt(np.maximum(np.einsum("ekk->ek", self.cov), 0.0))

    @property
    def gauges(self) -> tuple[ReferenceGauge, ...]:
        """Rotation and shift of the catalogue in each exposure."""
        return tuple(view.gauge for view in self.views if view.gauge is not None)

    def terms(self, *labels: str) -> tuple[LinearTerms, ...]:
        """Selected linear terms of each exposure.

        Raises
        ------
        InputError
            For an unknown label.
        """
        every = zip(self.values, self.cov, strict=True)
        return tuple(LinearTerms(self.labels, v, c).select(*labels) for v, c in every)

    def series(self, *labels: str) -> tuple[Float, Float, Float]:
        """Selected linear terms against time.

        Parameters
        ----------
        *labels : str

        Returns
        -------
        epoch : ndarray, shape (E,)
        values : ndarray, shape (E, k)
        cov : ndarray, shape (E, k, k)
        """
        some = self.terms(*labels)
        return self.epoch, np.array([t.values for t in some]), np.array([t.cov for t in some])


@one_thread
def fit_exposures(
    matches: Matches,
    model: DistortionModel,
    *,
    chip: int = 2,
    high_order: Solution | None = None,
    skip: bool = False,
    priors: GaussianPriors | None = None,
    rejection: Rejection = DEFAULT_REJECTION,
) -> ExposureSolutions:
    """Fit every exposure independently.

    Parameters
    ----------
    matches : Matches
        With errors and epochs.
    model : DistortionModel
        Its order, chips and unit are those of each exposure; frames and time dependence are
        ignored.
    chip : int
        Number of the reference chip.
    high_order : Solution, optional
        Of all exposures together: terms above the first order are fixed at its values, since a
        single exposure with few stars hardly determines them.  Their error is then common to all
        exposures, and is not in their covariance.
    skip : bool
        True to leave out and count exposures that cannot be fitted; else they are an error.
    priors : GaussianPriors, optional
        On the parameters of one exposure: those of `model` without frames and time dependence.
    rejection : Rejection
        As of `fit_linear`.

    Returns
    -------
    ExposureSolutions

    Raises
    ------
    InputError
        For matches without epochs, or a joint solution of another order or other chips.
    DegenerateError
        Naming exposure and chip: no stars on a chip, too few, or badly spread ones; when no
        exposure is left.
    """
    if matches.epoch is None:
        raise InputError(
            "a series in time needs the epoch of every exposure",
            where="data.columns",
            do="map column 'epoch'",
        )
    alone = replace(bare_model(model), time=None)
    base = priors or GaussianPriors.none(alone)
    joint = None if high_order is None else reference_gauge(without_frames(high_order), chip)
    if joint is not None and (joint.model.order, joint.model.chips) != (alone.order, alone.chips):
        raise InputError(
            f"the joint solution has order {joint.model.order} on {len(joint.model.chips)} chips, "
            f"and exposures are fitted with order {alone.order} on {len(alone.chips)}",
            where="high_order",
            do="give a solution of the same order and chips",
        )
    order = np.argsort(matches.exposure, kind="stable")
    codes, starts = np.unique(matches.exposure[order], return_index=True)
    names, epochs, fits, views, terms = [], [], [], [], []
    skipped: dict[str, str] = {}
    for code, rows in zip(codes, np.split(order, starts[1:]), strict=True):
        name = matches.exposure_names[code]
        table = matches.select(np.sort(rows))
        assert table.epoch is not None
        epoch = float(np.median(table.epoch))
        try:
            _require_stars(table, alone, 3 if joint is not None else alone.n_terms)
            if joint is None:
                fit = fit_linear(table, alone, rejection=rejection, priors=base)
            else:
                fit = _fit_held(table, alone, joint, epoch, chip, base, rejection)
        except DegenerateError as error:
            where = f"exposure {name}" + (f", {error.where}" if error.where else "")
            if not skip:
                raise DegenerateError(error.cause, where=where, do=error.do) from error
            skipped[name] = error.cause
            continue
        view = reference_gauge(fit, chip)
        names.append(name)
        epochs.append(epoch)
        fits.append(fit)
        views.append(view)
        terms.append(linear_terms(view))
    if not names:
        raise DegenerateError(
            f"none of {len(codes)} exposures can be fitted: {next(iter(skipped.values()))}",
            where=", ".join(matches.sources),
            do="lower model.order, or hold the high orders at a joint solution",
        )
    return ExposureSolutions(
        names=tuple(names),
        epoch=np.array(epochs),
        labels=terms[0].labels,
        values=np.array([t.values for t in terms]),
        cov=np.array([t.cov for t in terms]),
        views=tuple(views),
        fits=tuple(fits),
        skipped=skipped,
    )


def _require_stars(table: Matches, model: DistortionModel, least: int) -> None:
    """Raise DegenerateError for a chip of an exposure with fewer stars than terms to be fitted."""
    numbers = table.chip_number
    for chip in model.chips:
        n = int((numbers == chip.number).sum())
        if n < least:
            raise DegenerateError(
                f"{n} stars lie on this chip, fewer than the {least} terms of an axis"
                if n
                else "no star lies on this chip",
                where=f"chip {chip.name}",
                do="leave the exposure out (skip), or hold the high orders at a joint solution",
            )


def _fit_held(
    table: Matches,
    model: DistortionModel,
    joint: TransformedSolution,
    epoch: float,
    chip: int,
    base: GaussianPriors,
    rejection: Rejection,
) -> LinearFit:
    """Fit of one exposure with the terms above the first order fixed.

    They are known in the reference gauge, and the exposure has an orientation of its own.  It is
    found from a linear map, then from the fit: the mean is linear in the fixed values.
    """
    timed = joint.model.time is not None
    groups = joint.model.groups(
        len(model.chips),
        epoch=epoch if timed else None,
        chip=[c.number for c in model.chips],
    )
    known = joint.model.effective(joint.mean, groups)[groups.index]  # (chips, 2, K)
    high = np.array([i + j > 1 for i, j in model.basis(chip).terms])
    index = np.flatnonzero(np.tile(high, 2 * len(model.chips)))
    sigma = HELD_WITHIN * (1.0 if model.unit == "pix" else model.pixel_size(known.ravel()))

    def held(angle: float) -> Float:
        """Values of the fixed terms in an exposure that the gauge turns by an angle."""
        w = np.exp(-1j * angle) * (known[:, 0] + 1j * known[:, 1])
        return np.stack([w.real, w.imag], axis=1)[..., high].ravel()

    angle = _rotation(table, model, known)
    centre, precision = base.centre.copy(), base.precision.copy()
    centre[index], precision[index] = held(angle), sigma**-2
    priors = GaussianPriors(centre, precision)
    fit = fit_linear(table, model, rejection=rejection, priors=priors)
    gain = fit.cov[:, index] * sigma**-2
    for _ in range(20):
        found = reference_gauge(fit, chip).gauge
        assert found is not None
        step = held(found.rotation) - held(angle)
        fit, angle = replace(fit, mean=fit.mean + gain @ step), found.rotation
        if np.abs(step).max(initial=0.0) < sigma:
            break
    return fit


def _rotation(table: Matches, model: DistortionModel, known: Float) -> float:
    """Angle by which a gauge would turn (u, v), from a linear map of the joint solution."""
    bare = known.reshape(-1)
    w = model.predict(bare, table.x, table.y, chip=table.chip_number)
    A = np.column_stack([np.ones(len(table)), w])
    M = np.linalg.lstsq(A, np.column_stack([table.u, table.v]))[0][1:].T
    return float(-np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1]))
