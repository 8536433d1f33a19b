"""Two chips of an IDCTAB in one plane, with the errors that they share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesdist.assess.comparison_gap import ChipPair
from bayesdist.products.chips_in_frame import chips_of_idctab
from bayesdist.products.idctab import IdcTab
from bayesdist.products.idctab_row_covariance import jacobian_of_row

__all__ = ["pair_of_idctab", "reference_first"]

Float = NDArray[np.float64]


def pair_of_idctab(
    tab: IdcTab,
    reference: int,
    other: int,
    *,
    filter: str | None = None,
    epoch: float | None = None,
) -> ChipPair:
    """Two chips of an IDCTAB.

    Parameters
    ----------
    tab : IdcTab
    reference, other : int
        Chip numbers.
    filter : str, optional
        Names of both wheels may be joined by a comma.
    epoch : float, optional
        Decimal years, for the time-dependent terms of the 2015 scheme.

    Returns
    -------
    ChipPair
        In arcseconds; with a covariance where the file has that of both.

    Raises
    ------
    InputError
        As `chips_of_idctab`.
    """
    chips = chips_of_idctab(tab, filter=filter, epoch=epoch)
    names = None if filter is None else [part.strip() for part in filter.split(",")]
    zero = next(iter(chips))  # whose zero point is that of the plane
    parts: list[Float] = []
    for number in (reference, other):
        found = jacobian_of_row(
            tab,
            tab.row(number, names),
            number,
            epoch,
            reference_row=tab.row(zero, names),
            reference_chip=zero,
        )
        if found is None or tab.covariance is None:
            return ChipPair(chips[reference], chips[other], None)
        basis = chips[number].basis
        parts.append(np.kron(np.eye(2), basis.from_monomials(np.eye(basis.n_terms)).T) @ found)
    joint = np.concatenate(parts)
    assert tab.covariance is not None
    cov = joint @ np.asarray(tab.covariance["COV"], float) @ joint.T
    return ChipPair(chips[reference], chips[other], (cov + cov.T) / 2)


def reference_first(tab: IdcTab) -> list[int]:
    """Numbers of the chips of an IDCTAB, chip 2 first, where stwcs puts the aperture's zero point.

    Parameters
    ----------
    tab : IdcTab
    """
    numbers = {int(n) for n in tab.rows["DETCHIP"]} if "DETCHIP" in tab.columns else {1}
    return sorted(numbers, key=lambda n: (n != 2, n))
