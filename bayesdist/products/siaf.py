"""An aperture of the Science Instrument Aperture File, as far as an orientation needs it."""

from __future__ import annotations

from dataclasses import dataclass

from bayesdist.errors import InputError

__all__ = ["Aperture", "read_aperture"]

# The aperture file counts the physical overscan, which calibrated images no longer have.
_OVERSCAN = {"J": 24.0}


@dataclass(frozen=True)
class Aperture:
    """Where an aperture lies, in the terms of the aperture file.

    Parameters
    ----------
    name : str
        As "JWFC2FIX".
    v2_ref, v3_ref : float
        V2Ref and V3Ref, arcseconds.
    v3_idl_y_angle : float
        V3IdlYAngle: of the ideal Y axis from V3 towards V2, degrees.
    v_idl_parity : int
        VIdlParity, 1 or -1.
    reference_pixel : tuple of float
        Pixel of the chip that lies at (V2Ref, V3Ref), FITS 1-based.
    source : str
        Where the numbers are from.
    """

    name: str
    v2_ref: float
    v3_ref: float
    v3_idl_y_angle: float
    v_idl_parity: int
    reference_pixel: tuple[float, float]
    source: str = "given as numbers"


def read_aperture(name: str, *, overscan: float | None = None) -> Aperture:
    """An HST aperture from the tables of pysiaf, which must be installed.

    Parameters
    ----------
    name : str
        As "JWFC2FIX".
    overscan : float, optional
        Columns of physical overscan that XSciRef counts and the chip's pixels do not; 24 for ACS
        (names that begin with J), 0 for others.

    Returns
    -------
    Aperture

    Raises
    ------
    InputError
        When pysiaf is not installed, or knows no such aperture.

    Notes
    -----
    pysiaf asks a web page for its newest version as soon as it is imported; without network it goes
    on with a remark.
    """
    try:
        import pysiaf
    except ImportError as error:
        raise InputError(
            "pysiaf is not installed",
            where=f"aperture {name}",
            do="install it, or give the numbers as an Aperture",
        ) from error
    apertures = pysiaf.Siaf("HST").apertures
    if name not in apertures:
        same = sorted(a for a in apertures if a[:4] == name[:4])
        raise InputError(
            "the aperture file has no such aperture",
            where=f"aperture {name}",
            do=f"choose one of {', '.join(same)}" if same else "check the name",
        )
    found = apertures[name]
    if overscan is None:
        overscan = _OVERSCAN.get(name[0], 0.0)
    if found.XSciRef is None or found.V3IdlYAngle is None:
        raise InputError(
            "the aperture has no reference pixel or no angle",
            where=f"aperture {name}",
            do="choose one that covers a single chip",
        )
    return Aperture(
        name,
        float(found.V2Ref),
        float(found.V3Ref),
        float(found.V3IdlYAngle),
        int(found.VIdlParity),
        (float(found.XSciRef) - overscan, float(found.YSciRef)),
        f"pysiaf, HST aperture file {pysiaf.HST_PRD_VERSION}",
    )
