"""Calibration of a detector: maps of all chips to one plane, at any date.

A calibration is a fitted solution, or one read from a file, without the frames of exposures.  It
also contains the data that pipelines need: the plane, look-up tables, explicit inverses and the
reference date.  It applies to one filter.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from bayesdist.calibration import hooks
from bayesdist.calibration.chip_map import ChipMap, FurtherError, chip_of, sampling_of
from bayesdist.calibration.inverse import ExplicitInverse
from bayesdist.calibration.plane import ARCSEC, Plane
from bayesdist.errors import InputError
from bayesdist.infer.solution.solution import GaussianSolution, Solution
from bayesdist.infer.solution.transforms import at_exposure, without_frames
from bayesdist.model import Chip, DistortionModel, LookupTable, TimeDependence, corrected
from bayesdist.plugin import load_object
from bayesdist.utils.arrays import Float
from bayesdist.utils.quantities import (
    Direction,
    Epoch,
    Number,
    direction_in,
    year_of,
)

if TYPE_CHECKING:
    from astropy.modeling import Model
    from astropy.table import QTable

    from bayesdist.calibration.wcs import CalibrationWCS

__all__ = ["Calibration"]

ORIGINS = ("stated", "reference", "chip")
FOLLOWING_ORDER = 9  # order of the polynomial that replaces look-up tables in comparisons


@dataclass(frozen=True, eq=False, repr=False)
class Calibration:
    """Map from the pixels of all chips of a detector to one plane, with its errors.

    Use `bayesdist.read_calibration` to read a calibration from a run or from a file of any format,
    and `from_solution` to make one from a fit or a posterior.  Each chip maps pixels (x, y), FITS
    1-based, to (u, v) in three steps: the look-up tables `before` correct the pixel, the polynomial
    of the solution is evaluated at the corrected pixel, and the look-up tables `after` are added.

    Parameters
    ----------
    name : str
        Name of the file or run, for messages.
    solution : Solution
        Polynomials of all chips and their covariance, without frames of exposures.  The first chip
        is the reference chip.
    plane : Plane, optional
        Plane of (u, v): on the sky, in an aperture, of corrected pixels, or undefined ('free').
    instrument, detector, filter : str, optional
        Names; empty if unknown.
    errors : {'covariance', 'sigma', 'none'}
        Available errors of the coefficients: their covariance, only standard deviations of the
        monomial coefficients, or none.
    numbered : bool
        False for a file without chip numbers.
    before : tuple of LookupTable, optional
        Look-up tables in pixels that are applied before the polynomial.
    after : tuple of LookupTable, optional
        Look-up tables in the unit of u and v that are added to the polynomial.
    inverses : mapping of int to ExplicitInverse, optional
        Inverse polynomials from a file at the reference date, by chip number.
    scale : float, optional
        Size of a corrected pixel in the unit of u and v, if stated.
    scale_from : str, optional
        Source of `scale`.
    pixel_mas : float, optional
        Pixel scale on the sky in mas per pixel, if known for u and v in pixels.
    reference_date : float, optional
        Default date, in decimal years, for a calibration that depends on time.
    undated : str, optional
        Note that is added to results if no date is given.
    no_date : str, optional
        Reason why the calibration cannot be evaluated at another date; empty if it can.
    with_plane : ndarray, shape (D, 4), optional
        Covariance of the D parameters with the four parameters of the orientation of the plane.
    notes : tuple of str, optional
        Notes for users of the calibration.
    further : tuple of FurtherError, optional
        Position errors that the covariance of the solution does not include.

    Examples
    --------
    A camera with 0.2 arcsec per pixel, fitted to 500 stars and written as a TPV header:

    >>> rng = np.random.default_rng(1)
    >>> chip = bd.Chip(1, "camera", (1000, 1000), (500.5, 500.5))
    >>> model = bd.DistortionModel(1, (chip,), "arcsec")
    >>> stars, _ = bd.simulate_matches(model, [0, -100, 0, 0, 0, 100], 500, sigma=0.01, rng=rng)
    >>> fit = bd.fit_linear(stars, model)
    >>> calibration = bd.Calibration.from_solution(fit, name="camera", point=(150.0, 2.2))
    >>> calibration
    <Calibration 'camera': chip 1, order 1, u and v in arcsec on the sky at (150, 2.2), covariance>
    >>> [path.name for path in calibration.write("tpv", "camera.head")]
    ['camera_parameters.fits', 'camera.head']
    >>> again = bd.read_calibration("camera.head")
    >>> np.allclose(again.forward([1.0], [1.0], chip=1), calibration.forward([1.0], [1.0], chip=1))
    True
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
    pixel_mas: float | None = None
    reference_date: float | None = None
    undated: str = ""
    no_date: str = ""
    with_plane: Float | None = None
    notes: tuple[str, ...] = ()
    further: tuple[FurtherError, ...] = ()

    @classmethod
    def from_solution(
        cls,
        solution: Solution,
        *,
        name: str = "solution",
        point: Direction | None = None,
        detector: str = "",
        filter: str = "",
    ) -> Calibration:
        """Calibration of a fit or a posterior, without the frames of its exposures.

        Parameters
        ----------
        solution : LinearFit or Posterior
        name : str, optional
            Name for messages and files.
        point : SkyCoord or tuple, optional
            Right ascension and declination (numbers in degrees) of (u, v) = (0, 0), where u
            increases to the east and v to the north; by default the tangent point of the solution.
        detector, filter : str, optional
            Names to be written to files.

        Returns
        -------
        Calibration

        Raises
        ------
        InputError
            If `solution` is not a LinearFit or Posterior, or `point` is not a direction.
        """
        if not isinstance(solution, Solution):
            raise InputError(
                f"solution is a {type(solution).__name__}",
                where="from_solution",
                do="give a Posterior or LinearFit",
            )
        plane = None if point is None else Plane("sky", point=direction_in(point, "point"))
        return calibration_of(solution, name, plane=plane, detector=detector, filter=filter)

    def __repr__(self) -> str:
        chips = f"chip{'s' if len(self.numbers) > 1 else ''} {', '.join(map(str, self.numbers))}"
        location = {
            "sky": " on the sky",
            "aperture": " of an aperture",
            "detector": " of the corrected detector",
        }.get(self.plane.kind, "")
        if self.plane.point is not None:
            location += " at ({:.6g}, {:.6g})".format(*self.plane.point)
        parts = [chips, f"order {self.model.order}", f"u and v in {self.unit}{location}"]
        if self.before or self.after:
            parts.append("look-up tables")
        if self.model.time is not None:
            parts.append("depends on time")
        words = {"sigma": "standard deviations", "none": "no errors"}
        parts.append(words.get(self.errors, self.errors))
        return f"<Calibration {self.name!r}: {', '.join(parts)}>"

    @property
    def model(self) -> DistortionModel:
        """Distortion model of the solution."""
        return self.solution.model

    @property
    def unit(self) -> str:
        """Unit of the plane."""
        return self.model.unit

    @property
    def numbers(self) -> tuple[int, ...]:
        """Chip numbers, the reference chip first."""
        return tuple(chip.number for chip in self.model.chips)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Notes for users of the calibration, including the note on the plane."""
        return tuple(note for note in (*self.notes, self.plane.note) if note)

    # -- forward ----------------------------------------------------------------------------------

    def at(self, epoch: float | None = None, *, origin: str = "reference") -> dict[int, ChipMap]:
        """Polynomials of all chips at a date, the reference chip first.

        Parameters
        ----------
        epoch : float, optional
            Decimal years; `reference_date` by default.
        origin : {'reference', 'stated', 'chip'}
            Pixel that maps to (u, v) = 0: the reference pixel of the reference chip, the zero point
            of the solution, or the reference pixel of each chip.

        Returns
        -------
        dict of int to ChipMap
            Maps by chip number, without look-up tables.

        Raises
        ------
        InputError
            If the calibration cannot be evaluated at the date, or a required date is missing.
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
        """Maps of all chips, by chip number, with the look-up tables, for use with an output frame.

        `epoch` is in decimal years.  In a free plane (u, v) = 0 is at the reference pixel of the
        reference chip.
        """
        origin = "reference" if self.plane.kind == "free" else "stated"
        return self.with_tables(self.at(epoch, origin=origin))

    def by_chip(self, epoch: float | None = None) -> dict[int, ChipMap]:
        """Maps of all chips by chip number, without look-up tables, for comparisons chip by chip.

        `epoch` is in decimal years.  In an aperture (u, v) = 0 is at the reference pixel of each
        chip. Look-up tables are approximated by a polynomial; a note states the residuals.
        """
        maps = self.at(epoch, origin="chip" if self.plane.kind == "aperture" else "stated")
        if not self.before and not self.after:
            return maps
        out = {}
        for number, chip_map in self.with_tables(maps).items():
            polynomial, worst, rms = chip_map.polynomial(FOLLOWING_ORDER)
            note = (
                f"its look-up tables are approximated by a polynomial of order {FOLLOWING_ORDER}, "
                f"with residuals of at most {worst:.2g} pix, {rms:.2g} pix rms"
            )
            out[number] = replace(polynomial, notes=(*chip_map.notes, note))
        return out

    def with_tables(self, maps: Mapping[int, ChipMap]) -> dict[int, ChipMap]:
        """Add the look-up tables of the calibration to maps of chips, given by chip number."""
        return {
            number: replace(
                chip_map,
                before=tuple(
                    t
                    for t in sorted(self.before, key=lambda table: table.filter != "")
                    if t.chip == number and t.filter in ("", self.filter)
                ),
                after=tuple(t for t in self.after if t.chip == number),
            )
            for number, chip_map in maps.items()
        }

    def chip(
        self, number: int | None = None, epoch: float | None = None, *, origin: str = "reference"
    ) -> ChipMap:
        """Polynomial of one chip, by default the reference chip; see `at`."""
        maps = self.at(epoch, origin=origin)
        return chip_of(maps, self.numbers[0] if number is None else number, self.name)

    def joint_covariance(
        self, numbers: Sequence[int], epoch: float | None = None, *, origin: str = "reference"
    ) -> Float | None:
        """Covariance (2 K n, 2 K n) of the coefficients of n chips; None without errors.

        `numbers` are chip numbers.  Within each chip u comes before v.  See `at` for `epoch` and
        `origin`.
        """
        if self.errors == "none":
            return None
        parts = [self.coefficients(number, epoch, origin)[1] for number in numbers]
        joint = np.concatenate(parts)
        cov = joint @ np.asarray(self.solution.cov, float) @ joint.T
        return (cov + cov.T) / 2

    def forward(
        self, x: ArrayLike, y: ArrayLike, *, chip: int, epoch: float | None = None
    ) -> Float:
        """Positions (u, v) of pixels, including look-up tables.

        Parameters
        ----------
        x, y : array_like, shape (N,)
            FITS 1-based pixels.
        chip : int
            Chip number.
        epoch : float, optional
            Decimal years; `reference_date` by default.

        Returns
        -------
        ndarray, shape (N, 2)
            In the unit of u and v.

        Raises
        ------
        InputError
            If the chip is unknown, the calibration cannot be evaluated at the date, or a required
            date is missing.
        """
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
        """Legendre coefficients (2, K) of a chip, and their derivatives (2 K, D).

        The derivatives are with respect to the parameters of the solution.  See `at` for `epoch`
        and `origin`.
        """
        if origin not in ORIGINS:
            raise ValueError(f"the origin is {origin!r}")
        coefficients, jacobian = self._stated(number, epoch)
        if origin != "stated":
            origin_chip = number if origin == "chip" else self.numbers[0]
            value, slope = (
                (coefficients, jacobian)
                if origin_chip == number
                else self._stated(origin_chip, epoch)
            )
            basis = self.model.basis(origin_chip)
            zero = basis.evaluate(*np.array(basis.reference_pixel)[:, None])[0]
            shift, zero_jacobian = value @ zero, np.einsum("akd,k->ad", slope, zero)
            coefficients, jacobian = coefficients.copy(), jacobian.copy()
            coefficients[:, 0] -= shift  # the first basis function is 1
            jacobian[:, 0] -= zero_jacobian
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
        """Date at which the model is evaluated; None if it does not depend on time."""
        if epoch is not None and not np.isfinite(epoch):
            raise InputError(f"the epoch is {epoch}", do="give it in decimal years")
        if epoch is not None and self.no_date:
            raise InputError(
                self.no_date,
                where=self.name,
                do="omit the epoch, or give a file with a reference date (TDD_DATE)",
            )
        if self.model.time is None:
            return None
        if epoch is None and self.reference_date is None:
            raise InputError(
                "depends on time, but no date is given",
                where=self.name,
                do="give the epoch (--epoch on the command line)",
            )
        return self.reference_date if epoch is None else epoch

    def at_date(self, epoch: float | None = None) -> Calibration:
        """Calibration at one date, in decimal years, without time dependence."""
        if self.model.time is None:
            return self
        at_epoch = calibration_of_maps(
            self.at(epoch, origin="stated"),
            self.name,
            cov=self.joint_covariance(self.numbers, epoch, origin="stated"),
            errors=self.errors,
        )
        return replace(
            self, solution=at_epoch.solution, reference_date=None, undated="", inverses={}
        )

    def only(self, number: int, epoch: float | None = None) -> Calibration:
        """Calibration of a single chip, by its number, at one date in decimal years."""
        chip_map = self.chip(number, epoch, origin="stated")
        single = calibration_of_maps(
            {number: chip_map}, self.name, cov=chip_map.cov, errors=self.errors
        )
        return replace(
            self,
            solution=single.solution,
            reference_date=None,
            undated="",
            before=tuple(t for t in self.before if t.chip == number),
            after=tuple(t for t in self.after if t.chip == number),
            inverses={k: v for k, v in self.inverses.items() if k == number},
        )

    # -- files and tables -------------------------------------------------------------------------

    def write(
        self,
        format: str,
        file: str | os.PathLike[str],
        *,
        epoch: Epoch | None = None,
        scale_mas: Number | None = None,
        order: int | None = None,
        overwrite: bool = False,
        **settings: Any,
    ) -> list[Path]:
        """Write the calibration in a format.

        Parameters
        ----------
        format : str
            Name of the format, such as 'sip' or 'tpv'; `bayesdist.formats.list_formats` lists them.
        file : path
            File to write, or an existing folder, in which the files have the default names of the
            format.  A format with one file per chip needs a folder.
        epoch : float, str, Time or Quantity, optional
            Date at which a calibration that depends on time is written; a number is in decimal
            years.
        scale_mas : float or Quantity, optional
            Pixel scale on the sky in mas per pixel; by default `pixel_mas`.  It is needed if u and
            v are in pixels and the file contains angles.
        order : int, optional
            Order of the polynomial in the file (default: that of the calibration).  Look-up tables
            that the format cannot store are approximated by a polynomial of this order.
        overwrite : bool
            True to replace existing files.
        **settings
            Settings of the format: the keys of its table ``[products.NAME]`` in a configuration.

        Returns
        -------
        list of Path
            Files that were written: auxiliary files first, the file itself last.

        Raises
        ------
        InputError
            If the format or a setting is unknown, the file exists already, the folder does not
            exist, or the format cannot store the calibration, for example its look-up tables or
            time dependence.

        Warns
        -----
        bayesdist.errors.BayesdistWarning
            If other programs may misread the file, or the calibration was changed to fit the
            format.
        """
        written: list[Path] = load_object(hooks.WRITE)(
            self,
            format,
            file,
            epoch=epoch,
            scale_mas=scale_mas,
            order=order,
            overwrite=overwrite,
            **settings,
        )
        return written

    def to_sky(
        self,
        table: Any,
        *,
        columns: Sequence[str] | None = None,
        centroids: Sequence[str] | None = None,
        pixel_origin: float | None = None,
        chip: int | None = None,
        epoch: Epoch | None = None,
        point: Direction | None = None,
        covariance: bool = False,
    ) -> QTable:
        """Convert a table of pixel positions to sky positions, with all errors of the calibration.

        Parameters
        ----------
        table : table
            Pixels of stars, in any type that `Matches.from_table` accepts.  A column chip is needed
            if the detector has several chips.
        columns : tuple of str, optional
            Names of the columns with x and y; by default the names that `Matches.from_table`
            recognises.
        centroids : tuple of str, optional
            Names of the columns with the standard deviations of x and y, in pixels.
        pixel_origin : float, optional
            Coordinate of the centre of the first pixel: 1 as in FITS, 0 as in photutils.  The
            default is 0 if `Matches.from_table` recognises the columns as those of a program that
            counts from 0, and otherwise 1.
        chip : int, optional
            Chip number of all stars, instead of a column.
        epoch : float, str, Time or Quantity, optional
            Date, for a calibration that depends on time; a number is in decimal years.
        point : SkyCoord or tuple, optional
            Right ascension and declination (numbers in degrees) of (u, v) = (0, 0), with u to the
            east and v to the north; by default that of the calibration.
        covariance : bool
            True to return the joint covariance of all stars.

        Returns
        -------
        QTable
            The table with additional columns `ra` and `dec`, their standard deviations `sigma_ra`
            (multiplied by cos(dec)) and `sigma_dec`, and the correlation `corr_ra_dec`.
            ``meta["errors"]`` lists the errors that are included, and ``meta["pixel_origin"]`` is
            the pixel origin.  With `covariance`, ``meta["covariance"]`` is the covariance matrix
            (2 N, 2 N) of all stars in mas^2, with east and north alternating.

        Raises
        ------
        InputError
            If the plane of the calibration is not on the sky, or a column or chip is unknown.

        Examples
        --------
        >>> rng = np.random.default_rng(1)
        >>> chip = bd.Chip(1, "camera", (1000, 1000), (500.5, 500.5))
        >>> model = bd.DistortionModel(1, (chip,), "arcsec")
        >>> truth = [0, 50, 0, 0, 0, 50]
        >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, fraction=0.0, rng=rng)
        >>> calibration = bd.Calibration.from_solution(bd.fit_linear(stars, model))
        >>> sky = calibration.to_sky({"x": [500.5], "y": [500.5]}, point=(30.0, 0.0))
        >>> round(float(sky["ra"][0].value), 4)
        30.0
        >>> bool(abs(sky["sigma_ra"][0].to_value("mas") - 10 / 500**0.5) < 0.01)  # mean of 500
        True
        """
        positions: QTable = load_object(hooks.TO_SKY)(
            self,
            table,
            columns=columns,
            centroids=centroids,
            pixel_origin=pixel_origin,
            chip=chip,
            epoch=epoch,
            point=point,
            covariance=covariance,
        )
        return positions

    # -- scale ------------------------------------------------------------------------------------

    def pixel(self, epoch: float | None = None) -> tuple[float, str]:
        """Size of a corrected pixel in the unit of the plane, and its source.

        If the size is not stated, it is that of the reference pixel.  Raises InputError if this
        pixel has no area.
        """
        if self.scale is not None:
            return self.scale, self.scale_from
        area = abs(float(np.linalg.det(self.chip(epoch=epoch).linear)))
        if not area > 0:
            raise InputError(
                "the reference pixel has no area", where=self.name, do="give the scale"
            )
        return float(np.sqrt(area)), "the pixel at the zero point"

    # -- objects of astropy -----------------------------------------------------------------------

    def wcs(
        self,
        chip: int | None = None,
        *,
        epoch: Epoch | None = None,
        point: Direction | None = None,
        position_angle: Number | None = None,
        mirrored: bool = False,
        pixel_scale: Number | None = None,
    ) -> CalibrationWCS:
        """World coordinate system of a chip, with its errors.

        If the plane of the calibration is tangent to the sky, no further arguments are needed.
        Otherwise `point` places the plane on the sky; without it the world coordinates are u and v.

        Parameters
        ----------
        chip : int, optional
            Number of the chip; required if there are several.
        epoch : float, str or Time, optional
            Date; required if the calibration depends on time and has no reference date.
        point : SkyCoord or tuple of float, optional
            Sky position of (u, v) = (0, 0): right ascension and declination (ICRS) in degrees; by
            default that of the calibration.
        position_angle : float or Quantity, optional
            Position angle of the v axis at `point`, in degrees from north to east; 0 by default.
            It is required for a calibration in the plane of an aperture, and is that of V3 if the
            directions of u and v in V2, V3 are known.
        mirrored : bool
            True if u is 90 degrees west of v; by default it is 90 degrees east of it.
        pixel_scale : float or Quantity, optional
            Pixel scale in arcsec per pixel; by default `pixel_mas`.  It is required on the sky if u
            and v are in pixels.

        Returns
        -------
        CalibrationWCS

        Raises
        ------
        InputError
            If the chip is unknown, or a required chip, epoch, position angle or pixel scale is
            missing.
        """
        wcs: CalibrationWCS = load_object(hooks.WCS)(
            self,
            chip,
            epoch=epoch,
            point=point,
            position_angle=position_angle,
            mirrored=mirrored,
            pixel_scale=pixel_scale,
        )
        return wcs

    def to_model(self, chip: int | None = None, *, epoch: Epoch | None = None, **sky: Any) -> Model:
        """Compound model of astropy.modeling from 0-based pixels to the sky, or to u and v.

        Parameters
        ----------
        chip, epoch
            See `wcs`.
        **sky
            Arguments `point`, `position_angle`, `mirrored` and `pixel_scale` of `wcs`.

        Returns
        -------
        astropy.modeling.Model
            Model with inputs x and y and outputs right ascension and declination in degrees, or u
            and v.  It has an inverse.

        Raises
        ------
        InputError
            See `wcs`.
        """
        return self.wcs(chip, epoch=epoch, **sky).to_model()


