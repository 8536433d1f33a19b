"""A calibration as the prior of the next one, with its full covariance.

The polynomials of stars of another night lie in the plane of the earlier calibration but for the
frame: shift, rotation, scale, shears, as far as these are to be found anew.  Along a frame the
prior is flat.  With the tangents T of the frame at the earlier mean m, and Q a basis of what is
orthogonal to them, Q^T theta has the covariance Q^T C Q, and the precision of the prior is

    P = Q (Q^T C Q)^-1 Q^T

so that P T = 0.  Maps L m of a linear frame L are on the same flat, but C turns with L: whoever
knows the turn, from a first fit, asks for the priors about that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import sampling_of
from bayesdist.calibration.plane import ARCSEC
from bayesdist.errors import InputError
from bayesdist.infer.equations.priors import GaussianPriors, JointPrior
from bayesdist.model import DistortionModel
from bayesdist.model.frames import LINEAR_MATRICES, frame_names
from bayesdist.utils.arrays import Float, Int

FEWEST_DRAWS = 4.0  # effective draws for each parameter, whose covariance is inverted
SINGULAR = 1e-12  # of the largest eigenvalue in units of the standard deviations
SCALED = "shift_rotation_scale"  # frames that are flat whatever the turn


@dataclass(frozen=True, eq=False)
class CalibrationPrior:
    """Prior of a model's polynomials, and of their drift, by an earlier calibration."""

    model: DistortionModel
    name: str  # of the earlier calibration, for messages
    index: Int  # (r,), entries of theta that it knows, the polynomials before the drift
    mean: Float  # (r,)
    cov: Float  # (r, r)
    frame: str  # kind of the frame along which the prior is flat, as of `model.frames`
    draws: float = np.inf  # effective number behind the covariance; infinite if computed

    @property
    def turns(self) -> bool:
        """True where the frame has linear terms."""
        return self.frame not in ("none", "shift")

    def loose(self) -> GaussianPriors:
        """Priors for a first fit, from which the turn is found: scale is free with rotation."""
        free = self.frame if self.frame == "affine" else SCALED
        return (replace(self, frame=free) if self.turns else self)._priors(np.eye(2))

    def about(self, theta: Float) -> GaussianPriors:
        """Priors turned as parameters (D,) are turned against the earlier calibration."""
        return self._priors(self._turn(theta) if self.turns else np.eye(2))

    @property
    def _shape(self) -> tuple[int, int, int]:
        """Chips, axes and terms of the polynomials that are known."""
        chips = len(self.model.chips)
        n = int((self.index < self.model.n_polynomial).sum())
        return chips, 2, n // (2 * chips)

    def _polynomials(self, values: Float) -> Float:
        n = int(np.prod(self._shape))
        return values[:n].reshape(self._shape)

    def _turn(self, theta: Float) -> Float:
        """Linear map (2, 2) that takes the earlier polynomials nearest to others, as the frame."""
        before = self._polynomials(self.mean)[..., 1:].swapaxes(0, 1).reshape(2, -1)
        after = self._polynomials(theta[self.index])[..., 1:].swapaxes(0, 1).reshape(2, -1)
        if self.frame == "affine":
            return np.asarray(np.linalg.lstsq(before.T, after.T, rcond=None)[0].T)
        z, w = before[0] + 1j * before[1], after[0] + 1j * after[1]
        factor = complex(np.vdot(z, w) / np.vdot(z, z))
        if self.frame != SCALED:
            factor /= abs(factor)
        return np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])

    def _priors(self, turn: Float) -> GaussianPriors:
        chips, _, k = self._shape
        r, n = len(self.index), 2 * chips * k
        by = np.eye(r)
        by[:n, :n] = np.kron(np.eye(chips), np.kron(turn, np.eye(k)))
        mean, cov = by @ self.mean, by @ self.cov @ by.T
        free = self._tangents(mean)
        sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
        unit = np.where(sigma > 0, sigma, sigma.max() or 1.0)
        turned = np.linalg.svd(free / unit[:, None])[0]
        rest = turned[:, free.shape[1] :]
        values, vectors = np.linalg.eigh(rest.T @ (cov / np.outer(unit, unit)) @ rest)
        if values[0] <= SINGULAR * values[-1]:
            raise InputError(
                "its covariance has directions without error, as where a gauge was fixed",
                where=self.name,
                do="let them free by prior_calibration.frame",
            )
        rows = (rest @ vectors) / unit[:, None]
        G = self.model.n_distortion
        centre, precision = np.zeros(G), np.zeros((G, G))
        centre[self.index] = mean
        inverse = self._unbiased(len(values)) * (rows / values) @ rows.T
        precision[np.ix_(self.index, self.index)] = (inverse + inverse.T) / 2
        D = self.model.n_params
        return GaussianPriors(np.zeros(D), np.zeros(D), JointPrior(centre, precision, len(values)))

    def _tangents(self, mean: Float) -> Float:
        """Derivatives (r, q) of the parameters by those of the frame."""
        polynomials = self._polynomials(mean)
        columns = []
        for name in frame_names(self.frame):
            moved = np.zeros(self._shape)
            if name in ("shift_u", "shift_v"):
                moved[:, int(name == "shift_v"), 0] = 1.0  # the first basis function is 1
            else:
                moved[..., 1:] = np.einsum("ab,cbk->cak", LINEAR_MATRICES[name], polynomials)[
                    ..., 1:
                ]
            columns.append(np.concatenate([moved.ravel(), np.zeros(len(mean) - moved.size)]))
        return np.array(columns).reshape(-1, len(mean)).T

    def _unbiased(self, n: int) -> float:
        """Factor on the inverse of a covariance of draws (Hartlap et al. 2007, A&A 464, 399)."""
        if np.isinf(self.draws):
            return 1.0
        if self.draws < FEWEST_DRAWS * n:
            raise InputError(
                f"its {self.draws:.0f} effective draws are too few for the covariance of {n} "
                "parameters",
                where=self.name,
                do=f"sample it to a sampler.target_ess of {FEWEST_DRAWS * n:.0f}, or name the file "
                "of its least-squares fit",
            )
        return (self.draws - n - 2) / (self.draws - 1)


