"""What a file for a pipeline holds: all chips of a detector in one plane, at any date.

A calibration is a solution without the frames of exposures, whether it was fitted or read from a
file, with what pipelines need besides: the plane it maps to, look-up tables, explicit inverses, the
dates it holds for.  One calibration is of one filter.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.calibration.chip_map import ChipMap, sampling_of
from bayesdist.calibration.inverse import ExplicitInverse
from bayesdist.calibration.plane import Plane
from bayesdist.errors import InputError
from bayesdist.infer.transforms import Solution, View, without_frames
from bayesdist.model import Chip, DistortionModel, LookupTable, TimeDependence, corrected

__all__ = ["Calibration", "calibration_of", "calibration_of_maps", "gaussian_solution"]

Float = NDArray[np.float64]

ORIGINS = ("stated", "reference", "chip")


@dataclass(frozen=True, eq=False)
class Calibration:
    """All chips of a detector in one plane.

    Parameters
    ----------
    name : str
        Of the file or run, for messages.
    solution : Solution
        Without frames of exposures; its first chip is the reference chip.
    plane : Plane
    instrument, detector, filter : str
    errors : {'covariance', 'sigma', 'none'}
        What the solution's covariance is: all of it, standard deviations of monomials without
        their correlations, or nothing.
    numbered : bool
        False for a file that knows of no chip numbers.
    before, after : tuple of LookupTable
        Tables in pixels before the polynomial, and in the plane's unit behind it.
    inverses : mapping of int to ExplicitInverse
        By chip: from positions about its own zero point, at the reference date.
    scale : float, optional
        Size of a corrected pixel in the plane's unit, where the source states one.
    scale_from : str
        Where that is from.
    reference_date : float, optional
        Decimal years: the date of `at` where none is asked for.  Without it a calibration that
        depends on time must be asked for one.
    undated : str
        What a reader has to know of positions without a date.
    no_date : str
        Why it cannot be brought to a date; empty where it can.
    with_plane : ndarray, shape (D, 4), optional
        Covariance of the solution's parameters with those of the plane's orientation.
    notes : tuple of str
        What else a reader has to know.
    """

    name: str
    solution: Solution
    plane: Plane = field(default_factory=Plane)
    instrument: str = ""
    detector: str = ""
    filter: str = ""
    errors: str = "covariance"
    numbered: bool = True
    before: tuple[LookupTable, ...] = ()
    after: tuple[LookupTable, ...] = ()
    inverses: Mapping[int, ExplicitInverse] = field(default_factory=dict)
    scale: float | None = None
    scale_from: str = ""
    reference_date: float | None = None
    undated: str = ""
    no_date: str = ""
    with_plane: Float | None = None
    notes: tuple[str, ...] = ()

    @property
    def model(self) -> DistortionModel:
        """Structure of the solution."""
        return self.solution.model

    @property
    def unit(self) -> str:
        """Unit of the plane."""
        return self.model.unit

    @property
    def numbers(self) -> tuple[int, ...]:
        """Chip numbers, the reference chip first."""
        return tuple(chip.number for chip in self.model.chips)

    # -- forward ----------------------------------------------------------------------------------

    def at(self, epoch: float | None = None, *, origin: str = "reference") -> dict[int, ChipMap]:
        """The polynomials of all chips at a date.

        Parameters
        ----------
        epoch : float, optional
            Decimal years; the reference date by default.
        origin : {'reference', 'stated', 'chip'}
            Where (u, v) = 0 is: at the zero point of the reference chip, where the solution has
            it, or at the zero point of each chip by itself.

        Returns
        -------
        dict of int to ChipMap
            By chip number, the reference chip first.

        Raises
        ------
        InputError
            For a date that it cannot be brought to, or that it needs and is not given.
        """
        draws, notes = sampling_of(self.solution)
        notes = (*notes, *self.notes)
        if epoch is None and self.undated:
            notes = (*notes, self.undated)
        out = {}
        for number in self.numbers:
            coefficients, jacobian = self.coefficients(number, epoch, origin)
            cov = None
            if self.errors != "none":
                cov = jacobian @ np.asarray(self.solution.cov, float) @ jacobian.T
            out[number] = ChipMap(
                name=self.name,
                basis=self.model.basis(number),
                unit=self.unit,
                coefficients=coefficients,
                cov=cov,
                correlated=self.errors != "sigma",
                draws=draws,
                chip=number if self.numbered else None,
                epoch=None if self.model.time is None else epoch,
                notes=notes,
            )
        return out

    def in_frame(self, epoch: float | None = None) -> dict[int, ChipMap]:
        """As `at`, for an output frame: from the reference chip's zero point in a free plane."""
        return self.at(epoch, origin="reference" if self.plane.kind == "free" else "stated")

    def by_chip(self, epoch: float | None = None) -> dict[int, ChipMap]:
        """As `at`, for chips one by one: in an aperture each about its own zero point."""
        return self.at(epoch, origin="chip" if self.plane.kind == "aperture" else "stated")

    def chip(
        self, number: int | None = None, epoch: float | None = None, *, origin: str = "reference"
    ) -> ChipMap:
        """The polynomial of one chip, the reference chip by default; raises as `at`."""
        maps = self.at(epoch, origin=origin)
        if number is None:
            return next(iter(maps.values()))
        if number not in maps:
            raise InputError(
                f"there is no chip {number}",
                where=self.name,
                do=f"choose one of {', '.join(map(str, maps))}",
            )
        return maps[number]

    def joint_covariance(
        self, numbers: Sequence[int], epoch: float | None = None, *, origin: str = "reference"
    ) -> Float | None:
        """Covariance (2 K n, 2 K n) of the coefficients of several chips; None without errors."""
        if self.errors == "none":
            return None
        parts = [self.coefficients(number, epoch, origin)[1] for number in numbers]
        joint = np.concatenate(parts)
        cov = joint @ np.asarray(self.solution.cov, float) @ joint.T
        return (cov + cov.T) / 2

    def forward(
        self, x: ArrayLike, y: ArrayLike, *, chip: int, epoch: float | None = None
    ) -> Float:
        """Positions (N, 2) of pixels (N,), look-up tables included, as the solution states them."""
        px, py = np.asarray(x, float), np.asarray(y, float)
        if self.before:
            px, py = corrected(self.before, px, py, chip=chip, filter=self.filter)
        coefficients, _ = self.coefficients(chip, epoch, "stated")
        at = self.model.basis(chip).evaluate(px, py) @ coefficients.T
        for table in self.after:
            if table.chip == chip:
                at = at + table.evaluate(px, py)
        return at

    def coefficients(
        self, number: int, epoch: float | None = None, origin: str = "stated"
    ) -> tuple[Float, Float]:
        """Legendre coefficients (2, K) of a chip, and their derivatives (2 K, D) by the solution.

        Parameters
        ----------
        number : int
            Of the chip.
        epoch, origin
            As of `at`.
        """
        if origin not in ORIGINS:
            raise ValueError(f"the origin is {origin!r}")
        coefficients, jacobian = self._stated(number, epoch)
        if origin != "stated":
            whose = number if origin == "chip" else self.numbers[0]
            value, slope = (
                (coefficients, jacobian) if whose == number else self._stated(whose, epoch)
            )
            basis = self.model.basis(whose)
            zero = basis.evaluate(*np.array(basis.reference_pixel)[:, None])[0]
            shift, by = value @ zero, np.einsum("akd,k->ad", slope, zero)
            coefficients, jacobian = coefficients.copy(), jacobian.copy()
            coefficients[:, 0] -= shift  # the first basis function is 1
            jacobian[:, 0] -= by
        return coefficients, jacobian.reshape(-1, self.model.n_params)

    def _stated(self, number: int, epoch: float | None) -> tuple[Float, Float]:
        date = self._date(epoch)
        model = self.model
        model.chip_code(number)
        group = model.groups(1, epoch=date, chip=number)
        [(columns, d)] = model.effective_jacobian(self.solution.mean, group)
        jacobian = np.zeros((2, model.n_terms, model.n_params))
        jacobian[:, :, columns] = d
        return model.effective(self.solution.mean, group)[0], jacobian

    def _date(self, epoch: float | None) -> float | None:
        """The date to evaluate the model at."""
        if epoch is not None and not np.isfinite(epoch):
            raise InputError(f"the epoch is {epoch}", do="give it in decimal years")
        if epoch is not None and self.no_date:
            raise InputError(
                self.no_date,
                where=self.name,
                do="leave out the epoch, or give a file with a date of reference (TDD_DATE)",
            )
        if self.model.time is None:
            return None
        if epoch is None and self.reference_date is None:
            raise InputError(
                "depends on time and no date is given", where=self.name, do="give --epoch"
            )
        return self.reference_date if epoch is None else epoch

    # -- what else --------------------------------------------------------------------------------

    def pixel(self, epoch: float | None = None) -> tuple[float, str]:
        """Size of a corrected pixel in the plane's unit, and where that is from.

        Raises
        ------
        InputError
            When nothing states it and the pixel at the zero point has no area.
        """
        if self.scale is not None:
            return self.scale, self.scale_from
        area = abs(float(np.linalg.det(self.chip(epoch=epoch).linear)))
        if not area > 0:
            raise InputError(
                "the pixel at the zero point has no area", where=self.name, do="give --scale"
            )
        return float(np.sqrt(area)), "the pixel at the zero point"

    def with_tables(
        self, before: Iterable[LookupTable] = (), after: Iterable[LookupTable] = ()
    ) -> Calibration:
        """The calibration with look-up tables before and behind its polynomials."""
        return replace(self, before=tuple(before), after=tuple(after))


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Draws of parameters that are known by their mean and covariance alone."""

    mean: Float
    cov: Float

    def draws(self, n: int, rng: np.random.Generator) -> Float:
        """Parameter vectors, shape (n, D)."""
        return rng.multivariate_normal(self.mean, self.cov, size=n, method="eigh")


def gaussian_solution(model: DistortionModel, mean: Float, cov: Float) -> View:
    """A solution from its mean and covariance."""
    return View(model, mean, cov, Gaussian(mean, cov), _same)  # type: ignore[arg-type]


def _same(theta: Float) -> Float:
    return theta


def calibration_of(
    solution: Solution,
    name: str = "solution",
    *,
    plane: Plane | None = None,
    instrument: str = "",
    detector: str = "",
    filter: str = "",
    before: Iterable[LookupTable] = (),
    scale: tuple[float, str] | None = None,
) -> Calibration:
    """A fit or a posterior as a calibration, without the frames of its exposures.

    Parameters
    ----------
    solution : Solution
    name : str
        What to call it.
    plane : Plane, optional
        Where (u, v) lie; not known by default.
    instrument, detector, filter : str
    before : iterable of LookupTable
        In pixels, before the polynomial.
    scale : tuple of (float, str), optional
        Size of a corrected pixel, and where that is from; of u, v in pixels 1 by default.

    Returns
    -------
    Calibration
    """
    bare = solution if solution.model.frames == "none" else without_frames(solution)
    if scale is None and bare.model.unit == "pix":
        scale = 1.0, "pixels of u, v"
    size, source = scale or (None, "")
    return Calibration(
        name,
        bare,
        plane or Plane(),
        instrument,
        detector,
        filter,
        before=tuple(before),
        scale=size,
        scale_from=source,
    )


def calibration_of_maps(
    maps: Mapping[int, ChipMap],
    name: str,
    *,
    rates: Mapping[tuple[int, str, int, int], float] | None = None,
    reference_date: float | None = None,
    cov: Float | None = None,
    errors: str = "none",
    **what: object,
) -> Calibration:
    """A calibration from the polynomials of its chips, as files state them.

    Parameters
    ----------
    maps : mapping of int to ChipMap
        By chip number, the reference chip first; of one order and unit, at the reference date.
    name : str
    rates : mapping, optional
        From (chip, axis, i, j) to the rate of a monomial x^i y^j, in the unit per pixel^(i + j) and
        year; the same terms for every chip.
    reference_date : float, optional
        Decimal years, for rates.
    cov : ndarray, shape (D, D), optional
        Of the parameters, as the model orders them.
    errors : str
        As in `Calibration`.
    **what
        As in `Calibration`.

    Returns
    -------
    Calibration
    """
    first = next(iter(maps.values()))
    time = None
    if rates and reference_date is not None:
        time = TimeDependence(tuple(dict.fromkeys(key[1:] for key in rates)), (reference_date,))
    chips = tuple(
        Chip(number, str(number), one.basis.size, one.basis.reference_pixel)
        for number, one in maps.items()
    )
    model = DistortionModel(first.basis.order, chips, first.unit, time)
    mean = np.zeros(model.n_params)
    for number, one in maps.items():
        for axis in (0, 1):
            mean[model.coefficient_slice(number, axis)] = one.coefficients[axis]
        if time is not None and rates is not None:
            half = one.basis.half_size
            mean[model.tdd_slice(number)] = [
                rates[number, axis, i, j] * half[0] ** i * half[1] ** j for axis, i, j in time.terms
            ]
    if cov is None:
        cov, errors = np.zeros((model.n_params, model.n_params)), "none"
    return Calibration(
        name,
        gaussian_solution(model, mean, cov),
        errors=errors,
        reference_date=reference_date if time is not None else None,
        **what,  # type: ignore[arg-type]
    )
