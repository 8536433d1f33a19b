"""Chips of a detector, and the layout of the parameter vector of a distortion model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from numbers import Integral
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss

from bayesdist.errors import InputError
from bayesdist.model.basis import PolynomialBasis
from bayesdist.model.frames import CHIP_DEVIATIONS, FRAME_KINDS, RIGID, frame_names
from bayesdist.model.timedep import AXES, TimeDependence
from bayesdist.utils.arrays import Float, Int
from bayesdist.utils.quantities import UNITS, values_in
from bayesdist.utils.text import refuse_control_characters

GAUGES = ("first", "held")


@dataclass(frozen=True)
class Chip:
    """One detector chip.

    Parameters
    ----------
    number : int
        Chip number, as in the data and in calibration files.
    name : str
        Name of the detector or chip.
    size : tuple of float or Quantity
        Numbers of columns and rows, in pixels.
    reference_pixel : tuple of float or Quantity
        Origin of the polynomial's monomial form, in FITS 1-based pixels.

    Raises
    ------
    InputError
        If the number is not an integer, the name has control characters, or the size or the
        reference pixel is not a pair of finite numbers (positive for the size).

    Examples
    --------
    >>> chip = bd.Chip(1, "W2", (1016, 1016), (508.5, 508.5))
    >>> chip.size
    (1016, 1016)
    """

    number: int
    name: str
    size: tuple[float, float]
    reference_pixel: tuple[float, float]

    def __post_init__(self) -> None:
        if not isinstance(self.number, Integral):
            raise InputError(
                f"number is {self.number!r}", where=f"chip {self.name!r}", do="give a whole number"
            )
        refuse_control_characters([str(self.name)], f"chip {self.number}")
        for name in ("size", "reference_pixel"):
            pair = getattr(self, name)
            is_pair = isinstance(pair, Sequence) and not isinstance(pair, str)
            if hasattr(pair, "unit") or (is_pair and any(hasattr(side, "unit") for side in pair)):
                pixels = values_in(pair, "pix", name, where=f"chip {self.number}")
                object.__setattr__(self, name, tuple(pixels.tolist()))
        check_pixels(self.size, "size", self.number, positive=True)
        check_pixels(self.reference_pixel, "reference_pixel", self.number)

    def quadrature(self, nodes: int) -> tuple[Float, Float, Float]:
        """Nodes and weights for Gauss-Legendre quadrature over the area of the chip.

        Parameters
        ----------
        nodes : int
            Number of nodes per axis.  The quadrature is exact for polynomials up to degree
            2 nodes - 1 in x and in y.

        Returns
        -------
        x, y : ndarray, shape (nodes^2,)
            FITS 1-based pixels.
        weight : ndarray, shape (nodes^2,)
            Weights in square pixels; their sum is the area of the chip.
        """
        node, weight = leggauss(nodes)
        nx, ny = self.size
        x, y = np.meshgrid((nx + 1 + nx * node) / 2, (ny + 1 + ny * node) / 2)
        return x.ravel(), y.ravel(), nx * ny / 4 * np.outer(weight, weight).ravel()


def check_pixels(pair: Any, name: str, chip: Any, *, positive: bool = False) -> None:
    """Raise InputError unless `pair` has two finite numbers, and positive ones if required."""
    try:
        pixels = np.asarray(pair, float)
    except (TypeError, ValueError):
        pixels = np.zeros(0)
    if pixels.shape != (2,) or not np.isfinite(pixels).all() or (positive and pixels.min() <= 0):
        raise InputError(
            f"{name} is {pair!r}",
            where=f"chip {chip}",
            do=f"give two {'positive ' if positive else ''}numbers of pixels, along x and y",
        )


@dataclass(frozen=True)
class Parameter:
    """Description of one entry of theta."""

    name: str
    unit: str
    kind: str  # 'polynomial', 'tdd' (time-dependent distortion) or 'frame'
    chip: int | None = None  # chip number; for frames only if the parameter is a chip deviation
    axis: str | None = None  # 'u' or 'v'
    i: int | None = None  # degree in x: Legendre for 'polynomial', monomial for 'tdd'
    j: int | None = None  # degree in y
    exposure: str | None = None


@dataclass(frozen=True)
class ParameterLayout:
    """Fields of a `DistortionModel` (documented there), and the layout of its parameters.

    Chip codes and exposure codes are indices into `chips` and `exposures`.
    """

    order: int
    chips: tuple[Chip, ...]
    unit: str = "pix"
    time: TimeDependence | None = None
    frames: str = "none"
    exposures: tuple[str, ...] = ("1",)
    origin: tuple[float, float] = (0.0, 0.0)
    gauge: str = "first"
    held: tuple[float, float, float] = (0.0, 0.0, 0.0)
    chip_deviations: bool = False
    _bases: tuple[PolynomialBasis, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.unit not in UNITS:
            raise InputError(
                f"unknown unit {self.unit!r}",
                where="model",
                do=f"choose one of {', '.join(UNITS)}",
            )
        if self.frames not in FRAME_KINDS:
            raise InputError(
                f"unknown kind of frame {self.frames!r}",
                where="model.frames",
                do=f"choose one of {', '.join(FRAME_KINDS)}",
            )
        self._check_gauge()
        if not isinstance(self.chips, Sequence) or not all(
            isinstance(chip, Chip) for chip in self.chips
        ):
            raise InputError(
                f"chips is {self.chips!r}", where="model", do="give a tuple of bayesdist.Chip"
            )
        if not self.chips:
            raise InputError("no chip is given", where="chip", do="describe at least one chip")
        for label, labels in (
            ("chip number", [c.number for c in self.chips]),
            ("chip name", [c.name for c in self.chips]),
            ("exposure", self.exposures),
        ):
            name, count = Counter(labels).most_common(1)[0]
            if count > 1:
                raise InputError(
                    f"{label} {name!r} occurs twice", where="model", do="list each one once"
                )
        for axis, i, j in self.time.terms if self.time else ():
            if i + j > self.order:
                raise InputError(
                    f"term {axis}_{i}_{j} exceeds the polynomial order {self.order}",
                    where="model.tdd.terms",
                    do="raise model.order or drop the term",
                )
        bases = tuple(PolynomialBasis(self.order, c.size, c.reference_pixel) for c in self.chips)
        object.__setattr__(self, "_bases", bases)

    def _check_gauge(self) -> None:
        if self.gauge not in GAUGES:
            raise InputError(
                f"unknown gauge {self.gauge!r}",
                where="model.gauge",
                do=f"choose {' or '.join(GAUGES)}",
            )
        if self.gauge == "first" and any(self.held):
            raise InputError(
                f"the first exposure is held at {self.held}, but gauge 'first' requires the "
                "identity",
                where="model.held",
                do="choose gauge 'held' or remove the values",
            )
        if self.gauge == "held" and self.frames == "none":
            raise InputError(
                "gauge 'held' fixes the frame of the first exposure, but there are no frames",
                where="model.gauge",
                do="choose a kind of frame or gauge 'first'",
            )
        if self.chip_deviations and self.gauge != "held":
            raise InputError(
                "chip deviations need polynomials that are the mean of all exposures",
                where="model.chip_deviations",
                do="choose gauge 'held'",
            )
        if self.frames == "shift" and self.held[2]:
            raise InputError(
                "a frame of kind 'shift' has no rotation that could be held",
                where="model.held",
                do="choose another kind of frame",
            )

    @property
    def bases(self) -> tuple[PolynomialBasis, ...]:
        """Polynomial basis of each chip."""
        return self._bases

    @property
    def n_terms(self) -> int:
        """Number of polynomial terms per chip and axis."""
        return self.bases[0].n_terms

    @property
    def summary(self) -> str:
        """Order, chips, frames and number of parameters in a few words."""
        names = ", ".join(chip.name or str(chip.number) for chip in self.chips[:4])
        chips = f"{len(self.chips)} chip{'s' if len(self.chips) > 1 else ''}"
        ellipsis = ", ..." if len(self.chips) > 4 else ""
        frames = f", frames '{self.frames}'" if self.n_frame else ""
        drift = f", {len(self.time.terms)} terms of time" if self.time is not None else ""
        return (
            f"order {self.order}, {chips} ({names}{ellipsis}){frames}{drift}, "
            f"{self.n_params} parameters"
        )

    @property
    def n_frame(self) -> int:
        """Number of parameters per exposure: its frame and the chip deviations."""
        return len(frame_names(self.frames)) + len(self._own_names)

    @cached_property
    def _own_names(self) -> tuple[str, ...]:
        """Names of the chip deviations."""
        if not self.chip_deviations:
            return ()
        return tuple(f"{chip.name}.{name}" for chip in self.chips[1:] for name in CHIP_DEVIATIONS)

    @property
    def n_tdd(self) -> int:
        """Number of time-dependent parameters per chip."""
        return len(self.time.terms) * self.time.n_values if self.time else 0

    @property
    def n_polynomial(self) -> int:
        """Number of polynomial coefficients of all chips."""
        return 2 * self.n_terms * len(self.chips)

    @property
    def n_distortion(self) -> int:
        """Number of parameters of the polynomials and their drift, without the frames."""
        return self.n_polynomial + self.n_tdd * len(self.chips)

    @property
    def n_global(self) -> int:
        """Number of parameters outside of the local blocks."""
        return self.n_distortion + len(self.free_frame_names(0))

    def free_frame_names(self, exposure: int) -> tuple[str, ...]:
        """Names of the fitted parameters of one exposure: its frame, then its chip deviations.

        `exposure` is an exposure code (index into `exposures`).
        """
        if exposure > 0:
            return (*frame_names(self.frames), *self._own_names)
        if self.gauge == "first" or exposure < 0:
            return ()
        free = (name for name in frame_names(self.frames) if name not in RIGID)
        return (*free, *self._own_names)

    @property
    def chip_of_global(self) -> Int | None:
        """Chip codes (n_global,) of the global parameters.

        None if there is one chip, or if some of the parameters are those of a frame.
        """
        if len(self.chips) == 1 or self.n_global > self.n_distortion:
            return None
        codes = np.arange(len(self.chips), dtype=np.int64)
        return np.concatenate([np.repeat(codes, 2 * self.n_terms), np.repeat(codes, self.n_tdd)])

    @property
    def n_params(self) -> int:
        """Length of theta."""
        return self.n_global + self.n_frame * (len(self.exposures) - 1 if self.n_frame else 0)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Description of every entry of theta, in order."""
        out = []
        several = len(self.chips) > 1
        prefix = {c.number: f"{c.name}." if several else "" for c in self.chips}
        for chip in self.chips:
            for axis in AXES:
                for i, j in self.bases[0].terms:
                    name = f"{prefix[chip.number]}{axis}_{i}_{j}"
                    out.append(Parameter(name, self.unit, "polynomial", chip.number, axis, i, j))
        time = self.time
        drifts = () if time is None else tuple(product(time.terms, time.value_names()))
        for chip in self.chips:
            for (axis, i, j), value in drifts:
                name = f"{prefix[chip.number]}tdd.{axis}_{i}_{j}.{value}"
                unit = f"{self.unit}/yr" if value.startswith("rate") else self.unit
                out.append(Parameter(name, unit, "tdd", chip.number, axis, i, j))
        owner = dict(
            zip(
                self._own_names,
                (c.number for c in self.chips[1:] for _ in CHIP_DEVIATIONS),
                strict=bool(self._own_names),
            )
        )
        for code, exposure in enumerate(self.exposures):
            for p in self.free_frame_names(code):
                unit = self.unit if "shift" in p.split(".")[-1] else ""
                out.append(
                    Parameter(f"{exposure}.{p}", unit, "frame", owner.get(p), exposure=exposure)
                )
        return tuple(out)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of theta."""
        return tuple(p.name for p in self.parameters)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the entries of theta ('' if dimensionless or in radians)."""
        return tuple(p.unit for p in self.parameters)

    def chip_code(self, number: int) -> int:
        """Code (index) of a chip number; raises InputError if there is no such chip."""
        for code, chip in enumerate(self.chips):
            if chip.number == number:
                return code
        raise InputError(
            f"there is no chip {number}",
            do=f"choose one of the chips {', '.join(str(c.number) for c in self.chips)}",
        )

    def basis(self, chip: int | None = None) -> PolynomialBasis:
        """Polynomial basis of a chip number (default: the first chip)."""
        return self.bases[0 if chip is None else self.chip_code(chip)]

    def coefficient_slice(self, chip: int | None, axis: int) -> slice:
        """Slice of theta with the Legendre coefficients of a chip number and axis (0 u, 1 v)."""
        code = 0 if chip is None else self.chip_code(chip)
        start = (2 * code + axis) * self.n_terms
        return slice(start, start + self.n_terms)

    def tdd_slice(self, chip: int | None = None) -> slice:
        """Slice of theta with the time-dependent parameters of a chip number (default: first chip).

        Rates are per year.  They refer to monomials in units of half the size of the chip.
        """
        return self.drift_slice(0 if chip is None else self.chip_code(chip))

    def drift_slice(self, chip_code: int) -> slice:
        """Slice of theta with the time-dependent parameters of a chip, given by its code."""
        start = self.n_polynomial + chip_code * self.n_tdd
        return slice(start, start + self.n_tdd)

    def frame_slice(self, exposure: int) -> slice:
        """Slice of theta with the parameters `free_frame_names` of an exposure code."""
        if not self.free_frame_names(exposure):
            return slice(0, 0)
        if exposure == 0:
            return slice(self.n_distortion, self.n_global)
        start = self.n_global + (exposure - 1) * self.n_frame
        return slice(start, start + self.n_frame)

    def frame_columns(self, exposure: int | Int) -> Int:
        """Indices (..., q) into theta of the frame parameters of one or more exposure codes.

        The codes must not contain the first exposure together with others.
        """
        codes = np.asarray(exposure)
        first = int(codes.flat[0])
        block = self.frame_slice(first)
        return np.arange(block.start, block.stop) + self.n_frame * (codes - first)[..., None]

    @property
    def local_blocks(self) -> tuple[slice, ...]:
        """Slices of theta with the frame parameters of each exposure except the first."""
        if not self.n_frame:
            return ()
        return tuple(self.frame_slice(e) for e in range(1, len(self.exposures)))

    def has_frame(self, exposure: int) -> bool:
        """True if the frame of an exposure code is not the identity."""
        return self.n_frame > 0 and (exposure > 0 or (exposure == 0 and self.gauge == "held"))

    def own_slice(self, chip_code: int, exposure: int) -> slice:
        """Slice of the deviations of a chip within the `frame_slice` of an exposure.

        Chip and exposure are given by their codes.  The slice is empty if the chip has no
        deviations.
        """
        if not (self.chip_deviations and chip_code > 0 and self.has_frame(exposure)):
            return slice(0, 0)
        n, q = len(self.free_frame_names(exposure)) - len(self._own_names), len(CHIP_DEVIATIONS)
        return slice(n + (chip_code - 1) * q, n + chip_code * q)

    @cached_property
    def drift_columns(self) -> tuple[tuple[Float, ...], Int]:
        """Legendre coefficients of each chip's drifting monomials, and the axes of these terms.

        There is one array (n terms, K) per chip.  The axes (n terms,) are 0 for u and 1 for v.
        """
        if self.time is None:
            return tuple(np.zeros((0, self.n_terms)) for _ in self.chips), np.zeros(0, np.int64)
        columns = []
        for basis in self.bases:
            sx, sy = basis.half_size
            unit = np.zeros((len(self.time.terms), self.n_terms))
            for row, (_, i, j) in enumerate(self.time.terms):
                unit[row, basis.terms.index((i, j))] = sx**-i * sy**-j
            columns.append(basis.from_monomials(unit))
        return tuple(columns), np.array([AXES.index(t[0]) for t in self.time.terms], np.int64)
