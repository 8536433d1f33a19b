"""Time series of coefficients from fits of single exposures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.errors import DegenerateError, InputError
from bayesdist.utils.arrays import Float, Int

MAD_TO_SIGMA = 1.4826  # standard deviation over median absolute deviation of a Gaussian

MIN_EXPOSURES_FOUND = 5  # minimum number of exposures per segment if breaks are unknown


@dataclass(frozen=True, eq=False)
class Series:
    """Time series of k coefficients of E exposures, with formal covariances.

    Parameters
    ----------
    epoch : ndarray, shape (E,)
        Dates of the exposures in decimal years, in any order.
    values : ndarray, shape (E, k)
        Coefficients of the exposures.
    cov : ndarray, shape (E, k, k)
        Formal covariances of the coefficients; zero if formal errors are unknown.
    coefficients : tuple of str
        Names of the coefficients, such as 'A_2'.
    names : tuple of str, optional
        Names of the exposures; '1', '2', ... by default.
    group : tuple of str, optional
        Group of each exposure, such as its filter.
    source : str
        Origin of the series, for error messages.

    Raises
    ------
    InputError
        If shapes are inconsistent, values are not finite, names are repeated, or a covariance is
        not symmetric or has a negative eigenvalue.
    DegenerateError
        If there are fewer than three exposures, or a coefficient neither varies nor has a formal
        error (such as A_3 of the reference chip).
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
                    do="give one row per exposure",
                )
        for label, labels in (("names", self.names), ("group", self.group)):
            if labels and len(labels) != n:
                raise InputError(
                    f"{len(labels)} {label} for {n} exposures",
                    where=self.source,
                    do="give one per exposure",
                )
        for label, unique in (("coefficient", self.coefficients), ("exposure", self.names)):
            if len(set(unique)) < len(unique):
                repeated = next(v for v in unique if unique.count(v) > 1)
                raise InputError(
                    f"{label} {repeated!r} is repeated", where=self.source, do="name each once"
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
        # formal variances of different coefficients may differ by many orders of magnitude
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
        """Make a series with uncorrelated formal errors.

        Parameters
        ----------
        epoch : array_like, shape (E,)
            Dates of the exposures in decimal years.
        values : array_like, shape (E, k) or (E,)
            Coefficients of the exposures.
        sigma : array_like, optional
            Formal errors, with a shape that can be broadcast to that of the values; unknown by
            default.
        coefficients, names, group, source
            See `Series`.

        Returns
        -------
        Series

        Raises
        ------
        InputError
            If a formal error is negative; see also `Series`.
        """
        rows = np.asarray(values, float)
        rows = rows[:, None] if rows.ndim == 1 else rows
        errors = np.zeros_like(rows)
        if sigma is not None:
            formal = np.asarray(sigma, float)
            formal = formal[:, None] if formal.ndim == 1 and rows.shape[1] == 1 else formal
            errors = np.broadcast_to(formal, rows.shape)
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
        """Median (k,) of each coefficient, which is subtracted in all computations."""
        return np.median(self.values, axis=0)

    @cached_property
    def spread(self) -> Float:
        """Robust spread (k,) of each coefficient, by which priors are scaled.

        It is the larger of the standard deviation from the median absolute deviation and the median
        formal error; if both are zero, the ordinary standard deviation.
        """
        mad = MAD_TO_SIGMA * np.median(np.abs(self.values - self.centre), axis=0)
        out = np.maximum(mad, np.median(self.sigma, axis=0))
        return np.where(out > 0, out, self.values.std(axis=0))

    @property
    def group_names(self) -> tuple[str, ...]:
        """Names of the groups, starting with that with most exposures; empty without groups."""
        counts = {name: self.group.count(name) for name in sorted(set(self.group))}
        return tuple(sorted(counts, key=lambda name: -counts[name]))

    @property
    def group_code(self) -> Int:
        """Index (E,) in `group_names` of the group of each exposure; zero without groups."""
        if not self.group:
            return np.zeros(len(self), np.int64)
        place = {name: i for i, name in enumerate(self.group_names)}
        return np.array([place[name] for name in self.group], np.int64)

    def take(self, rows: ArrayLike) -> Series:
        """Select exposures.

        Parameters
        ----------
        rows : array_like
            Boolean mask (E,) or indices of the exposures.

        Returns
        -------
        Series
        """
        selected = np.arange(len(self))[np.asarray(rows)]
        return replace(
            self,
            epoch=self.epoch[selected],
            values=self.values[selected],
            cov=self.cov[selected],
            names=tuple(self.names[i] for i in selected),
            group=tuple(self.group[i] for i in selected) if self.group else (),
        )

    def only(self, *coefficients: str) -> Series:
        """Select coefficients by name.

        Parameters
        ----------
        *coefficients : str
            Names, in the order of the result.

        Returns
        -------
        Series

        Raises
        ------
        InputError
            If a name is unknown.
        """
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
