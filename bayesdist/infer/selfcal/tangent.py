"""Exposures on the sky: each has its own tangent plane, and frames join these as if it were flat.

A camera maps the plane that touches the sky where it points.  The planes of two exposures are not
related by a shift and a rotation: the difference grows with the square of the position and with the
offset.  Offsets are those of the current solution, so that the difference is known, and detections
are moved by it to the pixels at which they would be on one plane.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesdist.data.detections import Detections
from bayesdist.data.sky.tangent import ARCSEC
from bayesdist.model import DistortionModel
from bayesdist.utils.arrays import Float

STEPS = 3  # of Newton's method, each of which leaves a hundredth or less


@dataclass(frozen=True, eq=False)
class TangentPlane:
    """Plane of u and v, common to all exposures.

    The plane of an exposure touches the sky where the reference pixel of the first chip points, so
    that the distortion does not depend on the detections or on which exposure is the first one.
    """

    unit_arcsec: float  # size of the unit of u and v
    # point of contact of the common plane with the sky, in u and v; by default the mean of those
    # of the exposures
    point: tuple[float, float] | None = None

    def contact(self, contacts: Float) -> Float:
        """Point of contact (2,) of the common plane, given those (E, 2) of the exposures."""
        return contacts.mean(axis=0) if self.point is None else np.asarray(self.point, float)

    def displacements(self, flat: Float, touches: Float, contact: Float) -> Float:
        """Displacements (N, 2) from positions on the plane of an exposure to the common plane.

        `flat` (N, 2): positions by the frame of the exposure, which are exact at its point of
        contact `touches` (2,). `contact` (2,): that of the common plane. Result: (N, 2), in the
        unit of u and v.
        """
        radian = ARCSEC / self.unit_arcsec
        p = (touches - contact) / radian
        q = (flat - touches) / radian
        c = 1.0 / np.sqrt(1.0 + p @ p)
        s = c * p
        # the rotation that maps one point of contact to the other, and turns nothing else
        along = (q @ s)[:, None]
        exact = (q - s * along / (1.0 + c) + s) / (c - along)
        return np.asarray(radian * (exact - p - q))

    def onto_it(self, model: DistortionModel, detections: Detections, theta: Float) -> Detections:
        """Detections at the pixels where they would be if all exposures' planes were this one.

        `detections`: as they were seen. `theta` (D,): a solution: offsets and distortion. Result:
        at the pixels that the frames alone map to the position on this plane.
        """
        flat = places_of(model, detections, theta)
        contacts = contacts_of(model, theta, detections.epoch)
        contact = self.contact(contacts)
        moved = np.empty_like(flat)
        for e, touches in enumerate(contacts):
            here = detections.exposure == e
            moved[here] = self.displacements(flat[here], touches, contact)
        aim, out = flat + moved, detections
        slopes = model.slopes(theta, detections.x, detections.y, **_where(model, detections))
        back = np.linalg.inv(slopes)
        for _ in range(STEPS):
            step = np.einsum("nab,nb->na", back, aim - places_of(model, out, theta))
            out = replace(out, x=out.x + step[:, 0], y=out.y + step[:, 1])
        return out


def contacts_of(model: DistortionModel, theta: Float, epoch: Float | None = None) -> Float:
    """Positions (E, 2) of the first chip's reference pixel, where the exposures touch the sky.

    `epoch` (E,): dates of the exposures, which a model with a drift needs.
    """
    E, chip = len(model.exposures), model.chips[0]
    x, y = (np.full(E, z) for z in chip.reference_pixel)
    when = None if model.time is None else epoch
    return model.predict(theta, x, y, exposure=np.arange(E), chip=chip.number, epoch=when)


def places_of(
    model: DistortionModel, detections: Detections, theta: Float, dilation: Float | None = None
) -> Float:
    """Sky position (N, 2) of each detection by the model."""
    out = model.predict(theta, detections.x, detections.y, **_where(model, detections))
    if dilation is None:
        return out
    o = np.asarray(model.origin)
    return np.asarray(o + (out - o) * dilation[detections.exposure, None])


def _where(model: DistortionModel, detections: Detections) -> dict[str, Any]:
    """Exposure, chip and epoch of each detection, as `DistortionModel.predict` takes them."""
    when = None
    if model.time is not None and detections.epoch is not None:
        when = detections.epoch[detections.exposure]
    return {"exposure": detections.exposure, "chip": detections.chip, "epoch": when}
