"""What a kind of truth is, and the matched stars that are made of it."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .fields import MIDDLE, SIDE, Field

SIGMA = 0.02  # px: quoted error of a star on each axis
FALSE = 0.04  # fraction of false matches
FALSE_SIGMA = 0.6  # px: their scatter on each axis
CATALOGUE = 0.0005  # px: offset of the reference catalogue, as the user gives it

Map = Callable[[np.ndarray, np.ndarray, float | None], np.ndarray]  # x, y, epoch -> (N, 2)


@dataclass(frozen=True)
class Frame:
    """Where an exposure pointed: (u, v) = R (map) + shift.

    Parameters
    ----------
    shift : tuple of float
        Pixels.
    rotation : float
        Radians, from u to v.
    """

    shift: tuple[float, float]
    rotation: float

    @property
    def matrix(self) -> np.ndarray:
        """R (2, 2)."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        return np.array([[c, -s], [s, c]])

    def seen(self, w: np.ndarray) -> np.ndarray:
        """Positions (N, 2) in the exposure's frame."""
        return w @ self.matrix.T + self.shift

    def undone(self, uv: np.ndarray) -> np.ndarray:
        """Positions (N, 2) along the axes of the map."""
        return (uv - np.array(self.shift)) @ self.matrix


@dataclass(frozen=True)
class Piece:
    """A chip: its number, columns, rows, and where its rows begin in the mosaic."""

    number: int
    columns: int
    rows: int
    below: float

    def mosaic(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels as those of one detector of `SIDE` pixels."""
        return np.asarray(x, float), np.asarray(y, float) + self.below


ONE = (Piece(1, SIDE, SIDE, 0.0),)
TWO = (Piece(2, SIDE, SIDE // 2, 0.0), Piece(1, SIDE, SIDE // 2, SIDE / 2))


@dataclass(frozen=True, eq=False)
class Truth:
    """Matched stars, and what is true of them.

    Parameters
    ----------
    stars : dict of str to ndarray
        Columns of the file: x, y, u, v, sigma_u, sigma_v, and whatever else the kind has.
    true_map : callable
        x, y (N,) and epoch to the true (u, v) (N, 2), without catalogue errors and frames.
    config : dict
        Keys that a user writes, by block; `data`, `detector`, `assess` and `sampler` may be left
        out.
    epoch : float or None
        At which positions are assessed.
    frames : dict of str to Frame
        Of the exposures, by name; empty where the model has none.
    dates : dict of str to float
        Of the exposures of a self-calibration, where it is given any.
    chips : tuple of Piece
        Of the detector; true_map takes pixels of the mosaic, the stars have those of their chip.
    """

    stars: dict[str, np.ndarray]
    true_map: Map
    config: dict[str, Any]
    epoch: float | None = None
    frames: Mapping[str, Frame] = field(default_factory=dict)
    dates: Mapping[str, float] = field(default_factory=dict)
    chips: tuple[Piece, ...] = ONE

    @property
    def self_calibrated(self) -> bool:
        """Whether there is no catalogue to be matched with."""
        return "selfcal" in self.config


@dataclass(frozen=True)
class Kind:
    """A kind of truth.

    Parameters
    ----------
    name : str
    make : callable
        A random generator and a number of stars to a Truth.
    n : int
        Stars by default.
    words : tuple of str
        Any of them, in lower case, in a verdict's reason or a warning names the right cause.
    inside : bool
        Whether the truth is in the family that is fitted.
    kindest : bool
        Whether the actual error is what the best shift and rotation of the predicted positions
        leave: no reading of a position in any frame makes it smaller.
    misleading : tuple of str
        Any of them, in lower case, in a warning is advice that makes nothing better.
    """

    name: str
    make: Callable[[np.random.Generator, int], Truth]
    n: int
    words: tuple[str, ...] = ()
    inside: bool = False
    kindest: bool = False
    misleading: tuple[str, ...] = ()

    def truth(self, seed: int, n: int | None = None) -> Truth:
        """The truth of a seed, with another number of stars if one is given."""
        rng = np.random.default_rng([zlib.crc32(self.name.encode()), seed])
        return self.make(rng, self.n if n is None else n)


KINDS: dict[str, Kind] = {}


def kind(
    name: str,
    *words: str,
    n: int = 1500,
    inside: bool = False,
    kindest: bool = False,
    misleading: tuple[str, ...] = (),
    **options: Any,
) -> Callable[[Callable[..., Truth]], Callable[..., Truth]]:
    """A decorator that enters a function among the kinds, with options that it is called with.

    Of several on one function the lowest enters first.
    """

    def entered(make: Callable[..., Truth]) -> Callable[..., Truth]:
        assert name not in KINDS, name
        KINDS[name] = Kind(
            name, lambda rng, n: make(rng, n, **options), n, words, inside, kindest, misleading
        )
        return make

    return entered


def mapped(*parts: Field) -> Map:
    """The map of pixels from the middle, displaced by fields, the same at all epochs."""

    def true_map(x: np.ndarray, y: np.ndarray, epoch: float | None = None) -> np.ndarray:
        at = np.stack([np.asarray(x, float) - MIDDLE, np.asarray(y, float) - MIDDLE], axis=-1)
        return at + np.sum([part(x, y) for part in parts], axis=0)

    return true_map


def pixels(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y (n,) of stars scattered evenly over the detector."""
    x, y = rng.uniform(0.5, SIDE + 0.5, (2, n))
    return x, y


def normal_noise(rng: np.random.Generator, n: int, sigma: Any = SIGMA) -> np.ndarray:
    """Errors (n, 2) of positions."""
    return sigma * rng.standard_normal((n, 2))


def order_config(order: int, **model: Any) -> dict[str, Any]:
    """Configuration of a polynomial order and of the catalogue's usual budget row."""
    return {"model": {"order": order, **model}, "budget": [catalogue_row(CATALOGUE)]}


def catalogue_row(sigma: float, name: str = "reference catalogue") -> dict[str, Any]:
    """The budget row of a reference catalogue, or of something else that it may have errors in."""
    row = {"name": name, "kind": "systematic", "sigma_u": sigma, "sigma_v": sigma, "unit": "pix"}
    return row if sigma else row | {"source": "exact in the simulation"}


def observed(
    rng: np.random.Generator,
    x: np.ndarray,
    y: np.ndarray,
    true_uv: np.ndarray,
    *,
    noise: np.ndarray | None = None,
    sigma: Any = SIGMA,
    false: float = FALSE,
    offset: float = CATALOGUE,
    **columns: np.ndarray,
) -> dict[str, np.ndarray]:
    """Columns of matched stars.

    Parameters
    ----------
    rng : numpy.random.Generator
    x, y : ndarray, shape (N,)
    true_uv : ndarray, shape (N, 2)
        Positions without noise.
    noise : ndarray, shape (N, 2), optional
        Errors; by default normal ones of the quoted size.
    sigma : float or array_like, broadcast to (N, 2)
        Quoted errors.
    false : float
        Fraction of stars whose reference position is another star's.
    offset : float
        Of the whole catalogue: standard deviation on each axis.
    **columns : ndarray, shape (N,)
        Further columns.
    """
    n = x.size
    quoted = np.broadcast_to(np.asarray(sigma, float), (n, 2))
    uv = true_uv + (quoted * rng.standard_normal((n, 2)) if noise is None else noise)
    uv = uv + offset * rng.standard_normal(2)
    wrong = rng.uniform(size=n) < false
    uv = uv + wrong[:, None] * FALSE_SIGMA * rng.standard_normal((n, 2))
    out = {"x": x, "y": y, "u": uv[:, 0], "v": uv[:, 1]}
    return out | {"sigma_u": quoted[:, 0].copy(), "sigma_v": quoted[:, 1].copy(), **columns}
