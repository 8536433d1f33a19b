"""Error terms beside those of the solution: given by the user, or measured in another way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from bayesdist.assess.names import require_known
from bayesdist.assess.units import UNITS, convert
from bayesdist.diagnose.tables.mean_square import MeanSquare
from bayesdist.errors import InputError

__all__ = [
    "GIVEN",
    "LOCAL",
    "MEASURED",
    "TERM_KINDS",
    "LocalTerm",
    "UserTerm",
    "said_by_user",
]

Float = NDArray[np.float64]

TERM_KINDS = ("random", "systematic")
LOCAL = "local"

MEASURED = "measured in this run"
GIVEN = "given by the user"
PUBLISHED = "published"


def said_by_user(source: str) -> str:
    """What a user says of where a number comes from, as a source of a budget's row.

    It begins with one of the three kinds of source: a publication that is named so stays one.
    """
    text = source.strip()
    if text.lower().startswith((GIVEN, PUBLISHED)):
        return text[0].lower() + text[1:]
    return f"{GIVEN}: {text}" if text else GIVEN


@dataclass(frozen=True)
class UserTerm:
    """A Gaussian error given by the user, the same at every place of the detector.

    Parameters
    ----------
    name : str
    kind : str
        'random': independent at every position; 'systematic': one offset shared by the whole field.
    sigma_u, sigma_v : float
        Standard deviation of each axis.
    unit : str
        'pix', 'arcsec', 'mas' or 'deg'.
    source : str
        Where the number comes from: 'given by the user', or a publication.
    varies : bool
        Of a systematic term: whether it may differ from place to place in a way that is not known,
        as the errors of a catalogue do.  Requirements are then judged for one offset of the whole
        field, for a smooth field, and for independent errors at every position.

    Raises
    ------
    InputError
        For an unknown kind or unit, or a sigma that is negative or not finite.
    """

    name: str
    kind: str
    sigma_u: float
    sigma_v: float
    unit: str = "pix"
    source: str = GIVEN
    varies: bool = False

    def __post_init__(self) -> None:
        where = f"budget term {self.name!r}"
        require_known(self.kind, TERM_KINDS, "kind", where=where)
        require_known(self.unit, UNITS, "unit", where=where)
        for axis, sigma in (("u", self.sigma_u), ("v", self.sigma_v)):
            if not (math.isfinite(sigma) and sigma >= 0):
                raise InputError(
                    f"sigma_{axis} is {sigma}", where=where, do="give a number that is not negative"
                )

    def sigma(self, unit: str, pixel_scale: float | None = None) -> tuple[float, float]:
        """(sigma_u, sigma_v) in a unit; `pixel_scale` in mas as in `units.convert`."""
        where = f"budget term {self.name!r}"
        su, sv = (
            convert(s, self.unit, unit, pixel_scale, where=where)
            for s in (self.sigma_u, self.sigma_v)
        )
        return float(su), float(sv)


@dataclass(frozen=True, eq=False)
class LocalTerm:
    """A Gaussian error that all stars at a place share, and that differs from place to place.

    Such is the error of a look-up table: its nodes are closer than the points of the grid on which
    budgets and requirements are evaluated, and there the errors count as independent.

    Parameters
    ----------
    name : str
    sigma : dict of int to ndarray, shape (ny, nx, 2)
        By chip number: standard deviations of u and v on that grid, in the unit of the solution.
    source : str
    squares : mapping of int to MeanSquare
        By chip number: how well their mean squares are known themselves, where that is known.
    drawn : mapping of int to ndarray, shape (n, ny, nx, 2)
        By chip number: draws of the error on that grid, where neighbouring positions have some of
        it in common; without them positions err independently of each other.
    """

    name: str
    sigma: dict[int, Float]
    source: str = MEASURED
    squares: Mapping[int, MeanSquare] = field(default_factory=dict)
    drawn: Mapping[int, NDArray[np.floating]] = field(default_factory=dict)

    def relative_error(self, chip: int) -> float | None:
        """How well the sizes on a chip are known, relative to them; None where it is not known."""
        if chip in self.drawn:
            by_draw = np.sqrt(np.mean(np.square(self.drawn[chip]), axis=(1, 2, 3)))
            return float(by_draw.std() / max(float(by_draw.mean()), 1e-300))
        return self.squares[chip].relative_error if chip in self.squares else None

    def on(self, chip: int, shape: tuple[int, int]) -> tuple[Float, Float]:
        """Standard deviations (u, v), each (ny, nx), on a chip.

        Raises
        ------
        InputError
            For another grid, or a chip without values.
        """
        found = self.sigma.get(chip)
        if found is None or found.shape != (*shape, 2):
            raise InputError(
                f"is not known on a grid of {shape[1]} x {shape[0]} points of chip {chip}",
                where=f"budget term {self.name!r}",
                do="ask for the grid on which it was computed",
            )
        return found[..., 0], found[..., 1]

    def at(self, chip: int, size: tuple[float, float], x: Float, y: Float) -> Float:
        """Standard deviations (N, 2) at any pixels of a chip, interpolated on the grid.

        Parameters
        ----------
        chip : int
        size : tuple of float
            Columns and rows of the chip.
        x, y : ndarray, shape (N,)
            FITS 1-based pixels; beyond the grid the value of its edge holds.

        Raises
        ------
        InputError
            For a chip without values.
        """
        ny, nx, _ = self.sigma[chip].shape if chip in self.sigma else (0, 0, 0)
        self.on(chip, (ny, nx))  # refuses an unknown chip
        axes = [np.linspace(1.0, n, k) for n, k in zip(size, (nx, ny), strict=True)]
        points = [np.clip(a, axis[0], axis[-1]) for a, axis in zip((x, y), axes, strict=True)]
        return np.asarray(
            RegularGridInterpolator(axes[::-1], self.sigma[chip])(np.column_stack(points[::-1]))
        )
