"""Prior for a distortion model from an earlier calibration, with its full covariance.

New observations differ from the earlier calibration by a frame: a shift, and as required a
rotation, scale and shears.  The prior is flat along the parameters of this frame.  With the
derivatives T of the distortion parameters with respect to the frame parameters at the earlier mean
m, and an orthonormal basis Q of the complement of T, Q^T theta has the covariance Q^T C Q, where C
is the covariance of the earlier calibration.  The precision of the prior is

    P = Q (Q^T C Q)^-1 Q^T

so that P T = 0.  A linear frame L transforms not only m but also C.  The prior is therefore first
evaluated without a rotation (`CalibrationPrior.loose`), and then for the frame that a first fit has
found (`CalibrationPrior.about`).
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

FEWEST_DRAWS = 4.0  # minimum effective draws per parameter, to invert a sample covariance
SINGULAR = 1e-12  # smallest ratio of eigenvalues of the correlation matrix
SCALED = "shift_rotation_scale"  # kind of frame with the same flat directions for every rotation


@dataclass(frozen=True, eq=False)
class CalibrationPrior:
    """Prior for the polynomials and the drift of a model, from an earlier calibration."""

    model: DistortionModel
    name: str  # name of the earlier calibration, for messages
    index: Int  # (r,), entries of theta that have a prior, polynomials before drift
    mean: Float  # (r,)
    cov: Float  # (r, r)
    frame: str  # kind of frame along which the prior is flat, see `model.frames`
    draws: float = np.inf  # effective number of draws for `cov`; infinite if it is analytic

    @property
    def turns(self) -> bool:
        """True if the frame has linear terms."""
        return self.frame not in ("none", "shift")

    def loose(self) -> GaussianPriors:
        """Priors for a first fit, which determines the frame.

        They are flat along the frame with an additional scale, unless the frame has no linear
        terms.
        """
        flat_frame = self.frame if self.frame == "affine" else SCALED
        return (replace(self, frame=flat_frame) if self.turns else self)._priors(np.eye(2))

    def about(self, theta: Float) -> GaussianPriors:
        """Priors for the frame between the earlier calibration and the parameters theta (D,)."""
        return self._priors(self._turn(theta) if self.turns else np.eye(2))

    @property
    def _shape(self) -> tuple[int, int, int]:
        """Numbers of chips, axes and terms of the polynomials that have a prior."""
        chips = len(self.model.chips)
        n = int((self.index < self.model.n_polynomial).sum())
        return chips, 2, n // (2 * chips)

    def _polynomials(self, values: Float) -> Float:
        n = int(np.prod(self._shape))
        return values[:n].reshape(self._shape)

    def _turn(self, theta: Float) -> Float:
        """Linear part (2, 2) of the frame from the earlier polynomials to those of theta (D,)."""
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
        transformation = np.eye(r)
        transformation[:n, :n] = np.kron(np.eye(chips), np.kron(turn, np.eye(k)))
        mean, cov = transformation @ self.mean, transformation @ self.cov @ transformation.T
        free = self._tangents(mean)
        sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
        unit = np.where(sigma > 0, sigma, sigma.max() or 1.0)
        turned = np.linalg.svd(free / unit[:, None])[0]
        complement = turned[:, free.shape[1] :]
        values, vectors = np.linalg.eigh(complement.T @ (cov / np.outer(unit, unit)) @ complement)
        if values[0] <= SINGULAR * values[-1]:
            raise InputError(
                "its covariance has directions without error, probably due to a fixed gauge",
                where=self.name,
                do="make these directions free with prior_calibration.frame",
            )
        rows = (complement @ vectors) / unit[:, None]
        G = self.model.n_distortion
        centre, precision = np.zeros(G), np.zeros((G, G))
        centre[self.index] = mean
        inverse = self._unbiased(len(values)) * (rows / values) @ rows.T
        precision[np.ix_(self.index, self.index)] = (inverse + inverse.T) / 2
        D = self.model.n_params
        return GaussianPriors(np.zeros(D), np.zeros(D), JointPrior(centre, precision, len(values)))

    def _tangents(self, mean: Float) -> Float:
        """Derivatives (r, q) of the parameters with respect to those of the frame."""
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
        """Factor that makes the inverse of a sample covariance of n parameters unbiased.

        See Hartlap et al. (2007, A&A 464, 399).
        """
        if np.isinf(self.draws):
            return 1.0
        if self.draws < FEWEST_DRAWS * n:
            raise InputError(
                f"its {self.draws:.0f} effective draws are too few for the covariance of {n} "
                "parameters",
                where=self.name,
                do=f"sample it to a sampler.target_ess of {FEWEST_DRAWS * n:.0f}, or give the file "
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
    """Prior for a model from an earlier calibration of the same detector.

    Parameters
    ----------
    calibration : Calibration
        Earlier calibration, with a covariance and without look-up tables.
    model : DistortionModel
        Model of at least the same order.  Terms of higher order have no prior.
    frame : str, optional
        Kind of frame between the new observations and the earlier calibration, along which the
        prior is flat; by default that of the model's exposures.
    epoch : float, optional
        Decimal years at which a calibration that drifts is evaluated, for a model that does not.
    change_pix : float
        Rms per axis over the detector, in pixels, by which the distortion may have changed.
        Independent terms of equal rms are added to the covariance.

    Returns
    -------
    CalibrationPrior

    Raises
    ------
    InputError
        If the calibration has no covariance, has look-up tables, or differs from the model in its
        chips, unit or drift, or its order is higher.
    """
    earlier, name = calibration.model, calibration.name
    _require_alike(calibration, model)
    frame = model.frames if frame is None else frame
    if model.time is not None and frame not in ("none", "shift"):
        raise InputError(
            "the drift of the model would rotate with the frame, along which the prior is flat",
            where="prior_calibration.frame",
            do="choose 'none' or 'shift', or omit model.tdd",
        )
    index, rows, mean = [], [], []
    for chip in model.chips:
        if model.time is None:
            values, jacobian = calibration.coefficients(chip.number, epoch, "stated")
        else:  # coefficients at the reference date, which are parameters
            at = [earlier.coefficient_slice(chip.number, axis) for axis in (0, 1)]
            values = np.stack([np.asarray(calibration.solution.mean)[part] for part in at])
            jacobian = np.concatenate([np.eye(earlier.n_params)[part] for part in at])
        for axis in (0, 1):
            start = model.coefficient_slice(chip.number, axis).start
            index += [start + model.basis().terms.index(term) for term in earlier.basis().terms]
        rows.append(jacobian)
        mean.append(values.ravel())
    if model.time is not None:
        for chip in model.chips:
            part, earlier_part = model.tdd_slice(chip.number), earlier.tdd_slice(chip.number)
            index += range(part.start, part.stop)
            rows.append(np.eye(earlier.n_params)[earlier_part])
            mean.append(np.asarray(calibration.solution.mean)[earlier_part])
    jacobian = np.concatenate(rows)
    cov = jacobian @ np.asarray(calibration.solution.cov, float) @ jacobian.T
    if change_pix:
        n = 2 * earlier.n_terms * len(model.chips)
        added_variance = (change_pix * calibration.pixel(epoch)[0]) ** 2 / earlier.n_terms
        mean_squares = np.concatenate(
            [2 * [earlier.basis(c.number).mean_squares] for c in model.chips]
        )
        cov[np.arange(n), np.arange(n)] += added_variance / mean_squares.ravel()
    size = 1.0
    if earlier.unit != model.unit:
        size = ARCSEC[earlier.unit] / ARCSEC[model.unit]
    draws, _ = sampling_of(calibration.solution)
    return CalibrationPrior(
        model, name, np.array(index), size * np.concatenate(mean), size**2 * cov, frame, draws
    )


def _require_alike(calibration: Calibration, model: DistortionModel) -> None:
    """Raise InputError if a calibration cannot be the prior of a model."""
    earlier, location = calibration.model, calibration.name
    if calibration.errors != "covariance":
        available = {"none": "no errors", "sigma": "errors without correlations"}[
            calibration.errors
        ]
        raise InputError(
            f"has {available}, but a prior needs a covariance",
            where=location,
            do="give the run, or a file that bayesdist wrote",
        )
    if calibration.before or calibration.after:
        raise InputError(
            "has look-up tables, which a prior cannot include",
            where=location,
            do="give a calibration that has only polynomials",
        )
    if earlier.unit != model.unit and not {earlier.unit, model.unit} <= set(ARCSEC):
        raise InputError(
            f"is in {earlier.unit}, but the stars are in {model.unit}",
            where=location,
            do="give u and v in the unit of the earlier calibration",
        )
    sizes = {chip.number: tuple(chip.size) for chip in earlier.chips}
    for chip in model.chips:
        if sizes.get(chip.number) != tuple(chip.size):
            difference = f"has no chip {chip.number}"
            if chip.number in sizes:
                nx, ny = sizes[chip.number]
                difference = f"has a chip {chip.number} of {nx:g} x {ny:g} pixels"
            raise InputError(
                f"{difference}, but the model has one of {chip.size[0]:g} x {chip.size[1]:g}",
                where=location,
                do="give a calibration of this detector with the same chip numbers",
            )
    if earlier.order > model.order:
        raise InputError(
            f"is of order {earlier.order}, but the model is of order {model.order}",
            where=location,
            do=f"set model.order to at least {earlier.order}",
        )
    if model.time is not None and earlier.time != model.time:
        raise InputError(
            "does not have the same drift as the model",
            where=location,
            do="give model.tdd the terms, dates and breaks of the earlier run, or omit it",
        )
