"""A solution turned into the plane of an IDCTAB, with the error of the turn in its covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.solution import Solution
from bayesdist.errors import InputError
from bayesdist.model import DistortionModel, TimeDependence
from bayesdist.products.orientation import Orientation, check_frames

__all__ = ["Oriented", "oriented"]

Float = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Oriented:
    """A solution whose (u, v) are (Xc, Yc) of an IDCTAB, in arcseconds.

    Parameters
    ----------
    model : DistortionModel
    mean : ndarray, shape (D,)
    cov : ndarray, shape (D, D)
    source : Solution
        The solution before it was turned.
    orientation : Orientation
    with_orientation : ndarray, shape (D, 4)
        Covariance of the parameters with those of the orientation, which solutions of other
        filters share.
    """

    model: DistortionModel
    mean: Float
    cov: Float
    source: Solution
    orientation: Orientation
    with_orientation: Float

    def draws(self, n: int, rng: np.random.Generator) -> Float:
        """Parameter vectors, shape (n, D): each draw turned by a draw of the orientation."""
        o = self.orientation
        theta = np.asarray(self.source.draws(n, rng), float)
        if self.source is o.base:
            moved = (theta - np.asarray(o.base.mean)) @ o.derivative.T
            spread = o.reference_cov
        else:
            moved, spread = np.zeros((n, 4)), o.cov
        moved = moved + rng.multivariate_normal(np.zeros(4), spread, size=n, method="eigh")
        turn = o.scale * np.exp(moved[:, 2] + 1j * (o.angle + moved[:, 3]))
        return _turned(self.source.model, theta, turn, o.shift + moved[:, :2])

    @property
    def convergence(self) -> object:
        """That of the posterior; a linear fit has none."""
        return self.source.convergence  # type: ignore[attr-defined]

    @property
    def approximation(self) -> str:
        """That of the posterior; a linear fit has none."""
        return self.source.approximation  # type: ignore[attr-defined]


def oriented(solution: Solution, orientation: Orientation) -> Oriented:
    """Turn a solution into the plane of an IDCTAB.

    Every term of both axes is rotated together, those that depend on time as well: where (u, i, j)
    drifts, (v, i, j) does after the turn, so that the model of the result has both.

    Parameters
    ----------
    solution : Solution
        Without exposure frames; that on which the orientation rests, or that of another filter in
        the same system.
    orientation : Orientation

    Returns
    -------
    Oriented
        Its covariance holds the error of the orientation.  A solution other than the orientation's
        own is taken as independent of it.

    Raises
    ------
    InputError
        For a model with exposure frames, or in another unit than the orientation's.
    """
    model, base = solution.model, orientation.base
    check_frames(solution)
    if model.unit != base.model.unit:
        raise InputError(
            f"the solution is in {model.unit} and the orientation is for {base.model.unit}",
            where="model.unit",
            do="orient solutions of one system only",
        )
    mean, cov = np.asarray(solution.mean, float), np.asarray(solution.cov, float)
    turn = orientation.scale * np.exp(1j * orientation.angle)
    linear = _turned(model, np.eye(model.n_params), turn, np.zeros(2)).T
    turned = _turned(model, mean, turn, orientation.shift)
    # derivatives by shift_x, shift_y, log_scale, angle
    by = np.stack(
        [
            _turned(model, 0 * mean, turn, np.array([1.0, 0.0])),
            _turned(model, 0 * mean, turn, np.array([0.0, 1.0])),
            _turned(model, mean, turn, np.zeros(2)),
            _turned(model, mean, 1j * turn, np.zeros(2)),
        ],
        axis=1,
    )
    if solution is base:
        total = linear + by @ orientation.derivative
        with_orientation = total @ cov @ orientation.derivative.T + by @ orientation.reference_cov
        own = total @ cov @ total.T + by @ orientation.reference_cov @ by.T
    else:
        with_orientation = by @ orientation.cov
        own = linear @ cov @ linear.T + with_orientation @ by.T
    return Oriented(
        turned_model(model), turned, (own + own.T) / 2, solution, orientation, with_orientation
    )


def turned_model(model: DistortionModel) -> DistortionModel:
    """The model of a turned solution: in arcseconds, with both axes of each drifting term."""
    time = model.time
    if time is not None:
        time = TimeDependence(_both_axes(time), time.epoch0, time.breaks)
    return replace(model, unit="arcsec", time=time)


def _both_axes(time: TimeDependence) -> tuple[tuple[str, int, int], ...]:
    """The terms, and behind them those of the other axis that they lack."""
    partners = (("v" if axis == "u" else "u", i, j) for axis, i, j in time.terms)
    return (*time.terms, *(p for p in partners if p not in time.terms))


def _turned(model: DistortionModel, theta: Float, turn: complex | Complex, shift: Float) -> Float:
    """Parameters (..., D') of shift + turn (u + i v) from parameters (..., D)."""
    lead = theta.shape[:-1]
    turn = np.asarray(turn)[..., None]
    new = turned_model(model)
    out = np.zeros((*lead, new.n_params))
    for chip in model.chips:
        u, v = (model.coefficient_slice(chip.number, axis) for axis in (0, 1))
        w = turn * (theta[..., u] + 1j * theta[..., v])
        out[..., u], out[..., v] = w.real, w.imag
        out[..., u.start] += shift[..., 0]
        out[..., v.start] += shift[..., 1]
        if new.time is not None:
            rates = _rates(model, theta[..., model.tdd_slice(chip.number)])
            parts = [
                (turn * rates[i, j]).real if axis == "u" else (turn * rates[i, j]).imag
                for axis, i, j in new.time.terms
            ]
            out[..., new.tdd_slice(chip.number)] = np.concatenate(parts, axis=-1)
    return out


def _rates(model: DistortionModel, drifting: Float) -> dict[tuple[int, int], Complex]:
    """Time-dependent parameters (..., n_values) of u + i v for each pair of powers."""
    assert model.time is not None
    n = model.time.n_values
    out: dict[tuple[int, int], Complex] = {}
    for k, (axis, i, j) in enumerate(model.time.terms):
        values = drifting[..., n * k : n * (k + 1)] * (1 if axis == "u" else 1j)
        out[i, j] = out.get((i, j), 0) + values
    return out
