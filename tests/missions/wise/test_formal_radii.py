"""The error of a pair that a formal radius implies: against fits of pairs, and as published."""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.assess import uncertainty_map
from bayesdist.data import Matches
from bayesdist.errors import InputError
from bayesdist.infer import Rejection, fit_linear
from bayesdist.missions.wise.assess.residual_tables import TABLE_5_1, implied_sigma, printed_rows
from bayesdist.missions.wise.published import FORMAL_RADII, SAMPLE_SIZES, WISE_BANDS
from bayesdist.model import Chip, DistortionModel

SIZE = (1016.0, 1016.0)


@pytest.mark.parametrize("order", [1, 2, 4])
def test_fits_of_even_pairs_have_it(order):
    """The largest radius of a fit, at a corner of the array, gives the error of its pairs back."""
    k = 8.0 * np.arange(127) + 4.5
    x, y = (g.ravel() for g in np.meshgrid(k, k))
    n = x.size
    pairs = Matches(x, y, x, y, np.full(n, 0.1), np.full(n, 0.1))
    model = DistortionModel(order, (Chip(1, "A", SIZE, (508.5, 508.5)),))
    fit = fit_linear(pairs, model, rejection=Rejection(1e9, 1e9, 1.0))
    corner = uncertainty_map(fit, grid=(2, 2))  # centres of the outermost pixels
    assert implied_sigma(corner.radius_max, n, order=order) == pytest.approx(0.1, rel=0.01)


def test_a_corner_of_order_4_is_155():
    assert implied_sigma(np.sqrt(2.0), 155) == pytest.approx(1.0, rel=1e-12)


def test_the_published_radii_are_not_those_of_independent_pairs():
    """What the validation says: the error for each pair that the published radii imply."""
    implied = {band: implied_sigma(FORMAL_RADII[band], n) for band, n in SAMPLE_SIZES.items()}
    radial = {band: printed_rows(TABLE_5_1)[f"{band}/radial"].value["mean"] for band in WISE_BANDS}
    ratio = [implied[band] / (radial[band] / np.sqrt(np.pi / 2)) for band in WISE_BANDS]
    # 20, 17, 1.3 and 0.2: no factor that all bands share
    assert ratio == sorted(ratio, reverse=True)
    assert ratio[0] > 20 and ratio[3] < 0.25


def test_no_pairs_are_refused():
    with pytest.raises(InputError, match="0 pairs"):
        implied_sigma(0.01, 0)
