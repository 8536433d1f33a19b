"""Test of a released solution against new matches.

The new matches are fitted independently of the release, with its polynomial order, frames for each
exposure, a drift fixed to the released rates, and a new outlier mixture with jitter.  The new
polynomials at the mean date are mapped to the released ones by the frame that the data cannot
determine.  The remaining difference is the change.  Its covariance is the sum of those of the new
fit and of the release at this date, including the extrapolated rates.  For a campaign, exposures
deviate from the polynomials with the scatter of the release, and only shifts and rotations cannot
be determined.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.errors import InputError
from bayesdist.infer.catalogue.star_covariance import star_covariance, star_influence
from bayesdist.infer.catalogue.star_errors import StarErrors
from bayesdist.infer.density.grid import build_proposal
from bayesdist.infer.density.target import Target
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.equations.scaled import FieldTest, chi_square
from bayesdist.infer.exposures.hierarchy import held_in_reference
from bayesdist.infer.solution.linear import DEFAULT_REJECTION, LinearFit, Rejection, fit_linear
from bayesdist.infer.solution.solution import Solution, TransformedSolution
from bayesdist.infer.solution.transforms import without_frames
from bayesdist.infer.stars.likelihood import MixtureAt, OutlierMixture
from bayesdist.infer.stars.loading import load
from bayesdist.infer.stars.shards import Compute
from bayesdist.model import DistortionModel
from bayesdist.model.alignment import frame_between, frame_fields, mean_squares, without
from bayesdist.utils.arrays import Float

__all__ = ["NewFit", "SolutionChange", "change_of", "fit_new", "new_model", "with_star_errors_of"]

SAMPLE = 1_000_000  # number of matches used to compute the mean date
HELD = 1e-4  # prior sigma of a fixed rate, in units of its released sigma


@dataclass(frozen=True, eq=False)
class NewFit:
    """Fit of the new matches, independent of the release.

    Parameters
    ----------
    released : TransformedSolution
        The released polynomials and their drift, without frames.
    fit : LinearFit
        Least-squares fit of the new matches, from which the mixture fit starts.
    theta : ndarray, shape (D,)
        Mode of the mixture posterior, for the model of `fit`.
    cov : ndarray, shape (D, D)
        Covariance of theta.
    hyper : dict of str to float
        Hyperparameters 'j', 'f', 's_out' of the mixture at the mode, if they are fitted.
    target : Target
        Posterior density of the new matches.
    psi : ndarray
        The mode in sampled coordinates.
    epoch : float or None
        Mean date of the matches in decimal years; None if the model does not depend on time.
    scatter : ndarray, shape (q,)
        Prior inverse variances of the parameters of an exposure; zero for free parameters.
    extra : ndarray, shape (n, n) or None
        Additional covariance of the polynomials from errors common to all matches of a star.
    common : ndarray, shape (n_distortion, n) or None
        Covariance between the release and these polynomials, caused by common stars.
    """

    released: TransformedSolution
    fit: LinearFit
    theta: Float
    cov: Float
    hyper: dict[str, float]
    target: Target
    psi: Float
    epoch: float | None
    scatter: Float = field(default_factory=lambda: np.zeros(0))
    extra: Float | None = None
    common: Float | None = None

    @property
    def model(self) -> DistortionModel:
        """Model of the new matches: that of the release, with the new exposures."""
        return self.fit.model

    @property
    def likelihood(self) -> MixtureAt:
        """Likelihood of the mixture at its mode."""
        h = self.psi[None, self.target.n_theta :]
        return MixtureAt(self.theta, self.target.hyper.constants(h))

    @property
    def open(self) -> DistortionModel:
        """Model whose frames have only those parameters that the data cannot determine."""
        if self.model.gauge == "first":
            return self.model
        return replace(
            self.model,
            frames="shift_rotation",
            gauge="first",
            held=(0.0, 0.0, 0.0),
            chip_deviations=False,
        )


@dataclass(frozen=True, eq=False)
class SolutionChange:
    """Difference between the polynomials of the new matches and the released ones.

    Parameters
    ----------
    model : DistortionModel
        Model of the release, without frames.
    epoch : float or None
        Date at which the solutions are compared, in decimal years.
    released : ndarray, shape (chips, 2, K)
        Released polynomials at that date.
    difference : ndarray, shape (chips, 2, K)
        New minus released polynomials, in the frame of the release, without the part that frames
        can absorb.
    cov : ndarray, shape (n, n)
        Covariance of the difference, with n = 2 K chips.
    released_cov : ndarray, shape (n, n)
        Covariance of the released polynomials at that date, including all other errors that are
        common to the new matches.
    absorbed : ndarray, shape (n, q)
        Coefficients of the fields that frames can absorb.
    test : FieldTest
        Chi-square test of the difference.
    frame : tuple of ndarray
        Matrix (2, 2) and shift (2,) from the release to the first new exposure.
    """

    model: DistortionModel
    epoch: float | None
    released: Float
    difference: Float
    cov: Float
    released_cov: Float
    absorbed: Float
    test: FieldTest
    frame: tuple[Float, Float]


def fit_new(
    released: Solution,
    matches: Matches,
    *,
    mixture: OutlierMixture | None = None,
    rejection: Rejection = DEFAULT_REJECTION,
    compute: Compute | None = None,
    scatter: Mapping[str, float] | None = None,
    frames: str | None = None,
) -> NewFit:
    """Fit new matches independently of the release.

    Parameters
    ----------
    released : Solution
        A fit or a posterior. The kind of its frames is used, but not the frames themselves.
    matches : Matches
        New stars, with errors.
    mixture : OutlierMixture, optional
        Outlier model; by default that of a released posterior, or Gaussian outliers.
    rejection : Rejection
        See `fit_linear`.
    compute : Compute, optional
        See `fit_linear`.
    scatter : mapping of str to float, optional
        Standard deviations of the exposures of a campaign by name of the frame parameter, such as
        'scale'. Required if the release is that of a campaign.
    frames : str, optional
        Kind of the frames of the new exposures; by default that of the release.

    Returns
    -------
    NewFit

    Raises
    ------
    InputError
        If the matches have another unit than the release, or lack the epochs that it needs.
    DegenerateError
        If the matches do not determine polynomials of the released order.
    """
    bare = without_frames(released)
    model = new_model(released.model, matches)
    if frames is not None:
        model = replace(model, frames=frames)
    scattering = np.zeros(model.n_frame)
    if scatter is not None:
        model = held_in_reference(matches, model, model.chips[0].number)
        model = replace(model, chip_deviations=released.model.chip_deviations)
        names = model.free_frame_names(1)
        scattering = np.array([scatter[k] ** -2.0 if k in scatter else 0.0 for k in names])
    shards = load(model, matches, compute)
    mixture = mixture or released.mixture or OutlierMixture()
    priors = _priors(bare, model, scatter or {})
    fit = fit_linear(shards, model, rejection=rejection, priors=priors)
    target = Target(shards, mixture, priors)
    proposal = build_proposal(target, fit)
    best, n = proposal.best, model.n_params
    psi = proposal.split.to_psi(best.mode, best.at)
    epoch = matches.sample(SAMPLE).epoch if model.time is not None else None
    return NewFit(
        released=bare,
        fit=fit,
        theta=psi[:n],
        cov=best.factor.covariance()[:n, :n],
        hyper={k: float(v) for k, v in target.hyper.values(psi[n:]).items()},
        target=target,
        psi=psi,
        epoch=None if epoch is None else float(np.mean(epoch)),
        scatter=scattering,
    )


def new_model(released: DistortionModel, matches: Matches) -> DistortionModel:
    """Model of the release with the exposures of the new matches.

    Parameters
    ----------
    released : DistortionModel
        Model of the release.
    matches : Matches
        The new matches.

    Returns
    -------
    DistortionModel

    Raises
    ------
    InputError
        If the matches have another unit, or lack the epochs that the release needs.
    """
    location = ", ".join(matches.sources)
    if matches.unit != released.unit:
        raise InputError(
            f"the new matches are in {matches.unit}, but the release is in {released.unit}",
            where=location,
            do="convert them to one unit",
        )
    if released.time is not None and not matches.has_epoch:
        raise InputError(
            "the release depends on time, but the new matches have no epochs",
            where=location,
            do="map column 'epoch'",
        )
    sample = matches.sample(SAMPLE)
    return replace(
        released,
        exposures=matches.exposure_names,
        gauge="first",
        held=(0.0, 0.0, 0.0),
        chip_deviations=False,
        origin=(float(np.median(sample.u)), float(np.median(sample.v))),
    )


def change_of(new: NewFit, *, draws: float = np.inf) -> SolutionChange:
    """Difference between the polynomials of the new matches and the release, with its test.

    Parameters
    ----------
    new : NewFit
    draws : float
        Effective number of draws from which the released covariance was estimated. Their finite
        number matters less if the release contributes a small fraction of the covariance
        (Welch and Satterthwaite).

    Returns
    -------
    SolutionChange
    """
    released, model = new.released, new.released.model
    n, K, C = model.n_polynomial, model.n_terms, len(model.chips)
    at = _at_epoch(model, new.epoch)  # (n, n_distortion)
    old = (at @ released.mean).reshape(C, 2, K)
    now = (at @ new.theta[: model.n_distortion]).reshape(C, 2, K)
    # both solutions have the same rates; their error is counted once, with the release
    new_cov = new.cov[:n, :n]
    origin = np.asarray(new.model.origin)
    M, d = frame_between(old, now, new.open)
    back = np.linalg.inv(M)
    constant = np.zeros((C, 2, K))
    constant[:, :, 0] = origin
    shift = constant.copy()
    shift[:, :, 0] += d
    moved = np.einsum("ab,cbk->cak", back, now - shift) + constant
    turn = np.kron(np.eye(C), np.kron(back, np.eye(K)))
    released_cov = at @ released.cov @ at.T
    if new.extra is not None:
        released_cov = released_cov + turn @ new.extra @ turn.T
    if new.common is not None:
        common = at @ new.common @ turn.T
        released_cov = released_cov - common - common.T
    cov = turn @ new_cov @ turn.T + released_cov
    absorbed = frame_fields(model, new.open.frames, old, origin)
    norm = mean_squares(model)
    difference = (moved - old).ravel()
    projector = without(absorbed, norm)
    remainder = projector @ difference
    variance = np.einsum("ij,jk,ik->i", projector, cov, projector)
    of_release = np.einsum("ij,jk,ik->i", projector, released_cov, projector)
    varying = variance > 1e-16 * np.diag(cov)
    fraction = max(float(np.mean(of_release[varying] / variance[varying])), 1e-3)
    return SolutionChange(
        model=model,
        epoch=new.epoch,
        released=old,
        difference=remainder.reshape(C, 2, K),
        cov=projector @ cov @ projector.T,
        released_cov=released_cov,
        absorbed=absorbed,
        test=chi_square(remainder, cov, without=absorbed, norm=norm, draws=draws / fraction**2),
        frame=(M, d),
    )


def _priors(
    released: TransformedSolution, model: DistortionModel, scatter: Mapping[str, float]
) -> GaussianPriors:
    """Priors that fix the drift to its released values and constrain the exposures' deviations."""
    priors = GaussianPriors.none(model)
    rows = slice(released.model.n_polynomial, released.model.n_distortion)
    centre, precision = priors.centre.copy(), priors.precision.copy()
    centre[rows] = released.mean[rows]
    sigma = np.sqrt(np.maximum(np.diag(released.cov)[rows], 0.0))
    floor = 1e-12 * np.abs(released.mean).max(initial=1.0)
    precision[rows] = np.maximum(HELD * sigma, floor) ** -2.0
    for code in range(len(model.exposures)):
        first = model.frame_slice(code).start
        for k, name in enumerate(model.free_frame_names(code)):
            if name in scatter:
                precision[first + k] = scatter[name] ** -2.0
    return GaussianPriors(centre, precision)


