"""What clusters of stars have shown of a solution's covariance, and how well they show it."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.errors import InputError
from bayesdist.infer.robust.evidence import Evidence
from bayesdist.infer.robust.ratios import CellSize, PositionSigmas, Ratio
from bayesdist.infer.star_errors import StarCovariance

__all__ = ["RobustCovariance"]

Float = NDArray[np.float64]

LEVEL = 0.01  # of the test whether errors are independent
FEW = 10.0  # degrees of freedom of a position's variance below which it is hardly known
LEAST = 0.25  # of a formal variance: what chance leaves below it is raised to it
GROWING = 3.0  # errors by which a ratio may grow with the cells
ALONE = 0.9  # leverage of a cell that next to nothing else says what it says
AT_ONCE = 64  # positions whose degrees of freedom are found together


class RobustCovariance(Evidence):
    """A covariance that clusters of stars have shown, beside the formal one."""

    # -- the parameters' covariance ----------------------------------------------------------------

    @cached_property
    def ratio(self) -> Ratio:
        """Measured variance over the formal one: the mean over all independent combinations of the
        coefficients and drifts that frames do not take upon themselves."""
        return self._ratio(0)

    @property
    def exceeds(self) -> bool:
        """Whether the stars err together: chance makes such a ratio in one run of a hundred."""
        return self.ratio.p_value < LEVEL

    @cached_property
    def pooled(self) -> float:
        """How much of what single combinations of parameters show is given up for their mean.

        A pattern that is shorter than the waves of the polynomials raises all variances alike, and
        the mean of all ratios is known much better than each.  The share is that which makes the
        expected squared error least (Ledoit and Wolf 2004): 1 where the ratios differ by no more
        than chance.
        """
        relative = self._white @ self.from_cells() @ self._white.T
        differ = float(((relative - self.ratio.value * np.eye(len(relative))) ** 2).sum())
        return min(1.0, float(self._variance(self._white[None], 0)[1][0]) / differ)

    @cached_property
    def measured(self) -> Float:
        """Covariance (D, D) of the parameters as the clusters show it, pooled.

        Chance may bring variances below zero; none is left below a quarter of the formal one.
        """
        raw, here = self.from_cells(), np.ix_(self._own, self._own)
        step = self.pooled * (self.ratio.value * self.formal[here] - raw[here])
        # the others follow as far as they are correlated with these
        all_of = np.linalg.solve(self.formal[here], self.formal[self._own]).T
        return self._not_below(LEAST, raw + all_of @ step @ all_of.T)

    @cached_property
    def cov(self) -> Float:
        """Covariance (D, D) to be used: the measured one where it exceeds the formal one.

        No combination of parameters gets a smaller variance than the formal one.
        """
        if not self.exceeds:
            return self.formal
        return self._not_below(1.0, self.measured)

    def _not_below(self, least: float, cov: Float) -> Float:
        """A covariance, no variance of which is below a share of the formal one."""
        root = _root(self.formal)
        relative = np.linalg.solve(root, np.linalg.solve(root, cov).T)
        values, vectors = np.linalg.eigh((relative + relative.T) / 2)
        coloured = root @ vectors
        return np.asarray((coloured * np.maximum(values, least)) @ coloured.T)

    @property
    def of_all(self) -> Float:
        """`measured` for all parameters (P, P): frames follow as far as they are correlated."""
        if self.whole is None:
            return self.measured
        D = len(self.formal)
        follow = np.linalg.solve(self.whole[:D, :D], self.whole[:D]).T
        return np.asarray(self.whole + follow @ (self.measured - self.formal) @ follow.T)

    @property
    def shared(self) -> StarCovariance:
        """What has to be added to a solution, as `with_star_errors` takes it."""
        return StarCovariance(self.cov, self.formal)

    # -- how well it is known ----------------------------------------------------------------------

    @cached_property
    def _own(self) -> NDArray[np.int64]:
        """Which parameters of polynomials and drift no frame is degenerate with."""
        lowest = min({"none": 0, "shift": 1}.get(self.model.frames, 2), self.model.order)
        every = self.model.parameters[: self.model.n_distortion]
        degrees = np.array([(p.i or 0) + (p.j or 0) for p in every])
        return np.flatnonzero(degrees >= lowest)

    @cached_property
    def _white(self) -> Float:
        """Independent combinations (n, D) of these, of formal variance 1."""
        out = np.zeros((len(self._own), len(self.formal)))
        root = _root(self.formal[np.ix_(self._own, self._own)])
        out[:, self._own] = np.linalg.solve(root, np.eye(len(root)))
        return out

    def _ratio(self, k: int) -> Ratio:
        rows = self._white[None]
        n = rows.shape[1]
        value = float(np.trace(self._white @ self.from_cells(k) @ self._white.T)) / n
        error = float(np.sqrt(self._variance(rows, k)[0][0])) / n
        return Ratio(value, error, 2 * (value / error) ** 2)

    @cached_property
    def by_size(self) -> tuple[CellSize, ...]:
        """The ratio by the size of the cells: it stays where they are larger than a pattern."""
        side, n = self.cells.sides(self.model)[1], len(self._white)
        return tuple(
            CellSize(
                side * level.factor,
                float(self._square(level.influence, self._white[None])[0]) / n,
                self._ratio(k),
            )
            for k, level in enumerate(self.levels[1:])
        )

    @property
    def statement(self) -> str:
        """What a report has to say, in one sentence, and the doubts."""
        digits = ".0f" if self.ratio.value >= 10 else ".2f"
        ratio = f"{self.ratio.value:{digits}} +- {self.ratio.error:{digits}}"
        if self.exceeds:
            said = (
                f"stars err together: the variances of coefficients are {ratio} times the formal "
                "ones, and intervals that take stars for independent do not cover"
            )
        else:
            said = (
                f"stars err independently as far as can be seen: the variances of coefficients are "
                f"{ratio} times the formal ones"
            )
        return "; ".join([said, *self.doubts])

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """Why the measured covariance may be wrong itself, as sentences; empty where it is good."""
        out = []
        if self.ratio.dof < FEW:
            out.append(
                f"the variance rests on {self.ratio.dof:.0f} degrees of freedom: too few clusters"
            )
        first = self.by_size[0]
        for later in self.by_size[1:]:
            if later.ratio.value - first.ratio.value > GROWING * later.ratio.error:
                out.append(
                    f"cells of {later.pixels:.0f} pixels give a ratio of {later.ratio.value:.2f}, "
                    f"those of {first.pixels:.0f} pixels {first.ratio.value:.2f}: errors are "
                    "correlated beyond the cells"
                )
                break
        largest = self.levels[1].largest_leverage
        if largest > ALONE:
            out.append(f"a single cell determines some of the coefficients to {largest:.0%}")
        return tuple(out)

    def at(
        self,
        x: ArrayLike,
        y: ArrayLike,
        *,
        epoch: float | None = None,
        exposure: int | None = None,
        chip: int | None = None,
    ) -> PositionSigmas:
        """Errors of the model's positions; what it leaves out at the place itself is not in them.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            FITS 1-based pixels.
        epoch, exposure, chip
            As in `DistortionModel.predict`.

        Returns
        -------
        PositionSigmas

        Raises
        ------
        InputError
            For an exposure whose frame was left out of the covariance.
        """
        if exposure is not None and self.whole is not None:
            raise InputError(
                "the covariance is that of the polynomials alone",
                where="exposure",
                do="measure it with frames, or leave the exposure out",
            )
        J = self.model.jacobian(self.mean, x, y, epoch=epoch, exposure=exposure, chip=chip)
        rows = J[..., : len(self.formal)].reshape(-1, 1, len(self.formal))
        formal = _form(self.formal, rows)
        value = _form(self.measured, rows)
        parts = [rows[a : a + AT_ONCE] for a in range(0, len(rows), AT_ONCE)]
        alone = np.sqrt(np.concatenate([self._variance(part, 0)[0] for part in parts]))
        # the mean ratio is made from the same scores: errors add
        error = (1 - self.pooled) * alone + self.pooled * self.ratio.error * formal
        dof = np.maximum(2 * (value / error) ** 2, 1.0)
        shape = (-1, 2)
        return PositionSigmas(
            np.sqrt(value).reshape(shape), np.sqrt(formal).reshape(shape), dof.reshape(shape)
        )


def _form(cov: Float, rows: Float) -> Float:
    """Sum (n,) of the variances of quantities (n, r, D)."""
    return np.asarray(np.einsum("nrd,nrd->n", rows @ cov, rows))


def _root(cov: Float) -> Float:
    """Lower Cholesky factor, units apart."""
    scale = np.sqrt(np.diag(cov))
    root: Float = scale[:, None] * np.linalg.cholesky(cov / np.outer(scale, scale))
    return root
