"""Coefficients of many exposures against time, from fits of single exposures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import DegenerateError, InputError
from bayesdist.utils.arrays import Float, Int

MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, eq=False)
class Series:
    """k coefficients of E exposures, each with its date and formal covariance.

    Parameters
    ----------
    epoch : ndarray, shape (E,)
        Decimal years, in any order.
    values : ndarray, shape (E, k)
        The coefficients.
    cov : ndarray, shape (E, k, k)
        Their formal covariance; zero where no formal errors are known.
    coefficients : tuple of str
        Names of the coefficients, such as 'A_2'.
    names : tuple of str, optional
        Names of the exposures; '1', '2', ... by default.
    group : tuple of str, optional
        Group of each exposure, such as its filter.
    source : str
        Origin of the series, for messages.

    Raises
    ------
    InputError
        For shapes that do not fit, values that are not finite, repeated names, and covariances that
        are not symmetric or have negative eigenvalues.
    DegenerateError
        For fewer than three exposures, and a coefficient that neither varies nor has a formal
        error (such as the A_3 of the chip that defines the frame).
    """

    epoch: Float
    values: Float
    cov: Float
    coefficients: tuple[str, ...]
    names: tuple[str, ...] = ()
    group: tuple[str, ...] = ()
    source: str = "series"

    def __post_init__(self) -> None:
        for name in ("epoch", "values", "cov"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), np.float64))
        n, k = self.epoch.size, len(self.coefficients)
        if not self.names:
            object.__setattr__(self, "names", tuple(str(i + 1) for i in range(n)))
        for name, shape in (("epoch", (n,)), ("values", (n, k)), ("cov", (n, k, k))):
            if getattr(self, name).shape != shape:
                raise InputError(
                    f"{name} has shape {getattr(self, name).shape}, but {n} epochs and {k} "
                    f"coefficients need {shape}",
                    where=self.source,
                    do="give one row for each exposure",
                )
        for label, given in (("names", self.names), ("group", self.group)):
            if given and len(given) != n:
                raise InputError(
                    f"{len(given)} {label} for {n} exposures",
                    where=self.source,
                    do="give one for each exposure",
                )
        for label, unique in (("coefficient", self.coefficients), ("exposure", self.names)):
            if len(set(unique)) < len(unique):
                twice = next(v for v in unique if unique.count(v) > 1)
                raise InputError(
                    f"{label} {twice!r} stands twice", where=self.source, do="name each once"
                )
        self._check_numbers()
        if n < 3:
            raise DegenerateError(
                f"{n} exposures determine neither a trend nor a scatter",
                where=self.source,
                do="give at least three",
            )
        flat = ~(self.spread > 0)
        if flat.any():
            raise DegenerateError(
                f"coefficient {self.coefficients[int(np.argmax(flat))]!r} does not vary and has no "
                "formal error",
                where=self.source,
                do="leave it out: it is fixed by the choice of the frame",
            )

    def _check_numbers(self) -> None:
        good = {
            "epoch": np.isfinite(self.epoch),
            "value": np.isfinite(self.values).all(axis=1),
            "covariance": np.isfinite(self.cov).all(axis=(1, 2)),
        }
        for label, rows in good.items():
            if not rows.all():
                bad = int(np.argmin(rows))
                raise InputError(
                    f"{label} is not finite",
                    where=f"{self.source}, row {bad + 1} (exposure {self.names[bad]})",
                    do="drop the exposure",
                )
        size = np.abs(self.cov).max(axis=(1, 2))
        skew = np.abs(self.cov - np.swapaxes(self.cov, 1, 2)).max(axis=(1, 2))
        # formal variances of different coefficients may differ by many powers of ten
        sigma = np.sqrt(np.maximum(np.diagonal(self.cov, axis1=1, axis2=2), 0.0))
        unit = np.where(sigma > 0, sigma, 1.0)
        scaled = self.cov / (unit[:, :, None] * unit[:, None, :])
        wrong = (skew > 1e-8 * size) | (np.linalg.eigvalsh(scaled)[:, 0] < -1e-8)
        if wrong.any():
            bad = int(np.argmax(wrong))
            raise InputError(
                "covariance is not symmetric or has a negative eigenvalue",
                where=f"{self.source}, row {bad + 1} (exposure {self.names[bad]})",
                do="correct it",
            )

    @classmethod
    def of(
        cls,
        epoch: ArrayLike,
        values: ArrayLike,
        sigma: ArrayLike | None = None,
        *,
        coefficients: Sequence[str],
        names: Sequence[str] = (),
        group: Sequence[str] = (),
        source: str = "series",
    ) -> Series:
        """Series with uncorrelated formal errors.

        Parameters
        ----------
        epoch : array_like, shape (E,)
        values : array_like, shape (E, k) or (E,)
        sigma : array_like, optional
            Formal errors, of a shape that broadcasts to that of the values; none are known by
            default.
        coefficients, names, group, source
            As for `Series`.

        Returns
        -------
        Series
        """
        rows = np.asarray(values, float)
        rows = rows[:, None] if rows.ndim == 1 else rows
        errors = np.zeros_like(rows)
        if sigma is not None:
            given = np.asarray(sigma, float)
            given = given[:, None] if given.ndim == 1 and rows.shape[1] == 1 else given
            errors = np.broadcast_to(given, rows.shape)
        if np.any(errors < 0):
            bad = int(np.argmax((errors < 0).any(axis=1)))
            raise InputError(
                "formal error is negative", where=f"{source}, row {bad + 1}", do="correct it"
            )
        cov = errors[:, :, None] ** 2 * np.eye(rows.shape[1])
        return cls(
            np.asarray(epoch, float),
            rows,
            cov,
            tuple(coefficients),
            tuple(names),
            tuple(group),
            source,
        )

    def __len__(self) -> int:
        return len(self.epoch)

    @property
    def n_coefficients(self) -> int:
        """Number k of coefficients."""
        return len(self.coefficients)

    @property
    def sigma(self) -> Float:
        """Formal errors (E, k)."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))

    @property
    def span(self) -> tuple[float, float]:
        """Dates of the first and the last exposure."""
        return float(self.epoch.min()), float(self.epoch.max())

    @cached_property
    def centre(self) -> Float:
        """Median (k,) of each coefficient, which is subtracted before anything is computed."""
        return np.median(self.values, axis=0)

    @cached_property
    def spread(self) -> Float:
        """Robust spread (k,) of each coefficient, the unit in which priors are scaled.

        The median absolute deviation from the median as a standard deviation, or the median formal
        error, whichever is larger; the plain standard deviation where both vanish.
        """
        mad = MAD_TO_SIGMA * np.median(np.abs(self.values - self.centre), axis=0)
        out = np.maximum(mad, np.median(self.sigma, axis=0))
        return np.where(out > 0, out, self.values.std(axis=0))

    @property
    def group_names(self) -> tuple[str, ...]:
        """Groups, the one with most exposures first; empty where there are none."""
        counts = {name: self.group.count(name) for name in sorted(set(self.group))}
        return tuple(sorted(counts, key=lambda name: -counts[name]))

    @property
    def group_code(self) -> Int:
        """Index (E,) of each exposure's group in `group_names`; zeros without groups."""
        if not self.group:
            return np.zeros(len(self), np.int64)
        place = {name: i for i, name in enumerate(self.group_names)}
        return np.array([place[name] for name in self.group], np.int64)

    def take(self, rows: ArrayLike) -> Series:
        """Series of the exposures of a mask (E,) or of row numbers."""
        which = np.arange(len(self))[np.asarray(rows)]
        return replace(
            self,
            epoch=self.epoch[which],
            values=self.values[which],
            cov=self.cov[which],
            names=tuple(self.names[i] for i in which),
            group=tuple(self.group[i] for i in which) if self.group else (),
        )

    def only(self, *coefficients: str) -> Series:
        """Series of some of the coefficients, in the order of the arguments."""
        for name in coefficients:
            if name not in self.coefficients:
                raise InputError(
                    f"there is no coefficient {name!r}",
                    where=self.source,
                    do=f"choose among {', '.join(self.coefficients)}",
                )
        columns = [self.coefficients.index(name) for name in coefficients]
        return replace(
            self,
            values=self.values[:, columns],
            cov=self.cov[np.ix_(range(len(self)), columns, columns)],
            coefficients=tuple(coefficients),
        )
