"""Detections of stars in one or more exposures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.covariances import covariances_of
from bayesdist.data.tables.checks import COMPLETED, check_columns, columns_of, refuse_half
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int

NO_STAR = -1

_CODES = ("exposure", "chip", "star", "row")
_ELLIPSE = ("sigma_x", "sigma_y", "rho_xy")
_COLUMNS = ("x", "y", "sigma", *_ELLIPSE, "mag", "q", *_CODES)


@dataclass(frozen=True, eq=False)
class Detections:
    """Raw positions of stars in exposures; arrays of length N unless stated otherwise.

    Parameters
    ----------
    x, y : ndarray
        Raw detector positions, FITS 1-based pixels of the chip.
    exposure : ndarray of int, optional
        Indices into `exposure_names`; 0 by default.
    exposure_names : tuple of str, optional
        Names of the exposures. The default is their indices.
    chip : ndarray of int, optional
        Chip *numbers* (not codes); 1 by default.
    epoch : ndarray, shape (E,), optional
        Decimal year of each exposure.
    sigma : ndarray, optional
        Standard error of x and of y, pixels; positive. The default is the rms of `sigma_x` and
        `sigma_y`.
    mag : ndarray, optional
        Instrumental magnitudes, -2.5 log10(flux / exposure time).
    star : ndarray of int, optional
        Code of the star; by default -1, which means unknown.
    source : str
        Name of the file.
    q : ndarray, optional
        Quality of the PSF fit: 0 is perfect, large is poor.
    row : ndarray of int, optional
        Row in the file, counted from 0.
    sigma_x, sigma_y, rho_xy : ndarray, optional
        Standard errors of x and of y in pixels, and the correlation of both.

    Raises
    ------
    InputError
        If there are no detections, if lengths are unequal, if values are not finite, or if errors
        are not positive.
    """

    x: Float
    y: Float
    exposure: Int = COMPLETED
    exposure_names: tuple[str, ...] = COMPLETED
    chip: Int = COMPLETED
    epoch: Float | None = None
    sigma: Float | None = None
    mag: Float | None = None
    star: Int = COMPLETED
    source: str = "detections"
    q: Float | None = None
    row: Int = COMPLETED
    sigma_x: Float | None = None
    sigma_y: Float | None = None
    rho_xy: Float | None = None

    def __post_init__(self) -> None:
        n = np.size(self.x)
        for name, value in (("exposure", 0), ("chip", 1), ("star", NO_STAR)):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full(n, value))
        if self.row is None:
            object.__setattr__(self, "row", np.arange(n))
        if self.exposure_names is None:
            codes = range(int(np.max(self.exposure, initial=0)) + 1)
            object.__setattr__(self, "exposure_names", tuple(map(str, codes)))
        refuse_half(_ELLIPSE[:2], columns_of(self, _ELLIPSE), where=self.where, what="errors")
        if self.sigma is None and self.sigma_x is not None and self.sigma_y is not None:
            rms = np.sqrt((np.square(self.sigma_x) + np.square(self.sigma_y)) / 2)
            object.__setattr__(self, "sigma", rms)
        if n == 0:
            raise InputError("holds no detections", where=self.where, do="give a list with stars")
        check_columns(
            self,
            _COLUMNS,
            integers=_CODES,
            where=self.where,
            place=lambda index: f"{self.source}, row {self.row[index] + 1}",
            positive=("sigma", "sigma_x", "sigma_y"),
        )

    def __len__(self) -> int:
        return len(self.x)

    @property
    def name(self) -> str:
        """Name of the first exposure, which is the only one in a list of one exposure."""
        return self.exposure_names[0]

    @property
    def where(self) -> str:
        """File for messages, with the exposure if there is only one."""
        is_single = len(self.exposure_names) == 1
        return f"{self.source}, exposure {self.name}" if is_single else self.source

    @property
    def points(self) -> Float:
        """Positions (N, 2) of the detections, in pixels."""
        return np.column_stack([self.x, self.y])

    @property
    def covariances(self) -> Float | None:
        """Covariances (N, 2, 2) of x and y in square pixels; None without `sigma_x`."""
        if self.sigma_x is None or self.sigma_y is None:
            return None
        rho = 0.0 if self.rho_xy is None else self.rho_xy
        return covariances_of(self.sigma_x, self.sigma_y, rho)

    @property
    def chips(self) -> tuple[int, ...]:
        """Numbers of the chips that have detections."""
        return tuple(np.unique(self.chip).tolist())

    @property
    def n_stars(self) -> int:
        """Largest star code plus one."""
        return int(self.star.max()) + 1

    def select(self, which: NDArray[Any]) -> Detections:
        """Select detections by mask or indices; exposure names are kept.

        Parameters
        ----------
        which : ndarray of bool or int
            Boolean mask (N,), or indices.

        Returns
        -------
        Detections
            The selected detections.
        """
        columns = columns_of(self, _COLUMNS)
        return replace(self, **{name: values[which] for name, values in columns.items()})


def detections_of(
    lists: Sequence[Detections],
    *,
    epoch: Float | None = None,
    sigma: float | None = None,
) -> Detections:
    """Combine lists of one exposure each; `epoch` (E,) is in decimal years.

    `sigma` is an error in pixels common to all detections. Without it, errors, and the covariances
    of x and y, are those of the lists if all lists have them. Raises InputError if only some of the
    lists have magnitudes.
    """
    with_mag = [stars.mag is not None for stars in lists]
    if any(with_mag) and not all(with_mag):
        bare = lists[with_mag.index(False)]
        raise InputError(
            "has no magnitudes, although other lists do",
            where=bare.source,
            do="add them, or drop the column from all lists",
        )
    n = [len(stars) for stars in lists]
    errors: dict[str, Any] = {}
    if sigma is not None:
        errors = {"sigma": np.full(sum(n), sigma)}
    else:
        columns = [columns_of(stars, ("sigma", *_ELLIPSE[:2])) for stars in lists]
        names = set.intersection(*(set(of_list) for of_list in columns))
        errors = {name: np.concatenate([c[name] for c in columns]) for name in names}
        if "sigma_x" in names and any(stars.rho_xy is not None for stars in lists):
            errors["rho_xy"] = np.concatenate(
                [np.zeros(len(s)) if s.rho_xy is None else s.rho_xy for s in lists]
            )
    return Detections(
        np.concatenate([stars.x for stars in lists]),
        np.concatenate([stars.y for stars in lists]),
        np.repeat(np.arange(len(lists)), n),
        tuple(stars.name for stars in lists),
        np.concatenate([stars.chip for stars in lists]),
        epoch,
        mag=np.concatenate([stars.mag for stars in lists if stars.mag is not None])
        if all(with_mag)
        else None,
        source=lists[0].source if len(lists) == 1 else f"{len(lists)} star lists",
        **errors,
    )
