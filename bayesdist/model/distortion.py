"""The distortion model: structure without values, and the only parameter layout.

For a star on chip c in exposure e at epoch t, at FITS pixel (x, y):

    w = sum_k C_ck(t) phi_k(x, y)          (u, v) = T_e(w) = o + d_e + M_e (w - o)

With `chip_deviations` every chip but the first, whose reference pixel lies at c, deviates itself:

    w' = w + d_ec + L_ec (w - c)     (u, v) = o + d_e + M_e (w' - o) - (M_e - R_e) (c - o)

T_e of a polynomial is a polynomial, so every (chip, exposure, epoch) has *effective coefficients*:
the maps theta -> effective coefficients (`effective`) and its derivative (`effective_jacobian`)
are all that fits, samplers and predictions need to know of the model.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.errors import InputError
from bayesdist.model.basis import PolynomialBasis, as_pair
from bayesdist.model.frames import (
    CHIP_DEVIATIONS,
    FRAME_KINDS,
    RIGID,
    chip_matrix,
    frame_matrix,
    frame_names,
    frame_tangent,
    rigid_part,
)
from bayesdist.model.grouping import Groups, group_by
from bayesdist.model.timedep import AXES, TimeDependence

__all__ = ["GAUGES", "Chip", "DistortionModel", "Parameter"]

Float = NDArray[np.float64]
Int = NDArray[np.int64]

GAUGES = ("first", "held")
NO_EXPOSURE = -1  # code of the polynomial itself where it is no exposure's


@dataclass(frozen=True)
class Chip:
    """One detector chip.

    Parameters
    ----------
    number : int
        As in the data and in the IDCTAB column DETCHIP.
    name : str
    size : tuple of float
        Columns, rows.
    reference_pixel : tuple of float
        Zero point of the polynomial, FITS 1-based pixels.
    """

    number: int
    name: str
    size: tuple[float, float]
    reference_pixel: tuple[float, float]


@dataclass(frozen=True)
class Parameter:
    """What one entry of theta is.

    Parameters
    ----------
    name, unit : str
    kind : str
        'polynomial', 'tdd' or 'frame'.
    chip : int or None
        Chip number; of a frame's parameter that is a chip's own deviation.
    axis : str or None
        'u' or 'v'.
    i, j : int or None
        Degree in x and y: of the Legendre product ('polynomial') or of the monomial ('tdd').
    exposure : str or None
    """

    name: str
    unit: str
    kind: str
    chip: int | None = None
    axis: str | None = None
    i: int | None = None
    j: int | None = None
    exposure: str | None = None


@dataclass(frozen=True)
class DistortionModel:
    """Structure of a distortion solution: what is fitted, not its values.

    theta holds first the *global* parameters (Legendre coefficients of each chip and axis, then
    the time-dependent terms of each chip), then one *local* block for each exposure but the first.

    Polynomials and frames are determined only together: what all frames have in common is a change
    of the polynomials.  The *gauge* says how the two are told apart.

    - "first": the frame of the first exposure is the identity.  The polynomials are those of that
      exposure, with its shift, roll angle, scale and shear.
    - "held": the first exposure's shift and rotation are held at given values, exactly: they are no
      parameters.  Its scale and shear are parameters like those of all others, and stand at the end
      of the global ones.  Then scale and shear are *deviations* from polynomials that belong to no
      exposure, and need a prior that says that they scatter about zero; without it they are
      degenerate with the linear terms, and `fit_linear` says so.  Held at the first exposure's roll
      and zero point, the polynomials lie along the detector's axes, and so do the shears.

    Parameters
    ----------
    order : int
        Total polynomial order, 1 to 9.
    chips : tuple of Chip
    unit : str
        Unit of u and v.
    time : TimeDependence, optional
        Its terms are monomials of (x - xref) / (nx / 2), (y - yref) / (ny / 2): a rate is the drift
        in the unit of u, v per year at half the detector's size from the reference pixel.
    frames : str
        Transformation of each exposure, one of `FRAME_KINDS`.
    exposures : tuple of str
        Names; the first one defines the gauge.
    origin : tuple of float
        Point (u, v) about which frames rotate and scale.
    gauge : str
        'first' or 'held'.
    held : tuple of float
        With 'held': shift_u, shift_v (unit of u, v) and rotation (radians) of the first exposure.
    chip_deviations : bool
        Whether every chip but the first one has linear deviations of its own in each exposure.
        Needs gauge 'held': they have to scatter about zero as the others do.  Scale and shear of a
        frame then act on each chip about its own reference pixel, so that the distance between the
        chips, a lever of thousands of pixels, does not pass for a measurement of their scale.

    Raises
    ------
    InputError
        For an unknown kind of frame, no chip, a time-dependent term above the order, or a gauge
        that does not go with the frames.
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
        if self.frames not in FRAME_KINDS:
            raise InputError(
                f"unknown kind of frame {self.frames!r}",
                where="model.frames",
                do=f"choose one of {', '.join(FRAME_KINDS)}",
            )
        self._check_gauge()
        if not self.chips:
            raise InputError("no chip is given", where="chip", do="describe at least one chip")
        for what, given in (
            ("chip number", [c.number for c in self.chips]),
            ("chip name", [c.name for c in self.chips]),
            ("exposure", self.exposures),
        ):
            name, count = Counter(given).most_common(1)[0]
            if count > 1:
                raise InputError(
                    f"{what} {name!r} stands twice", where="model", do="name each one once"
                )
        for axis, i, j in self.time.terms if self.time else ():
            if i + j > self.order:
                raise InputError(
                    f"term {axis}_{i}_{j} is above the polynomial order {self.order}",
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
                f"the first exposure is held at {self.held} and is the identity",
                where="model.held",
                do="choose gauge 'held' or leave the values out",
            )
        if self.gauge == "held" and self.frames == "none":
            raise InputError(
                "gauge 'held' holds the frame of the first exposure, and there are no frames",
                where="model.gauge",
                do="choose a kind of frame or gauge 'first'",
            )
        if self.chip_deviations and self.gauge != "held":
            raise InputError(
                "chips that deviate by themselves have the polynomials for their mean",
                where="model.chip_deviations",
                do="choose gauge 'held'",
            )
        if self.frames == "shift" and self.held[2]:
            raise InputError(
                "a frame 'shift' has no rotation to be held",
                where="model.held",
                do="choose another kind of frame",
            )

    # -- layout ------------------------------------------------------------------------------------

    @property
    def n_terms(self) -> int:
        """Polynomial terms of one chip and axis."""
        return self._bases[0].n_terms

    @property
    def summary(self) -> str:
        """What it is, in a few words."""
        names = ", ".join(chip.name or str(chip.number) for chip in self.chips[:4])
        chips = f"{len(self.chips)} chip{'s' if len(self.chips) > 1 else ''}"
        more = ", ..." if len(self.chips) > 4 else ""
        frames = f", frames '{self.frames}'" if self.n_frame else ""
        drift = f", {len(self.time.terms)} terms of time" if self.time is not None else ""
        return (
            f"order {self.order}, {chips} ({names}{more}){frames}{drift}, "
            f"{self.n_params} parameters"
        )

    @property
    def n_frame(self) -> int:
        """Parameters of one exposure: of its frame, and of the chips' own deviations."""
        return len(frame_names(self.frames)) + len(self._own_names)

    @cached_property
    def _own_names(self) -> tuple[str, ...]:
        """Names of the deviations of single chips."""
        if not self.chip_deviations:
            return ()
        return tuple(f"{chip.name}.{name}" for chip in self.chips[1:] for name in CHIP_DEVIATIONS)

    @property
    def n_tdd(self) -> int:
        """Time-dependent parameters of one chip."""
        return len(self.time.terms) * self.time.n_values if self.time else 0

    @property
    def n_polynomial(self) -> int:
        """Polynomial coefficients of all chips."""
        return 2 * self.n_terms * len(self.chips)

    @property
    def n_distortion(self) -> int:
        """Parameters of the polynomials and of their drift: all but the frames."""
        return self.n_polynomial + self.n_tdd * len(self.chips)

    @property
    def n_global(self) -> int:
        """Parameters that are in no local block."""
        return self.n_distortion + len(self.free_frame_names(0))

    def free_frame_names(self, exposure: int) -> tuple[str, ...]:
        """Names of the fitted parameters of an exposure (by code): frame, then single chips."""
        if exposure > 0:
            return (*frame_names(self.frames), *self._own_names)
        if self.gauge == "first" or exposure < 0:
            return ()
        free = (name for name in frame_names(self.frames) if name not in RIGID)
        return (*free, *self._own_names)

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
                for i, j in self._bases[0].terms:
                    name = f"{prefix[chip.number]}{axis}_{i}_{j}"
                    out.append(Parameter(name, self.unit, "polynomial", chip.number, axis, i, j))
        for chip in self.chips:
            for axis, i, j in self.time.terms if self.time else ():
                for value in self.time.value_names():  # type: ignore[union-attr]
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
        """Units of the entries of theta ('' where there is none)."""
        return tuple(p.unit for p in self.parameters)

    def chip_code(self, number: int) -> int:
        """Index of a chip by its number.

        Raises
        ------
        InputError
            When no chip has that number.
        """
        for code, chip in enumerate(self.chips):
            if chip.number == number:
                return code
        raise InputError(
            f"there is no chip {number}",
            do=f"known chips are {', '.join(str(c.number) for c in self.chips)}",
        )

    def basis(self, chip: int | None = None) -> PolynomialBasis:
        """Polynomial basis of a chip (by number; the first one by default)."""
        return self._bases[0 if chip is None else self.chip_code(chip)]

    def coefficient_slice(self, chip: int | None, axis: int) -> slice:
        """Where theta holds the Legendre coefficients of a chip (by number) and axis (0 u, 1 v)."""
        return self._coefficients(0 if chip is None else self.chip_code(chip), axis)

    def _coefficients(self, chip_code: int, axis: int) -> slice:
        start = (2 * chip_code + axis) * self.n_terms
        return slice(start, start + self.n_terms)

    def tdd_slice(self, chip: int | None = None) -> slice:
        """Where theta holds the time-dependent parameters of a chip (by number)."""
        return self._tdd(0 if chip is None else self.chip_code(chip))

    def _tdd(self, chip_code: int) -> slice:
        start = self.n_polynomial + chip_code * self.n_tdd
        return slice(start, start + self.n_tdd)

    def frame_slice(self, exposure: int) -> slice:
        """Where theta holds the `free_frame_names` of an exposure (by code)."""
        if not self.free_frame_names(exposure):
            return slice(0, 0)
        if exposure == 0:
            return slice(self.n_distortion, self.n_global)
        start = self.n_global + (exposure - 1) * self.n_frame
        return slice(start, start + self.n_frame)

    @property
    def local_blocks(self) -> tuple[slice, ...]:
        """The local blocks of theta, one for each exposure but the first."""
        if not self.n_frame:
            return ()
        return tuple(self.frame_slice(e) for e in range(1, len(self.exposures)))

    # -- from parameters to effective coefficients ------------------------------------------------

    def groups(
        self,
        n: int,
        *,
        epoch: ArrayLike | None = None,
        exposure: ArrayLike | None = None,
        chip: ArrayLike | None = None,
    ) -> Groups:
        """Groups of stars with equal effective coefficients.

        Parameters
        ----------
        n : int
            Number of stars.
        epoch : array_like, optional
            Decimal years, one or N; needed by a model with time dependence.
        exposure : array_like, optional
            Codes into `exposures` or names, one or N; None is the polynomial itself, without a
            frame.
        chip : array_like, optional
            Chip numbers, one or N; None is the first chip.

        Returns
        -------
        Groups

        Raises
        ------
        InputError
            For an unknown chip or exposure, or a missing epoch.
        """
        codes = np.zeros(n, np.int64)
        if chip is not None:
            numbers = np.broadcast_to(np.asarray(chip), (n,))
            for number in np.unique(numbers):
                codes[numbers == number] = self.chip_code(int(number))
        frame = np.full(n, 0 if self.gauge == "first" else NO_EXPOSURE)
        if exposure is not None and self.n_frame:
            frame = np.broadcast_to(self._exposure_codes(np.asarray(exposure)), (n,))
        time = np.zeros(n)
        if self.time is not None:
            if epoch is None:
                raise InputError("the model depends on time and no epoch is given", do="give one")
            time = np.broadcast_to(np.asarray(epoch, float), (n,))
        return group_by(codes, np.asarray(frame, np.int64), time)

    def _exposure_codes(self, exposure: NDArray[np.generic]) -> Int:
        if np.issubdtype(exposure.dtype, np.integer):
            codes = exposure.astype(np.int64)
            if codes.size and not (0 <= codes.min() and codes.max() < len(self.exposures)):
                raise InputError(f"exposure codes must lie in 0..{len(self.exposures) - 1}")
            return codes
        known = {name: code for code, name in enumerate(self.exposures)}
        flat = [str(name) for name in np.atleast_1d(exposure).ravel()]
        unknown = [name for name in flat if name not in known]
        if unknown:
            raise InputError(f"there is no exposure {unknown[0]!r}")
        return np.array([known[name] for name in flat], np.int64).reshape(np.shape(exposure))

    @cached_property
    def _tdd_columns(self) -> tuple[tuple[Float, ...], Int]:
        """For each chip, the Legendre coefficients (n terms, K) of each drifting monomial; axes."""
        if self.time is None:
            return tuple(np.zeros((0, self.n_terms)) for _ in self.chips), np.zeros(0, np.int64)
        columns = []
        for basis in self._bases:
            sx, sy = basis.half_size
            unit = np.zeros((len(self.time.terms), self.n_terms))
            for row, (_, i, j) in enumerate(self.time.terms):
                unit[row, basis.terms.index((i, j))] = sx**-i * sy**-j
            columns.append(basis.from_monomials(unit))
        return tuple(columns), np.array([AXES.index(t[0]) for t in self.time.terms], np.int64)

    def drift_terms(self, chip: int | None = None) -> Float:
        """Legendre coefficients (n terms, K) of the monomials of a chip (by number) that drift."""
        return self._tdd_columns[0][0 if chip is None else self.chip_code(chip)]

    def _drift(self, chip: Int, epoch: Float) -> list[Float]:
        """Derivative of a group's polynomial by the chip's tdd parameters, (2, K, n_tdd) each."""
        assert self.time is not None
        columns, axes = self._tdd_columns
        weights = self.time.weights(epoch)
        out = []
        for c, w in zip(chip, weights, strict=True):
            d = np.zeros((2, self.n_terms, self.n_tdd))
            for t, axis in enumerate(axes):
                cols = slice(t * self.time.n_values, (t + 1) * self.time.n_values)
                d[axis, :, cols] = np.outer(columns[c][t], w)
            out.append(d)
        return out

    def polynomials(self, theta: ArrayLike, chip: Int, epoch: Float) -> Float:
        """Legendre coefficients of w, before the exposure frame.

        Parameters
        ----------
        theta : array_like, shape (..., n_params)
        chip : ndarray of int, shape (G,)
            Chip codes.
        epoch : ndarray, shape (G,)

        Returns
        -------
        ndarray, shape (..., G, 2, K)
        """
        theta = np.asarray(theta, float)
        K = self.n_terms
        poly = theta[..., : self.n_polynomial].reshape(*theta.shape[:-1], len(self.chips), 2, K)
        out = poly[..., chip, :, :]
        if self.time is not None:
            for g, d in enumerate(self._drift(chip, epoch)):
                out[..., g, :, :] += np.einsum("akm,...m->...ak", d, theta[..., self._tdd(chip[g])])
        return out

    def frame(self, theta: ArrayLike, exposure: int) -> tuple[Float, Float]:
        """Linear part (..., 2, 2) and shift (..., 2) of T_e for an exposure code."""
        return frame_matrix(*self._frame(np.asarray(theta, float), exposure))

    def _has_frame(self, exposure: int) -> bool:
        return self.n_frame > 0 and (exposure > 0 or (exposure == 0 and self.gauge == "held"))

    def _frame(self, theta: Float, exposure: int) -> tuple[str, Float]:
        """Kind of an exposure's frame and all its parameters (..., q), held ones included."""
        if not self._has_frame(exposure):
            return "none", theta[..., :0]
        names = frame_names(self.frames)
        values = theta[..., self.frame_slice(exposure)]
        if exposure:
            return self.frames, values[..., : len(names)]
        free = self.free_frame_names(0)
        out = np.empty((*theta.shape[:-1], len(names)))
        for k, name in enumerate(names):
            out[..., k] = (
                self.held[RIGID.index(name)] if name in RIGID else values[..., free.index(name)]
            )
        return self.frames, out

    def _own(self, chip_code: int, exposure: int) -> slice:
        """Where an exposure's block holds the own deviations of a chip; empty where there are none.

        A slice of `frame_slice`.
        """
        if not (self.chip_deviations and chip_code > 0 and self._has_frame(exposure)):
            return slice(0, 0)
        n, q = len(self.free_frame_names(exposure)) - len(self._own_names), len(CHIP_DEVIATIONS)
        return slice(n + (chip_code - 1) * q, n + chip_code * q)

    def _about_chip(self, w: Float, chip_code: int) -> Float:
        """w (..., K) of a chip, less its value at the reference pixel."""
        out = w.copy()
        out[..., 0] -= w @ self._bases[chip_code].monomial_matrix[0]
        return out

    def effective(self, theta: ArrayLike, groups: Groups) -> Float:
        """Effective Legendre coefficients of each group: the whole model as polynomials.

        Parameters
        ----------
        theta : array_like, shape (..., n_params)
        groups : Groups

        Returns
        -------
        ndarray, shape (..., G, 2, K)
        """
        theta = np.asarray(theta, float)
        out = self.polynomials(theta, groups.chip, groups.epoch)
        if not self.n_frame:
            return out
        o = np.asarray(self.origin)
        if self.chip_deviations:
            at_centre = np.stack([basis.monomial_matrix[0] for basis in self._bases])
            centre = np.einsum("...gak,gk->...ga", out, at_centre[groups.chip])
            for g, (c, e) in enumerate(zip(groups.chip, groups.exposure, strict=True)):
                own = self._own(int(c), int(e))
                if own.stop:
                    L, d = chip_matrix(theta[..., self.frame_slice(int(e))][..., own])
                    w = out[..., g, :, :]
                    w += np.einsum("...ab,...bk->...ak", L, self._about_chip(w, int(c)))
                    w[..., 0] += d
        for e in np.unique(groups.exposure):
            if not self._has_frame(int(e)):
                continue
            M, d = self.frame(theta, int(e))
            sel = groups.exposure == e
            w = out[..., sel, :, :]
            w[..., 0] -= o
            w = np.einsum("...ab,...gbk->...gak", M, w)
            w[..., 0] += (o + d)[..., None, :]
            if self.chip_deviations:
                R, _ = rigid_part(*self._frame(theta, int(e)))
                back = np.einsum("...ab,...gb->...ga", M - R, centre[..., sel, :] - o)
                w[..., 0] -= back * (groups.chip[sel] > 0)[:, None]
            out[..., sel, :, :] = w
        return out

    def effective_jacobian(self, theta: ArrayLike, groups: Groups) -> list[tuple[Int, Float]]:
        """Derivatives of the effective coefficients.

        Parameters
        ----------
        theta : array_like, shape (n_params,)
            The point at which the frames are linearised.
        groups : Groups

        Returns
        -------
        list of (columns, derivative), one for each group
            `columns` (m,) are the entries of theta that the group depends on (global ones first),
            `derivative` (2, K, m).
        """
        theta = np.asarray(theta, float)
        K, o = self.n_terms, np.asarray(self.origin)
        poly = self.polynomials(theta, groups.chip, groups.epoch)
        drift = self._drift(groups.chip, groups.epoch) if self.time is not None else None
        out = []
        for g in range(len(groups)):
            chip, e = int(groups.chip[g]), int(groups.exposure[g])
            M, _ = self.frame(theta, e)
            block, own = self.frame_slice(e), self._own(chip, e)
            values = theta[block][own]
            L, d = chip_matrix(values) if own.stop else (np.zeros((2, 2)), np.zeros(2))

            # by the polynomial's coefficients, then by what moves these
            columns = [np.r_[slice(2 * K * chip, 2 * K * (chip + 1))]]
            direct = np.einsum("ab,kl->akbl", M, np.eye(K))
            if own.stop:
                R, turning = rigid_part(*self._frame(theta, e))
                at_centre = self._bases[chip].monomial_matrix[0]
                direct += np.einsum("ab,kl->akbl", M @ L, self._about_chip(np.eye(K), chip).T)
                direct[:, 0] -= np.einsum("ab,l->abl", M - R, at_centre)
            blocks = [direct.reshape(2, K, 2 * K)]
            if drift is not None:
                columns.append(np.r_[self._tdd(chip)])
                blocks.append(np.einsum("akbl,blm->akm", direct, drift[g]))
            if block.stop > block.start:
                about_chip = self._about_chip(poly[g], chip)
                w = poly[g] + L @ about_chip
                w[:, 0] += d - o
                shift = np.zeros((2, K, 2))
                shift[0, 0, 0] = shift[1, 0, 1] = 1.0
                tangent = frame_tangent(*self._frame(theta, e))
                by_frame = np.einsum("mab,bk->akm", tangent, w)
                if own.stop:
                    by_frame[:, 0] -= ((tangent - turning) @ (poly[g] @ at_centre - o)).T
                of_all = np.concatenate([shift, by_frame], axis=2)
                names = frame_names(self.frames)
                fitted = [n for n in self.free_frame_names(e) if n in names]
                columns.append(np.r_[block][: len(fitted)])
                blocks.append(of_all[..., [names.index(n) for n in fitted]])
                if own.stop:
                    shapes, shifts = chip_matrix(np.eye(len(CHIP_DEVIATIONS)))
                    by_own = np.einsum("mab,bk->akm", shapes, about_chip)
                    by_own[:, 0] += shifts.T
                    columns.append(np.r_[block][own])
                    blocks.append(np.einsum("ab,bkm->akm", M, by_own))
            out.append((np.concatenate(columns), np.concatenate(blocks, axis=2)))
        return out

    # -- from parameters to positions -------------------------------------------------------------

    def predict(
        self,
        theta: ArrayLike,
        x: ArrayLike,
        y: ArrayLike,
        *,
        epoch: ArrayLike | None = None,
        exposure: ArrayLike | None = None,
        chip: ArrayLike | None = None,
    ) -> Float:
        """Positions (u, v) of detector pixels.

        Parameters
        ----------
        theta : array_like, shape (..., n_params)
            One or many parameter vectors.
        x, y : array_like, shape (N,)
            FITS 1-based pixels.
        epoch, exposure, chip : array_like, optional
            As in `groups`; each one value or N of them.

        Returns
        -------
        ndarray, shape (..., N, 2)
            In the unit of u, v.

        Raises
        ------
        InputError
            When theta has another length, or as `groups`.
        """
        theta = self._checked(theta)
        x, y = np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(y))
        groups = self.groups(x.size, epoch=epoch, exposure=exposure, chip=chip)
        E = self.effective(theta, groups)
        out = np.empty((*theta.shape[:-1], x.size, 2))
        for g, rows in enumerate(groups.members()):
            phi = self._bases[groups.chip[g]].evaluate(x[rows], y[rows])
            out[..., rows, :] = np.swapaxes(E[..., g, :, :] @ phi.T, -1, -2)
        return out

    def jacobian(
        self,
        theta: ArrayLike,
        x: ArrayLike,
        y: ArrayLike,
        *,
        epoch: ArrayLike | None = None,
        exposure: ArrayLike | None = None,
        chip: ArrayLike | None = None,
    ) -> Float:
        """Derivatives of the positions by every parameter.

        Parameters
        ----------
        theta : array_like, shape (n_params,)
        x, y, epoch, exposure, chip
            As in `predict`.

        Returns
        -------
        ndarray, shape (N, 2, n_params)
        """
        theta = self._checked(theta)
        x, y = np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(y))
        groups = self.groups(x.size, epoch=epoch, exposure=exposure, chip=chip)
        out = np.zeros((x.size, 2, self.n_params))
        jacobians = self.effective_jacobian(theta, groups)
        for g, (rows, (columns, d)) in enumerate(zip(groups.members(), jacobians, strict=True)):
            phi = self._bases[groups.chip[g]].evaluate(x[rows], y[rows])
            out[np.ix_(rows, np.arange(2), columns)] = np.einsum("nk,akm->nam", phi, d)
        return out

    def pixel_size(self, theta: ArrayLike, chip: int | None = None) -> float:
        """Size of a pixel at a chip's reference pixel, in the unit of u, v.

        Parameters
        ----------
        theta : array_like, shape (n_params,)
        chip : int, optional
            Chip number; the first chip by default.

        Returns
        -------
        float
            1 where u and v are pixels, else the square root of the pixel's area, without drift and
            frames.
        """
        return 1.0 if self.unit == "pix" else self.linear_scale(theta, chip)

    def linear_scale(self, theta: ArrayLike, chip: int | None = None) -> float:
        """Size of a pixel in what u and v are counted in, also where that is called pixels.

        Parameters
        ----------
        theta, chip
            As of `pixel_size`.

        Returns
        -------
        float
            Square root of the pixel's area at the reference pixel, without drift and frames.
        """
        theta, basis = np.asarray(theta, float), self.basis(chip)
        linear = [
            basis.to_monomials(theta[self.coefficient_slice(chip, axis)])[1:3] for axis in (0, 1)
        ]
        return float(np.sqrt(abs(np.linalg.det(linear))))

    def _checked(self, theta: ArrayLike) -> Float:
        theta = np.asarray(theta, float)
        if theta.shape[-1:] != (self.n_params,):
            raise InputError(
                f"theta has {theta.shape[-1] if theta.ndim else 0} values and the model has "
                f"{self.n_params} parameters"
            )
        return theta

    # -- as plain data ----------------------------------------------------------------------------

    def to_dict(self) -> dict[str, object]:
        """The structure as JSON-able data, for files."""
        return {
            "order": self.order,
            "chips": [
                {
                    "number": c.number,
                    "name": c.name,
                    "size": list(c.size),
                    "reference_pixel": list(c.reference_pixel),
                }
                for c in self.chips
            ],
            "unit": self.unit,
            "time": None
            if self.time is None
            else {
                "terms": [list(t) for t in self.time.terms],
                "epoch0": list(self.time.epoch0),
                "breaks": list(self.time.breaks),
            },
            "frames": self.frames,
            "exposures": list(self.exposures),
            "origin": list(self.origin),
            "gauge": self.gauge,
            "held": list(self.held),
            "chip_deviations": self.chip_deviations,
        }

    @classmethod
    def from_dict(cls, data: dict) -> DistortionModel:
        """The model that `to_dict` described.

        Raises
        ------
        InputError
            For a description by a version in which scale and rotation meant something else.
        """
        time = data["time"]
        if "gauge" not in data and data["frames"] in ("shift_rotation_scale", "affine"):
            raise InputError(
                f"an earlier version wrote this: '{data['frames']}' had other parameters then",
                where="model",
                do="fit again",
            )
        shift_u, shift_v, rotation = data.get("held", (0.0, 0.0, 0.0))
        return cls(
            order=data["order"],
            chips=tuple(
                Chip(c["number"], c["name"], as_pair(c["size"]), as_pair(c["reference_pixel"]))
                for c in data["chips"]
            ),
            unit=data["unit"],
            time=None
            if time is None
            else TimeDependence(
                tuple((str(a), int(i), int(j)) for a, i, j in time["terms"]),
                tuple(time["epoch0"]),
                tuple(time["breaks"]),
            ),
            frames=data["frames"],
            exposures=tuple(data["exposures"]),
            origin=as_pair(data["origin"]),
            gauge=data.get("gauge", "first"),
            held=(float(shift_u), float(shift_v), float(rotation)),
            chip_deviations=data.get("chip_deviations", False),
        )
