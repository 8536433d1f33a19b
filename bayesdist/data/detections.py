"""Detections of stars on one exposure or on many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.tables.checks import COMPLETED, check_columns, columns_of
from bayesdist.errors import InputError
from bayesdist.utils.arrays import Float, Int

NO_STAR = -1

_CODES = ("exposure", "chip", "star", "row")
_COLUMNS = ("x", "y", "sigma", "mag", "q", *_CODES)


@dataclass(frozen=True, eq=False)
class Detections:
    """Raw positions of stars on some exposures, arrays of length N unless stated otherwise.

    Parameters
    ----------
    x, y : ndarray
        Raw detector position, FITS 1-based pixels of the chip.
    exposure : ndarray of int, optional
        Codes into `exposure_names`; by default 0.
    exposure_names : tuple of str, optional
        By default the codes.
    chip : ndarray of int, optional
        Chip *numbers* (not codes); by default 1.
    epoch : ndarray, shape (E,), optional
        Decimal year of each exposure.
    sigma : ndarray, optional
        Standard error of x and of y, pixels; positive.
    mag : ndarray, optional
        Instrumental magnitudes, -2.5 log10(flux / exposure time).
    star : ndarray of int, optional
        Code of the star; by default it is not known, -1.
    source : str
        File.
    q : ndarray, optional
        Quality of the PSF fit: 0 is perfect, large is poor.
    row : ndarray of int, optional
        0-based row in the file.

    Raises
    ------
    InputError
        For no detections, unequal lengths, values that are not finite, or errors that are not
        positive.
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
        if n == 0:
            raise InputError("holds no detections", where=self.where, do="give a list with stars")
        check_columns(
            self,
            _COLUMNS,
            integers=_CODES,
            where=self.where,
            place=lambda index: f"{self.source}, row {self.row[index] + 1}",
            positive=("sigma",),
        )

    def __len__(self) -> int:
        return len(self.x)

    @property
    def name(self) -> str:
        """Name of the exposure, of a list of one; else of the first."""
        return self.exposure_names[0]

    @property
    def where(self) -> str:
        """File, for messages, and exposure where there is only one."""
        one = len(self.exposure_names) == 1
        return f"{self.source}, exposure {self.name}" if one else self.source

    @property
    def points(self) -> Float:
        """Positions (N, 2)."""
        return np.column_stack([self.x, self.y])

    @property
    def chips(self) -> tuple[int, ...]:
        """Numbers of the chips that have detections."""
        return tuple(np.unique(self.chip).tolist())

    @property
    def n_stars(self) -> int:
        """Largest star code plus one."""
        return int(self.star.max()) + 1

    def select(self, which: NDArray[Any]) -> Detections:
        """Detections by mask or indices; the exposures stay.

        Parameters
        ----------
        which : ndarray of bool or int

        Returns
        -------
        Detections
        """
        columns = columns_of(self, _COLUMNS)
        return replace(self, **{name: values[which] for name, values in columns.items()})


def detections_of(
    lists: Sequence[Detections],
    *,
    epoch: Float | None = None,
    sigma: float | None = None,
) -> Detections:
    """Detections of lists of one exposure each, with epochs (E,) in years.

    `sigma` is one error for all, pixels; without it errors are those of the lists, where all have
    some.  Refused where only some of the lists have magnitudes.
    """
    with_mag = [one.mag is not None for one in lists]
    if any(with_mag) and not all(with_mag):
        bare = lists[with_mag.index(False)]
        raise InputError("has no magnitudes, and others have", where=bare.source)
    n = [len(one) for one in lists]
    own = [one.sigma for one in lists if one.sigma is not None]
    errors = np.concatenate(own) if len(own) == len(lists) else None
    return Detections(
        np.concatenate([one.x for one in lists]),
        np.concatenate([one.y for one in lists]),
        np.repeat(np.arange(len(lists)), n),
        tuple(one.name for one in lists),
        np.concatenate([one.chip for one in lists]),
        epoch,
        errors if sigma is None else np.full(sum(n), sigma),
        np.concatenate([one.mag for one in lists if one.mag is not None])
        if all(with_mag)
        else None,
        source=lists[0].source if len(lists) == 1 else f"{len(lists)} star lists",
    )
