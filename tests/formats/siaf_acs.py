"""HRC and SBC as the Science Instrument Aperture File of HST has them.

Apertures JHRCFIX and JSBCFIX of siaf.dat in the observatory's PRD, as pysiaf 0.29.0 ships it.  The
files' physical overscan (19 columns for the HRC) is taken off the reference pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import polynomial

from bayesdist.calibration.chip_map import ChipMap, fitted_map

SIZE, ZERO, SCALE = (1024.0, 1024.0), (512.0, 512.0), 0.025

# Sci2IdlX, Sci2IdlY by the powers of x and y, arcseconds
COEFFICIENTS = {
    "HRC": (
        {
            (1, 0): 0.02828508, (0, 1): 0.0,
            (2, 0): -9.38035e-08, (1, 1): 2.550933e-07, (0, 2): -2.005112e-08,
            (3, 0): 2.7317e-12, (2, 1): -8.270567e-13, (1, 2): 1.159958e-11,
            (0, 3): -5.321904e-13,
            (4, 0): 9.15716e-15, (3, 1): -6.29138e-14, (2, 2): -3.80667e-14,
            (1, 3): -5.20913e-15, (0, 4): 9.9751e-16,
        },
        {
            (1, 0): 0.002874154, (0, 1): 0.02484302,
            (2, 0): 4.016919e-08, (1, 1): -4.040343e-08, (0, 2): 2.838485e-07,
            (3, 0): 1.142616e-11, (2, 1): 7.420373e-12, (1, 2): -1.450136e-11,
            (0, 3): 1.822777e-11,
            (4, 0): 7.55921e-15, (3, 1): -3.88504e-14, (2, 2): 2.08107e-14,
            (1, 3): -1.39277e-14, (0, 4): -3.16504e-14,
        },
    ),
    "SBC": (
        {
            (1, 0): 0.03354577, (0, 1): 0.0,
            (2, 0): -4.977968e-07, (1, 1): 3.950532e-07, (0, 2): 1.247304e-07,
            (3, 0): 1.448414e-10, (2, 1): 4.50008e-12, (1, 2): -8.744306e-11,
            (0, 3): -1.352112e-10,
            (4, 0): 4.92695e-13, (3, 1): -2.949e-14, (2, 2): 1.11587e-13,
            (1, 3): -3.70431e-14, (0, 4): -9.21844e-13,
        },
        {
            (1, 0): 0.00326176, (0, 1): 0.0300779,
            (2, 0): -3.569536e-08, (1, 1): 4.569743e-08, (0, 2): 3.158587e-07,
            (3, 0): 4.532078e-12, (2, 1): -2.235765e-10, (1, 2): 6.744296e-12,
            (0, 3): 3.564404e-11,
            (4, 0): 7.02595e-14, (3, 1): 1.30454e-13, (2, 2): 1.74492e-15,
            (1, 3): 1.92652e-13, (0, 4): -1.47338e-14,
        },
    ),
}  # fmt: skip


def siaf_calibration(detector: str) -> ChipMap:
    """The polynomials of an aperture, from its zero point."""
    matrices = []
    for terms in COEFFICIENTS[detector]:
        c = np.zeros((5, 5))
        for (i, j), value in terms.items():
            c[i, j] = value
        matrices.append(c)

    def positions(x, y):
        u, v = (polynomial.polyval2d(x - ZERO[0], y - ZERO[1], c) for c in matrices)
        return u, v

    return fitted_map(
        positions, f"SIAF, {detector}", order=4, size=SIZE, reference_pixel=ZERO,
        unit="arcsec", chip=1,
    )  # fmt: skip