def _at_epoch(model: DistortionModel, epoch: float | None) -> Float:
    """Matrix (n, n_distortion) from polynomials and drift to the polynomials at a date."""
    out = np.eye(model.n_polynomial, model.n_distortion)
    if model.time is None:
        return out
    groups = model.groups(len(model.chips), epoch=epoch, chip=[chip.number for chip in model.chips])
    size = 2 * model.n_terms
    for g, (columns, d) in enumerate(
        model.effective_jacobian(np.zeros(model.n_distortion), groups)
    ):
        c = int(groups.chip[g])
        out[c * size : (c + 1) * size] = 0.0
        out[c * size : (c + 1) * size, columns] = d.reshape(size, -1)
    return out


def with_star_errors_of(
    errors: StarErrors,
    new: NewFit,
    matches: Matches,
    released: tuple[LinearFit, Matches] | None = None,
) -> NewFit:
    """Include the catalogue errors, which are common to all matches of a star, in the covariance.

    If the release was made with the same catalogue, these errors affect both solutions, and their
    covariance is taken into account.

    Parameters
    ----------
    errors : StarErrors
        Errors of the catalogue by star code. The quoted errors of the matches include them.
    new : NewFit
    matches : Matches
        The matches of `new`, with star codes.
    released : tuple of LinearFit and Matches, optional
        The release and its matches, if they have the same catalogue and star codes.

    Returns
    -------
    NewFit
        Copy of `new` with `extra` and `common` set.
    """
    n = new.model.n_polynomial
    shared = star_covariance(new.fit, matches, errors, frames=False)
    out = replace(new, extra=shared.extra[:n, :n])
    if released is None or released[1].star is None or matches.star is None:
        return out
    codes = np.intersect1d(released[1].star, matches.star)
    old, now = (
        star_influence(fit, table, errors, codes).by
        for fit, table in (released, (new.fit, matches))
    )
    covariances = errors.covariances(codes, len(old))
    return replace(out, common=_common(old, covariances, now[..., :n]))


def _common(old: Float, covariances: Float, new: Float) -> Float:
    """Covariance (D, n) of parameters that depend on the errors of the same stars.

    `old` (levers, 2, stars, D) and `new` (levers, 2, stars, n) are the derivatives of two solutions
    with respect to these errors, whose covariances are (stars, levers, 2, levers, 2).
    """
    moved = np.einsum("slamb,mbsn->lasn", covariances, new)
    return np.asarray(np.einsum("lasd,lasn->dn", old, moved))
