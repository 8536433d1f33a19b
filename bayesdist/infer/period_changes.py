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
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.stats import chi2 as chi_square
from scipy.stats import norm

from bayesdist.errors import InputError
from bayesdist.model import DistortionModel

__all__ = ["CoefficientChange", "PeriodComparison", "PositionChange"]

Float = NDArray[np.float64]

SIGNIFICANT = 0.01  # probability under which a difference is called one


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
class PositionChange:
    """The largest difference of two models over the array, and how likely noise makes one.

    Parameters
    ----------
    largest : float
        Radial, in the unit of u, v.
    at : tuple of float
        Where, FITS 1-based pixels.
    chip : int
        On which chip.
    sigma : float
        Standard error of the difference there, along its direction.
    noise_median, noise_95 : float
        Largest difference over the array that noise alone makes: median and 95th percentile.
    p_value : float
        Share of noise fields with a largest difference of this size: it accounts for the search
        over the array.
    chi2 : float
        Of the whole field with its joint covariance.  The field is as good as its coefficients, so
        this is also the chi-square of these.
    dof : int
    p_field : float
        Probability of a chi-square as large.
    """

    largest: float
    at: tuple[float, float]
    chip: int
    sigma: float
    noise_median: float
    noise_95: float
    p_value: float
    chi2: float
    dof: int
    p_field: float


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

    @cached_property
    def combined_cov(self) -> Float:
        """Covariance (D, D) of the combined model."""
        return _covariance(self.shares, self.covs, self.shares)

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

    def joint(self, period: str, against: str | None = None) -> tuple[float, int, float]:
        """Chi-square of all coefficients together, its degrees of freedom, and its probability."""
        difference, cov = self.difference(period, against)
        return _tested(difference, cov)

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
        scale = np.sqrt(np.diag(cov))
        root = np.linalg.cholesky(cov / np.outer(scale, scale)) * scale[:, None]
        noise = rng.standard_normal((n_draws, len(scale))) @ root.T
        largest, worst = np.zeros(n_draws), (-1.0, 0, (0.0, 0.0), 0.0)
        for chip in self.model.chips:
            x, y = _points(chip.size, grid)
            phi = self.model.basis(chip.number).evaluate(x, y)
            u, v = (self.model.coefficient_slice(chip.number, axis) for axis in (0, 1))
            radial = (noise[:, u] @ phi.T) ** 2 + (noise[:, v] @ phi.T) ** 2
            largest = np.maximum(largest, np.sqrt(radial.max(axis=1)))
            field = np.stack([phi @ difference[u], phi @ difference[v]])
            size = np.hypot(*field)
            k = int(np.argmax(size))
            if size[k] > worst[0]:
                along = np.zeros(len(scale))
                direction = field[:, k] / size[k] if size[k] > 0 else np.array([1.0, 0.0])
                along[u], along[v] = direction[0] * phi[k], direction[1] * phi[k]
                sigma = float(np.sqrt(along @ cov @ along))
                worst = (float(size[k]), chip.number, (float(x[k]), float(y[k])), sigma)
        chi2, dof, p_field = _tested(difference, cov)
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

    @cached_property
    def homogeneity(self) -> tuple[float, int, float]:
        """Chi-square that all periods have one model, its degrees of freedom, its probability.

        Of the differences of all periods but one from the combined model, with their joint
        covariance: the last one follows from them.
        """
        contrasts = [self._contrast(name, None) for name in self.names[:-1]]
        cov = np.block(
            [[_covariance(one, self.covs, other) for other in contrasts] for one in contrasts]
        )
        differences = np.concatenate([self.difference(name)[0] for name in self.names[:-1]])
        return _tested(differences, cov)

    def verdict(self, *, rng: np.random.Generator, tolerance: float | None = None) -> str:
        """One sentence: whether the distortion changes, by how much, and whether that matters.

        Parameters
        ----------
        rng : numpy.random.Generator
        tolerance : float, optional
            Largest difference of positions that does not matter, in the unit of u, v.

        Returns
        -------
        str
        """
        chi2, dof, p = self.homogeneity
        changes = {name: self.positions(name, rng=rng) for name in self.names}
        # the most significant, not the largest: the shortest period has the largest noise
        name, most = max(changes.items(), key=lambda one: one[1].chi2)
        unit = self.model.unit
        head = "The distortion changes" if p < SIGNIFICANT else "No change is seen"
        out = (
            f"{head} (chi-square {chi2:.4g} for {dof} degrees of freedom, {_probability(p)}): "
            f"{name} differs most from the combined model, by up to {most.largest:.2g} +- "
            f"{most.sigma:.1g} {unit} at ({most.at[0]:.0f}, {most.at[1]:.0f}), where noise alone "
            f"makes {most.noise_median:.2g} (95 %: {most.noise_95:.2g})"
        )
        if tolerance is None:
            return out + "."
        limit = f"the tolerance of {tolerance:g} {unit}"
        # the largest of a noisy field lies too high rather than too low
        if all(one.largest + 2 * one.sigma <= tolerance for one in changes.values()):
            return f"{out}; all periods are below {limit}."
        beyond = [
            name
            for name, one in changes.items()
            if one.p_value < SIGNIFICANT and one.largest - 2 * one.sigma > tolerance
        ]
        if beyond:
            return f"{out}; beyond {limit}: {', '.join(beyond)}."
        return f"{out}; the data do not decide whether a period exceeds {limit}."


def _covariance(one: Float, covs: Float, other: Float) -> Float:
    """Covariance (D, D) of two combinations (P, D, D) of independent vectors."""
    return np.asarray((one @ covs @ other.swapaxes(1, 2)).sum(axis=0))


def _probability(p: float) -> str:
    return "p < 1e-12" if p < 1e-12 else f"p = {p:.2g}"


def _points(size: tuple[float, float], grid: int) -> tuple[Float, Float]:
    """Points (grid^2,) from edge to edge of a detector."""
    x, y = np.meshgrid(np.linspace(1, size[0], grid), np.linspace(1, size[1], grid))
    return x.ravel(), y.ravel()


def _tested(difference: Float, cov: Float) -> tuple[float, int, float]:
    """Chi-square of a vector, its degrees of freedom, and the probability of one as large."""
    scale = np.sqrt(np.diag(cov))
    factor = cho_factor(cov / np.outer(scale, scale))
    scaled = difference / scale
    value = float(scaled @ cho_solve(factor, scaled))
    return value, len(scaled), float(chi_square.sf(value, len(scaled)))
