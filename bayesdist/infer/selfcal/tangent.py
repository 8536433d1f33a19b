"""Tangent planes of the exposures, and their mapping to a common plane.

A camera images the tangent plane at its pointing, but exposure frames treat the sky as flat.  The
planes of two exposures are not related by a shift and a rotation; the difference grows with the
square of the position and with the offset.  Since the offsets are known from the current solution,
detections are moved to the pixels where they would be on the common plane.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesdist.data.detections import Detections
from bayesdist.data.sky import ARCSEC
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float

STEPS = 3  # Newton steps, each of which reduces the error by a factor of 100 or more


@dataclass(frozen=True, eq=False)
class TangentPlane:
    """Tangent plane of u and v that is common to all exposures.

    The tangent point of an exposure is the position of the first chip's reference pixel, so that
    the distortion depends neither on the detections nor on the order of the exposures.

    Parameters
    ----------
    unit_arcsec : float
        Unit of u and v in arcseconds.
    point : tuple of float, optional
        Tangent point of the common plane in u and v; by default the mean of those of the exposures.
    """

    unit_arcsec: float
    point: tuple[float, float] | None = None

    def contact(self, contacts: Float) -> Float:
        """Tangent point (2,) of the common plane, from those (E, 2) of the exposures.

        Parameters
        ----------
        contacts : ndarray, shape (E, 2)

        Returns
        -------
        ndarray, shape (2,)
        """
        return contacts.mean(axis=0) if self.point is None else np.asarray(self.point, float)

    def displacements(self, flat: Float, touches: Float, contact: Float) -> Float:
        """Displacements from the tangent plane of an exposure to the common plane.

        Parameters
        ----------
        flat : ndarray, shape (N, 2)
            Positions according to the frame of the exposure, which are exact at its tangent point.
        touches : ndarray, shape (2,)
            Tangent point of the exposure.
        contact : ndarray, shape (2,)
            Tangent point of the common plane.

        Returns
        -------
        ndarray, shape (N, 2)
            Displacements in the unit of u and v.
        """
        radian = ARCSEC / self.unit_arcsec
        p = (touches - contact) / radian
        q = (flat - touches) / radian
        c = 1.0 / np.sqrt(1.0 + p @ p)
        s = c * p
        # the rotation along the great circle from one tangent point to the other
        along = (q @ s)[:, None]
        exact = (q - s * along / (1.0 + c) + s) / (c - along)
        return np.asarray(radian * (exact - p - q))

    def onto_it(self, model: DistortionModel, detections: Detections, theta: Float) -> Detections:
        """Move detections to the pixels where they would be if all exposures had this plane.

        Parameters
        ----------
        model : DistortionModel
        detections : Detections
            Observed detections.
        theta : ndarray, shape (D,)
            Parameters of a solution, which provide offsets and distortion.

        Returns
        -------
        Detections
            Detections at pixels that the model maps to the positions on the common plane.
        """
        flat = places_of(model, detections, theta)
        contacts = contacts_of(model, theta, detections.epoch)
        contact = self.contact(contacts)
        moved = np.empty_like(flat)
        for e, touches in enumerate(contacts):
            rows = detections.exposure == e
            moved[rows] = self.displacements(flat[rows], touches, contact)
        aim, out = flat + moved, detections
        slopes = model.slopes(theta, detections.x, detections.y, **_where(model, detections))
        back = np.linalg.inv(slopes)
        for _ in range(STEPS):
            step = np.einsum("nab,nb->na", back, aim - places_of(model, out, theta))
            out = replace(out, x=out.x + step[:, 0], y=out.y + step[:, 1])
        return out


def contacts_of(model: DistortionModel, theta: Float, epoch: Float | None = None) -> Float:
    """Tangent points (E, 2) of the exposures: positions of the first chip's reference pixel.

    `epoch` (E,) are the dates of the exposures, required by a model with drift.
    """
    E, chip = len(model.exposures), model.chips[0]
    x, y = (np.full(E, z) for z in chip.reference_pixel)
    when = None if model.time is None else epoch
    return model.predict(theta, x, y, exposure=np.arange(E), chip=chip.number, epoch=when)


def places_of(
    model: DistortionModel, detections: Detections, theta: Float, dilation: Float | None = None
) -> Float:
    """Sky position (N, 2) of each detection according to the model."""
    out = model.predict(theta, detections.x, detections.y, **_where(model, detections))
    if dilation is None:
        return out
    o = np.asarray(model.origin)
    return np.asarray(o + (out - o) * dilation[detections.exposure, None])


def _where(model: DistortionModel, detections: Detections) -> dict[str, Any]:
    """Exposure, chip and epoch of each detection, as keyword arguments of `predict`."""
    when = None
    if model.time is not None and detections.epoch is not None:
        when = detections.epoch[detections.exposure]
    return {"exposure": detections.exposure, "chip": detections.chip, "epoch": when}
