"""The time-dependent terms of ACS/WFC in the primary header of an IDCTAB, as stwcs reads them.

    CX11 += CXB dt,  CY11 += CTB dt,  CY10 += CYB dt

with dt in years from TDD_DATE (scheme of 2015).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bayesdist.errors import InputError

__all__ = ["RATES", "drift", "scheme_of"]

# (axis, power of x, power of y) of a coefficient: the keyword of its rate, less the chip number.
RATES = {("u", 1, 0): "TDD_CXB", ("v", 1, 0): "TDD_CTB", ("v", 0, 1): "TDD_CYB"}


def scheme_of(keywords: Mapping[str, float]) -> str:
    """What stwcs makes of the keywords of an ACS/WFC table, in its order of trial.

    Parameters
    ----------
    keywords : mapping
        All keywords that begin with TDD.

    Returns
    -------
    str
        '2015' (TDD_CTB1 ...), '2014' (TDD_CYB1 ...), 'order' (TDDORDER with TDD_A, TDD_B), or
        'default': terms of 2004.5 that are written in its code.
    """
    for keyword, scheme in (("TDD_CTB1", "2015"), ("TDD_CYB1", "2014"), ("TDDORDER", "order")):
        if keyword in keywords:
            return scheme
    return "default"


def drift(
    keywords: Mapping[str, float],
    terms: tuple[tuple[int, int], ...],
    chip: int,
    epoch: float,
    where: str,
) -> NDArray[np.float64]:
    """What the terms add to the coefficients of a chip.

    Parameters
    ----------
    keywords : mapping
        All keywords that begin with TDD.
    terms : tuple of (int, int)
        Powers of the coefficients.
    chip : int
    epoch : float
        Decimal years.
    where : str
        Name of the file, for the error.

    Returns
    -------
    ndarray, shape (2, n_terms)

    Raises
    ------
    InputError
        For keywords of another scheme than that of 2015.
    """
    scheme = scheme_of(keywords)
    if scheme != "2015" or "TDD_DATE" not in keywords:
        raise InputError(
            f"time-dependent terms of the scheme {scheme!r} are not evaluated here",
            where=where,
            do="leave out the epoch, or use a table with TDD_DATE and TDD_CTB1",
        )
    out = np.zeros((2, len(terms)))
    for (axis, i, j), name in RATES.items():
        rate = keywords.get(f"{name}{chip}", 0.0)
        out["uv".index(axis), terms.index((i, j))] = rate * (epoch - keywords["TDD_DATE"])
    return out
