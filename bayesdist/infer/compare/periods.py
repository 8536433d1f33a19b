"""Models of several periods, their differences, and the significance of the differences.

See WSDC D-T033, Appendix C.  The normal equations of the periods add up to those of all data, so
that the models of the periods, the combined model, and the statistics of their differences follow
from these sums.  The combined model includes the data of each period.  With A_p = N^-1 N_p, the
fraction of period p in the normal equations, it is sum_q A_q theta_q, hence

    theta_p - theta = (1 - A_p) theta_p - sum_{q != p} A_q theta_q.

If the weights are the inverse variances, the covariance of this difference is C_p - C, not C_p + C.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from astropy.time import Time
from scipy.linalg import block_diag

from bayesdist.data import Matches
from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.equations.normal import NormalEquations, least_squares, require_full_rank
from bayesdist.infer.equations.scaled import FieldTest, chi_square, scaled_cholesky, scaled_inverse
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.stars.stars import Stars, Sums
from bayesdist.model import Chip, DistortionModel
from bayesdist.model.grid import grid_pixels, mesh
from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import chi2_sf, norm_sf

Periods = Mapping[str, tuple[float, float]]  # start and end in decimal years, by name

MOST_MJD = 2e6  # about five thousand years, close to the range of date libraries


@dataclass(frozen=True, eq=False)
class PeriodSums(Sums):
    """Sums over the matches of one period.

    Parameters
    ----------
    equations : NormalEquations
        Normal equations about the mean of the fit to all data, with its rejection limits.
    squares : NormalEquations or None
        The same sums with squared weights, which the sandwich covariance needs; None without
        additional weights.
    n : int
        Number of matches used.
    """

    equations: NormalEquations
    squares: NormalEquations | None
    n: int


def sums_of_stars(stars: Stars, fit: LinearFit, radial_weight: float = 1.0) -> PeriodSums:
    """Accumulate the sums over matches of one period.

    Parameters
    ----------
    stars : Stars
        Matches of the period.
    fit : LinearFit
        Fit to all data; its model and rejection limits are applied to every period.
    radial_weight : float
        Weight in the corners, as in the fit; see `Rejection`.

    Returns
    -------
    PeriodSums
    """
    equations = least_squares(stars, fit.mean, fit.clip, radial_weight)
    squares = None
    if radial_weight != 1.0:
        squares = least_squares(stars, fit.mean, fit.clip, radial_weight, 2)
    return PeriodSums(equations, squares, int(equations.scalars[0]))


def compare_periods(
    fit: LinearFit, sums: Mapping[str, PeriodSums], *, rescale: bool = True
) -> PeriodComparison:
    """Fit the model to each period and to all of them.

    Parameters
    ----------
    fit : LinearFit
        Fit to all data, as given to `sums_of_stars`.
    sums : mapping of str to PeriodSums
        Sums of at least two periods by name. The combined model is fitted to these periods; it
        differs from `fit` if there are matches outside all periods.
    rescale : bool
        True to multiply all errors by the square root of chi-square per degree of freedom about
        the models of the periods. Otherwise, quoted errors that are too small make noise look
        significant.

    Returns
    -------
    PeriodComparison
        Residual structure that is constant in time cancels in the differences if all periods
        cover the array in the same way.

    Raises
    ------
    InputError
        If there are fewer than two periods, or the model has frames or time dependence.
    DegenerateError
        If a period does not determine the model; the message names the parameters.
    """
    if len(sums) < 2:
        raise InputError(f"the number of periods is {len(sums)}", do="give at least two")
    model = fit.model
    if model.n_frame or model.time is not None:
        raise InputError(
            "periods are compared by polynomials only, but the model has "
            + ("frames of exposures" if model.n_frame else "time-dependent terms"),
            where="model",
            do="set model.frames = 'none' (refer the pairs to common solutions first) and drop the "
            "time-dependent terms",
        )
    steps, covs, normals, chi2, dof = [], [], [], 0.0, 0
    for name, period_sums in sums.items():
        arrow, right = period_sums.equations.assemble(model, fit.mean)
        try:
            require_full_rank(arrow, model, period_sums.equations.groups)
        except DegenerateError as error:
            raise DegenerateError(
                f"the {period_sums.n} pairs of period {name} do not determine the model: "
                f"{error.cause}",
                where="periods",
                do="give longer periods or lower model.order",
            ) from error
        normal = arrow.dense()
        inverse = scaled_inverse(normal)
        step, cov = inverse @ right, inverse
        chi2 += float(period_sums.equations.scalars[2])
        dof += 2 * period_sums.n
        if period_sums.squares is None:
            # with additional weights, chi-square remains that about the fit to all data
            chi2 -= float(right @ step)
            dof -= len(step)
        else:
            meat, _ = period_sums.squares.assemble(model, fit.mean)
            cov = inverse @ meat.dense() @ inverse
        steps.append(step)
        covs.append(cov)
        normals.append(normal)
    all_inverse = scaled_inverse(np.sum(normals, axis=0))
    fractions = np.array([all_inverse @ normal for normal in normals])
    scale = float(np.sqrt(chi2 / dof)) if rescale else 1.0
    return PeriodComparison(
        model=model,
        names=tuple(sums),
        means=fit.mean + np.array(steps),
        covs=np.array(covs) * scale**2,
        fractions=fractions,
        counts=tuple(period_sums.n for period_sums in sums.values()),
        error_scale=scale,
    )


@dataclass(frozen=True, eq=False)
class CoefficientChange:
    """Differences between the coefficients of two models.

    Parameters
    ----------
    names : tuple of str, length D
        Names of the coefficients.
    difference, sigma : ndarray, shape (D,)
        Differences and their standard errors.
    """

    names: tuple[str, ...]
    difference: Float
    sigma: Float

    @property
    def z(self) -> Float:
        """Differences (D,) in units of their errors."""
        return self.difference / self.sigma

    @property
    def p_value(self) -> Float:
        """Two-sided p-value (D,) of each difference by itself."""
        return np.asarray(2 * norm_sf(np.abs(self.z)))


@dataclass(frozen=True, eq=False)
class PeriodComparison:
    """Models of several periods and the combined model.

    Parameters
    ----------
    model : DistortionModel
    names : tuple of str, length P
        Names of the periods.
    means : ndarray, shape (P, D)
        Parameters of each period.
    covs : ndarray, shape (P, D, D)
        Covariance of the parameters of each period; periods are independent.
    fractions : ndarray, shape (P, D, D)
        A_p = N^-1 N_p; their sum is the identity.
    counts : tuple of int
        Number of matches in each period.
    error_scale : float
        Factor that was applied to the quoted errors.
    """

    model: DistortionModel
    names: tuple[str, ...]
    means: Float
    covs: Float
    fractions: Float
    counts: tuple[int, ...]
    error_scale: float

    @cached_property
    def combined(self) -> Float:
        """Parameters (D,) of the combined model."""
        return np.einsum("pij,pj->i", self.fractions, self.means)

    def _code(self, period: str) -> int:
        if period not in self.names:
            raise InputError(
                f"there is no period {period!r}", do=f"choose among {', '.join(self.names)}"
            )
        return self.names.index(period)

    def _contrast(self, period: str, against: str | None) -> Float:
        """Matrices (P, D, D) that give a difference as a linear combination of the means."""
        D = self.means.shape[1]
        out = np.zeros_like(self.covs)
        p = self._code(period)
        if against is not None:
            q = self._code(against)
            if p == q:
                raise InputError(f"period {period} is compared with itself", do="name another")
            out[p], out[q] = np.eye(D), -np.eye(D)
            return out
        out[:] = -self.fractions
        # 1 - A_p without the cancellation that occurs for a period with most of the data
        out[p] = np.delete(self.fractions, p, axis=0).sum(axis=0)
        return out

    def difference(self, period: str, against: str | None = None) -> tuple[Float, Float]:
        """Parameters of a period minus those of the combined model, or of another period.

        Parameters
        ----------
        period : str
            Name of the period.
        against : str, optional
            Another period; the combined model by default.

        Returns
        -------
        difference : ndarray, shape (D,)
        cov : ndarray, shape (D, D)
            Covariance of the difference.

        Raises
        ------
        InputError
            If a period is unknown, or is compared with itself.
        """
        contrast = self._contrast(period, against)
        # subtract a common mean first, to avoid rounding errors from large constants
        difference = np.einsum("pij,pj->i", contrast, self.means - self.means[0])
        return difference, _covariance(contrast, self.covs, contrast)

    def coefficients(
        self, period: str, against: str | None = None, *, monomial: bool = False
    ) -> CoefficientChange:
        """Difference of each coefficient with its error.

        Parameters
        ----------
        period, against
            See `difference`.
        monomial : bool
            True for coefficients of powers of the pixel offsets, as in SIP, instead of Legendre
            coefficients.

        Returns
        -------
        CoefficientChange
        """
        difference, cov = self.difference(period, against)
        if monomial:
            matrices = (self.model.basis(chip.number).monomial_matrix for chip in self.model.chips)
            # without time and frames the parameters are u and v of each chip in turn
            to_monomials = block_diag(*(m for m in matrices for _ in (0, 1)))
            difference, cov = to_monomials @ difference, to_monomials @ cov @ to_monomials.T
        return CoefficientChange(self.model.names, difference, np.sqrt(np.diag(cov)))

    def positions(
        self,
        period: str,
        against: str | None = None,
        *,
        rng: np.random.Generator,
        grid: int = 33,
        n_draws: int = 2000,
    ) -> PositionChange:
        """Largest difference in position over the array, with its significance.

        Parameters
        ----------
        period, against
            See `difference`.
        rng : numpy.random.Generator
            Random generator of the noise fields.
        grid : int
            Number of points along each axis, from edge to edge of the detector.
        n_draws : int
            Number of simulated noise fields with which the largest difference is compared. The
            smallest possible p-value is 1 / (n_draws + 1).

        Returns
        -------
        PositionChange

        Raises
        ------
        InputError
            See `difference`.
        """
        difference, cov = self.difference(period, against)
        return largest_difference(self.model, difference, cov, rng=rng, grid=grid, n_draws=n_draws)

    def field(
        self,
        period: str,
        against: str | None = None,
        *,
        chip: Chip | None = None,
        grid: tuple[int, int] = (17, 17),
    ) -> DifferenceField:
        """Difference in position over a chip.

        Parameters
        ----------
        period, against
            See `difference`.
        chip : Chip, optional
            The first chip by default.
        grid : tuple of int
            Number of points along x and y.

        Returns
        -------
        DifferenceField

        Raises
        ------
        InputError
            See `difference`.
        """
        chip = chip or self.model.chips[0]
        return difference_field(self.model, *self.difference(period, against), chip, grid)

    @cached_property
    def homogeneity(self) -> FieldTest:
        """Chi-square test of the hypothesis that all periods have the same model.

        It uses the differences of all periods but the last from the combined model, with their
        joint covariance; that of the last period follows from these.
        """
        contrasts = [self._contrast(name, None) for name in self.names[:-1]]
        cov = np.block(
            [
                [
                    _covariance(row_contrast, self.covs, column_contrast)
                    for column_contrast in contrasts
                ]
                for row_contrast in contrasts
            ]
        )
        differences = np.concatenate([self.difference(name)[0] for name in self.names[:-1]])
        return chi_square(differences, cov)


def _covariance(one: Float, covs: Float, other: Float) -> Float:
    """Covariance (D, D) of two linear combinations (P, D, D) of P independent vectors."""
    return np.asarray((one @ covs @ other.swapaxes(1, 2)).sum(axis=0))


# -- difference in position between two models over the array, compared with noise -----------------


@dataclass(frozen=True, eq=False)
class PositionChange:
    """Largest difference in position between two models over the array, with its significance."""

    largest: float  # length of the largest difference vector, in the unit of u, v
    at: tuple[float, float]  # its position, FITS 1-based pixels
    chip: int  # number of its chip
    sigma: float  # standard error of the difference there, along its direction
    noise_median: float  # median of the largest difference over the array from noise alone
    noise_95: float  # 95th percentile of the same
    # fraction of noise fields with a largest difference of at least this size, which accounts for
    # the search over the array
    p_value: float
    chi2: float  # chi-square of the entire field, which equals that of its coefficients
    dof: int  # degrees of freedom of `chi2`
    p_field: float  # probability of a larger chi-square


@dataclass(frozen=True, eq=False)
class DifferenceField:
    """Difference in position between two models on a grid over one chip."""

    chip: Chip
    x: Float  # (nx,) FITS 1-based pixels, from edge to edge
    y: Float  # (ny,) FITS 1-based pixels, from edge to edge
    du: Float  # (ny, nx) difference in u, in the unit of u, v
    dv: Float  # (ny, nx) difference in v
    p_value: Float  # (ny, nx) chance probability of the difference at each position by itself


def largest_difference(
    model: DistortionModel,
    difference: Float,
    cov: Float,
    *,
    rng: np.random.Generator,
    grid: int,
    n_draws: int,
) -> PositionChange:
    """Find the largest difference over the array and compare it with `n_draws` noise fields.

    The model must have neither frames nor time dependence.  `difference` (D,) and `cov` (D, D) are
    the difference of its parameters and the covariance; `grid` is the number of points per axis.
    """
    noise = rng.standard_normal((n_draws, len(cov))) @ scaled_cholesky(cov).T
    largest, worst = np.zeros(n_draws), (-1.0, 0, (0.0, 0.0), 0.0)
    for chip in model.chips:
        x, y = mesh(*grid_pixels(chip.size, (grid, grid)))
        phi = model.basis(chip.number).evaluate(x, y)
        u, v = (model.coefficient_slice(chip.number, axis) for axis in (0, 1))
        radial = (noise[:, u] @ phi.T) ** 2 + (noise[:, v] @ phi.T) ** 2
        largest = np.maximum(largest, np.sqrt(radial.max(axis=1)))
        field = np.stack([phi @ difference[u], phi @ difference[v]])
        size = np.hypot(*field)
        k = int(np.argmax(size))
        if size[k] > worst[0]:
            along = np.zeros(len(cov))
            direction = field[:, k] / size[k] if size[k] > 0 else np.array([1.0, 0.0])
            along[u], along[v] = direction[0] * phi[k], direction[1] * phi[k]
            sigma = float(np.sqrt(along @ cov @ along))
            worst = (float(size[k]), chip.number, (float(x[k]), float(y[k])), sigma)
    chi2, dof, p_field = chi_square(difference, cov)
    return PositionChange(
        largest=worst[0],
        at=worst[2],
        chip=worst[1],
        sigma=worst[3],
        noise_median=float(np.median(largest)),
        noise_95=float(np.quantile(largest, 0.95)),
        p_value=float((1 + (largest >= worst[0]).sum()) / (n_draws + 1)),
        chi2=chi2,
        dof=dof,
        p_field=p_field,
    )


def difference_field(
    model: DistortionModel, difference: Float, cov: Float, chip: Chip, grid: tuple[int, int]
) -> DifferenceField:
    """Difference on a grid (nx, ny) of one chip; see `largest_difference` for the arguments."""
    x, y = grid_pixels(chip.size, grid)
    phi = model.basis(chip.number).evaluate(*mesh(x, y))
    parts = [model.coefficient_slice(chip.number, axis) for axis in (0, 1)]
    field = np.stack([phi @ difference[part] for part in parts], axis=-1)
    joint = np.empty((len(phi), 2, 2))
    for a, row_slice in enumerate(parts):
        for b, column_slice in enumerate(parts):
            joint[:, a, b] = np.einsum(
                "nk,kl,nl->n", phi, cov[row_slice, column_slice], phi, optimize=True
            )
    z2 = np.einsum("na,na->n", field, np.linalg.solve(joint, field[..., None])[..., 0])
    du, dv, p_value = (a.reshape(len(y), len(x)) for a in (*field.T, chi2_sf(z2, 2)))
    return DifferenceField(chip, x, y, du, dv, p_value)


def mjd_periods(centres: Sequence[float], days: float) -> dict[str, tuple[float, float]]:
    """Start and end dates (decimal years) of periods of `days` days, by name.

    Each period is centred on a Modified Julian Date, from `centres`, and named after it.

    Raises InputError if the length is not positive or a centre is not a valid date.
    """
    if not days > 0:
        raise InputError(
            f"the length of the periods is {days:g} days",
            where="periods",
            do="give a positive length",
        )
    beyond = [c for c in centres if not abs(c) < MOST_MJD]
    if beyond:
        raise InputError(
            f"a period is centred on {beyond[0]:g}, which is not a Modified Julian Date",
            where="periods",
            do="give days such as 55212.5",
        )
    # same time scale as for epochs that a file gives as Modified Julian Dates
    edges = np.asarray(centres, float)[:, None] + np.array([-days / 2, days / 2])
    years = np.asarray(Time(edges, format="mjd", scale="tt").decimalyear, float)
    return {
        f"{centre:.10g}": (float(start), float(stop))
        for centre, (start, stop) in zip(centres, years, strict=True)
    }


def check_periods(periods: Periods) -> None:
    """Raise InputError if there are fewer than two periods, or if they are reversed or overlap."""
    if len(periods) < 2:
        raise InputError(
            f"the number of periods is {len(periods)}",
            where="periods",
            do="give at least two periods to compare",
        )
    ordered = sorted(periods.items(), key=lambda one: one[1])
    for name, (start, stop) in ordered:
        if not start < stop:
            raise InputError(
                f"period {name} starts at {start:.8g} and ends at {stop:.8g}",
                where="periods",
                do="give the earlier date first",
            )
    for (first, before), (second, after) in pairwise(ordered):
        if after[0] < before[1]:
            raise InputError(
                f"periods {first} and {second} overlap",
                where="periods",
                do="start each period at or after the end of the previous one",
            )


def sum_by_period(matches: Matches, periods: Periods, task: Callable[[Matches], Any]) -> Any:
    """Sum the results of `task` over the matches of each period, in one pass over the data.

    `task` is called with the matches of a period in each chunk; its results must support addition.
    Matches outside all periods [start, end) are ignored.  Returns the sums by name of the period.
    Raises InputError if there are no epochs, periods overlap, or a period has no matches.
    """
    location = ", ".join(matches.sources)
    if not matches.has_epoch:
        raise InputError(
            "periods need an epoch for every pair", where=location, do="map column 'epoch'"
        )
    check_periods(periods)
    sums: dict[str, Any] = {}
    for table in matches.batches():
        epoch = table.column("epoch")
        for name, (start, stop) in periods.items():
            inside = (epoch >= start) & (epoch < stop)
            if inside.any():
                part = task(table.select(inside))
                sums[name] = sums[name] + part if name in sums else part
    for name, (start, stop) in periods.items():
        if name not in sums:
            raise InputError(
                f"period {name} ({start:.8g} to {stop:.8g}) has no pairs",
                where=location,
                do="correct the period or leave it out",
            )
    return {name: sums[name] for name in periods}
