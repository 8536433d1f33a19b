"""Weighted linear fit: two passes with rejection, relinearised frames, formal covariance.

The procedure follows the programme gnDSTR (WSDC D-T033, section 3): fit, reject matches with
a residual or a chi-square above a limit, and fit again.  Stars near the corners can get additional
weight.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real

import numpy as np

from bayesdist.data.matches import Matches
from bayesdist.data.tables.column import conversion
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.equations.normal import (
    check_coverage,
    gauss_newton,
    least_squares,
    refuse_absorbed_drift,
    require_full_rank,
    starting_point,
)
from bayesdist.infer.equations.priors import GaussianPriors
from bayesdist.infer.equations.scaled import scaled_cholesky
from bayesdist.infer.solution.solution import Solution
from bayesdist.infer.stars.likelihood import Clip, ClippedGaussian
from bayesdist.infer.stars.loading import opened
from bayesdist.infer.stars.shards import Compute, Shards
from bayesdist.infer.stars.stars import Stars, in_table_order, prepare
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.quantities import Random, generator_of, takes, value_in, values_in

MEDIAN_STARS = 1_000_000  # medians are taken over at most about this many stars
MEDIAN_CHI2_2 = 2 * np.log(2)  # median of chi-square with two degrees of freedom
# chi-square of a residual of four errors, within which the absolute limit does not apply: a true
# match lies beyond with a probability of 3e-4
WITHIN_ERRORS = 16.0


@dataclass(frozen=True)
class Rejection:
    """Rejection limits and weights of a two-pass fit.

    Parameters
    ----------
    clip_chi2 : float
        Limit on the chi-square (sum over both axes) of a star in the first pass; stars above it
        are left out of the second pass. If the quoted errors are too small in general, the limit
        is scaled up with the median chi-square.
    clip_abs : float, Quantity or None
        Limit on the absolute residual of a star in the first pass, in pixels; None for no limit.
        Stars are kept beyond it if their residual is within four of their own errors. If the quoted
        errors are too large in general, these are taken as small as the median chi-square says.
    radial_weight : float
        Factor on the inverse variance in the corners; it increases with the square of the radius
        from 1 at the centre.

    Raises
    ------
    InputError
        If a limit or the weight is not positive.

    Examples
    --------
    >>> strict = bd.Rejection(clip_chi2=16.0, clip_abs=None)
    >>> strict.radial_weight
    1.0
    """

    clip_chi2: float = 25.0
    clip_abs: float | None = 2.0
    radial_weight: float = 1.0

    def __post_init__(self) -> None:
        if self.clip_abs is not None:
            limit = value_in(self.clip_abs, "pix", "clip_abs", where="fit.clip_abs")
            object.__setattr__(self, "clip_abs", limit)
        for name in ("clip_chi2", "clip_abs", "radial_weight"):
            limit = getattr(self, name)
            if limit is not None and not (isinstance(limit, Real) and float(limit) > 0):
                raise InputError(
                    f"{name} is {limit!r}", where="Rejection", do="give a positive number"
                )


DEFAULT_REJECTION = Rejection()
NO_REJECTION = Rejection(np.inf, None)


@dataclass(frozen=True, eq=False)
class LinearFit(Solution):
    """A weighted least-squares solution with its formal covariance.

    Parameters
    ----------
    model : DistortionModel
    mean : ndarray, shape (D,)
        Estimated parameters, in the order of `model.names`.
    cov : ndarray, shape (D, D)
        Formal covariance. With additional weight in the corners it has the sandwich form, which
        remains valid although the weights differ from the inverse variances.
    clip : Clip
        Rejection limits of the second pass, and the parameters at which residuals are compared
        with them.
    n_rows, n_used : int
        Number of all stars, and of the stars used in the second pass.
    rms_u, rms_v : float
        Rms residuals of the stars used, in the unit of u, v.
    rms_rejected : float
        Rms residual per axis of the rejected stars, in the unit of u, v; 0 if none were rejected.
    rejected : dict of str to int
        Number of rejected stars by reason.
    chi2 : float
        Chi-square of the stars used, with the quoted errors.
    dof : int
        Degrees of freedom.
    condition : float
        Condition number of the normal matrix scaled to unit diagonal.
    tangent_point : tuple of float, optional
        RA and Dec in degrees of the tangent point of u, v; see `Matches.tangent_point`.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> np.allclose(fit.sigma, np.sqrt(np.diag(fit.cov)))
    True
    >>> fit.draws(7, rng).shape
    (7, 12)
    """

    model: DistortionModel
    mean: Float
    cov: Float
    clip: Clip
    n_rows: int
    n_used: int
    rms_u: float
    rms_v: float
    rms_rejected: float
    rejected: dict[str, int]
    chi2: float
    dof: int
    condition: float
    tangent_point: tuple[float, float] | None = field(default=None)

    def __repr__(self) -> str:
        return (
            f"LinearFit({self.model.summary}, {self.n_used} of {self.n_rows} stars, "
            f"rms {self.rms_u:.4g} and {self.rms_v:.4g} {self.unit}, "
            f"chi2/dof {self.chi2:.5g}/{self.dof}, condition {self.condition:.3g})"
        )

    @property
    def likelihood(self) -> ClippedGaussian:
        """Gaussian likelihood, at the mean, of the stars used in the second pass."""
        return ClippedGaussian(np.asarray(self.mean), self.clip)

    @property
    def n_rejected(self) -> int:
        """Number of rejected stars."""
        return self.n_rows - self.n_used

    def uses(self, matches: Matches) -> Bool:
        """Boolean mask that is True for the stars that pass the rejection limits.

        Parameters
        ----------
        matches : Matches
            The N stars that were fitted, or other stars of the same exposures.

        Returns
        -------
        ndarray of bool, shape (N,)
        """
        return self.clip.keeps(self.model, matches)

    @cached_property
    def _root(self) -> Float:
        return scaled_cholesky(self.cov)  # parameters fixed by a gauge have no error

    def draws(self, n: int, rng: Random) -> Float:
        """Draw parameter vectors from the Gaussian with this mean and covariance.

        Parameters
        ----------
        n : int
            Number of draws.
        rng : int or numpy.random.Generator
            Seed or random generator.

        Returns
        -------
        ndarray, shape (n, D)
        """
        return self.mean + generator_of(rng).standard_normal((n, len(self.mean))) @ self._root.T

    def mapped(self, matrix: Float) -> LinearFit:
        """Fit with the deviations from the mean multiplied by a matrix.

        Parameters
        ----------
        matrix : ndarray, shape (D, D)
            Rows and columns in the order of `model.names`.

        Returns
        -------
        LinearFit
        """
        return replace(self, cov=matrix @ self.cov @ matrix.T)


@takes(matches=Matches, time=TimeDependence)
def build_model(
    matches: Matches,
    *,
    order: int,
    size: tuple[float, float] | None = None,
    reference_pixel: tuple[float, float] | None = None,
    name: str = "",
    chips: tuple[Chip, ...] = (),
    frames: str = "none",
    time: TimeDependence | None = None,
) -> DistortionModel:
    """Build a distortion model for a table of matches, with its chips, exposures and unit.

    Parameters
    ----------
    matches : Matches
    order : int
        Polynomial order, 1 to 12.
    size : tuple of float or Quantity, optional
        Number of columns and rows in pixels, for a detector with a single chip. Give either this
        or `chips`.
    reference_pixel : tuple of float, optional
        Zero point (x, y) of the polynomials in pixels, for a single chip; its centre by default.
    name : str
        Name of the single chip.
    chips : tuple of Chip
        Chips of the detector.
    frames : str
        Transformation of each exposure: 'none', 'shift', 'shift_rotation', 'shift_rotation_scale'
        or 'affine'.
    time : TimeDependence, optional
        Polynomial terms that depend on time; none by default.

    Returns
    -------
    DistortionModel

    Raises
    ------
    InputError
        If neither a size nor chips are given, if the matches are on several chips but one chip is
        described, or if time-dependent terms are requested for matches without epochs.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> bd.build_model(matches, order=2, size=(1016, 1016)).n_params
    12
    """
    if not chips:
        if size is None:
            raise InputError(
                "the detector's size is not given", where="detector.size", do="give it"
            )
        nx, ny = values_in(size, "pix", "size", where="detector.size").tolist()
        centre = ((nx + 1) / 2, (ny + 1) / 2)
        number = int(matches.chip_numbers[0])
        chips = (Chip(number, name or f"chip {number}", size, reference_pixel or centre),)
    if len(chips) == 1 and len(matches.chip_numbers) > 1:
        raise InputError(
            f"the matches are on chips {', '.join(map(str, matches.chip_numbers))} "
            "but only one chip is described",
            where="chip",
            do="give one [[chip]] block for each, or select one chip",
        )
    if time is not None and not matches.has_epoch:
        raise InputError(
            "time-dependent terms need an epoch for every star",
            where="data.columns",
            do="map column 'epoch' or drop model.tdd",
        )
    sample = matches.sample(MEDIAN_STARS)
    return DistortionModel(
        order=order,
        chips=chips,
        unit=matches.unit,
        time=time,
        frames=frames,
        exposures=matches.exposure_names,
        origin=(float(np.median(sample.u)), float(np.median(sample.v))),
    )


@takes(matches=(Matches, Shards), model=DistortionModel, rejection=Rejection, compute=Compute)
def fit_linear(
    matches: Matches | Shards,
    model: DistortionModel,
    *,
    rejection: Rejection = DEFAULT_REJECTION,
    priors: GaussianPriors | None = None,
    compute: Compute | None = None,
) -> LinearFit:
    """Fit a distortion model by weighted least squares in two passes, with rejection in between.

    Parameters
    ----------
    matches : Matches or Shards
        Stars with position errors.
    model : DistortionModel
    rejection : Rejection
        Rejection limits, and additional weight in the corners.
    priors : GaussianPriors, optional
        Gaussian priors on parameters; flat by default.
    compute : Compute, optional
        Computing engine; threads of this process by default.

    Returns
    -------
    LinearFit

    Raises
    ------
    DegenerateError
        If the data do not determine the model: too few stars, stars that cover too little of a
        chip, or degenerate parameters.
    InputError
        If the matches have no errors, another unit than the model, or other chips.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> fit.mean.shape, fit.cov.shape
    ((12,), (12, 12))
    """
    with opened(model, matches, compute) as shards:
        fit = _fitted(shards, model, rejection, priors or GaussianPriors.none(model))
    return replace(fit, tangent_point=getattr(matches, "tangent_point", None))


def _fitted(
    shards: Shards, model: DistortionModel, rejection: Rejection, priors: GaussianPriors
) -> LinearFit:
    radial_weight = rejection.radial_weight
    check_coverage(model, shards.survey, priors.n_informative, known=priors.joint is not None)
    first = shards.sum(least_squares, None, None, radial_weight)
    theta = starting_point(first, model, priors)
    refuse_absorbed_drift(first, theta, model, priors)
    theta = gauss_newton(first, theta, model, priors)

    stride = max(1, len(shards) // MEDIAN_STARS)
    typical = float(np.median(np.concatenate(shards.sum(_some_chi2, theta, stride))))
    clip = Clip(
        theta,
        chi2_limit=rejection.clip_chi2 * max(1.0, typical / MEDIAN_CHI2_2),
        abs_limit=np.inf
        if rejection.clip_abs is None
        else rejection.clip_abs * model.pixel_size(theta),
        spared_chi2=WITHIN_ERRORS * min(1.0, typical / MEDIAN_CHI2_2),
    )
    second = shards.sum(least_squares, clip.theta, clip, radial_weight)
    n_used, n_far = int(second.scalars[0]), int(second.scalars[1])
    n_rejected = len(shards) - n_used
    if n_used * 2 + priors.n_informative < model.n_params or n_used < 0.05 * len(shards):
        raise DegenerateError(
            f"{n_rejected} of {len(shards)} rows are beyond the rejection limits: half of the "
            f"residuals exceed {_median_residual(shards, theta, stride, model.unit)}",
            where="fit",
            do="check the match (another field, wrong pairs, or radians or hours in place of "
            "degrees), the errors, and fit.clip_chi2 and fit.clip_abs",
        )

    theta = gauss_newton(second, theta, model, priors)
    about = model.effective(theta, second.groups)
    matrix, _ = second.moved(about).assemble(model, theta)
    matrix = matrix + priors.matrix(model)
    space = require_full_rank(matrix, model, second.groups)
    factor = matrix.factor()
    cov = factor.covariance()
    # statistics at the solution, and the sums of squared weights for the sandwich covariance
    final = shards.sum(least_squares, theta, clip, radial_weight, 2)
    if radial_weight != 1.0:
        meat, _ = final.assemble(model, theta)
        cov = cov @ (meat + priors.matrix(model)).dense() @ cov
    _, _, chi2, uu, vv, beyond, *_ = final.scalars
    return LinearFit(
        model=model,
        mean=theta,
        cov=cov,
        clip=clip,
        n_rows=len(shards),
        n_used=n_used,
        rms_u=float(np.sqrt(uu / n_used)),
        rms_v=float(np.sqrt(vv / n_used)),
        rms_rejected=float(np.sqrt(beyond / (2 * max(n_rejected, 1)))),
        rejected={"chi-square": n_rejected - n_far, "absolute residual": n_far},
        chi2=float(chi2),
        dof=2 * n_used - model.n_params + priors.n_informative,
        condition=space.condition,
    )


def _median_residual(shards: Shards, theta: Float, every: int, unit: str) -> str:
    """Median residual of the stars, formatted in arcsec or pixels."""
    median = float(np.median(np.concatenate(shards.sum(_some_residuals, theta, every))))
    if unit == "pix":
        return f"{median:.3g} px"
    return f"{median * conversion(unit, 'arcsec', where='fit'):.3g} arcsec"


def _some_residuals(stars: Stars, theta: Float, every: int) -> tuple[Float, ...]:
    """Residuals (radial) of every `every`-th star."""
    return (np.hypot(*stars.residuals(theta)[::every].T),)


def _some_chi2(stars: Stars, theta: Float, every: int) -> tuple[Float, ...]:
    """Chi-square (sum over both axes) of every `every`-th star."""
    return (stars.chi2(stars.residuals_along_axes(theta))[::every],)


@takes(solution=Solution, matches=Matches)
def residuals(solution: Solution, matches: Matches) -> Float:
    """Residuals of the matches: data minus model at the mean of a solution.

    Parameters
    ----------
    solution : LinearFit or Posterior
    matches : Matches

    Returns
    -------
    ndarray, shape (N, 2)
        Residuals in u and v, in the unit of u, v.

    Raises
    ------
    InputError
        If the matches have no errors, another unit than the model, or other chips.

    Examples
    --------
    >>> from bayesdist.missions.wise import simulate_wise
    >>> rng = np.random.default_rng(1)
    >>> matches, truth = simulate_wise(500, rng=rng)
    >>> model = bd.build_model(matches, order=2, size=(1016, 1016))
    >>> fit = bd.fit_linear(matches, model)
    >>> bd.residuals(fit, matches).shape
    (500, 2)
    """
    stars, order = prepare(solution.model, matches)
    return in_table_order(stars.residuals(solution.mean), order)