def prior_of_calibration(
    calibration: Calibration,
    model: DistortionModel,
    *,
    frame: str | None = None,
    epoch: float | None = None,
    change_pix: float = 0.0,
) -> CalibrationPrior:
    """Prior of a model by an earlier calibration of the same detector.

    The calibration has its covariance, and no look-up tables; the model is of the same order or a
    higher one, whose further terms have no prior.  `frame` is that of the new stars against the
    earlier plane, along which the prior is flat: by default that of the model's exposures.  `epoch`
    is the date of a calibration that drifts, for a model that does not.  `change_pix` is the rms
    over the detector, on each axis, by which the two may differ: independent terms of equal rms are
    added to the covariance.  InputError for a calibration of other chips, another unit, a higher
    order or another drift.
    """
    own, name = calibration.model, calibration.name
    _require_alike(calibration, model)
    frame = model.frames if frame is None else frame
    if model.time is not None and frame not in ("none", "shift"):
        raise InputError(
            "the drift of the model would turn with the frame, which the prior leaves free",
            where="prior_calibration.frame",
            do="choose 'none' or 'shift', or leave model.tdd out",
        )
    index, rows, mean = [], [], []
    for chip in model.chips:
        if model.time is None:
            values, jacobian = calibration.coefficients(chip.number, epoch, "stated")
        else:  # those at the reference date, which are parameters themselves
            at = [own.coefficient_slice(chip.number, axis) for axis in (0, 1)]
            values = np.stack([np.asarray(calibration.solution.mean)[part] for part in at])
            jacobian = np.concatenate([np.eye(own.n_params)[part] for part in at])
        for axis in (0, 1):
            start = model.coefficient_slice(chip.number, axis).start
            index += [start + model.basis().terms.index(term) for term in own.basis().terms]
        rows.append(jacobian)
        mean.append(values.ravel())
    if model.time is not None:
        for chip in model.chips:
            part, there = model.tdd_slice(chip.number), own.tdd_slice(chip.number)
            index += range(part.start, part.stop)
            rows.append(np.eye(own.n_params)[there])
            mean.append(np.asarray(calibration.solution.mean)[there])
    jacobian = np.concatenate(rows)
    cov = jacobian @ np.asarray(calibration.solution.cov, float) @ jacobian.T
    if change_pix:
        n = 2 * own.n_terms * len(model.chips)
        share = (change_pix * calibration.pixel(epoch)[0]) ** 2 / own.n_terms
        each = np.concatenate([2 * [own.basis(c.number).mean_squares] for c in model.chips])
        cov[np.arange(n), np.arange(n)] += share / each.ravel()
    size = 1.0
    if own.unit != model.unit:
        size = ARCSEC[own.unit] / ARCSEC[model.unit]
    draws, _ = sampling_of(calibration.solution)
    return CalibrationPrior(
        model, name, np.array(index), size * np.concatenate(mean), size**2 * cov, frame, draws
    )


def _require_alike(calibration: Calibration, model: DistortionModel) -> None:
    """Refuse a calibration that says nothing of a model."""
    own, where = calibration.model, calibration.name
    if calibration.errors != "covariance":
        known = {"none": "no errors", "sigma": "errors without correlations"}[calibration.errors]
        raise InputError(
            f"has {known}, and a prior needs a covariance",
            where=where,
            do="name the run, or a file that bayesdist wrote",
        )
    if calibration.before or calibration.after:
        raise InputError(
            "has look-up tables, which are no part of a prior",
            where=where,
            do="name a calibration by polynomials alone",
        )
    if own.unit != model.unit and not {own.unit, model.unit} <= set(ARCSEC):
        raise InputError(
            f"is in {own.unit}, and the stars are in {model.unit}",
            where=where,
            do="give u and v in the unit of the earlier calibration",
        )
    sizes = {chip.number: tuple(chip.size) for chip in own.chips}
    for chip in model.chips:
        if sizes.get(chip.number) != tuple(chip.size):
            what = f"has no chip {chip.number}"
            if chip.number in sizes:
                nx, ny = sizes[chip.number]
                what = f"has a chip {chip.number} of {nx:g} x {ny:g} pixels"
            raise InputError(
                f"{what}, and the model has one of {chip.size[0]:g} x {chip.size[1]:g}",
                where=where,
                do="name a calibration of this detector, whose chips have the same numbers",
            )
    if own.order > model.order:
        raise InputError(
            f"is of order {own.order}, and the model of order {model.order}",
            where=where,
            do=f"set model.order to {own.order} or more",
        )
    if model.time is not None and own.time != model.time:
        raise InputError(
            "does not drift as the model does",
            where=where,
            do="give model.tdd the terms, dates and breaks of the earlier run, or leave it out",
        )
