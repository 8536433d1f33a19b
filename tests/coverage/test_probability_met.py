"""`probability_met` is a probability: of calibrations said to meet a limit with p, at least p do.

It is the share of draws of the error, draw less posterior mean, whose statistic over the detector
is at or under the limit.  The error that a calibration truly has is its mean less the truth.  With
flat priors on coefficients and drift nothing but the data says where the truth is, and the truth
less the mean, given the data, is distributed as the mean less the truth over data sets, up to the
sign, which no statistic sees: whatever the truth was.  So truths may be drawn from anywhere.  But a
limit must not know the data that it is for: it is set beforehand, from other calibrations of the
same kind.  What is drawn beside the solution (the reference catalogue's offset, what the model
leaves out at a place) is drawn anew in each truth as well.

The size of what the model leaves out has a prior, and truths here are not drawn from it: nothing is
left out, or a pattern of one size.  Where nothing is, more calibrations meet their limit than is
said, as the prior cannot exclude what the data cannot; where the pattern is, the distance from the
limit counts, and limits are spread evenly in the logarithm in place of sizes.  The probability is
a lower bound: no fewer meet their limit than is said.  That it is not a useless one is what
`test_total_errors` shows of widths, and tests/adversarial of verdicts.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, norm

from tests.reduced import only_in_full

from .runs import JUDGED, probabilities
from .summary import CONFIDENCE, excess, reliability

pytestmark = [
    pytest.mark.slow,
    only_in_full("tests/assess/test_requirements has probabilities of known distributions"),
]


@pytest.fixture(scope="module", params=JUDGED)
def found(request):
    return request.param, *probabilities(request.param)


def test_no_fewer_meet_their_limit_than_is_said(found, capsys):
    kind, said, met = found
    bins = reliability(said, met)
    with capsys.disabled():
        for one in bins:
            low, high = one.band()
            print(
                f"\n{kind}: said {one.said:.3f}, met {one.met:.3f} of {one.n} "
                f"({low:.3f} to {high:.3f})",
                end="",
            )
        print(f"\n{kind}: more than is said, in standard deviations: {excess(said, met):.2f}")
    for one in bins:
        assert one.met >= one.band(len(bins))[0], one
    assert excess(said, met) > -norm.ppf(0.5 + CONFIDENCE / 2)
    # what the claim is about: enough of them, and their own band
    near = (said >= 0.8) & (said < 0.95)
    assert near.sum() >= 20
    n, share = int(near.sum()), float(said[near].mean())
    assert met[near].sum() >= binom.ppf(0.005, n, share)


def test_the_limits_are_near_the_errors(found):
    """Or nothing is shown: probabilities on both sides, many of them neither 0 nor 1."""
    _, said, _ = found
    assert (said < 0.5).any() and (said > 0.8).any()
    assert np.mean((said > 0.02) & (said < 0.98)) >= 0.5
