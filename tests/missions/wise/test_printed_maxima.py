"""Maxima that the report prints, from calibrations of simulated pairs with false matches.

Source: WSDC D-T033, section 4 (longest vectors, zeroth order suppressed) and Appendix B (A_DMAX,
B_DMAX).
"""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.assess import distortion_vectors
from bayesdist.formats.sip.build import sip_from_solution
from bayesdist.infer import Rejection, fit_linear
from bayesdist.missions.wise.meta_data.meta import read_wise_meta, write_wise_meta
from bayesdist.missions.wise.published import LONGEST_VECTORS, WISE_BANDS
from bayesdist.missions.wise.simulate import wise_set
from bayesdist.products.common.coefficients import evaluate
from tests.reduced import only_in_full

from .calibrations import CLIP_ABS, matches_of, pairs_of

# Appendix B: A_DMAX, B_DMAX
LARGEST_CORRECTIONS = {
    "W1": (2.046, 1.066),
    "W2": (2.083, 1.089),
    "W3": (2.095, 1.300),
    "W4": (0.971, 0.582),
}
# a longest vector is then known to 0.1 %; in W4 pairs are worst, and its vectors short
PAIRS = {"W1": 400_000, "W2": 400_000, "W3": 400_000, "W4": 2_500_000}


def reach(band: str, side: float) -> float:
    """Offset of the outermost places: the printed A_DMAX are those of pixel centres, W4's of edges.

    No printed vector of W4 can be had from the centres: there its longest one has 1.426 px.
    """
    return side / 2 - (0.0 if band == "W4" else 0.5)


def places(band: str, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (N,) from the centre over the array, corners and edges among them."""
    g = np.linspace(-reach(band, side), reach(band, side), 201)
    u, v = np.meshgrid(g, g)
    return u.ravel(), v.ravel()


@pytest.fixture(scope="module", params=WISE_BANDS)
def calibrated(request):
    one = wise_set(request.param, pairs=PAIRS[request.param], seed=3, partition=True)
    return request.param, fit_linear(
        matches_of(pairs_of(one)), one.model, rejection=Rejection(clip_abs=CLIP_ABS)
    )


@pytest.mark.slow
@only_in_full("tests/missions/wise/test_sip_wise has the longest vector")
def test_longest_vectors(calibrated):
    """To 0.5 %; in a corner, the zeroth order suppressed."""
    band, fit = calibrated
    side = fit.model.chips[0].size[0]
    centre = np.full(2, (side + 1) / 2)
    offset = np.column_stack(places(band, side))
    moved = fit.model.predict(fit.mean, *(offset + centre).T) - offset
    length = np.hypot(*(moved - fit.model.predict(fit.mean, *centre[:, None])[0]).T)
    assert length.max() == pytest.approx(LONGEST_VECTORS[band], rel=0.005)
    assert np.abs(offset[np.argmax(length)]).min() == reach(band, side)
    # what the report draws ends at pixel centres
    drawn = distortion_vectors(fit, grid=(33, 33), part="no_constant").length_max
    assert drawn == pytest.approx(length.max(), rel=0.005 if band == "W4" else 1e-9)


def test_largest_corrections(calibrated, tmp_path):
    """Within rounding and error; in the file where W4 is taken to the edges, the others are not."""
    band, fit = calibrated
    header = sip_from_solution(fit, linear="sip", inverse_order=4)
    write_wise_meta(tmp_path / "w.meta", {int(band[1]): header})
    [one] = read_wise_meta(tmp_path / "w.meta")
    u, v = places(band, fit.model.chips[0].size[0])
    phi = fit.model.basis().evaluate(u + header.crpix[0], v + header.crpix[1])
    for axis, (terms, printed) in enumerate(
        zip((header.a, header.b), LARGEST_CORRECTIONS[band], strict=True)
    ):
        at = phi[np.argmax(np.abs(evaluate(terms, u, v)))]
        rows = fit.model.coefficient_slice(None, axis)
        sigma = np.sqrt(at @ fit.cov[rows, rows] @ at)
        stated = float(one.printed[f"{'AB'[axis]}_DMAX"])
        # both numbers are rounded to three decimals
        assert abs(stated - printed) < 0.001 + 4 * sigma
        assert 4 * sigma < 0.01 * printed
