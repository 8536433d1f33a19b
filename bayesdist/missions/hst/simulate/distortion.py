"""Simulated distortion of ACS/WFC: model and true parameters.

The linear terms and their drift are those of ACS ISR 2015-06, Tables 1-3 and Section 4.4.1, in the
gauge of the report: WFC2 is the reference chip, with A_1 = B_1 = 0 and A_3 = 0, and WFC1 is in the
same system.  The report does not contain the higher terms.  They are invented here, with sizes that
agree to one or two digits with those in the IDCTABs of the observatory: displacements of some 65
pixels in the corners.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from bayesdist.errors import InputError
from bayesdist.model import Chip, DistortionModel, TimeDependence
from bayesdist.utils.arrays import Float

SM4 = 2009.4  # Servicing Mission 4, May 2009
EPOCH0 = (2004.5, 2012.5)  # RDATE of Tables 1-3
HALF = (2048.0, 1024.0)

CHIPS = (
    Chip(1, "WFC1", (4096.0, 2048.0), HALF),
    Chip(2, "WFC2", (4096.0, 2048.0), HALF),
)

# Tables 1-3: term -> chip -> alpha and beta before SM4, alpha and beta after it
DRIFT: dict[tuple[str, int, int], dict[int, tuple[float, float, float, float]]] = {
    ("u", 1, 0): {  # A_2
        1: (0.98205648, -9.22e-06, 0.98196909, -2.18e-05),
        2: (0.99468101, -9.16e-06, 0.99459657, -2.26e-05),
    },
    ("v", 1, 0): {  # B_2
        1: (0.080947069, 3.617e-05, 0.081139194, 3.235e-05),
        2: (0.068598586, 3.532e-05, 0.068779336, 3.070e-05),
    },
    ("v", 0, 1): {  # B_3
        1: (0.97263238, 2.42e-06, 0.97263233, -1.12e-06),
        2: (1.00622300, 3.30e-06, 1.00621870, -8.04e-07),
    },
}

# terms without drift: B_1 of WFC1 is published (2079.58 before SM4), A_1 and A_3 are invented
STILL: dict[int, dict[tuple[str, int, int], float]] = {
    1: {("u", 0, 0): 4.3, ("v", 0, 0): 2079.58, ("u", 0, 1): 0.0074},
    2: {},
}

# higher terms: displacement along u and v, in pixels, at (x', y') = (2048, 1024)
# fmt: off
SHAPE: dict[int, dict[tuple[int, int], tuple[float, float]]] = {
    1: {
        (2, 0): (35.0, -9.2), (1, 1): (-15.4, 11.8), (0, 2): (2.3, -9.8),
        (3, 0): (-4.2, 0.6), (2, 1): (-0.5, -1.8), (1, 2): (-1.1, -0.2), (0, 3): (0.1, -0.4),
        (4, 0): (0.3, -0.3), (3, 1): (0.3, -0.3), (2, 2): (0.4, -0.4), (1, 3): (-0.01, 0.03),
        (0, 4): (0.15, -0.15),
        (5, 0): (0.2, -0.2), (4, 1): (0.08, -0.09), (3, 2): (-0.06, 0.06), (2, 3): (-0.02, 0.0),
        (1, 4): (0.02, -0.03), (0, 5): (-0.01, 0.01),
    },
    2: {
        (2, 0): (35.6, -4.9), (1, 1): (-10.9, 12.3), (0, 2): (2.2, -7.5),
        (3, 0): (-4.2, 0.6), (2, 1): (-0.1, -2.3), (1, 2): (-1.1, -0.2), (0, 3): (0.0, -0.5),
        (4, 0): (0.4, -0.3), (3, 1): (0.02, -0.02), (2, 2): (0.2, -0.2), (1, 3): (-0.03, 0.01),
        (0, 4): (0.03, -0.02),
        (5, 0): (0.14, -0.12), (4, 1): (-0.06, 0.06), (3, 2): (0.03, 0.01), (2, 3): (0.01, 0.01),
        (1, 4): (-0.01, 0.03), (0, 5): (0.0, 0.01),
    },
}
# fmt: on

# scale relative to F606W, minus 1, from the offsets of A_2 over 2048 pixels in Figure 25: 0.05 px
# for F435W and F475W, and 0.1 px with opposite sign for F814W
SCALE = MappingProxyType(
    {"F435W": 0.05 / 2048, "F475W": 0.048 / 2048, "F606W": 0.0, "F814W": -0.1 / 2048}
)
# B_2 differs for only one filter and chip, by 0.06 px over 2048 pixels (Figure 26)
TURN = MappingProxyType({("F814W", 2): -0.06 / 2048})

ACS_FILTERS = tuple(SCALE)


def acs_model() -> DistortionModel:
    """Model of the simulation: order 5, two chips, drifts of A_2, B_2 and B_3 with a break at SM4.

    Returns
    -------
    DistortionModel
        Model in the gauge of the report, without frames of exposures.
    """
    return DistortionModel(5, CHIPS, "pix", TimeDependence(tuple(DRIFT), EPOCH0, (SM4,)))


def acs_solution(filter: str = "F606W") -> tuple[DistortionModel, Float]:
    """Simulated distortion in a filter.

    Parameters
    ----------
    filter : str
        One of `ACS_FILTERS`.  Filters differ by a scale about the reference pixel of WFC2, and
        F814W also by B_2 of WFC2.  The drifts are the same in all filters (Section 4.4.4).

    Returns
    -------
    model : DistortionModel
    theta : ndarray, shape (114,)
        True parameters.

    Raises
    ------
    InputError
        If the filter is unknown.
    """
    if filter not in SCALE:
        raise InputError(
            f"there is no filter {filter!r}", where="filter", do=f"choose {', '.join(SCALE)}"
        )
    model = acs_model()
    theta = np.zeros(model.n_params)
    for chip in CHIPS:
        monomial = np.zeros((2, model.n_terms))
        terms = model.basis(chip.number).terms
        for (i, j), displacement in SHAPE[chip.number].items():
            monomial[:, terms.index((i, j))] = np.array(displacement) / (
                HALF[0] ** i * HALF[1] ** j
            )
        for (axis, i, j), value in STILL[chip.number].items():
            monomial[int(axis == "v"), terms.index((i, j))] = value
        drift = []
        for (axis, i, j), values in DRIFT.items():
            before, rate, after, rate_after = values[chip.number]
            monomial[int(axis == "v"), terms.index((i, j))] = before
            # drifts of the model are displacements at half the size of the chip
            edge = HALF[0] ** i * HALF[1] ** j
            drift += [rate * edge, (after - before) * edge, rate_after * edge]
        monomial *= 1.0 + SCALE[filter]
        monomial[1, terms.index((1, 0))] += TURN.get((filter, chip.number), 0.0)
        for axis_code in (0, 1):
            theta[model.coefficient_slice(chip.number, axis_code)] = model.basis(
                chip.number
            ).from_monomials(monomial[axis_code])
        theta[model.tdd_slice(chip.number)] = drift
    return model, theta
