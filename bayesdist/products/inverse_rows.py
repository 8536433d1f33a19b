"""INVERSE rows of an IDCTAB in the output frame, and how well they undo its FORWARD rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesdist.errors import InputError
from bayesdist.products.application import Application
from bayesdist.products.idctab import IdcTab
from bayesdist.products.sip_inverse import detector_grid

__all__ = ["InverseRows"]

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class InverseRows:
    """The INVERSE row of one chip.

    Parameters
    ----------
    tab : IdcTab
    chip : int
    filter : list of str or None
    zero : ndarray, shape (2,)
        Output position of the chip's zero point.
    pixels_per_arcsec : float
        Of the output frame.
    closure, rms : float
        As of `InversePolynomial`: at the date of the forward positions.
    """

    tab: IdcTab
    chip: int
    filter: list[str] | None
    zero: Float
    pixels_per_arcsec: float
    closure: float = float("nan")
    rms: float = float("nan")

    @classmethod
    def of(
        cls, application: Application, tab: IdcTab | None, chip: int, filter: str | None, name: str
    ) -> InverseRows:
        """The row of a chip, with its error.

        Parameters
        ----------
        application : Application
            Of the same table.
        tab : IdcTab or None
            None is refused.
        chip : int
        filter : str or None
            Names of both wheels may be joined by a comma.
        name : str
            Of the file, for errors.

        Raises
        ------
        InputError
            Without INVERSE rows.
        """
        names = None if filter is None else [part.strip() for part in filter.split(",")]
        if tab is None or not tab.matching_rows(chip, names, "INVERSE").size:
            raise InputError(
                f"holds no INVERSE row of chip {chip}",
                where=name,
                do="choose --method newton or polynomial",
            )
        whole = Application(application.chips, application.frame)
        basis = whole.calibration(chip).basis
        x0, y0 = basis.reference_pixel
        at = whole.forward([x0], [y0], chip=chip)
        zero = np.array([at.x[0], at.y[0]])
        plain = cls(tab, chip, names, zero, whole.frame.pixels_per_unit)
        x, y = detector_grid(basis.size)
        there = whole.forward(x, y, chip=chip)
        miss = np.hypot(
            *(p - q for p, q in zip(plain.pixels(there.x, there.y), (x, y), strict=True))
        )
        return cls(
            tab,
            chip,
            names,
            zero,
            whole.frame.pixels_per_unit,
            float(miss.max()),
            float(np.sqrt(np.mean(miss**2))),
        )

    def pixels(self, X: ArrayLike, Y: ArrayLike) -> tuple[Float, Float]:
        """Pixels of the whole chip, FITS 1-based, from output positions (N,)."""
        Xc = (np.asarray(X, float) - self.zero[0]) / self.pixels_per_arcsec
        Yc = (np.asarray(Y, float) - self.zero[1]) / self.pixels_per_arcsec
        return self.tab.invert(self.chip, Xc, Yc, filter=self.filter)
