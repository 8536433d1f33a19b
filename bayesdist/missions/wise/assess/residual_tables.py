"""Tables 5-1, 5-2 and 5-3 of WSDC D-T033 for any bands, and their published values.

All statistics have errors.  The errors of single pairs that the published tables imply are computed
from their radial rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from itertools import combinations, product

import numpy as np

from bayesdist.diagnose.residuals.binned import BAND_AXES, BinnedSums
from bayesdist.diagnose.residuals.tables import STATISTICS, StatisticsTable, bin_row, pair_row
from bayesdist.errors import InputError
from bayesdist.model.basis import polynomial_terms

_AXES = BAND_AXES[:2]

HEADS = dict(
    zip(STATISTICS, ("Mean", "Sigma", "Min", "Max", "Median", "1%-tile", "99%-tile"), strict=True)
)

# columns as in HEADS
TABLE_5_1 = """
W1/X 0.002070 0.01949 -0.08298 0.06435 0.002512 -0.04942 0.04579
W1/Y -0.009074 0.01159 -0.04935 0.04348 -0.00373 -0.03837 0.0251
W1/radial 0.10500 0.01133 0.08822 0.1532 0.1024 0.08905 0.1389
W2/X 0.002548 0.01679 -0.05003 0.03995 0.003702 -0.03939 0.03376
W2/Y 0.01571 0.008914 -0.00831 0.09537 0.01525 -0.003964 0.04101
W2/radial 0.1153 0.008315 0.1003 0.1602 0.1141 0.1023 0.1402
W3/X 0.001249 0.01608 -0.07536 0.06285 0.000749 -0.04667 0.03709
W3/Y 0.003491 0.008846 -0.02428 0.05594 0.003343 -0.01592 0.02558
W3/radial 0.2993 0.01451 0.2736 0.3576 0.2971 0.2765 0.3421
W4/X -0.003836 0.0236 -0.07924 0.07422 -0.004239 -0.05865 0.04831
W4/Y 0.000638 0.02276 -0.07615 0.08211 0.001318 -0.05045 0.05234
W4/radial 0.4832 0.0156 0.4345 0.5377 0.4829 0.4487 0.5187
"""

TABLE_5_2 = """
W2-W1/X 0.00052 0.03326 -0.1078 0.09478 0.000037 -0.09063 0.08506
W2-W1/Y 0.05974 0.03211 -0.04772 0.1874 0.05815 -0.01593 0.1630
W3-W1/X -0.003054 0.04556 -0.2649 0.1186 -0.000803 -0.1474 0.08938
W3-W1/Y 0.02614 0.03602 -0.1187 0.2176 0.02591 -0.05655 0.1174
W4-W1/X -0.03016 0.1339 -0.4757 0.4248 -0.03325 -0.3536 0.2691
W4-W1/Y 0.01859 0.1267 -0.3999 0.4230 0.1710 -0.2721 0.3172
W3-W2/X -0.003574 0.04361 -0.2090 0.1282 0.000165 -0.1413 0.08150
W3-W2/Y -0.03360 0.03034 -0.1408 0.04692 -0.03316 -0.1147 0.02745
W4-W2/X -0.03068 0.1339 -0.4978 0.3718 -0.03169 -0.3679 0.2731
W4-W2/Y -0.04080 0.1273 -0.4553 0.3888 -0.03699 -0.3401 0.2463
W4-W3/X -0.02711 0.1257 -0.4398 0.3993 -0.02883 -0.3322 0.2591
W4-W3/Y -0.007193 0.1258 -0.4086 0.4141 -0.005563 -0.2878 0.2811
"""

TABLE_5_3 = """
W1/X 0.0 0.2073 -1.111 1.111 0.0 -0.5059 0.5059
W1/Y 0.0 0.0388 -0.1982 0.1982 0.0 -0.1005 0.1005
W2/X 0.0 0.06531 -0.2474 0.2474 0.0 -0.1471 0.1471
W2/Y 0.0 0.03467 -0.2851 0.2851 0.0 -0.08801 0.08801
W3/X 0.0 0.06256 -0.3801 0.3801 0.0 -0.1546 0.1546
W3/Y 0.0 0.03440 -0.2206 0.2206 0.0 -0.0829 0.0829
W4/X 0.0 0.1811 -0.8310 0.8310 0.0 -0.4249 0.4249
W4/Y 0.0 0.1764 -0.8766 0.8766 0.0 -0.4102 0.4102
"""


def residual_tables(
    bands: Mapping[str, BinnedSums],
    *,
    rng: np.random.Generator,
    arcsec: Mapping[str, float],
    absorbed: Mapping[str, int],
) -> dict[str, StatisticsTable]:
    """Residual tables '5-1', '5-2' and '5-3' of several bands.

    Table 5-1 has the residuals of the fit in bins, in pixels.  Table 5-2 has the differences of two
    bands bin by bin, and Table 5-3 the differences over all pairs of bins of a band, both in
    arcsec.  The errors of two bands are assumed to be independent.  If both use the same catalogue
    stars in the same frames, the errors of the catalogue cancel in the difference.  Its noise is
    then overestimated, and its noise-free part underestimated.

    Parameters
    ----------
    bands : mapping of str to BinnedSums
        Binned residuals of each band, with equal numbers of bins over the same field.
    rng : numpy.random.Generator
        Random generator for the errors.
    arcsec : mapping of str to float
        Arcsec per pixel of each band.
    absorbed : mapping of str to int
        Number of coefficients per axis that were fitted to these stars, for example 15 at order 4;
        1 for a model that was not fitted to them.

    Returns
    -------
    dict of str to StatisticsTable
        Tables that have rows; Table 5-2 needs at least two bands.

    Raises
    ------
    DegenerateError
        If too few bins of a band have two stars.
    """
    pixels = {(name, axis): bands[name].values(axis) for name, axis in product(bands, BAND_AXES)}
    scaled = {(name, axis): values.scaled(arcsec[name]) for (name, axis), values in pixels.items()}
    fitting = tuple(
        # the fit does not reduce the scatter of single stars (radial rows)
        bin_row(
            f"{name}/{axis}", values, absorbed=1 if axis == "radial" else absorbed[name], rng=rng
        )
        for (name, axis), values in pixels.items()
    )
    between = tuple(
        bin_row(
            f"{later}-{earlier}/{axis}",
            scaled[later, axis].minus(scaled[earlier, axis]),
            absorbed=max(absorbed[earlier], absorbed[later]),
            rng=rng,
        )
        for (earlier, later), axis in product(combinations(bands, 2), _AXES)
    )
    all_pairs = tuple(
        pair_row(f"{name}/{axis}", scaled[name, axis], absorbed=absorbed[name], rng=rng)
        for name, axis in product(bands, _AXES)
    )
    aligned = "Single-frameset band-to-band alignment residuals"
    within = "In-band multiframe alignment residuals"
    tables = {
        "5-1": StatisticsTable("Distortion fitting residuals", "Band/Axis", "pix", fitting),
        "5-2": StatisticsTable(aligned, "Bands/Axis", "arcsec", between),
        "5-3": StatisticsTable(within, "Band/Axis", "arcsec", all_pairs),
    }
    return {name: table for name, table in tables.items() if table.rows}


@dataclass(frozen=True)
class PrintedRow:
    """Row of a published table."""

    label: str
    value: Mapping[str, float]  # by the names in `STATISTICS`
    rounding: Mapping[str, float]  # half a unit of the last published digit


def printed_rows(text: str) -> dict[str, PrintedRow]:
    """Parse a published table into rows by label.

    Each line of `text` has a label and seven numbers in the order of `STATISTICS`.  Raises
    InputError for any other line.
    """
    out = {}
    for k, line in enumerate(text.strip().splitlines(), 1):
        label, *numbers = line.split()
        try:
            decimals = [Decimal(number) for number in numbers]
        except ArithmeticError:
            decimals = []
        if len(decimals) != len(STATISTICS) or not all(d.is_finite() for d in decimals):
            raise InputError(
                f"a row of statistics is a label and {len(STATISTICS)} numbers, not {line!r}",
                where=f"row {k}",
                do="correct the row",
            )
        value = {n: float(d) for n, d in zip(STATISTICS, decimals, strict=True)}
        half = {
            n: float(Decimal((0, (5,), int(d.as_tuple().exponent) - 1)))
            for n, d in zip(STATISTICS, decimals, strict=True)
        }
        out[label] = PrintedRow(label, value, half)
    return out


def noise_of_bins(mean_length: float, n_pairs: float, n_bins: int = 31 * 31) -> float:
    """Noise of the mean residuals in bins, from the mean length of single residuals.

    For normal errors s per axis the mean length of a residual is sqrt(pi / 2) s, which is given in
    the radial rows of Table 5-1.  The noise of the mean in a bin is s / sqrt(pairs per bin).

    Parameters
    ----------
    mean_length : float
        Mean of a radial row.
    n_pairs : float
        Number of pairs of the band (given in section 4), distributed uniformly over the bins.
    n_bins : int
        Number of bins.

    Returns
    -------
    float
        Noise per axis in the unit of `mean_length`.
    """
    return float(mean_length / np.sqrt(np.pi / 2) / np.sqrt(n_pairs / n_bins))


def implied_sigma(radius_max: float, n_pairs: int, *, order: int = 4) -> float:
    """Error per axis of a pair, from the largest position error of the fitted polynomial.

    If the pairs are distributed uniformly over the array, the coefficients of Legendre products are
    independent.  The product of degrees i and j then contributes the variance (2i + 1)(2j + 1) / N
    in a corner, where the error is largest.

    Parameters
    ----------
    radius_max : float
        Largest hypot(sigma_x, sigma_y) of the polynomial's position over the array.
    n_pairs : int
        Number of pairs, uniformly over the array.
    order : int
        Order of the polynomial.

    Returns
    -------
    float
        Error in the unit of `radius_max`.

    Raises
    ------
    InputError
        If there are no pairs.
    """
    if n_pairs < 1:
        raise InputError(f"{n_pairs} pairs are given", do="give at least one pair")
    corner = sum((2 * i + 1) * (2 * j + 1) for i, j in polynomial_terms(order))
    return float(radius_max / np.sqrt(2 * corner / n_pairs))
