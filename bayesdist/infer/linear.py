"""The weighted linear fit: two passes with rejection, frames relinearised, formal covariance.

The procedure of the WISE programme gnDSTR (WSDC D-T033, section 3): fit, drop pairs whose residual
chi-square or absolute residual is beyond a limit, fit again; optional extra weight towards the
corners.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.magnitude_errors import MagnitudeErrors, estimate
from bayesdist.data.matches import MatchTable
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.arrow import Arrow, ArrowFactor
from bayesdist.infer.identify import check_coverage, require_full_rank
from bayesdist.infer.normal import NormalEquations, accumulate
from bayesdist.infer.prior import GaussianPriors
from bayesdist.infer.stars import Stars, prepare
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.model.frames import nearest_frame

__all__ = ["LinearFit", "build_model", "fit_by_magnitude", "fit_linear"]

Float = NDArray[np.float64]

RELINEARISED = 1e-7  # pixels: where the Gauss-Newton iteration over the frames stops
MEDIAN_CHI2_2 = 2 * np.log(2)  # median of chi-square with two degrees of freedom


@dataclass(frozen=True, eq=False)
class LinearFit:
    """A weighted least-squares solution with its formal covariance.

    Parameters
    ----------
    model : DistortionModel
    mean : ndarray, shape (D,)
        Estimated parameters.
    cov : ndarray, shape (D, D)
        Formal covariance; with extra corner weights the sandwich form, which stays a covariance.
    residual : ndarray, shape (N, 2)
        Data minus model of every row of the table, in the unit of u, v.
    used : ndarray of bool, shape (N,)
        Rows of the second pass.
    rejected : dict of str to int
        Rows left out of the second pass, by reason.
    chi2 : float
        Of the rows used, with the quoted errors.
    dof : int
    condition : float
        Of the normal matrix scaled to unit diagonal.
    """

    model: DistortionModel
    mean: Float
    cov: Float
    residual: Float
    used: NDArray[np.bool_]
    rejected: dict[str, int]
    chi2: float
    dof: int
    condition: float

    @property
    def unit(self) -> str:
        """Unit of u and v."""
        return self.model.unit

    @property
    def sigma(self) -> Float:
        """Formal sigma of each parameter."""
        return np.sqrt(np.diag(self.cov))

    @property
    def rms_u(self) -> float:
        """Rms residual in u of the rows used."""
        return float(np.sqrt(np.mean(self.residual[self.used, 0] ** 2)))

    @property
    def rms_v(self) -> float:
        """Rms residual in v of the rows used."""
        return float(np.sqrt(np.mean(self.residual[self.used, 1] ** 2)))

    @cached_property
    def _root(self) -> Float:
        scale = self.sigma
        return np.linalg.cholesky(self.cov / np.outer(scale, scale)) * scale[:, None]

    def draws(self, n: int, rng: np.random.Generator) -> Float:
        """Parameter vectors from the Gaussian with this mean and covariance.

        Parameters
        ----------
        n : int
        rng : numpy.random.Generator

        Returns
        -------
        ndarray, shape (n, D)
        """
        return self.mean + rng.standard_normal((n, len(self.mean))) @ self._root.T


def build_model(
    matches: MatchTable,
    *,
    order: int,
    size: tuple[float, float] | None = None,
    reference_pixel: tuple[float, float] | None = None,
    name: str = "",
    chips: tuple[Chip, ...] = (),
    frames: str = "none",
    time: TimeDependence | None = None,
) -> DistortionModel:
    """A model that fits a table: its chips, exposures and unit.

    Parameters
    ----------
    matches : MatchTable
    order : int
        Polynomial order, 1 to 9.
    size : tuple of float, optional
        Columns and rows of a single chip; give this or `chips`.
    reference_pixel : tuple of float, optional
        Zero point; the detector's centre by default.
    name : str
        Name of the single chip.
    chips : tuple of Chip
    frames : str
        Transformation of each exposure.
    time : TimeDependence, optional

    Returns
    -------
    DistortionModel

    Raises
    ------
    InputError
        When neither a size nor chips are given, or an epoch is needed and missing.
    """
    if not chips:
        if size is None:
            raise InputError(
                "the detector's size is not given", where="detector.size", do="give it"
            )
        centre = ((size[0] + 1) / 2, (size[1] + 1) / 2)
        number = int(matches.chip_numbers[0])
        chips = (Chip(number, name or f"chip {number}", size, reference_pixel or centre),)
    if len(chips) == 1 and len(matches.chip_numbers) > 1:
        raise InputError(
            f"the matches lie on chips {', '.join(map(str, matches.chip_numbers))} "
            "and one chip is described",
            where="chip",
            do="give one [[chip]] block for each, or select one chip",
        )
    if time is not None and matches.epoch is None:
        raise InputError(
            "time-dependent terms need an epoch for every star",
            where="data.columns",
            do="map column 'epoch' or drop model.tdd",
        )
    return DistortionModel(
        order=order,
        chips=chips,
        unit=matches.unit,
        time=time,
        frames=frames,
        exposures=matches.exposure_names,
        origin=(float(np.median(matches.u)), float(np.median(matches.v))),
    )


def fit_linear(
    matches: MatchTable,
    model: DistortionModel,
    *,
    clip_chi2: float = 25.0,
    clip_abs: float | None = 2.0,
    radial_weight: float = 1.0,
    priors: GaussianPriors | None = None,
) -> LinearFit:
    """Two-pass weighted least squares.

    Parameters
    ----------
    matches : MatchTable
        With errors.
    model : DistortionModel
    clip_chi2 : float
        Rows with a first-pass chi-square (both axes) above this are left out of the second pass.
        Where the errors are too small as a whole, the limit is scaled by the median chi-square.
    clip_abs : float or None
        Rows with a first-pass residual above this many pixels are left out too.
    radial_weight : float
        Factor on the inverse variance in the corners, rising as the square of the radius.
    priors : GaussianPriors, optional
        Gaussian priors on named parameters.

    Returns
    -------
    LinearFit

    Raises
    ------
    DegenerateError
        When the data do not determine the model: see `check_coverage` and `require_full_rank`.
    """
    check_coverage(model, matches)
    priors = priors or GaussianPriors.none(model)
    stars = prepare(model, matches)
    extra = _corner_weight(stars, radial_weight)
    inverse = np.column_stack([1.0 / stars.var_u, 1.0 / stars.var_v])

    zero = np.zeros((len(stars.groups), 2, model.n_terms))
    first = accumulate(stars, zero, inverse * extra[:, None])
    theta = _start(first, stars, priors)
    _refuse_absorbed_drift(first, theta, stars, priors, matches)
    theta = _gauss_newton(first, theta, stars, priors, matches)

    residual = stars.residuals(theta)
    chi2 = (residual**2 * inverse).sum(axis=1)
    spread = max(1.0, float(np.median(chi2)) / MEDIAN_CHI2_2)
    too_unlikely = chi2 > clip_chi2 * spread
    too_far = np.zeros(len(stars), bool)
    if clip_abs is not None:
        limit = clip_abs * model.pixel_size(theta)
        too_far = np.hypot(residual[:, 0], residual[:, 1]) > limit
    used = ~(too_unlikely | too_far)
    if used.sum() * 2 < model.n_params or used.mean() < 0.05:
        raise DegenerateError(
            f"{int((~used).sum())} of {len(used)} rows are beyond the rejection limits",
            where="fit",
            do="check the match, the errors, and fit.clip_chi2 and fit.clip_abs",
        )

    weights = inverse * (extra * used)[:, None]
    about = model.effective(theta, stars.groups)
    second = accumulate(stars, about, weights)
    theta = _gauss_newton(second, theta, stars, priors, matches)
    about = model.effective(theta, stars.groups)
    matrix, _ = second.moved(about).assemble(model, theta, stars.groups)
    matrix = matrix + priors.matrix(model)
    space = require_full_rank(matrix, model, matches)
    factor = matrix.factor()
    cov = factor.covariance()
    if radial_weight != 1.0:
        cov = _sandwich(factor, cov, stars, about, theta, weights * extra[:, None], priors)

    residual = stars.residuals(theta)
    chi2 = (residual**2 * inverse).sum(axis=1)
    return LinearFit(
        model=model,
        mean=theta,
        cov=cov,
        residual=stars.in_table_order(residual),
        used=stars.in_table_order(used).astype(bool),
        rejected={
            "chi-square": int((too_unlikely & ~too_far).sum()),
            "absolute residual": int(too_far.sum()),
        },
        chi2=float(chi2[used].sum()),
        dof=int(2 * used.sum()) - model.n_params + priors.n_informative,
        condition=space.condition,
    )


def fit_by_magnitude(
    matches: MatchTable,
    model: DistortionModel,
    *,
    max_iterations: int = 10,
    priors: GaussianPriors | None = None,
    **options: Any,
) -> tuple[LinearFit, MatchTable, MagnitudeErrors]:
    """Fit and errors by magnitude, in turn, until both stand still.

    Parameters
    ----------
    matches : MatchTable
        With magnitudes; errors, if there are any, are replaced.
    model : DistortionModel
    max_iterations : int
    priors : GaussianPriors, optional
    **options
        As of `fit_linear`.

    Returns
    -------
    fit : LinearFit
    matches : MatchTable
        With the errors of the last iteration.
    errors : MagnitudeErrors
        The bins and their values.

    Raises
    ------
    InputError
        When the table has no magnitudes, or the errors do not settle.
    """
    if matches.mag is None:
        raise InputError(
            "errors by magnitude need magnitudes",
            where="data.columns",
            do="map column 'mag' or give data.sigma another value",
        )
    ones = np.ones(len(matches))
    fit = fit_linear(matches.with_sigma(ones, ones), model, priors=priors, **options)
    before: Float | None = None
    for _ in range(max_iterations):
        errors = estimate(
            matches.mag, fit.residual[:, 0], fit.residual[:, 1], n_params=model.n_params
        )
        sigma_u, sigma_v = errors.at(matches.mag)
        table = matches.with_sigma(sigma_u, sigma_v)
        fit = fit_linear(table, model, priors=priors, **options)
        now = np.concatenate([errors.sigma_u, errors.sigma_v])
        if before is not None and np.abs(now / before - 1).max() < 0.01:
            return fit, table, errors
        before = now
    raise InputError(
        f"the errors by magnitude did not settle in {max_iterations} iterations",
        where="data.sigma",
        do="give errors as columns or as one number",
    )


def _corner_weight(stars: Stars, factor: float) -> Float:
    radius2 = (stars.X**2 + stars.Y**2) / 2  # 1 in the corners
    return 1.0 + (factor - 1.0) * radius2


def _start(first: NormalEquations, stars: Stars, priors: GaussianPriors) -> Float:
    """Frames from linear maps of the exposures, then polynomials with the frames held."""
    model, groups = stars.model, stars.groups
    theta = np.zeros(model.n_params)
    if model.n_frame:
        affine = np.array([_affine(w, r) for w, r in zip(first.weight, first.right, strict=True)])
        o = np.asarray(model.origin)
        for e in range(1, len(model.exposures)):
            for g in np.flatnonzero(groups.exposure == e):
                gauge = np.flatnonzero((groups.exposure == 0) & (groups.chip == groups.chip[g]))
                if len(gauge) and np.isfinite(affine[g]).all():
                    A, A0 = affine[g], affine[gauge[0]]
                    M = A[:, 1:] @ np.linalg.inv(A0[:, 1:])
                    d = A[:, 0] - o - M @ (A0[:, 0] - o)
                    theta[model.frame_slice(e)] = nearest_frame(model.frames, M, d)
                    break
    held = first.moved(model.effective(theta, groups))
    matrix, right = held.assemble(model, theta, groups)
    prior = priors.matrix(model)
    n = model.n_global
    theta[:n] = np.linalg.lstsq(
        matrix.border + prior.border, right[:n] + priors.pull(theta)[:n], rcond=1e-13
    )[0]
    return theta


def _refuse_absorbed_drift(
    equations: NormalEquations,
    theta: Float,
    stars: Stars,
    priors: GaussianPriors,
    matches: MatchTable,
) -> None:
    """Refuse frames that absorb the drift of the linear terms.

    With a curved polynomial such a degeneracy is not exact, and the fit would follow its valley to
    numbers that mean nothing.  On the linear part of the model it is exact, and shows.
    """
    model = stars.model
    if model.time is None or not model.n_frame:
        return
    flat = np.zeros_like(theta)
    for chip in model.chips:
        for axis in (0, 1):
            part = model.coefficient_slice(chip.number, axis)
            flat[part][:3] = theta[part][:3]
    matrix, _ = equations.assemble(model, flat, stars.groups)
    require_full_rank(matrix + priors.matrix(model), model, matches)


def _affine(weight: Float, right: Float) -> Float:
    """Constant and linear coefficients (2, 3) of one group by itself; NaN where undetermined."""
    out = np.full((2, 3), np.nan)
    for axis, pair in ((0, 0), (1, 2)):
        W = weight[pair][:3, :3]
        if np.linalg.matrix_rank(W, rtol=1e-10) == 3:
            out[axis] = np.linalg.solve(W, right[axis][:3])
    return out


def _gauss_newton(
    equations: NormalEquations,
    theta: Float,
    stars: Stars,
    priors: GaussianPriors,
    matches: MatchTable,
) -> Float:
    """Solve, moving the equations instead of passing over the data again."""
    model, groups = stars.model, stars.groups
    prior = priors.matrix(model)
    about = model.effective(theta, groups)
    for _ in range(50):
        matrix, right = equations.moved(about).assemble(model, theta, groups)
        matrix = matrix + prior
        try:
            step = matrix.factor().solve(right + priors.pull(theta))
        except np.linalg.LinAlgError:
            require_full_rank(matrix, model, matches)
            raise
        theta = theta + step
        before, about = about, model.effective(theta, groups)
        moved = np.abs(about - before).sum(axis=2).max()
        if moved < RELINEARISED * model.pixel_size(theta):
            return theta
    raise DegenerateError(
        "the exposure frames did not settle in 50 iterations",
        where="model.frames",
        do="check that the exposures overlap and are not mirrored, or choose 'affine'",
    )


def _sandwich(
    factor: ArrowFactor,
    bread: Float,
    stars: Stars,
    about: Float,
    theta: Float,
    squared: Float,
    priors: GaussianPriors,
) -> Float:
    """Covariance of an estimate whose weights are not the inverse variances."""
    moments = accumulate(stars, about, squared)
    middle, _ = moments.assemble(stars.model, theta, stars.groups)
    meat: Arrow = middle + priors.matrix(stars.model)
    return bread @ meat.dense() @ bread
