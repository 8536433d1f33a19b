"""Distortion model: parameters, predicted positions, and their derivatives.

The position (u, v) of a star on chip c in exposure e at epoch t, measured at FITS pixel (x, y), is

    w = sum_k C_ck(t) phi_k(x, y)          (u, v) = T_e(w) = o + d_e + M_e (w - o)

where phi_k are the Legendre products of `PolynomialBasis` and T_e is the frame of the exposure.
With `chip_deviations` every chip except the first has an additional linear transformation about
the position c of its reference pixel:

    w' = w + d_ec + L_ec (w - c)     (u, v) = o + d_e + M_e (w' - o) - (M_e - R_e) (c - o)

T_e of a polynomial is again a polynomial.  The coefficients of this polynomial for one chip,
exposure and epoch are called *effective coefficients*.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.errors import InputError
from bayesdist.model.effective import EffectiveCoefficients, Groups, group_by
from bayesdist.utils.arrays import Float, Int

NO_EXPOSURE = -1  # exposure code that stands for the polynomial without any exposure frame


@dataclass(frozen=True)
class DistortionModel(EffectiveCoefficients):
    """Parametric form of a distortion solution, without parameter values.

    The parameter vector theta starts with the *global* parameters: the Legendre coefficients of
    each chip and axis, followed by the time-dependent terms of each chip.  They are followed by one
    *local* block per exposure, except for the first exposure.

    A transformation that is common to all frames is degenerate with the polynomials.  The *gauge*
    removes this degeneracy:

    - "first": the frame of the first exposure is the identity.  The polynomials include the shift,
      roll angle, scale and shear of that exposure.
    - "held": the shift and rotation of the first exposure are fixed at the values in `held` and are
      not parameters.  Its scale and shear are parameters, as for all other exposures, at the end of
      the global parameters.  Scale and shear are then *deviations* from polynomials that do not
      belong to any single exposure.  They require a prior with zero mean; without it they are
      degenerate with the linear terms, and `fit_linear` reports this.  If the first exposure is
      held at its roll angle and zero point, the polynomials and shears are aligned with the
      detector axes.

    Parameters
    ----------
    order : int
        Total polynomial order, 1 to 12.
    chips : tuple of Chip
    unit : str
        Unit of u and v.
    time : TimeDependence, optional
        Linear drift of some terms.  These terms are monomials of (x - xref) / (nx / 2) and
        (y - yref) / (ny / 2), so that a rate is the drift, in the unit of u and v per year, at half
        the chip's size from the reference pixel.
    frames : str
        Transformation of each exposure, one of `FRAME_KINDS`.
    exposures : tuple of str
        Names of the exposures; the first one defines the gauge.
    origin : tuple of float
        Point (u, v) about which frames rotate and scale.
    gauge : str
        'first' or 'held'.
    held : tuple of float
        Shift_u, shift_v (unit of u and v) and rotation (radians) of the first exposure, for the
        gauge 'held'.
    chip_deviations : bool
        True if every chip except the first has an additional linear deviation in each exposure.
        It requires the gauge 'held', since these deviations also need a prior with zero mean.
        Scale and shear of a frame then act on each chip about the reference pixel of that chip.
        Otherwise the distance between the chips, thousands of pixels, would be taken for a precise
        measurement of their scale.

    Raises
    ------
    InputError
        If the kind of frame is unknown, no chip is given, a time-dependent term exceeds the order,
        or the gauge is incompatible with the frames.

    Examples
    --------
    >>> chip = bd.Chip(1, "W2", (1016, 1016), (508.5, 508.5))
    >>> model = bd.DistortionModel(3, (chip,))
    >>> model.n_params  # ten coefficients per axis
    20
    >>> model.predict(np.zeros(20), [1.0, 508.5], [1.0, 508.5])
    array([[0., 0.],
           [0., 0.]])
    """

    def groups(
        self,
        n: int,
        *,
        epoch: ArrayLike | None = None,
        exposure: ArrayLike | None = None,
        chip: ArrayLike | None = None,
    ) -> Groups:
        """Group stars that have the same effective coefficients.

        Parameters
        ----------
        n : int
            Number of stars.
        epoch : array_like, optional
            Decimal years, scalar or shape (n,); required by a model with time dependence.
        exposure : array_like, optional
            Indices into `exposures`, or names, scalar or shape (n,).  By default the polynomial
            without an exposure frame is used.
        chip : array_like, optional
            Chip numbers, scalar or shape (n,); the first chip by default.

        Returns
        -------
        Groups

        Raises
        ------
        InputError
            If a chip or exposure is unknown or the epoch is missing.
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
                raise InputError(
                    "the model depends on time, but no epoch is given", do="give an epoch"
                )
            time = np.broadcast_to(np.asarray(epoch, float), (n,))
        return group_by(codes, np.asarray(frame, np.int64), time)

    def _exposure_codes(self, exposure: NDArray[np.generic]) -> Int:
        if np.issubdtype(exposure.dtype, np.integer):
            codes = exposure.astype(np.int64)
            if codes.size and not (codes.min() >= 0 and codes.max() < len(self.exposures)):
                raise InputError(
                    f"exposure codes must be from 0 to {len(self.exposures) - 1}",
                    do="give the codes or the names of exposures of this model",
                )
            return codes
        code_of = {name: code for code, name in enumerate(self.exposures)}
        flat = [str(name) for name in np.atleast_1d(exposure).ravel()]
        unknown = [name for name in flat if name not in code_of]
        if unknown:
            raise InputError(
                f"there is no exposure {unknown[0]!r}",
                do=f"choose one of the {len(self.exposures)} exposures of the model, the first of "
                f"which is {self.exposures[0]!r}",
            )
        return np.array([code_of[name] for name in flat], np.int64).reshape(np.shape(exposure))

    def drift_terms(self, chip: int | None = None) -> Float:
        """Legendre coefficients (n drifting terms, K) of the drifting monomials.

        `chip` is a chip number (default: the first chip).
        """
        return self.drift_columns[0][0 if chip is None else self.chip_code(chip)]

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
        """Predicted positions (u, v) of detector pixels.

        Parameters
        ----------
        theta : array_like, shape (..., n_params)
            One or more parameter vectors.
        x, y : array_like, shape (N,)
            FITS 1-based pixels.
        epoch, exposure, chip : array_like, optional
            See `groups`; each is a scalar or has shape (N,).

        Returns
        -------
        ndarray, shape (..., N, 2)
            In the unit of u, v.

        Raises
        ------
        InputError
            If theta has a wrong length, or an argument is invalid (see `groups`).
        """
        theta = self._checked(theta)
        x, y = np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(y))
        groups = self.groups(x.size, epoch=epoch, exposure=exposure, chip=chip)
        E = self.effective(theta, groups)
        out = np.empty((*theta.shape[:-1], x.size, 2))
        for g, rows in enumerate(groups.members()):
            phi = self.bases[groups.chip[g]].evaluate(x[rows], y[rows])
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
        """Derivatives of the positions with respect to every parameter.

        Parameters
        ----------
        theta : array_like, shape (n_params,)
            Parameters of the model.
        x, y, epoch, exposure, chip
            See `predict`.

        Returns
        -------
        ndarray, shape (N, 2, n_params)
            In the unit of u and v per unit of each parameter.

        Raises
        ------
        InputError
            If theta has a wrong length, or an argument is invalid (see `groups`).
        """
        theta = self._checked(theta)
        x, y = np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(y))
        groups = self.groups(x.size, epoch=epoch, exposure=exposure, chip=chip)
        out = np.zeros((x.size, 2, self.n_params))
        jacobians = self.effective_jacobian(theta, groups)
        for g, (rows, (columns, d)) in enumerate(zip(groups.members(), jacobians, strict=True)):
            phi = self.bases[groups.chip[g]].evaluate(x[rows], y[rows])
            out[np.ix_(rows, np.arange(2), columns)] = np.einsum("nk,akm->nam", phi, d)
        return out

    def slopes(
        self,
        theta: ArrayLike,
        x: ArrayLike,
        y: ArrayLike,
        *,
        epoch: ArrayLike | None = None,
        exposure: ArrayLike | None = None,
        chip: ArrayLike | None = None,
    ) -> Float:
        """Derivatives of the positions with respect to the pixel coordinates.

        Parameters
        ----------
        theta : array_like, shape (n_params,)
            Parameters of the model.
        x, y, epoch, exposure, chip
            See `predict`.

        Returns
        -------
        ndarray, shape (N, 2, 2)
            [[du/dx, du/dy], [dv/dx, dv/dy]], in the unit of u and v per pixel.

        Raises
        ------
        InputError
            If theta has a wrong length, or an argument is invalid (see `groups`).
        """
        px, py = np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(y))
        groups = self.groups(px.size, epoch=epoch, exposure=exposure, chip=chip)
        return self.linearised(theta, groups, px, py)[1]

    def linearised(
        self, theta: ArrayLike, groups: Groups, x: Float, y: Float
    ) -> tuple[Float, Float]:
        """Predicted positions and their derivatives with respect to the pixel coordinates.

        Parameters
        ----------
        theta : array_like, shape (n_params,)
            Parameters of the model.
        groups : Groups
            Groups of the N pixels, from `groups`.
        x, y : ndarray, shape (N,)
            FITS 1-based pixels.

        Returns
        -------
        position : ndarray, shape (N, 2)
            In the unit of u and v.
        slope : ndarray, shape (N, 2, 2)
            See `slopes`.

        Raises
        ------
        InputError
            If theta has a wrong length.
        """
        effective = self.effective(self._checked(theta), groups)
        position, slope = np.empty((x.size, 2)), np.empty((x.size, 2, 2))
        for g, rows in enumerate(groups.members()):
            basis = self.bases[groups.chip[g]]
            phi = basis.evaluate(x[rows], y[rows])
            position[rows] = phi @ effective[g].T
            for axis, D in enumerate(basis.derivatives):
                slope[rows, :, axis] = phi @ (D @ effective[g].T)
        return position, slope

    def pixel_size(self, theta: ArrayLike, chip: int | None = None) -> float:
        """Pixel scale at the reference pixel of a chip, in the unit of u and v per pixel.

        Parameters
        ----------
        theta : array_like, shape (n_params,)
            Parameters of the model.
        chip : int, optional
            Chip number; the first chip by default.

        Returns
        -------
        float
            1 if the unit of u and v is the pixel; otherwise the square root of the pixel area,
            without drift and frames.

        Raises
        ------
        InputError
            If there is no such chip.
        """
        return 1.0 if self.unit == "pix" else self.linear_scale(theta, chip)

    def linear_scale(self, theta: ArrayLike, chip: int | None = None) -> float:
        """Pixel scale at the reference pixel, not assumed to be 1 even if u and v are in pixels.

        Parameters
        ----------
        theta, chip
            See `pixel_size`.

        Returns
        -------
        float
            Square root of the pixel area in the unit of u and v, without drift and frames.

        Raises
        ------
        InputError
            If there is no such chip.
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
                f"theta has {theta.shape[-1] if theta.ndim else 0} values, but the model has "
                f"{self.n_params} parameters",
                do="give one value per parameter, in the order of `names`",
            )
        return theta

    def to_dict(self) -> dict[str, Any]:
        """Model as data that can be written as JSON; see `from_dict`."""
        values = {item.name: getattr(self, item.name) for item in fields(self) if item.init}
        return _plain(values)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> DistortionModel:
        """Model from the data that `to_dict` returned.

        Raises
        ------
        InputError
            If a value is missing, unknown or of the wrong type.  Such data are not converted, since
            they may come from a version in which they had another meaning.
        """
        from pydantic import TypeAdapter, ValidationError  # takes 0.1 s to import

        names = {item.name for item in fields(cls) if item.init}
        faults = [f"{name!r} is missing" for name in sorted(names - set(data))]
        faults += [f"{name!r} is not known" for name in sorted(set(data) - names)]
        if not faults:
            try:
                return TypeAdapter(cls).validate_json(json.dumps(data), strict=True)
            except ValidationError as error:
                first = error.errors()[0]
                faults = [f"{'.'.join(map(str, first['loc']))!r}: {first['msg']}"]
        raise InputError(
            f"this model was written by another version or is damaged: {faults[0]}",
            where="model",
            do="fit again",
        )


def _plain(value: Any) -> Any:
    """Convert a value to the types of JSON: mappings, lists, numbers and strings."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(element) for key, element in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(element) for element in value]
    return value.item() if isinstance(value, np.generic) else value
