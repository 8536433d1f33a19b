"""CD matrix and image size of a FITS header."""

from __future__ import annotations

import numpy as np
from astropy.io import fits

from bayesdist.errors import FormatError
from bayesdist.utils.arrays import Float

CD_KEYWORDS = ("CD1_1", "CD1_2", "CD2_1", "CD2_2")
# Keywords that other headers have instead of a CD matrix.
LINEAR_KEYWORDS = (
    *("PC1_1", "PC1_2", "PC2_1", "PC2_2"),
    *("CDELT1", "CDELT2", "CROTA1", "CROTA2"),
)


def cd_matrix(header: fits.Header, where: str) -> Float:
    """CD matrix (2, 2), also from PC and CDELT or from CROTA2 (FITS 4.0, section 8.1).

    As in wcslib, CD takes precedence over PC, and PC over CROTA2.
    """
    if any(keyword in header for keyword in CD_KEYWORDS):
        return np.array([finite_number(header, k, where, 0.0) for k in CD_KEYWORDS]).reshape(2, 2)
    scale = np.array([finite_number(header, k, where, 1.0) for k in ("CDELT1", "CDELT2")])
    if "CROTA2" in header and not any(keyword in header for keyword in LINEAR_KEYWORDS[:4]):
        angle = np.deg2rad(finite_number(header, "CROTA2", where))
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[scale[0] * c, -scale[1] * s], [scale[0] * s, scale[1] * c]])
    pc = [
        finite_number(header, k, where, d)
        for k, d in zip(LINEAR_KEYWORDS[:4], (1.0, 0.0, 0.0, 1.0), strict=True)
    ]
    return scale[:, None] * np.array(pc).reshape(2, 2)


def image_size(header: fits.Header) -> tuple[int, int] | None:
    """Columns and rows stated in a header; None if it states none.

    A side of one pixel counts as a placeholder.

    A compressed image is a table with its size in ZNAXIS. HST headers have NPIX if all pixels have
    one value and there are no data.
    """
    pairs = [("ZNAXIS1", "ZNAXIS2"), ("IMAGEW", "IMAGEH"), ("NPIX1", "NPIX2")]
    if "TABLE" not in str(header.get("XTENSION", "")):
        pairs.insert(0, ("NAXIS1", "NAXIS2"))
    for names in pairs:
        n = [header.get(name, 0) for name in names]
        if all(isinstance(k, int | float) and k > 1 for k in n):
            return int(n[0]), int(n[1])
    return None


def finite_number(
    header: fits.Header, keyword: str, where: str, default: float | None = None
) -> float:
    """Value of a keyword, or the default.

    Raises FormatError if the keyword is missing and has no default, or if its value is not a finite
    number.
    """
    value = header.get(keyword, default)
    if value is None:
        raise FormatError("is missing", where=f"{where}, keyword {keyword}", do="add the keyword")
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise FormatError(
            f"value {value!r} is not a finite number",
            where=f"{where}, keyword {keyword}",
            do="correct the value",
        )
    return float(value)
