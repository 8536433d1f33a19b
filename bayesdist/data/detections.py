"""Detections of stars on many exposures, where the positions of the stars are not known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesdist.data.starlists import StarList
from bayesdist.data.tables.checks import check_columns, columns_of
from bayesdist.errors import InputError

__all__ = ["NO_STAR", "Detections", "detections_of"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

NO_STAR = -1

_CODES = ("exposure", "chip", "star")
_COLUMNS = ("x", "y", "sigma", "mag", *_CODES)


@dataclass(frozen=True, eq=False)
class Detections:
    """Raw positions of all exposures, arrays of length N unless stated otherwise.

    `star` groups the detections of one star by its code, with `NO_STAR` where it is not known;
    `chip` is 1 by default.  Refused are no detections, unequal lengths, values that are not finite,
    and errors that are not positive.
    """

    x: Float  # FITS 1-based pixels of the chip
    y: Float
    exposure: Int  # codes, from 0
    exposure_names: tuple[str, ...]
    chip: Int = None  # type: ignore[assignment]
    epoch: Float | None = None  # (E,), decimal years
    sigma: Float | None = None  # error of x and of y, pixels
    mag: Float | None = None  # instrumental
    star: Int = None  # type: ignore[assignment]
    source: str = "detections"

    def __post_init__(self) -> None:
        n = len(self.x)
        if n == 0:
            raise InputError("holds no detections", where=self.source, do="give lists with stars")
        if self.chip is None:
            object.__setattr__(self, "chip", np.ones(n, np.int64))
        if self.star is None:
            object.__setattr__(self, "star", np.full(n, NO_STAR))
        check_columns(self, _COLUMNS, integers=_CODES, where=self.source, positive=("sigma",))

    def __len__(self) -> int:
        return len(self.x)

    @property
    def n_stars(self) -> int:
        """Largest star code plus one."""
        return int(self.star.max()) + 1

    def select(self, which: NDArray[Any]) -> Detections:
        """Detections by mask or indices; the exposures stay."""
        columns = columns_of(self, _COLUMNS)
        return replace(self, **{name: values[which] for name, values in columns.items()})


def detections_of(
    lists: Sequence[StarList],
    *,
    epoch: Sequence[float] | None = None,
    sigma: float | None = None,
) -> Detections:
    """Detections of star lists, one for each exposure, with epochs (years) and one error (pixels).

    Refused where only some of the lists have magnitudes.
    """
    with_mag = [one.mag is not None for one in lists]
    if any(with_mag) and not all(with_mag):
        bare = lists[with_mag.index(False)]
        raise InputError("has no magnitudes, and others have", where=bare.source)
    n = [len(one) for one in lists]
    return Detections(
        np.concatenate([one.x for one in lists]),
        np.concatenate([one.y for one in lists]),
        np.repeat(np.arange(len(lists)), n),
        tuple(one.exposure for one in lists),
        np.concatenate([one.chip for one in lists]),
        None if epoch is None else np.asarray(epoch, float),
        None if sigma is None else np.full(sum(n), sigma),
        np.concatenate([one.mag for one in lists if one.mag is not None])
        if all(with_mag)
        else None,
        source=lists[0].source if len(lists) == 1 else f"{len(lists)} star lists",
    )
