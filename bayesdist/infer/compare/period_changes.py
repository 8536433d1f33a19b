"""How far models of several periods differ, with significance (WSDC D-T033, Appendix C).

The combined model shares its data with each period: with A_p = N^-1 N_p, the share of period p in
the normal equations, it is sum_q A_q theta_q, hence

    theta_p - theta = (1 - A_p) theta_p - sum_{q != p} A_q theta_q,

whose covariance for weights that are the inverse variances is C_p - C, not C_p + C.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.stats import norm

from bayesdist.errors import InputError
from bayesdist.infer.compare.positions import (
    DifferenceField,
    PositionChange,
    difference_field,
    largest_difference,
)
from bayesdist.infer.equations.scaled import FieldTest, chi_square
from bayesdist.model import Chip, DistortionModel

__all__ = ["CoefficientChange", "PeriodComparison"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CoefficientChange:
    """Differences of all coefficients between two models.

    Parameters
    ----------
    names : tuple of str, length D
    difference, sigma : ndarray, shape (D,)
        And its standard error.
    """

    names: tuple[str, ...]
    difference: Float
    sigma: Float

    @property
    def z(self) -> Float:
        """Differences in units of their errors, shape (D,)."""
        return self.difference / self.sigma

    @property
    def p_value(self) -> Float:
        """Two-sided probability of each difference, of each by itself, shape (D,)."""
        return np.asarray(2 * norm.sf(np.abs(self.z)))


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
    shares : ndarray, shape (P, D, D)
        A_p = N^-1 N_p; they add up to one.
    counts : tuple of int
        Pairs of each.
    error_scale : float
        What the quoted errors were multiplied by.
    """

    model: DistortionModel
    names: tuple[str, ...]
    means: Float
    covs: Float
    shares: Float
    counts: tuple[int, ...]
    error_scale: float

    @cached_property
    def combined(self) -> Float:
        """Parameters (D,) of the model of all periods."""
        return np.einsum("pij,pj->i", self.shares, self.means)

    def _code(self, period: str) -> int:
        if period not in self.names:
            raise InputError(
                f"there is no period {period!r}", do=f"choose among {', '.join(self.names)}"
            )
        return self.names.index(period)

    def _contrast(self, period: str, against: str | None) -> Float:
        """Factors (P, D, D) by which the means make a difference."""
        D = self.means.shape[1]
        out = np.zeros_like(self.covs)
        p = self._code(period)
        if against is not None:
            q = self._code(against)
            if p == q:
                raise InputError(f"period {period} is compared with itself", do="name another")
            out[p], out[q] = np.eye(D), -np.eye(D)
            return out
        out[:] = -self.shares
        # 1 - A_p without the cancellation that a period with most of the data brings
        out[p] = np.delete(self.shares, p, axis=0).sum(axis=0)
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
            Coefficients of pixel offsets, as SIP has them, in place of Legendre ones.

        Returns
        -------
        CoefficientChange
        """
        difference, cov = self.difference(period, against)
        if monomial:
            both = (self.model.basis(chip.number).monomial_matrix for chip in self.model.chips)
            # parameters without time and frames: u and v of each chip, in a row
            to_monomials = block_diag(*(m for m in both for _ in (0, 1)))
            difference, cov = to_monomials @ difference, to_monomials @ cov @ to_monomials.T
        return CoefficientChange(self.model.names, difference, np.sqrt(np.diag(cov)))

    def joint(self, period: str, against: str | None = None) -> FieldTest:
        """Chi-square of all coefficients together."""
        difference, cov = self.difference(period, against)
        return chi_square(difference, cov)

    def positions(
        self,
        period: str,
        against: str | None = None,
        *,
        rng: np.random.Generator,
        grid: int = 33,
        n_draws: int = 2000,
    ) -> PositionChange:
        """The largest difference over the array with its significance.

        Parameters
        ----------
        period, against
            As `difference`.
        rng : numpy.random.Generator
        grid : int
            Points along each axis, from edge to edge of the detector.
        n_draws : int
            Fields of noise that the largest difference is compared with; its probability is not
            told below 1 / (n_draws + 1).

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

        Of the differences of all periods but one from the combined model, with their joint
        covariance: the last one follows from them.
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
