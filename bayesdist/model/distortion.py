"""Distortion model: structure without values, and its predictions.

For a star on chip c in exposure e at epoch t, at FITS pixel (x, y):

    w = sum_k C_ck(t) phi_k(x, y)          (u, v) = T_e(w) = o + d_e + M_e (w - o)

With `chip_deviations` every chip but the first, whose reference pixel lies at c, deviates itself:

    w' = w + d_ec + L_ec (w - c)     (u, v) = o + d_e + M_e (w' - o) - (M_e - R_e) (c - o)

T_e of a polynomial is a polynomial, so every (chip, exposure, epoch) has *effective coefficients*.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.errors import InputError
from bayesdist.model.effective import EffectiveCoefficients
from bayesdist.model.grouping import Groups, group_by
from bayesdist.utils.arrays import Float, Int

NO_EXPOSURE = -1  # code of the polynomial itself where it is no exposure's


@dataclass(frozen=True)
class DistortionModel(EffectiveCoefficients):
    """Structure of a distortion solution, without its values.

    theta holds first the *global* parameters (Legendre coefficients of each chip and axis, then
    the time-dependent terms of each chip), then one *local* block for each exposure but the first.

    Polynomials and frames are determined only together: what all frames have in common is a change
    of the polynomials.  The *gauge* separates the two.

    - "first": the frame of the first exposure is the identity.  The polynomials are those of that
      exposure, with its shift, roll angle, scale and shear.
    - "held": the first exposure's shift and rotation are held at given values, exactly: they are no
      parameters.  Its scale and shear are parameters like those of all others, and stand at the end
      of the global ones.  Then scale and shear are *deviations* from polynomials that belong to no
      exposure, and need a prior by which they scatter about zero; without it they are
      degenerate with the linear terms, and `fit_linear` says so.  Held at the first exposure's roll
      and zero point, the polynomials lie along the detector's axes, and so do the shears.

    Parameters
    ----------
    order : int
        Total polynomial order, 1 to 12.
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
        True where every chip but the first one has linear deviations of its own in each exposure.
        Needs gauge 'held': they have to scatter about zero as the others do.  Scale and shear of a
        frame then act on each chip about its own reference pixel, so that the distance between the
        chips, a lever of thousands of pixels, does not pass for a measurement of their scale.

    Raises
    ------
    InputError
        For an unknown kind of frame, no chip, a time-dependent term above the order, or a gauge
        that does not go with the frames.

    Examples
    --------
    >>> chip = bd.Chip(1, "W2", (1016, 1016), (508.5, 508.5))
    >>> model = bd.DistortionModel(3, (chip,))
    >>> model.n_params  # ten coefficients along each axis
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
            if codes.size and not (codes.min() >= 0 and codes.max() < len(self.exposures)):
                raise InputError(f"exposure codes must lie in 0..{len(self.exposures) - 1}")
            return codes
        known = {name: code for code, name in enumerate(self.exposures)}
        flat = [str(name) for name in np.atleast_1d(exposure).ravel()]
        unknown = [name for name in flat if name not in known]
        if unknown:
            raise InputError(f"there is no exposure {unknown[0]!r}")
        return np.array([known[name] for name in flat], np.int64).reshape(np.shape(exposure))

    def drift_terms(self, chip: int | None = None) -> Float:
        """Legendre coefficients (n terms, K) of the monomials of a chip (by number) that drift."""
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
        """Derivatives of the positions by the pixel.

        Parameters
        ----------
        theta : array_like, shape (n_params,)
        x, y, epoch, exposure, chip
            As in `predict`.

        Returns
        -------
        ndarray, shape (N, 2, 2)
            [[du/dx, du/dy], [dv/dx, dv/dy]], in the unit of u, v per pixel.
        """
        px, py = np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(y))
        groups = self.groups(px.size, epoch=epoch, exposure=exposure, chip=chip)
        return self.linearised(theta, groups, px, py)[1]

    def linearised(
        self, theta: ArrayLike, groups: Groups, x: Float, y: Float
    ) -> tuple[Float, Float]:
        """Positions of pixels, and their derivatives by the pixel.

        Parameters
        ----------
        theta : array_like, shape (n_params,)
        groups : Groups
            Of the pixels.
        x, y : ndarray, shape (N,)

        Returns
        -------
        position : ndarray, shape (N, 2)
        slope : ndarray, shape (N, 2, 2)
            As of `slopes`.
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
        """Size of a pixel in the unit that u and v are counted in, even if that is called pixels.

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

    def to_dict(self) -> dict[str, Any]:
        """Structure as JSON-able data, for files."""
        values = {one.name: getattr(self, one.name) for one in fields(self) if one.init}
        return _plain(values)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> DistortionModel:
        """Model that `to_dict` described.

        Raises
        ------
        InputError
            For a description that lacks a value, or has one too many or of another type: an
            earlier version may have meant something else by it.
        """
        from pydantic import TypeAdapter, ValidationError  # 0.1 s that others need not wait for

        names = {one.name for one in fields(cls) if one.init}
        faults = [f"{name!r} is missing" for name in sorted(names - set(data))]
        faults += [f"{name!r} is not known" for name in sorted(set(data) - names)]
        if not faults:
            try:
                return TypeAdapter(cls).validate_json(json.dumps(data), strict=True)
            except ValidationError as error:
                first = error.errors()[0]
                faults = [f"{'.'.join(map(str, first['loc']))!r}: {first['msg']}"]
        raise InputError(
            f"another version wrote this description, or it is damaged: {faults[0]}",
            where="model",
            do="fit again",
        )


def _plain(value: Any) -> Any:
    """A value as JSON has it: mappings, lists, numbers and texts."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(one) for one in value]
    return value.item() if isinstance(value, np.generic) else value
