"""World coordinate systems of calibrations with the common interface of astropy (APE 14)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units
from astropy.coordinates import ICRS, SkyCoord
from astropy.wcs.wcsapi import BaseLowLevelWCS
from astropy.wcs.wcsapi.high_level_api import HighLevelWCSMixin
from numpy.typing import ArrayLike

from bayesdist.calibration import hooks
from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.chip_map import ChipMap, chosen_chip
from bayesdist.calibration.modeling import plane_model, sky_model
from bayesdist.calibration.plane import Plane, SkyPlacement
from bayesdist.calibration.sky_positions import placement_of, plane_covariances, sky_positions
from bayesdist.errors import BayesdistError, InputError
from bayesdist.infer.solution.solution import GaussianSolution, ParameterMap
from bayesdist.infer.solution.transforms import at_exposure
from bayesdist.plugin import load_object
from bayesdist.utils.arrays import Bool, Float
from bayesdist.utils.quantities import (
    Direction,
    Epoch,
    Number,
    Random,
    direction_in,
    generator_of,
    value_in,
    whole_number,
    year_of,
)
from bayesdist.utils.text import number

if TYPE_CHECKING:
    from astropy.modeling import Model
    from astropy.wcs import WCS
    from gwcs import WCS as GWCS

__all__ = ["CalibrationWCS"]

SIP_ORDER = 9  # highest order of a SIP polynomial


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationWCS(BaseLowLevelWCS, HighLevelWCSMixin):
    """World coordinate system of one chip at one date, with its errors.

    Use `Calibration.wcs` to create it.  It has both interfaces of APE 14: methods for numbers, such
    as `pixel_to_world_values`, and methods for objects, such as `pixel_to_world`.  It can be used
    with photutils, reproject, regions, ndcube, WCSAxes, and other packages that accept such a WCS.

    Pixels are 0-based: the centre of the first pixel is (0, 0).  World coordinates are right
    ascension and declination (ICRS) in degrees, or u and v if the plane of the calibration has no
    position on the sky.  Positions of any shape are broadcast.  The inverse uses Newton's method on
    the map, including look-up tables, and is NaN if there is no solution.

    Parameters
    ----------
    calibration : Calibration
        Calibration of a single chip that does not depend on time.
    placement : SkyPlacement or None
        Tangent point on the sky and directions of u and v; None for a WCS of u and v.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> chip = bd.Chip(1, "camera", (1000, 1000), (500.5, 500.5))
    >>> model = bd.DistortionModel(1, (chip,), "arcsec")
    >>> truth = [0, -50, 0, 0, 0, 50]
    >>> stars, _ = bd.simulate_matches(model, truth, 500, sigma=0.01, fraction=0.0, rng=rng)
    >>> fit = bd.fit_linear(stars, model)
    >>> wcs = bd.Calibration.from_solution(fit, name="camera", point=(150.0, 2.2)).wcs()
    >>> wcs.pixel_to_world(499.5, 499.5).to_string(precision=4)
    '150.0000 2.2000'
    >>> x, y = wcs.world_to_pixel_values(150.0, 2.2)
    >>> bool(np.hypot(x - 499.5, y - 499.5) < 0.05)
    True
    >>> cov = wcs.covariance(499.5, 499.5)  # of the mean of 500 stars
    >>> bool(abs(cov[0, 0].to_value("mas2") ** 0.5 - 10 / 500**0.5) < 0.1)
    True
    """

    calibration: Calibration
    placement: SkyPlacement | None = None

    @cached_property
    def chip_map(self) -> ChipMap:
        """Map from FITS 1-based pixels to the plane (u, v), including look-up tables."""
        [chip_map] = self.calibration.with_tables(self.calibration.at(origin="stated")).values()
        return chip_map

    @property
    def chip(self) -> int:
        """Number of the chip."""
        return self.calibration.numbers[0]

    # -- values -----------------------------------------------------------------------------------

    def pixel_to_world_values(self, *pixel_arrays: ArrayLike) -> tuple[Float, Float]:
        """Convert pixels to world coordinates.

        Parameters
        ----------
        *pixel_arrays : array_like
            0-based x and y of any shape.

        Returns
        -------
        tuple of ndarray
            Right ascension and declination in degrees, or u and v in the unit of the calibration;
            scalars if x and y are scalars.
        """
        x, y, shape = _flat(*pixel_arrays)
        plane = self.chip_map.at(x + 1.0, y + 1.0)
        first, second = plane if self.placement is None else self.placement.sky(plane)
        return first.reshape(shape)[()], second.reshape(shape)[()]

    def world_to_pixel_values(self, *world_arrays: ArrayLike) -> tuple[Float, Float]:
        """Convert world coordinates to pixels.

        Parameters
        ----------
        *world_arrays : array_like
            Right ascension and declination in degrees, or u and v in the unit of the calibration,
            of any shape.

        Returns
        -------
        tuple of ndarray
            0-based x and y; NaN if no pixel on the chip or near it has this position.
        """
        first, second, shape = _flat(*world_arrays)
        plane = np.stack([first, second])
        if self.placement is not None:
            plane = self.placement.plane(first, second)
        x, y = self.chip_map.unfolded_pixels(plane) - 1.0
        return x.reshape(shape)[()], y.reshape(shape)[()]

    # -- description of the axes ------------------------------------------------------------------

    @property
    def pixel_n_dim(self) -> int:
        """Number of pixel axes."""
        return 2

    @property
    def world_n_dim(self) -> int:
        """Number of world axes."""
        return 2

    @property
    def pixel_axis_names(self) -> tuple[str, str]:
        """Names of the pixel axes."""
        return "x", "y"

    @property
    def world_axis_names(self) -> tuple[str, str]:
        """Names of the world axes."""
        return ("u", "v") if self.placement is None else ("ra", "dec")

    @property
    def world_axis_physical_types(self) -> tuple[str, str]:
        """Physical types of the world axes: UCDs on the sky, otherwise custom types."""
        if self.placement is None:
            return "custom:pos.detector.u", "custom:pos.detector.v"
        return "pos.eq.ra", "pos.eq.dec"

    @property
    def world_axis_units(self) -> tuple[str, str]:
        """Units of the world axes."""
        unit = self.calibration.unit if self.placement is None else "deg"
        return unit, unit

    @property
    def axis_correlation_matrix(self) -> Bool:
        """Matrix (2, 2) that is True if a world axis depends on a pixel axis; here always."""
        return np.ones((2, 2), bool)

    @property
    def world_axis_object_components(self) -> list[tuple[str, int, str]]:
        """Components (object, argument, attribute) of the world coordinates; see APE 14."""
        if self.placement is None:
            return [("u", 0, "value"), ("v", 0, "value")]
        return [
            ("celestial", 0, "spherical.lon.degree"),
            ("celestial", 1, "spherical.lat.degree"),
        ]

    @property
    def world_axis_object_classes(self) -> dict[str, tuple[type, tuple[()], dict[str, Any]]]:
        """Classes of the world objects: a SkyCoord (ICRS), or Quantities u and v."""
        if self.placement is None:
            unit = units.Unit(self.calibration.unit)
            return {axis: (units.Quantity, (), {"unit": unit}) for axis in ("u", "v")}
        return {"celestial": (SkyCoord, (), {"frame": ICRS(), "unit": units.deg})}

    @property
    def pixel_shape(self) -> tuple[int, int]:
        """Columns and rows of the chip."""
        nx, ny = self.chip_map.basis.size
        return round(nx), round(ny)

    @property
    def array_shape(self) -> tuple[int, int]:
        """Rows and columns of the chip, the shape of its image as an array."""
        nx, ny = self.pixel_shape
        return ny, nx

    @property
    def pixel_bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Edges (min, max) of the chip in x and in y, in 0-based pixels (APE 14)."""
        nx, ny = self.chip_map.basis.size
        return (-0.5, nx - 0.5), (-0.5, ny - 0.5)

    @property
    def bounding_box(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Edges of the chip in x and in y, like `pixel_bounds`; pixels outside are mapped too."""
        return self.pixel_bounds

    # -- errors -----------------------------------------------------------------------------------

    def covariance(
        self, x: ArrayLike, y: ArrayLike, *, joint: bool = False, further: bool = True
    ) -> units.Quantity:
        """Covariance of the positions of pixels.

        It includes the errors of the coefficients and the `further` errors of the calibration, as
        `bayesdist apply --sky` does, but not the errors of centroids.

        Parameters
        ----------
        x, y : array_like
            0-based pixels of any shape.
        joint : bool
            True to include the covariance between all positions.
        further : bool
            False to exclude the further errors of the calibration, so that the covariance is that
            of the draws from `draw`.

        Returns
        -------
        astropy.units.Quantity
            In mas^2 along east and north, or along u and v in the square of their unit.  The shape
            is that of the positions followed by (2, 2); with `joint` it is (2 N, 2 N) for N
            positions, with the two axes of each position adjacent.

        Raises
        ------
        InputError
            If the calibration has no errors.
        """
        px, py, shape = _flat(x, y)
        calibration = self.calibration if further else replace(self.calibration, further=())
        if self.placement is None:
            single, joint_cov = plane_covariances(
                calibration,
                {self.chip: self.chip_map},
                px + 1.0,
                py + 1.0,
                np.full(px.shape, self.chip),
                joint=joint,
            )
            unit = units.Unit(self.calibration.unit) ** 2
        else:
            at = sky_positions(
                calibration, px + 1.0, py + 1.0, self.chip, placement=self.placement, joint=joint
            )
            single, joint_cov, unit = at.cov, at.joint, units.mas**2
        if single is None:
            raise InputError(
                "has no errors of the coefficients",
                where=self.calibration.name,
                do="use a run, or a file that contains the covariance",
            )
        if joint_cov is not None:
            return units.Quantity(joint_cov.reshape(2 * px.size, 2 * px.size), unit)
        return units.Quantity(single.reshape(*shape, 2, 2), unit)

    def draw(self, n: int, rng: Random = 1) -> list[CalibrationWCS]:
        """Random draws from the posterior of the WCS.

        Each draw is a WCS of the same chip without errors.  The coefficients are drawn from the
        posterior; the further errors of the calibration are not drawn.

        Parameters
        ----------
        n : int
            Number of draws.
        rng : int or numpy.random.Generator
            Seed or random generator.

        Returns
        -------
        list of CalibrationWCS

        Raises
        ------
        InputError
            If the calibration has no errors of the coefficients, or `n` is negative.
        """
        n = whole_number(n, "the number of draws", least=0, where="draw")
        if self.calibration.errors == "none":
            raise InputError(
                "has no coefficient errors to draw",
                where=self.calibration.name,
                do="use a run, or a file that contains the covariance",
            )
        solution = self.calibration.solution
        exact = np.zeros((solution.model.n_params,) * 2)
        out = []
        for k, theta in enumerate(solution.draws(n, generator_of(rng)), start=1):
            name = f"{self.calibration.name}, draw {k}"
            calibration = replace(
                self.calibration,
                name=name,
                solution=GaussianSolution(solution.model, theta, exact),
                errors="none",
                further=(),
            )
            drawn = replace(self, calibration=calibration)
            # set the cached map, which would be slow to compute for thousands of draws
            drawn.__dict__["chip_map"] = replace(
                self.chip_map, name=name, coefficients=theta.reshape(2, -1), cov=None
            )
            out.append(drawn)
        return out

    # -- other objects ----------------------------------------------------------------------------

    def to_model(self) -> Model:
        """Compound model of astropy.modeling from 0-based pixels to the world, with its inverse.

        Returns
        -------
        astropy.modeling.Model
            Model with inputs x and y and outputs right ascension and declination in degrees, or u
            and v.  Its inverse uses Newton's method, like `world_to_pixel_values`.
        """
        return self._model(None)

    def _model(self, inverse_order: int | None) -> Model:
        plane = plane_model(self.chip_map, inverse_order)
        return plane if self.placement is None else sky_model(plane, self.placement)

    def to_gwcs(self, *, inverse_order: int | None = None) -> GWCS:
        """WCS of the package gwcs, with the same map and its inverse.

        Parameters
        ----------
        inverse_order : int, optional
            Order of a polynomial inverse that is fitted over the chip and can be stored in ASDF
            files.  By default the inverse uses Newton's method, and the WCS cannot be written to a
            file.

        Returns
        -------
        gwcs.WCS
            WCS from the frame ``detector`` in pixels to the frame ``world``, ICRS or u and v.  It
            has no bounding box.  If you set one, as in ``w.bounding_box = wcs.bounding_box``, gwcs
            rejects positions outside the range of the four corners.  These include some pixels at
            curved edges, and all pixels if the chip contains a celestial pole.

        Raises
        ------
        InputError
            If gwcs is not installed, or a polynomial inverse is requested for a chip with look-up
            tables after the polynomial.
        """
        try:
            import gwcs
            from gwcs import coordinate_frames as frames
        except ImportError:
            raise InputError(
                "gwcs is not installed", where="to_gwcs", do="install gwcs 1.0 or newer"
            ) from None
        pixel = (units.pix, units.pix)
        detector = frames.Frame2D(name="detector", axes_names=self.pixel_axis_names, unit=pixel)
        if self.placement is None:
            unit = units.Unit(self.calibration.unit)
            world = frames.Frame2D(
                name="world",
                axes_names=self.world_axis_names,
                unit=(unit, unit),
                axis_physical_types=self.world_axis_physical_types,
            )
        else:
            world = frames.CelestialFrame(
                name="world", reference_frame=ICRS(), unit=(units.deg, units.deg)
            )
        out = gwcs.WCS([(detector, self._model(inverse_order)), (world, None)])
        out.pixel_shape = self.pixel_shape
        return out

    def to_fits_sip(self, *, max_residual: float = 0.0) -> WCS:
        """WCS of astropy.wcs with SIP polynomials.

        It is exact for polynomials up to order 9 without look-up tables.  Otherwise a polynomial of
        order 9 is fitted over the chip, and accepted if its residuals are at most `max_residual`.

        Parameters
        ----------
        max_residual : float
            Largest accepted distance, in pixels, between the fitted polynomial and the map.

        Returns
        -------
        astropy.wcs.WCS
            `to_header(relax=True)` writes it as a FITS header.

        Raises
        ------
        InputError
            If the plane has no position on the sky, or the fitted polynomial deviates from the map
            by more than `max_residual`; the message states the largest and rms distance.
        """
        placement = self.placement
        if placement is None:
            raise InputError(
                "has no position on the sky, which a SIP header requires",
                where=self.calibration.name,
                do="give the argument point of wcs, the sky position of u, v = 0",
            )
        allowed = value_in(max_residual, "pix", "max_residual", where="to_fits_sip")
        if not allowed >= 0:
            raise InputError(
                f"max_residual is {max_residual}",
                where="to_fits_sip",
                do="give a distance in pixels, 0 or more",
            )
        chip_map, worst, rms = self.chip_map.polynomial(
            min(self.chip_map.basis.order, SIP_ORDER)
            if not (self.chip_map.before or self.chip_map.after)
            else SIP_ORDER
        )
        if worst > allowed:
            raise InputError(
                f"look-up tables or terms above order {SIP_ORDER} cannot be written in SIP: a "
                f"polynomial of order {chip_map.basis.order} differs by up to {worst:.2g} pixels "
                f"(rms {rms:.2g})",
                where=self.calibration.name,
                do=f"give max_residual={_rounded_up(worst):g} to accept that, or use to_gwcs",
            )
        return load_object(hooks.FITS_WCS)("sip", self._on_tangent_plane(chip_map), placement.point)

    def _on_tangent_plane(self, chip_map: ChipMap) -> Calibration:
        """Calibration of the chip with u to the east and v to the north, in arcsec."""
        placement = self.placement
        assert placement is not None
        K = chip_map.basis.n_terms
        model = replace(self.calibration.model, order=chip_map.basis.order, unit="arcsec")
        matrix = np.asarray(np.kron(placement.matrix, np.eye(K)), float)
        cov = np.zeros((2 * K, 2 * K)) if chip_map.cov is None else chip_map.cov
        source = GaussianSolution(model, chip_map.coefficients.ravel(), cov)
        return Calibration(
            self.calibration.name,
            source.transformed(model, ParameterMap(matrix), matrix),
            Plane("sky", point=placement.point),
            errors=self.calibration.errors,
            notes=self.calibration.notes,
        )

    # -- in words ---------------------------------------------------------------------------------

    def __repr__(self) -> str:
        nx, ny = self.pixel_shape
        name = self.calibration.name.rpartition("/")[2]
        lines = [f"<CalibrationWCS of {name!r}, chip {self.chip}, {nx} x {ny} pixels"]
        x, y = (nx - 1) / 2, (ny - 1) / 2
        try:
            lines += self._centre_lines(x, y)
        except BayesdistError as error:
            lines.append(f"  {error.cause}")
        lines.append(f"  {'1 sigma':<9} {self._sigma_words(x, y)}")
        lines += [f"  {'note':<9} {note}" for note in self.chip_map.notes]
        return "\n".join(lines) + ">"

    def _centre_lines(self, x: float, y: float) -> list[str]:
        """Lines that state the position of the centre, the pixel scale and the parity."""
        world = self.pixel_to_world_values(x, y)
        slope = self.chip_map.slope(x + 1.0, y + 1.0)[0]
        if self.placement is None:
            unit, across = self.calibration.unit, np.hypot(*slope)
            return [
                f"  centre    u {world[0]:.6g}, v {world[1]:.6g} {unit}; not on the sky: give wcs "
                "the point",
                f"  pixel     {across[0]:.6g} x {across[1]:.6g} {unit}, "
                + ("u, v as x, y" if np.linalg.det(slope) > 0 else "u, v mirrored against x, y"),
            ]
        [step] = self.placement.steps(*(np.array([w]) for w in world)) @ slope / 1e3
        across = np.hypot(*step)
        angle = np.degrees(np.arctan2(step[0, 1], step[1, 1]))
        sky = np.linalg.det(step) < 0
        return [
            f"  centre    RA {world[0]:.7f}, Dec {world[1]:+.7f} deg (ICRS)",
            f"  pixel     {across[0]:.6g} x {across[1]:.6g} arcsec, +y at position angle "
            f"{angle:.4g} deg, {'parity as on the sky' if sky else 'a mirror image of the sky'}",
        ]

    def _sigma_words(self, x: float, y: float) -> str:
        """Standard deviations per axis at the centre and in the worst corner, in words."""
        corners = ([x, 0.0, 2 * x, 0.0, 2 * x], [y, 0.0, 0.0, 2 * y, 2 * y])
        try:
            cov = self.covariance(*corners)
        except InputError:
            return "not known"
        sigma = np.sqrt(np.trace(cov.value, axis1=1, axis2=2) / 2)
        unit = self.calibration.unit if self.placement is None else "mas"
        centre, corner = number(sigma[0], 2), number(sigma[1:].max(), 2)
        return f"{centre} {unit} at the centre, {corner} {unit} in the worst corner, along an axis"


def wcs_of_chip(
    calibration: Calibration,
    chip: int | None,
    *,
    epoch: Epoch | None,
    point: Direction | None,
    position_angle: Number | None,
    mirrored: bool,
    pixel_scale: Number | None,
) -> CalibrationWCS:
    """WCS of a chip; see `Calibration.wcs`."""
    number = chosen_chip(calibration.numbers, chip, where=calibration.name)
    date = None if epoch is None else year_of(epoch)
    calibration.at(date)  # raises an error for an invalid date
    placement = None
    if calibration.plane.point is not None or point is not None:
        angle = scale = None
        if position_angle is not None:
            angle = value_in(position_angle, "deg", "position_angle", where="wcs")
        if pixel_scale is not None:
            scale = value_in(pixel_scale, "arcsec", "pixel_scale", where="wcs")
            if not (np.isfinite(scale) and scale > 0):
                raise InputError(
                    f"pixel_scale is {scale:g}",
                    where="wcs",
                    do="give the size of a pixel in arcsec, a positive number",
                )
        elif calibration.pixel_mas is not None:
            scale = calibration.pixel_mas / 1000
        _check_placement(calibration, angle, scale)
        placement = placement_of(
            calibration,
            None if point is None else direction_in(point, "point", where="wcs"),
            position_angle=angle,
            mirrored=mirrored,
            pixel_scale=scale,
        )
    elif position_angle is not None or mirrored or pixel_scale is not None:
        raise InputError(
            "has no position on the sky, so that directions and scale of u and v are undefined",
            where=calibration.name,
            do="also give the point, the sky position of u, v = 0",
        )
    return CalibrationWCS(_at_date(calibration, number, date), placement)


def _check_placement(
    calibration: Calibration, position_angle: float | None, pixel_scale: float | None
) -> None:
    """Raise InputError if the direction or the scale of a plane on the sky is missing."""
    if calibration.plane.kind == "aperture" and position_angle is None:
        raise InputError(
            "is in the plane of an aperture, and its orientation on the sky is unknown",
            where=calibration.name,
            do="give position_angle, that of V3 (or of v, if V3 is unknown) at the point",
        )
    if calibration.unit == "pix" and not (
        pixel_scale is not None and np.isfinite(pixel_scale) and pixel_scale > 0
    ):
        raise InputError(
            "has u and v in pixels of unknown size"
            if pixel_scale is None
            else f"has u and v in pixels, but pixel_scale is {pixel_scale:g}",
            where=calibration.name,
            do="give pixel_scale in arcsec, a positive number",
        )


def _at_date(calibration: Calibration, number: int, epoch: float | None) -> Calibration:
    """Calibration of one chip at a date; the draws of its solution are kept."""
    date = calibration.reference_date if epoch is None else epoch
    return replace(
        calibration,
        solution=at_exposure(calibration.solution, epoch=date, chips=(number,)),
        before=tuple(t for t in calibration.before if t.chip == number),
        after=tuple(t for t in calibration.after if t.chip == number),
        inverses={k: v for k, v in calibration.inverses.items() if k == number},
        reference_date=None,
        undated="",
        no_date="",
        with_plane=None,
    )


def _rounded_up(value: float) -> float:
    """Value rounded up to two significant digits."""
    step = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(np.ceil(value / step) * step)


def _flat(*arrays: ArrayLike) -> tuple[Float, Float, tuple[int, ...]]:
    """Broadcast and flatten two arrays; returns both (N,) and their common shape."""
    try:
        first, second = np.broadcast_arrays(*(np.asarray(array, float) for array in arrays))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"x and y are not positions ({error})",
            do="give numbers, or arrays of the same shape",
        ) from error
    return first.ravel(), second.ravel(), first.shape
