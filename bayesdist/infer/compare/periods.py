"""Models of several periods, their differences, and the significance of these.

WSDC D-T033, Appendix C.  The normal equations of the periods add up to those of all data, so that
the model of each period, the combined one and all statistics of their differences come from these
sums.  The combined model shares its data with each period: with A_p = N^-1 N_p, the fraction of
period p in the normal equations, it is sum_q A_q theta_q, hence

    theta_p - theta = (1 - A_p) theta_p - sum_{q != p} A_q theta_q,

whose covariance for weights that are the inverse variances is C_p - C, not C_p + C.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from bayesdist.errors import DegenerateError, InputError
from bayesdist.infer.compare.positions import (
    DifferenceField,
    PositionChange,
    difference_field,
    largest_difference,
)
from bayesdist.infer.equations.normal import NormalEquations, least_squares
from bayesdist.infer.equations.rank import require_full_rank
from bayesdist.infer.equations.scaled import FieldTest, chi_square, scaled_inverse
from bayesdist.infer.solution.linear import LinearFit
from bayesdist.infer.stars.stars import Stars
from bayesdist.infer.stars.sums import Sums
from bayesdist.model import Chip, DistortionModel
from bayesdist.utils.arrays import Float
from bayesdist.utils.distributions import norm_sf

__all__ = [
    "CoefficientChange",
    "PeriodComparison",
    "PeriodSums",
    "compare_periods",
    "sums_of_stars",
]


@dataclass(frozen=True, eq=False)
class PeriodSums(Sums):
    """Sums over the matches of one period.

    Parameters
    ----------
    equations : NormalEquations
        About the mean of the fit of all data, with the matches that it uses.
    squares : NormalEquations or None
        With squared weights, where extra weights make the sandwich necessary.
    n : int
        Number of matches used.
    """

    equations: NormalEquations
    squares: NormalEquations | None
    n: int


def sums_of_stars(stars: Stars, fit: LinearFit, radial_weight: float = 1.0) -> PeriodSums:
    """Sums over some matches of one period.

    Parameters
    ----------
    stars : Stars
    fit : LinearFit
        Of all data: its model, and its rule for leaving matches out, which is then one for all.
    radial_weight : float
        As the fit's.

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
    """Model of each period, and the differences from the combined one.

    Parameters
    ----------
    fit : LinearFit
        Of all data, as given to `sums_of_stars`.
    sums : mapping of str to PeriodSums
        Two or more periods.  Together they are the combined data set, of which `fit` need not be
        the fit: where matches lie outside all periods it is not.
    rescale : bool
        True to multiply all errors by one factor, the root of chi-square per degree of freedom
        about the models of the periods.  Otherwise quoted errors that are too small make a change
        of noise.

    Returns
    -------
    PeriodComparison
        Residual structure that is the same in all periods cancels in the differences as far as
        the periods cover the array alike.

    Raises
    ------
    InputError
        For fewer than two periods, and for a model with frames or time dependence.
    DegenerateError
        When a period does not determine the model, naming the parameters.
    """
    if len(sums) < 2:
        raise InputError(f"{len(sums)} periods are given", do="give two or more")
    model = fit.model
    if model.n_frame or model.time is not None:
        raise InputError(
            "periods are compared by polynomials alone, and the model has "
            + ("frames of exposures" if model.n_frame else "time-dependent terms"),
            where="model",
            do="set model.frames = 'none' (refer the pairs to common solutions first) and drop the "
            "time-dependent terms",
        )
    steps, covs, normals, chi2, dof = [], [], [], 0.0, 0
    for name, one in sums.items():
        arrow, right = one.equations.assemble(model, fit.mean)
        try:
            require_full_rank(arrow, model, one.equations.groups)
        except DegenerateError as error:
            raise DegenerateError(
                f"the {one.n} pairs of period {name} do not determine the model: {error.cause}",
                where="periods",
                do="give longer periods or lower model.order",
            ) from error
        normal = arrow.dense()
        inverse = scaled_inverse(normal)
        step, cov = inverse @ right, inverse
        chi2 += float(one.equations.scalars[2])
        dof += 2 * one.n
        if one.squares is None:
            # with extra weights chi-square stays that about the fit of all data
            chi2 -= float(right @ step)
            dof -= len(step)
        else:
            meat, _ = one.squares.assemble(model, fit.mean)
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
        counts=tuple(one.n for one in sums.values()),
        error_scale=scale,
    )