def calibration_of(
    solution: Solution,
    name: str = "solution",
    *,
    plane: Plane | None = None,
    detector: str = "",
    filter: str = "",
    scale: tuple[float, str] | None = None,
) -> Calibration:
    """Calibration of a fit or a posterior, without the frames of its exposures.

    Parameters
    ----------
    solution : Solution
        Fit or posterior.
    name : str
        Name for messages.
    plane : Plane, optional
        By default the tangent plane of the solution, or a free plane if it has no tangent point.
    detector, filter : str, optional
        Names of the detector and of the filter, if they are known.
    scale : tuple of (float, str), optional
        Size of a corrected pixel in the unit of u and v, and its source; by default 1 for u and v
        in pixels.

    Returns
    -------
    Calibration
    """
    bare = solution if solution.model.frames == "none" else without_frames(solution)
    if plane is None and solution.tangent_point is not None and bare.model.unit in ARCSEC:
        plane = Plane("sky", point=solution.tangent_point)
    if scale is None and bare.model.unit == "pix":
        scale = 1.0, "pixels of u, v"
    size, source = scale or (None, "")
    return Calibration(
        name,
        bare,
        plane or Plane(),
        detector=detector,
        filter=filter,
        scale=size,
        scale_from=source,
    )


def calibration_of_exposure(
    solution: Solution,
    exposure: str,
    name: str = "",
    *,
    epoch: Epoch | None = None,
    plane: Plane | None = None,
    detector: str = "",
    filter: str = "",
    scale: tuple[float, str] | None = None,
) -> Calibration:
    """Calibration of one exposure of a fit or a posterior, including the frame of the exposure.

    The frame (shift, rotation, scale, shear) is combined with the polynomials, as are its
    covariance and its draws.

    Parameters
    ----------
    solution : Solution
        Fit or posterior of a model with frames.
    exposure : str
        Name of the exposure.
    name : str, optional
        Name for messages (default: that of the exposure).
    epoch : float, str or Time, optional
        Date of the exposure; required for a model with time dependence.
    plane, detector, filter, scale
        See `calibration_of`.

    Returns
    -------
    Calibration
        Without time dependence.

    Raises
    ------
    InputError
        If there is no such exposure, or the epoch is missing.
    """
    date = None if epoch is None else year_of(epoch)
    return calibration_of(
        at_exposure(solution, exposure=exposure, epoch=date),
        name or f"exposure {exposure}",
        plane=plane,
        detector=detector,
        filter=filter,
        scale=scale,
    )


