"""Section 4.4.4 of ACS ISR 2015-06: is the drift the same in every filter?"""

from __future__ import annotations

import numpy as np
import pytest

from bayesdist.errors import DegenerateError, InputError
from bayesdist.kinds.campaign.series import ChangeAtBreak, TrendModel, filter_dependence, fit_series
from tests.reduced import only_in_full

from .campaign import LINES, campaign

FILTERS = {"F606W": 70, "F814W": 25, "F435W": 20}


def by_filter(answer, draws) -> dict[str, ChangeAtBreak]:
    """Changes (n, filters, k) of all filters but the first, by name."""
    return {name: ChangeAtBreak.of(draws[:, k]) for k, name in enumerate(answer.names[1:])}


@pytest.mark.slow
@only_in_full("tests/app/campaign has one")
def test_a_common_drift():
    truth = campaign(11, filters=FILTERS)
    answer = filter_dependence(truth.series, LINES)
    assert answer.names == ("F606W", "F814W", "F435W")
    assert not answer.depends
    assert answer.all_slopes.p_value > 0.01
    offsets = by_filter(answer, answer.common.group_offset)
    for place, name in enumerate(("F814W", "F435W"), start=1):
        offset = offsets[name]
        assert (np.abs(offset.value - 3e-5 * place) < 4 * offset.sigma).all()
        assert by_filter(answer, answer.separate.group_slope)[name].p_value > 0.001
    # a prediction in another filter is shifted by its offset
    first, other = (answer.common.predict([2012.0], group=g).mean for g in ("F606W", "F814W"))
    np.testing.assert_allclose(other - first, [offsets["F814W"].value], rtol=1e-6)


def test_a_drift_of_its_own():
    own = np.array([0.0, -1.2e-5, 0.0])
    truth = campaign(12, filters=FILTERS, slopes={"F814W": own})
    answer = filter_dependence(truth.series, LINES)
    compared = answer.comparison
    places = (compared.posteriors.index(p) for p in (answer.separate, answer.common))
    gain, error = compared.difference(*places)
    assert answer.depends and gain > 2 * error
    slopes = by_filter(answer, answer.separate.group_slope)
    found = slopes["F814W"]
    assert (np.abs(found.value - own) < 4 * found.sigma).all()
    assert abs(found.significance[1]) > 4 and slopes["F435W"].p_value > 0.001
    assert answer.all_slopes.p_value < 1e-5
    assert len(answer.all_slopes.value) == 6


def test_wrong_questions():
    truth = campaign(13, filters={"F606W": 60, "F814W": 2})
    with pytest.raises(DegenerateError, match="2 exposures of group 'F814W'"):
        filter_dependence(truth.series, LINES)
    with pytest.raises(InputError, match="no slopes"):
        filter_dependence(truth.series, TrendModel("constant"))
    with pytest.raises(InputError, match="fewer than two filters"):
        filter_dependence(campaign(13).series, LINES)
    common = campaign(14, filters={"F606W": 40, "F814W": 20})
    fitted = fit_series(common.series, LINES)
    with pytest.raises(InputError, match="have common slopes"):
        _ = fitted.group_slope
