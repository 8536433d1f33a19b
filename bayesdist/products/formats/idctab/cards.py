"""Primary header of an IDCTAB of ours: its drift, and the origin of its numbers.

==================  ==========================================================================
BDVAFAC, BDUNIT     velocity aberration that was divided out; unit of u and v in the fit
BDU0_c, BDV0_c      constant of chip c that went into V2REF and V3REF
BDANGLE, BDSCALE    similarity from (u, v) to (Xc, Yc); sigmas BDANGSIG, BDSCASIG
BDV2SIG, BDV3SIG    sigmas of V2 and V3 of (u, v) = (0, 0)
BDAGRRMS, BDAGRMAX  distance to the reference table when the similarity is taken out
BDCLOS_c            worst closure of the INVERSE rows of chip c
==================  ==========================================================================
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesdist.calibration.calibration import Calibration
from bayesdist.calibration.plane import Orientation
from bayesdist.products.formats.common.cards import number_card, text_card, wrapped_cards
from bayesdist.products.formats.idctab.hdus import Piece
from bayesdist.products.formats.idctab.numbers import ChipNumbers

__all__ = ["closure_cards", "provenance_cards", "tdd_cards"]


def tdd_cards(fitted: Sequence[ChipNumbers], epoch: float | None, acs_wfc: bool) -> list[str]:
    """Time-dependent terms of ACS/WFC in the scheme of 2015, zeros where none was fitted."""
    if not acs_wfc:
        return []
    comment = "" if epoch is not None else "no time-dependent terms"
    cards = [number_card("TDD_DATE", 2004.5 if epoch is None else epoch, "[yr] reference date")]
    rates = {name: f.column(name) for f in fitted for name in f.names if name.startswith("TDD")}
    for chip in (1, 2):  # stwcs looks for TDD_CTB1 to know the scheme, whatever the chip
        rates.setdefault(f"TDD_CTB{chip}", 0.0)
    for name in sorted(rates):
        cards.append(number_card(name, rates[name], comment or "[arcsec/pix/yr]"))
    return cards


def provenance_cards(
    fitted: Sequence[ChipNumbers], vafactor: float, calibration: Calibration
) -> list[str]:
    """Cards on the origin of the numbers: unit and constants of the fit, and the orientation."""
    orientation = calibration.plane.orientation
    unit = calibration.unit if orientation is None else orientation.base.model.unit
    cards = [
        text_card("CREATOR", "bayesdist"),
        number_card("BDVAFAC", float(vafactor), "VAFACTOR that was divided out"),
        text_card("BDUNIT", unit, "unit of u and v in the fit"),
    ]
    for f in fitted:
        for axis, value in zip("UV", f.constant, strict=True):
            keyword = f"BD{axis}0_{f.chip.number}"
            cards.append(number_card(keyword, float(value), "[arcsec] constant, now in V2/V3REF"))
    return cards if orientation is None else cards + _orientation_cards(orientation, vafactor)


def _orientation_cards(orientation: Orientation, vafactor: float) -> list[str]:
    """Cards on the orientation, its error and its agreement with the reference."""
    sigma = orientation.sigma
    scale = orientation.scale / vafactor
    degrees = np.rad2deg([orientation.angle, sigma["angle"]]).tolist()
    cards = [
        number_card("BDANGLE", degrees[0], "[deg] from (u, v) to (Xc, Yc)"),
        number_card("BDANGSIG", degrees[1], "[deg] 1-sigma of BDANGLE"),
        number_card("BDSCALE", scale, "[arcsec] one unit of u and v"),
        number_card("BDSCASIG", scale * sigma["log_scale"], "[arcsec] 1-sigma of BDSCALE"),
        number_card("BDV2SIG", sigma["shift_x"], "[arcsec] 1-sigma of V2 of (u, v) = 0"),
        number_card("BDV3SIG", sigma["shift_y"], "[arcsec] 1-sigma of V3 of (u, v) = 0"),
        number_card("BDAGRRMS", orientation.agreement.rms, "[mas] rms distance to reference"),
        number_card("BDAGRMAX", orientation.agreement.worst, "[mas] largest distance"),
    ]
    return cards + wrapped_cards("HISTORY", [f"V2/V3: {orientation.source}"], 72)


def closure_cards(pieces: Sequence[Piece]) -> list[str]:
    """Cards on the closure of INVERSE with FORWARD rows, the worst of all filters for each chip."""
    worst: dict[int, float] = {}
    for piece in pieces:
        for f, back in zip(piece.fitted, piece.inverse, strict=False):
            worst[f.chip.number] = max(worst.get(f.chip.number, 0.0), back.closure)
    return [
        number_card(f"BDCLOS_{chip}", value, "[pix] worst closure of INVERSE at TDD_DATE")
        for chip, value in worst.items()
    ]
