"""The covariance of the polynomials of one row of an IDCTAB, from its HDU COVAR."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayesdist.products.formats.common.coefficients import idctab_column
from bayesdist.products.idctab import FILTER_COLUMNS, IdcTab
from bayesdist.products.parity import parity_of
from bayesdist.products.tdd import RATES

__all__ = ["covariance_of_row", "jacobian_of_row"]

Float = NDArray[np.float64]


def covariance_of_row(
    tab: IdcTab,
    row: int,
    chip: int,
    epoch: float | None = None,
    *,
    reference_row: int | None = None,
    reference_chip: int | None = None,
) -> Float | None:
    """Covariance of the monomials of one row at a date.

    Parameters
    ----------
    tab : IdcTab
    row : int
    chip : int
        The chip that the row is of.
    epoch : float, optional
        Decimal years; without it that of the reference date.
    reference_row, reference_chip : int, optional
        Where they are given, the constant term is the place of the chip's zero point from that of
        this chip, along Xc and Yc; else it is exact.

    Returns
    -------
    ndarray, shape (2 K, 2 K), or None
        X before Y, in the order of `IdcTab.terms`; None where the file has no errors for the row.
    """
    jacobian = jacobian_of_row(
        tab, row, chip, epoch, reference_row=reference_row, reference_chip=reference_chip
    )
    if jacobian is None or tab.covariance is None:
        return None
    return jacobian @ np.asarray(tab.covariance["COV"], float) @ jacobian.T


def jacobian_of_row(
    tab: IdcTab,
    row: int,
    chip: int,
    epoch: float | None = None,
    *,
    reference_row: int | None = None,
    reference_chip: int | None = None,
) -> Float | None:
    """Derivatives of the monomials of one row by the numbers in COVAR.

    Parameters
    ----------
    tab, row, chip, epoch, reference_row, reference_chip
        As in `covariance_of_row`.

    Returns
    -------
    ndarray, shape (2 K, n), or None
        None where the file has no errors for the row.
    """
    entries = tab.covariance
    if entries is None:
        return None
    place = _numbers_of_row(tab, row, chip)
    if not place:
        return None
    terms, years = tab.terms, 0.0
    if epoch is not None and "TDD_DATE" in tab.tdd:
        years = epoch - tab.tdd["TDD_DATE"]
    jacobian = np.zeros((2 * len(terms), len(entries)))
    for n in range(2 * len(terms)):
        axis, (i, j) = "uv"[n // len(terms)], terms[n % len(terms)]
        column = idctab_column(tab.prefixes[n // len(terms)], i, j)
        rate = f"{RATES.get((axis, i, j), '')}{chip}"
        for key, factor in ((column, 1.0), (rate, years)):
            if key in place:
                jacobian[n, place[key]] = factor
    if reference_row is not None and reference_chip is not None and reference_chip != chip:
        other = _numbers_of_row(tab, reference_row, reference_chip)
        parity = parity_of(tab.instrument, tab.detector)
        for k, name in enumerate(("V2REF", "V3REF")):
            for numbers, sign in ((place, 1.0), (other, -1.0)):
                if name in numbers:
                    jacobian[k * len(terms), numbers[name]] = sign * parity[k]
    return jacobian if jacobian.any() else None


def _numbers_of_row(tab: IdcTab, row: int, chip: int) -> dict[str, int]:
    """Where the numbers of a row stand in COVAR, by name; empty where they do not."""
    entries = tab.covariance
    assert entries is not None
    listed = [str(name).strip() for name in entries["PARAM"]]
    mine = np.flatnonzero(entries["DETCHIP"].astype(int) == chip)
    own = [c for c in FILTER_COLUMNS if c in (entries.dtype.names or ())]
    if own:
        # numbers stand once for all filters that share them: found again by their values
        sets = {tuple(str(entries[c][k]).strip() for c in own) for k in mine}
        of_set = [
            [int(k) for k in mine if tuple(str(entries[c][k]).strip() for c in own) == one]
            for one in sorted(sets)
        ]
        same = [s for s in of_set if _is_of_row(tab, row, listed, s)]
        if not same:
            return {}
        # all filters share the drift, which stands with the first one
        rates = [k for k in mine if listed[k].startswith("TDD")]
        mine = np.array([*rates, *same[0]])
    return {listed[k]: int(k) for k in mine}


def _is_of_row(tab: IdcTab, row: int, listed: list[str], some: Sequence[int]) -> bool:
    entries = tab.covariance
    assert entries is not None
    return all(
        float(entries["VALUE"][k]) == float(tab.rows[listed[k]][row])
        for k in some
        if listed[k] in tab.columns and listed[k][0] in "CAB"
    )
