"""Mock of the optical model that the WISE report compares its bands with."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bayesdist.missions.wise.simulate import WISE_ARRAYS
from bayesdist.missions.wise.simulate.bringup import optical_model
from bayesdist.products import SipHeader, write_sip
from bayesdist.products.formats.common.cards import text_card

__all__ = ["STAND_IN_TURN", "write_stand_in"]

BAND = "W2"  # whose longest differences from the optical model the mock has
STAND_IN_TURN = 270

HISTORY = (
    "A made-up optical model: a stand-in, not the Code V model of WISE, whose",
    "coefficients are not published. It is the distortion of W2 plus a cubic",
    "field, so that its longest vector, and its longest difference from W2,",
    "are those of WSDC D-T033. It must be turned by 270 degrees to fit.",
)


def write_stand_in(path: Path) -> None:
    """Write the model as it was delivered: turned by 270 degrees it resembles all bands."""
    model, theta = optical_model(BAND, STAND_IN_TURN)
    array, basis = WISE_ARRAYS[BAND], model.basis()
    forward = basis.to_monomials(theta.reshape(2, -1))
    for axis, term in enumerate(((1, 0), (0, 1))):
        forward[axis, basis.terms.index(term)] -= 1.0
    forward[:, 0] = 0.0  # the rest at the reference pixel is rounding
    a, b = (dict(zip(basis.terms, map(float, one), strict=True)) for one in forward)
    nx, ny = array.size
    sip = SipHeader(
        crpix=array.centre,
        crval=(0.0, 0.0),
        cd=np.diag([-1.0, 1.0]) * array.scale / 3600,
        ctype=("RA---TAN-SIP", "DEC--TAN-SIP"),
        order=(model.order, model.order),
        a=a,
        b=b,
        size=(int(nx), int(ny)),
        cards=tuple(text_card("HISTORY", line) for line in HISTORY),
    )
    write_sip(sip, path)