@dataclass(frozen=True, eq=False)
class CoefficientChange:
    """Differences of all coefficients between two models.

    Parameters
    ----------
    names : tuple of str, length D
    difference, sigma : ndarray, shape (D,)
        Difference and its standard error.
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
        """Two-sided probability (D,) of each difference, regardless of the others."""
        return np.asarray(2 * norm_sf(np.abs(self.z)))


@dataclass(frozen=True, eq=False)
class PeriodComparison:
    """Models of several periods and the combined one.

    Parameters
    ----------
    model : DistortionModel
    names : tuple of str, length P
        Periods.
    means : ndarray, shape (P, D)
    covs : ndarray, shape (P, D, D)
        Covariance of each, independent of the others.
    fractions : ndarray, shape (P, D, D)
        A_p = N^-1 N_p; their sum is the identity.
    counts : tuple of int
        Number of matches in each.
    error_scale : float
        Factor on the quoted errors.
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
        """Parameters (D,) of the model of all periods."""
        return np.einsum("pij,pj->i", self.fractions, self.means)

    def _code(self, period: str) -> int:
        if period not in self.names:
            raise InputError(
                f"there is no period {period!r}", do=f"choose among {', '.join(self.names)}"
            )
        return self.names.index(period)

    def _contrast(self, period: str, against: str | None) -> Float:
        """Factors (P, D, D) on the means that give a difference."""
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
        against : str, optional
            Another period; the combined model by default.

        Returns
        -------
        difference : ndarray, shape (D,)
        cov : ndarray, shape (D, D)

        Raises
        ------
        InputError
            For an unknown period, or one against itself.
        """
        contrast = self._contrast(period, against)
        # differences of the means: large constants cancel before they meet rounding errors
        difference = np.einsum("pij,pj->i", contrast, self.means - self.means[0])
        return difference, _covariance(contrast, self.covs, contrast)

    def coefficients(
        self, period: str, against: str | None = None, *, monomial: bool = False
    ) -> CoefficientChange:
        """Difference of each coefficient with its error.

        Parameters
        ----------
        period, against
            As `difference`.
        monomial : bool
            True for coefficients of pixel offsets, as in SIP, in place of Legendre ones.

        Returns
        -------
        CoefficientChange
        """
        difference, cov = self.difference(period, against)
        if monomial:
            both = (self.model.basis(chip.number).monomial_matrix for chip in self.model.chips)
            # without time and frames the parameters are u and v of each chip in turn
            to_monomials = block_diag(*(m for m in both for _ in (0, 1)))
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
        """Largest difference over the array with its significance.

        Parameters
        ----------
        period, against
            As `difference`.
        rng : numpy.random.Generator
        grid : int
            Points along each axis, from edge to edge of the detector.
        n_draws : int
            Fields of noise that the largest difference is compared with; its probability is at
            least 1 / (n_draws + 1).

        Returns
        -------
        PositionChange
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
        """Difference of the positions over a chip.

        Parameters
        ----------
        period, against
            As `difference`.
        chip : Chip, optional
            The first chip by default.
        grid : tuple of int
            Points on x and on y.

        Returns
        -------
        DifferenceField
        """
        chip = chip or self.model.chips[0]
        return difference_field(self.model, *self.difference(period, against), chip, grid)

    @cached_property
    def homogeneity(self) -> FieldTest:
        """Chi-square of the periods about one model for all.

        Computed from the differences of all periods but one from the combined model, with their
        joint covariance: the last one follows from them.
        """
        contrasts = [self._contrast(name, None) for name in self.names[:-1]]
        cov = np.block(
            [[_covariance(one, self.covs, other) for other in contrasts] for one in contrasts]
        )
        differences = np.concatenate([self.difference(name)[0] for name in self.names[:-1]])
        return chi_square(differences, cov)


def _covariance(one: Float, covs: Float, other: Float) -> Float:
    """Covariance (D, D) of two combinations (P, D, D) of independent vectors."""
    return np.asarray((one @ covs @ other.swapaxes(1, 2)).sum(axis=0))