def as_calibration(one: Solution | Calibration) -> Calibration:
    """Calibration of a solution; a calibration is returned unchanged."""
    return one if isinstance(one, Calibration) else calibration_of(one)


def calibration_of_maps(
    maps: Mapping[int, ChipMap],
    name: str,
    *,
    rates: Mapping[tuple[int, str, int, int], float] | None = None,
    reference_date: float | None = None,
    cov: Float | None = None,
    errors: str = "none",
    **what: Any,
) -> Calibration:
    """Calibration from the polynomials of its chips, as given in files.

    Parameters
    ----------
    maps : mapping of int to ChipMap
        Maps at the reference date by chip number, the reference chip first.  All must have the same
        order and unit.
    name : str
        Name for messages.
    rates : mapping, optional
        Drift by (chip, axis, i, j) of the coefficients of monomials x^i y^j, in the unit of u and v
        per pixel^(i + j) and year.  All chips must have the same drifting terms.
    reference_date : float, optional
        Decimal years.
    cov : ndarray, shape (D, D), optional
        Covariance of the parameters, in the order of the model.
    errors : {'covariance', 'sigma', 'none'}
        See `Calibration`.
    **what
        Further fields of `Calibration`.

    Returns
    -------
    Calibration
    """
    first = next(iter(maps.values()))
    time = None
    if rates and reference_date is not None:
        time = TimeDependence(tuple(dict.fromkeys(key[1:] for key in rates)), (reference_date,))
    chips = tuple(
        Chip(number, str(number), chip_map.basis.size, chip_map.basis.reference_pixel)
        for number, chip_map in maps.items()
    )
    model = DistortionModel(first.basis.order, chips, first.unit, time)
    mean = np.zeros(model.n_params)
    for number, chip_map in maps.items():
        for axis in (0, 1):
            mean[model.coefficient_slice(number, axis)] = chip_map.coefficients[axis]
        if time is not None and rates is not None:
            half = chip_map.basis.half_size
            mean[model.tdd_slice(number)] = [
                rates[number, axis, i, j] * half[0] ** i * half[1] ** j for axis, i, j in time.terms
            ]
    if cov is None:
        cov, errors = np.zeros((model.n_params, model.n_params)), "none"
    return Calibration(
        name,
        GaussianSolution(model, mean, cov),
        errors=errors,
        reference_date=reference_date if time is not None else None,
        **what,
    )
